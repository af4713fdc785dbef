"""Training data from renders. Each sample is developed when it is needed."""

import copy
import hashlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, Self, Unpack

from clpipe.base.errors import ImageError, RequestError
from clpipe.base.processors import available_processors
from clpipe.base.readonly import ReadOnly
from clpipe.base.text import as_texts
from clpipe.base.user_warnings import warn
from clpipe.base.validation import check_argument_types
from clpipe.chain.drawing import plain_settings
from clpipe.chain.python_words import errors_in_python, python_words
from clpipe.chain.rendition import DEVELOPMENT
from clpipe.chain.request import Request
from clpipe.dataset.arrays import ArrayFormat, dtype_named
from clpipe.dataset.developer import Sample, SampleSpec
from clpipe.dataset.inputs import cache_size, jobs_of
from clpipe.dataset.numbering import Numbering
from clpipe.dataset.passes import Passes, part_of
from clpipe.dataset.prefetch import PATCHES_TOGETHER, BatchSize, attempted, prefetched
from clpipe.dataset.samples import Read, SampleBatch, SampleLoader
from clpipe.inputs.loader import ImageLoader
from clpipe.outputs.patches import Patches

if TYPE_CHECKING:
    from clpipe.chain.keywords import Keywords


class Dataset(ReadOnly):
    """Samples of renders as a camera records them, with new noise in each epoch.

    Iterate over the dataset, index it, or pass it to ``torch.utils.data.DataLoader``.

    >>> import tempfile
    >>> import OpenImageIO as oiio
    >>> import clpipe
    >>> folder = tempfile.TemporaryDirectory()
    >>> render = oiio.ImageBufAlgo.fill((0.2, 0.3, 0.4), oiio.ROI(0, 64, 0, 48, 0, 1, 0, 3))
    >>> _ = render.write(f"{folder.name}/a.exr")
    >>> samples = clpipe.Dataset(folder.name, iso=3200, patch=16, device="numpy", cache=0)
    >>> len(samples), samples[0]["image"].shape, samples[0]["truth"].shape
    (16, (16, 16, 3), (16, 16, 3))
    >>> folder.cleanup()

    A sample is a dict:

    - "image": (height, width, 3) uint8 if the chain ends in display values, else float32.
    - "truth", with ``truth``: the image without noise. With ``keep``, images of steps by their
      names, and "truth.NAME" for the same without noise, float32.
    - "raw", with ``raw``, and "truth.raw": the mosaic, uint16 in DN. A float ``dtype`` scales it.
    - "variance", with ``variance``: the variance of the noise in each pixel of the mosaic, in
      squared signal, float32, in the layout of the raw.
    - "carried.NAME" for each layer of ``carry``, (height, width, channel), warped like the image.
      "carried.valid", (height, width), is 1 where the render has content, else 0.
    - "key": the path of the render relative to the input directory. "epoch", "seed".
    - "camera", "iso". "a" and "b" state the sensor noise, Var[y] = a*y + b in signal units (1 is
      the white level). They are 0 without noise.
    - With a raw in the chain, "cfa", such as "RGGB", and "black_level" and "white_level" in DN.
      "gains" is the white balance of red, green and blue. "xyz_to_camera", 3x3, maps CIE XYZ (D65)
      to the colours of the raw, like ColorMatrix of a DNG.
    - "k", "d" and "distortion_model", "exposure_time", "row_time" and "color_matrix", like those of
      :class:`clpipe.CameraInfo`. They are of the whole picture. Unknown numbers are NaN.
    - With ``patch``, "place": its first column and row in the picture, and "turn": its EXIF
      orientation after augmentation (1 is unchanged).

    All arrays are C-contiguous and writable, in the orientation of the sensor. The noise in epoch E
    is the noise of frame E of ``clpipe run --frames``. A sample depends only on its render, the
    settings and the epoch, not on order, sharding, workers or restarts. Each epoch draws new
    values, except for kept images.

    With ``patch``, samples are square parts of pictures. Only these parts are developed, and their
    values are those of the whole picture. The mosaic of a patch starts with the CFA pattern of the
    camera. Places and augmentation are drawn by key, epoch and seed. A rotation by 90 degrees turns
    row noise into column noise. Estimates from the whole picture (``gray_world``, ``auto``
    exposure) are made once for all patches of an image that are requested together.

    The process that develops the first sample opens the device. OpenCL does not survive a fork, so
    workers of a process that has used it must be spawned (``multiprocessing_context="spawn"``).

    Args:
        inputs: files, directories, globs and manifests, as for :func:`clpipe.run`.
        config: as for :class:`~clpipe.Pipeline`. None is the settings that a kept image carries,
            else the default.
        device: as for :class:`~clpipe.Pipeline`.
        keep: steps whose images are added to samples, or "all".
        start_at: the first step to run. Inputs are then images that were kept before it.
        until: the last step to run.
        truth: adds the image without noise. "clean" is the training target. "development", or
            True, is denoised as strongly as the noisy image. None is "clean" for patches of a chain
            with noise, else False.
        carry: layers to warp with the image, such as "Depth" or "nn:normal", like ``--carry`` of
            ``clpipe run``.
        layer: the layer of an EXR that is the picture. None selects it automatically.
        transfer: the transfer curve of renders with integer samples: "srgb" or "linear".
        exclude: patterns of files to skip in directories and globs, such as depth.
        patch: the side of patches in px, or :class:`~clpipe.Patches`. None is whole pictures.
        raw: adds the raw. "mosaic" is (height, width). "packed" is four planes, (4, height/2,
            width/2), in the order R, Gr, Gb, B for every pattern.
        variance: adds the variance of the noise, in the layout of ``raw``, else as a mosaic.
        dtype: the type of images and raws. None is as above. "float16" and "float32" contain
            display values from 0 to 1 without rounding, and raws scaled to 0 at black and 1 at
            white. "uint16" contains display values from 0 to 65535, and raws in DN.
        channels_first: whether arrays of three dimensions are (channel, height, width).
        draws: "image" draws values once per image and epoch, and "patch" once per patch. None is
            "patch", except for a grid.
        on_error: "raise" the error of an image that cannot be read or developed, or "skip" the
            image with a warning. An index of a skipped image returns a sample of the next one.
            Headers are read at once. Files without a valid header are rejected, or skipped.
        cache: the bytes of decoded renders to cache for more patches and epochs, as a number or as
            text such as "4G". Workers share them as memory-mapped files in the temporary directory
            (``TMPDIR``). 0 keeps none.
        epoch: the number of the first epoch.
        epochs: the number of epochs. None is endless.
        threads: the number of images to decode in parallel. None is one per processor.
        **settings: any value of a configuration file, which overrides ``config``.

    Raises:
        RequestError: a name or value is not allowed, an input is missing, a directory has no
            images, or two images have the same name. It is also raised if the chain has no noise,
            raw or variance that is requested, or if a type cannot hold the values.
    """

    @errors_in_python()
    @check_argument_types
    def __init__(
        self,
        inputs: str | Path | Sequence[str | Path],
        config: str | Path | Sequence[str | Path] | None = None,
        *,
        device: str | int | None = None,
        keep: str | Sequence[str] | None = None,
        start_at: str | None = None,
        until: str | None = None,
        truth: bool | Literal["development", "clean"] | None = None,
        carry: str | Sequence[str] | None = None,
        layer: str | None = None,
        transfer: Literal["srgb", "linear"] | None = None,
        exclude: str | Sequence[str] | None = None,
        patch: int | Patches | None = None,
        raw: Literal["packed", "mosaic"] | None = None,
        variance: bool = False,
        dtype: Any = None,
        channels_first: bool = False,
        draws: Literal["image", "patch"] | None = None,
        on_error: Literal["raise", "skip"] = "raise",
        cache: int | str = "1G",
        epoch: int = 0,
        epochs: int | None = 1,
        threads: int | None = None,
        **settings: "Unpack[Keywords]",
    ) -> None:
        for name, number in {"epochs": epochs, "threads": threads}.items():
            if number is not None and number < 1:
                raise RequestError(f"found {name} {number}; expected 1 or more, or None")
        self._patches = Patches(patch) if isinstance(patch, int) else patch
        request = Request.from_options(
            config=config,
            values=plain_settings(settings),
            start_at=start_at,
            until=until,
            layer=layer,
            transfer=transfer,
            carry=as_texts(carry),
        )
        loader = ImageLoader(request)
        self._skips = on_error == "skip"
        self._jobs = jobs_of(loader, as_texts(inputs), as_texts(exclude), self._skips)
        chain = loader.first_chain(self._jobs)
        if truth is None and patch and any(step.adds_noise for step in chain.steps):
            truth = "clean"
        random_positions = self._patches is not None and self._patches.per_image != "grid"
        is_drawn = bool(loader.settings.draws) or any(job.values for job in self._jobs)
        self._draws_by_patch = is_drawn and (draws == "patch" if draws else random_positions)
        spec = SampleSpec(
            arrays=ArrayFormat(dtype_named(dtype), channels_first, raw),
            keep=chain.select(as_texts(keep)),
            truth=DEVELOPMENT if truth is True else truth or None,
            variance=variance,
        )
        spec.check(chain, self._patches)
        selector = None if device is None else str(device)
        self._loader = SampleLoader(loader, spec, self._patches, cache_size(cache), selector)
        self._label = loader.settings.label
        self._epochs = epochs
        self._threads = threads or available_processors()
        self._numbered: Numbering | None = None
        self._passes = Passes(0)
        self.set_epoch(epoch)

    def __repr__(self) -> str:
        epochs = "endless epochs" if self._epochs is None else f"{self._epochs} epochs"
        return f"Dataset({len(self._jobs)} images, {epochs}, {self._label})"

    @property
    def _epoch(self) -> int:
        return self._passes.epoch

    @check_argument_types
    def set_epoch(self, epoch: int) -> None:
        """Continue with the start of an epoch. Use it before each epoch, or to resume a run.

        Workers of a ``DataLoader`` follow, also persistent ones.

        Raises:
            RequestError: the epoch is negative.
        """
        if epoch < 0:
            raise RequestError(f"found epoch {epoch}; expected 0 or more")
        self._passes.set(epoch)
        self._first = self._next = 0

    def state_dict(self) -> dict[str, Any]:
        """Return the position of the iteration as plain values for :meth:`load_state_dict`."""
        return {"epoch": self._epoch, "sample": self._next, "images": self._digest()}

    @check_argument_types
    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Start the next iteration after the last sample of a saved state.

        Raises:
            RequestError: the state belongs to other images or patches.
        """
        if state.get("images") != self._digest():
            raise RequestError(
                "the state belongs to a dataset with other images or patches. Create the dataset "
                "with the inputs and patches that it had when the state was saved"
            )
        self.set_epoch(state["epoch"])
        self._first = self._next = state["sample"]

    @check_argument_types
    def shard(self, index: int | None = None, of: int | None = None) -> Self:
        """Return one of ``of`` parts of the dataset: every ``of``-th image, starting at ``index``.

        By default, these are the rank and the number of ranks of ``torch.distributed`` if it runs.
        Use either this or PyTorch's sampler for distributed runs.

        Raises:
            RequestError: ``index`` is not from 0 to ``of`` - 1.
        """
        index, of = part_of(index, of)
        part = copy.copy(self)
        part._jobs = self._jobs[index::of]
        part._passes = self._passes.copy()
        part._numbered = None
        return part

    def __len__(self) -> int:
        """Return the number of samples in all epochs.

        Raises:
            TypeError: the number of epochs is endless.
            ImageError: the size of an image, which a grid needs, cannot be read.
        """
        if self._epochs is None:
            raise TypeError("a dataset with endless epochs has no length. Set epochs=N")
        return self._numbering().samples_per_epoch * self._epochs

    def __getitem__(self, index: int) -> Sample:
        """Return a sample. Samples are ordered by epoch, then by image.

        Raises:
            IndexError: the index is out of range.
            ImageError: the image cannot be read or processed.
            DeviceError: there is no usable device.
        """
        return self.__getitems__([index])[0]

    @errors_in_python()
    def __getitems__(self, indices: Sequence[int]) -> list[Sample]:
        """Return the samples of a batch, as PyTorch's ``DataLoader`` requests them.

        Samples of one image, and small samples of several images, are developed together. Raises
        the errors of :meth:`__getitem__`.
        """
        positions = [self._position(index) for index in indices]
        groups: dict[tuple[int, ...], list[int]] = {}
        together = self._patches and not self._draws_by_patch
        for i, position in enumerate(positions):
            # Whole pictures are not grouped, so a repeated index is developed again.
            groups.setdefault(position[:2] if together else (i,), []).append(i)
        samples: list[Sample] = [{}] * len(positions)
        requested = [
            (*positions[members[0]][:2], [positions[i][2] for i in members])
            for members in groups.values()
        ]
        for group, developed in zip(
            groups.values(), self._develop_together(requested), strict=True
        ):
            for i, sample in zip(group, developed, strict=True):
                samples[i] = sample
        return samples

    def _develop_together(
        self, requested: Sequence[tuple[int, int, Sequence[int]]]
    ) -> Iterator[list[Sample]]:
        """Yield the samples of several images, each given by epoch, image and sample numbers.

        Raises:
            ImageError: as for :meth:`_develop_other`.
        """
        side = self._patches.size if self._patches else None
        read: list[tuple[SampleBatch, Read | ImageError]] = []
        size, first = BatchSize(side), 0
        for end, each in enumerate(requested, 1):
            batch = self._batch(*each)
            image = attempted(partial(self._loader.read, batch))
            read.append((batch, image))
            is_full = isinstance(image, tuple) and size.add(batch, image[0].source.pixels)
            if is_full or end == len(requested):
                waits = self._loader.begin(read)
                for place, wait in zip(requested[first:end], waits, strict=True):
                    try:
                        samples = wait()
                    except ImageError as error:
                        samples = self._develop_other(error, *place)
                    yield samples
                read, size, first = [], BatchSize(side), end

    def _develop_other(
        self, error: ImageError, epoch: int, image: int, numbers: Sequence[int]
    ) -> list[Sample]:
        """Return samples of the next valid image, if errors such as that of this one are skipped.

        Raises:
            ImageError: the error, or no image can be read and developed.
        """
        for offset in range(1, len(self._jobs) + 1):
            if not self._skips:
                raise error
            warn(python_words(f"skipped: {error}"))
            batch = self._batch(epoch, (image + offset) % len(self._jobs), numbers)
            if offset < len(self._jobs):
                try:
                    return self._loader.begin([(batch, self._loader.read(batch))])[0]()
                except ImageError as other:
                    error = other
        raise ImageError("no image of the dataset can be read and developed")

    def _batch(self, epoch: int, image: int, numbers: Sequence[int]) -> SampleBatch:
        """Return samples of an image, in an epoch counted from the first one."""
        drawn = numbers[0] if self._draws_by_patch else None
        return SampleBatch(self._jobs[image], self._epoch + epoch, numbers, drawn)

    def __iter__(self) -> Iterator[Sample]:
        """Yield every sample in order. A few images are decoded and developed ahead.

        Raises:
            ImageError: an image cannot be read or processed.
            DeviceError: there is no usable device.
        """
        self._next, self._first = self._first, 0
        together = PATCHES_TOGETHER if self._draws_by_patch else 1
        pending = prefetched(self._loader, self._batches(self._next), self._threads, together)
        with closing(pending), errors_in_python():
            for batch, wait in pending:
                try:
                    samples = wait()
                except ImageError as error:
                    if not self._skips:
                        raise
                    warn(python_words(f"skipped: {error}"))
                    self._next += len(batch.numbers)
                    continue
                for sample in samples:
                    self._next += 1
                    yield sample

    def _numbering(self) -> Numbering:
        """Return the numbering of samples.

        Raises:
            ImageError: the size of an image, which a grid needs, cannot be read.
        """
        if self._numbered is None:
            self._numbered = Numbering([self._loader.count(job, self._epoch) for job in self._jobs])
        return self._numbered

    def _position(self, index: int) -> tuple[int, int, int]:
        """Return epoch, image, and number within the image of a sample.

        Raises:
            IndexError: the index is out of range.
        """
        number = index + len(self) if index < 0 else index
        if number < 0 or not self._jobs or (self._epochs is not None and number >= len(self)):
            raise IndexError(f"found sample {index}; there are {len(self)}")
        return self._numbering().position(number)

    def _batches(self, first: int) -> Iterator[SampleBatch]:
        """Yield the batches to develop, image by image, starting at a sample."""
        if self._jobs:
            for epoch, image, numbers in self._numbering().groups(first):
                if epoch == self._epochs:
                    return
                parts = [[n] for n in numbers] if self._draws_by_patch else [numbers]
                yield from (self._batch(epoch, image, part) for part in parts)

    def _digest(self) -> str:
        """Return a digest of the images and patches of this dataset."""
        identity = [self._patches, *(job.key for job in self._jobs)]
        return hashlib.sha256(repr(identity).encode()).hexdigest()
