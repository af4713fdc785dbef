"""The Python API: a chain of stages as a callable object."""

import threading
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple, Unpack

import numpy as np
from xxhash import xxh3_64_hexdigest

from clpipe.base.errors import ImageError, RequestError
from clpipe.base.readonly import ReadOnly
from clpipe.base.text import as_texts, unknown_name
from clpipe.base.types import Array
from clpipe.base.user_warnings import warn
from clpipe.base.validation import check_argument_types
from clpipe.chain.chain import Chain
from clpipe.chain.drawing import plain_settings
from clpipe.chain.entering import prepare_image
from clpipe.chain.files import load_settings
from clpipe.chain.identity import image_key, noise_key
from clpipe.chain.layers import layer_of_array, layer_steps, reader_of
from clpipe.chain.making import make_chain
from clpipe.chain.methods import base_name
from clpipe.chain.overscan import margins_of_array
from clpipe.chain.paths import resolve_paths
from clpipe.chain.python_words import errors_in_python, python_words
from clpipe.chain.registry import load_stage_file, loaded_stage_files
from clpipe.chain.settings import Settings, overlay, settings_from
from clpipe.chain.unused import ImageFacts, unused_values
from clpipe.engine.clipping import WARNING_SHARE, clipped_share, clipping_text
from clpipe.engine.device import Device, open_device
from clpipe.engine.options import RunOptions
from clpipe.engine.runner import Result
from clpipe.engine.service import Frame, Service, picture
from clpipe.engine.state import State
from clpipe.images.arrays import as_array, as_image, as_stack
from clpipe.images.kinds import MIN_CHANNELS, flow_vectors
from clpipe.reference.carried import RESAMPLING, Layer, LayerKind, warp
from clpipe.reference.geometry import NO_MARGINS, Margins
from clpipe.stage import ImageLayer, Kind

if TYPE_CHECKING:
    from clpipe.chain.keywords import Keywords


class Prepared(NamedTuple):
    """An image that :meth:`Pipeline.prepare` has prepared.

    Args:
        chain: its chain, which holds only weak references to ``layers``.
        pixels: its pixels.
        own_key: its image key.
        layers: the layers that steps read, by step.
        warnings: warnings about the image.
    """

    chain: Chain
    pixels: Array
    own_key: str
    layers: Mapping[str, ImageLayer]
    warnings: tuple[str, ...]


