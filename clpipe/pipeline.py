"""The Python API: a chain as an object that takes NumPy images."""

import itertools
import threading
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Unpack

import numpy as np
from xxhash import xxh3_64_hexdigest

from clpipe.base.errors import ImageError, RequestError
from clpipe.base.readonly import ReadOnly
from clpipe.base.text import one_of, several
from clpipe.base.types import Array, plain
from clpipe.base.validation import typed
from clpipe.chain.chain import Chain
from clpipe.chain.depth import depth_of_array
from clpipe.chain.entering import enter
from clpipe.chain.files import load_settings
from clpipe.chain.identity import image_key, noise_key
from clpipe.chain.making import make_chain
from clpipe.chain.overscan import margins_of_array
from clpipe.chain.settings import Settings, overlay
from clpipe.engine.clipping import MUCH, clipped_share, clipping_text
from clpipe.engine.device import open_device
from clpipe.engine.runner import Result, Runner
from clpipe.images.arrays import as_array, as_image
from clpipe.images.kinds import CHANNELS, vectors_of
from clpipe.reference.carried import RESAMPLING, Layer, LayerKind, warp
from clpipe.reference.defocus import Depth
from clpipe.reference.geometry import NO_MARGINS, Margins
from clpipe.stage import Kind

if TYPE_CHECKING:
    from clpipe.chain.keywords import Keywords