class Pipeline(ReadOnly):
    """A chain of stages on a device. Call it with an image, see :meth:`process`.

    >>> import numpy as np
    >>> import clpipe
    >>> camera = clpipe.Pipeline(iso=3200, device="numpy", denoise={"luma_strength": 0.3})
    >>> render = np.full((24, 32, 3), 0.2, np.float32)  # linear light
    >>> shot = camera(render, "frame_0001")
    >>> shot.image.shape, shot.image.dtype
    ((24, 32, 3), dtype('uint8'))

    Args:
        config: a built-in configuration, such as "default" or "paper", or a TOML file. If you name
            several, each overrides those before it, and one with ``stages`` replaces their
            development.
        device: an index or part of a name from ``clpipe devices``, or "numpy". None is the first
            GPU, else the CPU.
        keep: steps whose images are also returned, or "all".
        start_at: the first step to run. Images must be of the kind that it reads.
        until: the last step to run.
        **settings: any value of a configuration file, which overrides ``config``: ``iso=3200``,
            ``denoise={"method": "mean"}``. A draw, such as ``iso={"choice": [100, 800]}``, depends
            on the key of the image.

    A pipeline can be pickled, for example for ``multiprocessing``. Each process opens the device
    for itself. OpenCL does not survive a fork, so start processes with "spawn" or "forkserver".

    Raises:
        RequestError: a name or value is not allowed.
        DeviceError: there is no usable device.
    """

    _is_sequence: ClassVar[bool] = False  # whether images are frames of a sequence

    @errors_in_python()
    @check_argument_types
    def __init__(
        self,
        config: str | Path | Sequence[str | Path] = "default",
        *,
        device: str | int | None = None,
        keep: str | Sequence[str] | None = None,
        start_at: str | None = None,
        until: str | None = None,
        **settings: "Unpack[Keywords]",
    ) -> None:
        self._settings = overlay(
            load_settings(*as_texts(config)), resolve_paths(None, plain_settings(settings))
        )
        self._chain_range = start_at, until
        self._keep = tuple(as_texts(keep))
        self._selector = None if device is None else str(device)
        self._count = 0
        self._open()
        images = ImageFacts(self._is_sequence, from_files=False)
        for note in unused_values(self._settings, self.chain, images):
            warn(note)

    def _open(self) -> None:
        """Build the chain, and open the device in this process."""
        self._lock = threading.Lock()  # guards the count of images
        self._default_chain = self._chain(self._settings)
        self._kept = self._default_chain.select(self._keep)
        self._service = Service([open_device(self._selector)])

    def __getstate__(self) -> dict[str, Any]:
        """Return the arguments, because a device cannot leave its process."""
        names = "_chain_range", "_keep", "_selector", "_count"
        state = {name: vars(self)[name] for name in names}
        code = loaded_stage_files(base_name(name) for name in self._settings.stages)
        return {**state, "settings": self._settings.record(), "stage_files": code}

    def __setstate__(self, state: dict[str, Any]) -> None:
        for file in state.pop("stage_files"):
            load_stage_file(file)
        self._settings = settings_from(state.pop("settings"))
        vars(self).update(state)
        self._open()

    def _chain(self, settings: Settings) -> Chain:
        start_at, until = self._chain_range
        return make_chain(settings, start_at=start_at, until=until)

    def __repr__(self) -> str:
        device_name = self.device.info.label if self.device else "numpy"
        return f"Pipeline({self._settings.label}, {self.chain.label}, on {device_name})"

    @property
    def settings(self) -> Settings:
        """The settings of all images, with draws that are not drawn yet."""
        return self._settings

    @property
    def device(self) -> Device | None:
        """The device; None is NumPy."""
        return self._service.devices[0]

    @property
    def chain(self) -> Chain:
        """The steps of the chain, each with its resolved parameters."""
        return self._default_chain

    def process(
        self,
        image: Array,
        key: str = "",
        depth: Array | None = None,
        overscan: tuple[int, int, int, int] = NO_MARGINS,
        **settings: "Unpack[Keywords]",
    ) -> Result:
        """Run the chain on one image. ``camera(image)`` is the same as ``camera.process(image)``.

        Noise is deterministic: the same image, key, seed and ISO give the same noise. To get other
        noise, pass another key.

        >>> import numpy as np
        >>> import clpipe
        >>> camera = clpipe.Pipeline(iso=3200, device="numpy", keep="quantize")
        >>> render = np.full((24, 32, 3), 0.2, np.float32)
        >>> shot = camera.process(render, "frame_0001")
        >>> shot.kept["quantize"].shape  # the raw, in DN
        (24, 32)
        >>> again = camera.process(render, "frame_0001")
        >>> other = camera.process(render, "frame_0002", iso=6400)
        >>> bool((again.image == shot.image).all()), bool((other.image == shot.image).all())
        (True, False)

        Args:
            image: a NumPy array, or a CPU tensor of any library with DLPack. If the chain starts on
                RGB, it is (height, width, 3), linear, and 1 is white. The sensor saturates at 2,
                unless ``exposure`` is changed. If the chain starts on a mosaic or a raw, it is
                (height, width). The type is float16, float32 or float64, also uint16 for raws and
                uint8 for display values.
            key: the name of the image. Draws depend on the key and the seed. Noise also depends on
                the pixels and the ISO. To give several images or ISOs the same noise, pass them one
                ``noise_key``, which replaces all of these. To repeat the noise of a picture of
                ``clpipe run``, pass the ``noise_key`` of its sidecar.
            depth: (height, width), for depth of field, in the unit that the stage defocus states.
                The background is infinite, 0, or 1e9 and more.
            overscan: the margins of image and depth outside the picture, in px: left, top, right
                and bottom. A lens with distortion shows a part of them.
            **settings: values for this image only, as for the class. Another ISO, gain or noise
                parameter costs nothing. For another method or size, kernels are compiled.

        Returns:
            A :class:`~clpipe.Result`. Its ``image`` is (height, width, 3) uint8 if the chain ends
            in display values, else float32. Its ``kept`` contains the images of ``keep`` by step,
            float32.

        Raises:
            ImageError: the image has a wrong shape or type, is not finite, or is too large.
            RequestError: a name or value is not allowed.
        """
        arrays = {} if depth is None else {"depth": depth}
        with errors_in_python():
            prepared = self.prepare(image, key, arrays, overscan, settings)
            result = self.develop(prepared)
        self._announce(key, prepared, result)
        return result

    def develop(self, prepared: Prepared, state: State | None = None) -> Result:
        """Return the result of an image that :meth:`prepare` has prepared.

        ``state`` is the state of the sequence that the image is a frame of.

        Raises:
            ImageError: the image is too large.
        """
        frame = self._frame(prepared, RunOptions(state=state))
        return self._with_origin(self._service.run(frame), prepared)

    def _frame(self, prepared: Prepared, options: RunOptions) -> Frame:
        """Return a prepared image for the service."""
        seed = noise_key(prepared.chain.settings, prepared.own_key)
        return picture(prepared.chain, prepared.pixels, seed, self._kept, options)

    def prepare(
        self,
        image: Array,
        key: str,
        arrays: Mapping[str, Array],
        overscan: tuple[int, int, int, int],
        settings: Mapping[str, Any],
        earlier: Prepared | None = None,
    ) -> Prepared:
        """Return an image with what runs the chain on it.

        Arguments and errors are those of :meth:`process`. ``arrays`` are its layers, by kind. If
        the image was prepared before, with other settings, ``earlier`` saves time.
        """
        chain = self._chain_for(key, settings)
        for name in chain.light_layer_steps:
            raise RequestError(
                f"{name}: it needs a layer of flickering light, which an array does not have. "
                "Use clpipe run, which reads the layer from the render's file"
            )
        try:
            checked = earlier.pixels if earlier else as_image(image, chain.source, chain.bands)
        except ImageError as error:
            raise ImageError(f"{key}: {error}" if key else str(error)) from None
        margins = margins_of_array(overscan, checked)

        def layer(chain: Chain, step: str, width: int, height: int, kept: Margins) -> ImageLayer:
            if earlier:
                return earlier.layers[step]
            kind = layer_steps(chain)[step].layer_kind
            array = as_array(arrays[kind], kind) if kind in arrays else None
            cropped = array if array is None or kept else margins.cropped(array)
            return layer_of_array(chain, step, cropped, width, height)

        entered = prepare_image(chain, checked, margins, layer)
        unread = sorted(arrays.keys() - {each.kind for each in entered.layers.values()})
        notes = [f"no step reads the {kind}. Set {reader_of(kind)} to use it" for kind in unread]
        texts = (*notes, *entered.warnings)
        chain, pixels = entered.chain, entered.pixels
        if earlier:
            return Prepared(chain, pixels, earlier.own_key, entered.layers, texts)
        digest = "" if chain.settings.noise_key else digest_of(pixels)
        return Prepared(chain, pixels, image_key(key, digest), entered.layers, texts)

    __call__ = process

    @errors_in_python()
    def carry(
        self,
        layer: Array,
        kind: LayerKind,
        key: str = "",
        overscan: tuple[int, int, int, int] = NO_MARGINS,
        **settings: "Unpack[Keywords]",
    ) -> tuple[Array, Array]:
        """Warp a ground-truth layer of an image like :meth:`process` warps its pixels.

        >>> import numpy as np
        >>> import clpipe
        >>> camera = clpipe.Pipeline(
        ...     device="numpy", distortion={"method": "brown_conrady", "fx": 30, "k1": 0.2}
        ... )
        >>> depth, valid = camera.carry(np.full((24, 32), 2.5, np.float32), "depth")
        >>> depth.shape, valid.shape
        ((24, 32), (24, 32))

        Args:
            layer: (height, width[, channel]) of any type, as large as the image.
            kind: selects the interpolation. "depth" is interpolated linearly in 1/depth. "normal"
                is interpolated bilinearly and normalised to length 1. "flow" contains vectors in
                px, to the right and down; they are interpolated bilinearly, and both ends are
                warped. At edges between surfaces, these three take the nearest pixel. "label"
                always takes the nearest pixel. "colour" is blended.
            key: the name of the image, on which draws depend.
            overscan: as for :meth:`process`.
            **settings: as for :meth:`process`.

        Returns:
            The warped layer, and a mask of (height, width). Both are 0 where the image has no
            content, and the mask is 1 elsewhere.

        Raises:
            ImageError: the layer does not fit its kind.
            RequestError: a name or value is not allowed.
        """
        if kind not in RESAMPLING:
            raise RequestError(unknown_name("kind", str(kind), RESAMPLING))
        layer = as_array(layer, "layer")
        if layer.ndim not in (2, 3) or not layer.size:
            raise ImageError(f"found a layer of {layer.shape}; expected (height, width[, channel])")
        pixels = layer.reshape(*layer.shape[:2], -1)
        if pixels.shape[2] < (least := MIN_CHANNELS.get(kind, 1)):
            raise ImageError(f"found {pixels.shape[2]} channels; {kind} has {least} or more")
        vectors = flow_vectors("", ("",) * pixels.shape[2]) if kind == "flow" else ()
        margins = margins_of_array(overscan, layer)
        entered = prepare_image(self._chain_for(key, settings), pixels, margins)
        source_layer = Layer(kind, entered.pixels, vectors=vectors)
        size = entered.pixels.shape[1::-1]
        (warped,), valid = warp([source_layer], entered.chain.geometry, *size)
        return warped if layer.ndim == 3 else warped[..., 0], valid

    def _chain_for(self, key: str, settings: Mapping[str, Any]) -> Chain:
        """Return the chain of an image, with its own draws and settings.

        Raises:
            DeviceError: this process was forked from the one that opened the device.
        """
        if self.device:
            self.device.check_process()
        own = self._settings
        if settings:
            own = overlay(own, resolve_paths(None, plain_settings(settings)))
        return self._chain(own.drawn(key)) if settings or own.draws else self.chain

    def process_many(
        self,
        images: Array | Iterable[Array | tuple[Array, str | Mapping[str, Any]]],
        names: Sequence[str] | None = None,
        views: Sequence[Mapping[str, Any]] | None = None,
        times: Sequence[float] | None = None,
        **settings: "Unpack[Keywords]",
    ) -> Iterator[Result]:
        """Run the chain on several images, or on a stack of views.

        Images of an iterable are processed one by one, when you take their results. The views of a
        stack are processed together, which costs less for small ones. Their results are the same
        as one by one.

        >>> import numpy as np
        >>> import clpipe
        >>> camera = clpipe.Pipeline(iso=800, device="numpy")
        >>> render = np.full((24, 32, 3), 0.2, np.float32)
        >>> images = [(render, "a"), (render, {"key": "b", "iso": 3200})]
        >>> [shot.image.shape for shot in camera.process_many(images)]
        [(24, 32, 3), (24, 32, 3)]
        >>> stack = np.stack([render, render / 2])
        >>> views = [{"camera": "sony-a7r2"}, {"camera": "nikon-d850", "iso": 100}]
        >>> shots = camera.process_many(stack, ["left", "right"], views, times=[0.5, 0.5])
        >>> [(shot.image.shape, shot.camera.iso, shot.camera.time) for shot in shots]
        [((24, 32, 3), 800.0, 0.5), ((24, 32, 3), 100.0, 0.5)]

        Args:
            images: a stack of views, (view, height, width, 3), like an image of :meth:`process`.
                Or images, or pairs of an image and its key, or pairs of an image and a dict of
                arguments of :meth:`process`, such as ``{"key": "a", "iso": 800}``. The default key
                is the number of the image ("0", "1", ...), which continues in further calls.
            names: the keys of the views of a stack.
            views: the settings of each view of a stack.
            times: the times of the views of a stack, in s, for their ``camera``.
            **settings: values for all images.

        Raises:
            ImageError, RequestError: as for :meth:`process`, or there are not as many names, views
                or times as views in the stack.
        """
        is_stack = any(hasattr(images, name) for name in ("__dlpack__", "__array_interface__"))
        if is_stack:
            with errors_in_python():
                stack = as_stack(images, "images", names=names, views=views, times=times)
                yield from self._process_stack(stack, names, views, times, settings)
            return
        if any(given is not None for given in (names, views, times)):
            raise RequestError(
                "names, views and times belong to the views of a stack, (view, height, width, 3); "
                "for other images, pass pairs of an image and its arguments"
            )
        for item in images:
            if isinstance(item, tuple) and len(item) != 2:
                raise ImageError(f"found a tuple of {len(item)}; expected an image and its key")
            image, arguments = item if isinstance(item, tuple) else (item, {})
            keywords = {"key": arguments} if isinstance(arguments, str) else arguments
            yield self.process(image, **{"key": self._next_key(), **settings, **keywords})

    def _process_stack(
        self,
        stack: Array,
        names: Sequence[str] | None,
        views: Sequence[Mapping[str, Any]] | None,
        times: Sequence[float] | None,
        settings: Mapping[str, Any],
    ) -> list[Result]:
        """Return the results of the views of a stack, see :meth:`process_many`."""
        keys = [self._next_key() for _ in stack] if names is None else names
        own = [{**settings, **each} for each in views or [{}] * len(stack)]
        triples = zip(stack, keys, own, strict=True)
        prepared = [self.prepare(view, key, {}, NO_MARGINS, one) for view, key, one in triples]
        frames = [self._frame(each, RunOptions()) for each in prepared]
        results = []
        for number, development in enumerate(self._service.develop(frames)):
            result = self._with_origin(development.result(), prepared[number])
            if times is not None:
                result = replace(result, time=float(times[number]))
            self._announce(keys[number], prepared[number], result)
            results.append(result)
        return results

    def _next_key(self) -> str:
        """Return the number of the next image without a name."""
        with self._lock:
            self._count += 1
            return str(self._count - 1)

    @staticmethod
    def _with_origin(result: Result, prepared: Prepared) -> Result:
        return replace(result, origin=(prepared.chain, prepared.pixels.shape[1::-1]))

    @staticmethod
    def _announce(key: str, prepared: Prepared, result: Result) -> None:
        """Issue the warnings about an image."""
        for text in prepared.warnings:
            warn(f"{key}: {python_words(text)}")
        share = clipped_share(result, prepared.chain) or 0.0
        # Photographs are already clipped.
        if share >= WARNING_SHARE and prepared.chain.source is not Kind.DISPLAY:
            warn(f"{key}: {clipping_text(share)}")


def digest_of(image: Array) -> str:
    """Return a fast digest of the samples of an image."""
    return xxh3_64_hexdigest(np.ascontiguousarray(image).data)