class Pipeline(ReadOnly):
    """A chain of stages on a device, ready for images.

    Args:
        config: a built-in configuration ("default", "paper") or a TOML file, or several, each over
            those before it: of a second one with ``stages``, the development.
        device: an index or a part of a name as ``clpipe devices`` lists them, or "numpy"; None
            takes the first GPU, else the CPU.
        keep: steps whose image is returned beside the last one, or "all".
        start_at: the first step to run; images are then of the kind that it reads.
        until: the last step to run.
        **settings: what a configuration file may hold, over ``config``: ``iso=3200``,
            ``denoise={"method": "mean"}``, ``iso={"choice": [100, 800]}`` (drawn by image key).

    Raises:
        RequestError: a name or value that is not allowed.
        DeviceError: there is no usable device.
    """

    @typed
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
        self._settings = overlay(load_settings(*several(config)), plain(settings))
        self._ends = start_at, until
        self._numbers = itertools.count()
        self._lock = threading.Lock()  # lets one thread use the device at a time
        chain = self._chain(self._settings)
        kept = chain.select(several(keep))
        encode = chain.result is Kind.DISPLAY
        on = open_device(None if device is None else str(device))
        self._runner = Runner(chain, on, kept, encode=encode, final=not encode)

    def _chain(self, settings: Settings) -> Chain:
        start_at, until = self._ends
        return make_chain(settings, start_at=start_at, until=until)

    def __repr__(self) -> str:
        device = self._runner.device
        where = device.info.label if device else "numpy"
        return f"Pipeline({self._settings.label}, {self.chain.label}, on {where})"

    @property
    def chain(self) -> Chain:
        """The steps, each with its resolved parameters."""
        return self._runner.chain

    def process(
        self,
        image: Array,
        key: str,
        depth: Array | None = None,
        overscan: tuple[int, int, int, int] = NO_MARGINS,
        **settings: "Unpack[Keywords]",
    ) -> Result:
        """Run the chain on one image.

        Args:
            image: (height, width, 3) linear RGB, 1 = full scale of the sensor, of float16, float32
                or float64; or (height, width) where the chain starts on a mosaic, also of uint16;
                or a finished picture, also of uint8, where it starts on one. A NumPy array, or a
                tensor of any library with DLPack that is on the CPU.
            key: the image's name. Draws depend on it and on the seed alone; noise on both, on what
                the image holds, and on the ISO. Who wants the same noise in several images, or in
                one at several ISOs, gives them one ``noise_key``, which replaces these; that of a
                picture of ``clpipe run`` stands in its sidecar, and repeats its noise.
            depth: (height, width), for a chain with depth of field: in the unit that defocus says;
                infinite, 1e9 or more or 0 where there is nothing.
            overscan: how far, in px, image and depth go on beyond the picture: to the left, at the
                top, to the right and at the bottom. A lens shows what it sees of that.
            **settings: values for this image alone, as for the class. Another ISO, gain or noise
                parameter costs nothing; for another method or size, kernels are compiled.

        Returns:
            ``image`` is (height, width, 3) uint8 where the chain ends in display values, else
            float32; ``kept`` has the images of ``keep``, float32, by their names.

        Raises:
            ImageError: an image of the wrong shape or type, not finite, or too large.
            RequestError: a name or value that is not allowed.
        """
        runner = self._runner_for(key, settings)
        for name in runner.chain.lit_by_layers:
            raise RequestError(
                f"{name}: found a layer of the light that flickers, which an array has "
                "not; clpipe run takes it from the render's file"
            )
        try:
            checked = as_image(image, runner.chain.source)
        except ImageError as error:
            raise ImageError(f"{key}: {error}") from None
        margins = margins_of_array(overscan, checked)

        def depth_of(chain: Chain, width: int, height: int, kept: Margins) -> Depth:
            given = None if depth is None else as_array(depth, "depth")
            cropped = given if given is None or kept else margins.cropped(given)
            return depth_of_array(cropped, width, height)

        own = enter(runner.chain, checked, margins, depth_of)
        if depth is not None and own.depth is None:
            unread = "depth is given, but no step reads it; defocus.method=thin_lens does"
            warnings.warn(f"{key}: {unread}", stacklevel=2)
        for warning in own.warnings:
            warnings.warn(f"{key}: {warning}", stacklevel=2)
        chain, pixels = own.chain, own.pixels
        runner = runner if chain is runner.chain else runner.for_chain(chain)
        own_key = image_key(key, "" if chain.settings.noise_key else digest_of(pixels))
        with self._lock:
            result = runner.run(pixels, noise_key(chain.settings, own_key))
        share = clipped_share(result, chain) or 0.0
        if share >= MUCH and chain.source is not Kind.DISPLAY:  # a photograph was clipped before
            warnings.warn(f"{key}: {clipping_text(share)}", stacklevel=2)
        return result

    def carry(
        self,
        layer: Array,
        kind: LayerKind,
        key: str = "",
        overscan: tuple[int, int, int, int] = NO_MARGINS,
        **settings: "Unpack[Keywords]",
    ) -> tuple[Array, Array]:
        """Move a layer that goes along with an image as :meth:`process` moves its pixels.

        Args:
            layer: (height, width[, channel]) of any type, as large as the image.
            kind: "depth" is interpolated linearly in 1/depth within a surface, a "normal"
                bilinearly and then as long as 1, and so is a "flow", whose vectors in px to the
                right and down are mapped at both ends. Between two surfaces these are taken from
                the nearest pixel. A "label" always is; a "colour" is blended.
            key: the image's name, on which draws depend.
            overscan: as for :meth:`process`.
            **settings: as for :meth:`process`.

        Returns:
            The layer as it is in the picture, 0 where the image has nothing, and a mask of (height,
            width) that is 0 there, else 1.

        Raises:
            ImageError: it is no layer of that kind.
            RequestError: a name or value that is not allowed.
        """
        if kind not in RESAMPLING:
            raise RequestError(one_of("kind", str(kind), RESAMPLING))
        layer = as_array(layer, "layer")
        if layer.ndim not in (2, 3) or not layer.size:
            raise ImageError(f"found a layer of {layer.shape}; expected (height, width[, channel])")
        pixels = layer.reshape(*layer.shape[:2], -1)
        if pixels.shape[2] < (least := CHANNELS.get(kind, 1)):
            raise ImageError(f"found {pixels.shape[2]} channels; {kind} has {least} or more")
        vectors = vectors_of("", ("",) * pixels.shape[2]) if kind == "flow" else ()
        margins = margins_of_array(overscan, layer)
        own = enter(self._runner_for(key, settings).chain, pixels, margins)
        along = Layer(kind, own.pixels, vectors=vectors)
        (moved,), valid = warp([along], own.chain.geometry, *own.pixels.shape[1::-1])
        return moved if layer.ndim == 3 else moved[..., 0], valid

    def _runner_for(self, key: str, settings: Mapping[str, Any]) -> Runner:
        """The runner for an image, with what is drawn and set for it alone."""
        own = overlay(self._settings, plain(settings)) if settings else self._settings
        return (
            self._runner.for_chain(self._chain(own.drawn(key)))
            if settings or own.draws
            else self._runner
        )

    def process_many(
        self, images: Iterable[Array | tuple[Array, str | Mapping[str, Any]]]
    ) -> Iterator[Result]:
        """Run the chain on images, each when its result is taken from the iterator.

        Args:
            images: each is an image, whose key is then its number ("0", "1", ..., counted on from
                call to call), or an image with its key, or an image with a dict of further
                arguments of :meth:`process`, such as ``{"key": "a", "iso": 800}``.
        """
        for item in images:
            image, arguments = item if isinstance(item, tuple) else (item, {})
            named = {"key": arguments} if isinstance(arguments, str) else arguments
            yield self.process(image, **{"key": str(next(self._numbers)), **named})


def digest_of(image: Array) -> str:
    """A digest of an image's samples that takes little time."""
    return xxh3_64_hexdigest(np.ascontiguousarray(image).data)
