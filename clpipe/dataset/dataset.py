"""Training data straight from renders: each sample is developed when it is needed."""

import copy
import hashlib
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, Self, Unpack

from clpipe.base.errors import ImageError, RequestError
from clpipe.base.processors import available_processors
from clpipe.base.readonly import ReadOnly
from clpipe.base.text import several
from clpipe.base.types import plain
from clpipe.base.validation import typed
from clpipe.chain.rendition import DEVELOPMENT
from clpipe.chain.request import Request
from clpipe.dataset.ahead import PATCHES, Size, begun_ahead
from clpipe.dataset.arrays import ArrayFormat, dtype_named
from clpipe.dataset.developer import Sample, SampleSpec
from clpipe.dataset.inputs import cache_size, jobs_of
from clpipe.dataset.numbering import Numbering
from clpipe.dataset.samples import SampleBatch, SampleLoader
from clpipe.inputs.loader import ImageLoader, LoadedImage
from clpipe.outputs.patches import Patches

if TYPE_CHECKING:
    from clpipe.chain.keywords import Keywords


class Dataset(ReadOnly):
    """Renders as a camera sees them, sample by sample, with new noise in each epoch.

    Iterate over it, or index it: ``torch.utils.data.DataLoader`` takes it as it is. A sample is a
    dict of

    - "image": (height, width, 3) uint8 where the chain ends in display values, else float32,
    - "truth", with ``truth``: the same without noise; images of ``keep`` by the names of their
      steps, and "truth.NAME" for each of them without noise; float32,
    - "raw", with ``raw``, and "truth.raw": the mosaic, uint16 in DN; or in signal, see ``dtype``,
    - "variance", with ``variance``: that of the noise in each pixel of the mosaic, in signal
      squared, float32, in the form of the raw,
    - "carried.NAME" for each layer of ``carry``, (height, width, channel) as the picture is, and
      "carried.valid", (height, width): 1 where the render has something, else 0,
    - "key": the name of the render, its path below the folder that was given; "epoch", "seed",
    - "camera", "iso", and "a" and "b": the sensor noise that was added, Var[y] = a*y + b in signal
      units (1 is the white level), zeros where none was,
    - where the chain makes a raw: "cfa", such as "RGGB"; "black_level" and "white_level" in DN;
      "gains", the white balance of red, green and blue; "xyz_to_camera", 3x3, from CIE XYZ (D65) to
      the raw's colours, as a DNG's ColorMatrix,
    - of a patch, "place": its first column and row in the picture, and "turn": how it was turned
      then, one of EXIF's orientations (1 is not at all).

    All arrays are C-contiguous and writable, in the sensor's orientation. The noise of an image in
    epoch E is that of frame E of ``clpipe run --frames``. So a sample depends on its render, the
    settings and the epoch alone, and not on order, sharding, workers or restarts. Draws are made
    again in each epoch; kept images keep theirs.

    With ``patch``, samples are square parts of pictures, and only they are developed, each from as
    much of the render as it needs: a patch has the bits that the whole picture has there. It begins
    where its mosaic, turned, has the camera's CFA pattern. Places and turns are drawn for each key,
    epoch and seed. Turned by 90 degrees, what a sensor does to its rows is done to columns. What a
    chain estimates from the whole picture (``gray_world``, ``auto`` exposure) it still does, once
    for the patches of an image that are asked for together.

    The device is opened by the process that first makes a sample. OpenCL does not survive a fork:
    workers of a process that has used it must be spawned (``multiprocessing_context="spawn"``).

    Args:
        inputs: files, folders, globs and manifests, as ``clpipe run`` takes them.
        config: as for :class:`~clpipe.Pipeline`; None is the settings that a kept image carries,
            else the default.
        device: as for :class:`~clpipe.Pipeline`.
        keep: steps whose image a sample has, too, or "all".
        start_at: the first step to run; inputs are then images that were kept before it.
        until: the last step to run.
        truth: whether a sample has its image without noise, too. "clean" is the picture to train
            on; "development", or True, is denoised as strongly as the noisy one is. None is "clean"
            with ``patch``, where the chain adds noise, else False.
        carry: layers that go along with the picture, such as "Depth" or "nn:normal", as ``--carry``
            of ``clpipe run``.
        layer: the layer of an EXR that is the picture; None chooses.
        transfer: the transfer curve of renders in whole numbers: "srgb" or "linear".
        exclude: patterns of files that are not taken from folders and globs, such as depth.
        patch: the sides of patches, in px, or :class:`~clpipe.Patches`; None is whole pictures.
        raw: whether a sample has its raw, too: "mosaic" is (height, width), "packed" is its planes,
            (4, height/2, width/2) in R, Gr, Gb, B, whatever the pattern.
        variance: whether a sample has the variance of its noise, in the form of ``raw``, else as a
            mosaic.
        dtype: of pictures and raws. None is as above. "float16" and "float32": display values from
            0 to 1, not rounded to eight bits, and raws in signal, 0 at black and 1 at white.
            "uint16": display values from 0 to 65535, and raws in DN.
        channels_first: whether arrays of three dimensions are (channel, height, width).
        draws: whether an "image" has one draw of each value and epoch, or each "patch" its own; the
            picture that its bits are those of is then developed with that. None is "patch", but
            for a grid.
        on_error: what becomes of an image that cannot be read or developed: "raise" its error, or
            "skip" it with a warning. Asked for by their numbers, its samples are then those of the
            next image. Headers are read at once; files without one are refused, or left out.
        cache: bytes of decoded renders that are kept for further patches and epochs, also as a
            text, such as "4G". Workers share them: they are files among the system's temporary
            ones (``TMPDIR``), mapped into memory. 0 keeps none.
        epoch: the number of the first epoch.
        epochs: how many epochs there are; None is no end.
        threads: how many images are decoded at once; None is one for each processor.
        **settings: what a configuration file may hold, over ``config``.

    Raises:
        RequestError: a name or value that is not allowed, a missing input, a folder without images,
            two images of one name, a truth of a chain without noise, a raw or a variance that it
            has not, a type that does not hold its values.
    """

    @typed
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
            values=plain(settings),
            start_at=start_at,
            until=until,
            layer=layer,
            transfer=transfer,
            carry=several(carry),
        )
        loader = ImageLoader(request)
        self._skips = on_error == "skip"
        self._jobs = jobs_of(loader, several(inputs), several(exclude), self._skips)
        chain = loader.first_chain(self._jobs)
        if truth is None and patch and any(step.adds_noise for step in chain.steps):
            truth = "clean"
        at_random = self._patches is not None and self._patches.per_image != "grid"
        is_drawn = bool(loader.settings.draws) or any(job.values for job in self._jobs)
        self._draws_by_patch = is_drawn and (draws == "patch" if draws else at_random)
        spec = SampleSpec(
            arrays=ArrayFormat(dtype_named(dtype), channels_first, raw),
            keep=chain.select(several(keep)),
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
        self.set_epoch(epoch)

    def __repr__(self) -> str:
        epochs = "endless epochs" if self._epochs is None else f"{self._epochs} epochs"
        return f"Dataset({len(self._jobs)} images, {epochs}, {self._label})"

    def set_epoch(self, epoch: int) -> None:
        """Begin with this epoch, from the next sample on; use it to resume a training run.

        Raises:
            RequestError: it is negative.
        """
        if epoch < 0:
            raise RequestError(f"found epoch {epoch}; expected 0 or more")
        self._epoch = epoch
        self._first = self._next = 0

    def state_dict(self) -> dict[str, Any]:
        """Where iteration is: what :meth:`load_state_dict` takes, as plain values."""
        return {"epoch": self._epoch, "sample": self._next, "images": self._digest()}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Have the next iteration go on behind the last sample of the one that a state is of.

        Raises:
            RequestError: the state is of other images or other patches.
        """
        if state.get("images") != self._digest():
            raise RequestError(
                "the state is of a dataset of other images, or of other patches of them; make the "
                "dataset as it was when the state was taken"
            )
        self.set_epoch(state["epoch"])
        self._first = self._next = state["sample"]

    def shard(self, index: int, of: int) -> Self:
        """A part for one of several workers: every ``of``-th image, from the ``index``-th on.

        Indices count from 0.

        Raises:
            RequestError: there is no such part.
        """
        if not 0 <= index < of:
            raise RequestError(f"found shard {index} of {of}; expected 0 to {of - 1}")
        part = copy.copy(self)
        part._jobs = self._jobs[index::of]
        part._numbered = None
        return part

    def __len__(self) -> int:
        """How many samples there are, over all epochs.

        Raises:
            TypeError: epochs are endless.
            ImageError: the size of an image is needed for a grid, and cannot be read.
        """
        if self._epochs is None:
            raise TypeError("a dataset of endless epochs has no length; set epochs=N")
        return self._numbering().of_epoch * self._epochs

    def __getitem__(self, index: int) -> Sample:
        """A sample; those of an image follow each other, and those of the second epoch the first's.

        Raises:
            IndexError: there is none of that number.
            ImageError: its image cannot be read or processed.
            DeviceError: there is no usable device.
        """
        return self.__getitems__([index])[0]

    def __getitems__(self, indices: Sequence[int]) -> list[Sample]:
        """Samples by their numbers, those of one image, and small ones of any, developed together.

        PyTorch's ``DataLoader`` asks so for the samples of a batch. Errors as :meth:`__getitem__`.
        """
        places = [self._place(index) for index in indices]
        groups: dict[tuple[int, ...], list[int]] = {}
        together = self._patches and not self._draws_by_patch
        for i, place in enumerate(places):
            # A whole picture is all that an image has; asked for twice, it is made twice.
            groups.setdefault(place[:2] if together else (i,), []).append(i)
        samples: list[Sample] = [{}] * len(places)
        asked = [(*places[own[0]][:2], [places[i][2] for i in own]) for own in groups.values()]
        for group, made in zip(groups.values(), self._made_together(asked), strict=True):
            for i, sample in zip(group, made, strict=True):
                samples[i] = sample
        return samples

    def _made_together(
        self, asked: Sequence[tuple[int, int, Sequence[int]]]
    ) -> Iterator[list[Sample]]:
        """Samples of several images, each by epoch, image and the numbers of its samples.

        What fails together is made alone, which says why. Errors as :meth:`_made`.
        """
        side = self._patches.size if self._patches else None
        pending: list[tuple[int, int, Sequence[int]]] = []
        read: list[tuple[SampleBatch, LoadedImage, Sample]] = []
        size, are_enough = Size(side), False
        for last, each in enumerate(asked, 1 - len(asked)):
            pending.append(each)
            batch = self._batch(*each)
            with suppress(ImageError):
                read.append((batch, *self._loader.read(batch)))
                are_enough = size.add(batch, read[-1][1].source.pixels)
            if last and len(read) == len(pending) and not are_enough:
                continue
            begun: list[Callable[[], list[Sample]]] = []
            if len(read) == len(pending):
                with suppress(ImageError):
                    begun = self._loader.begin(read)
            for number, alone in enumerate(pending):
                made: list[Sample] | None = None
                with suppress(ImageError):
                    made = begun[number]() if begun else None
                yield self._made(*alone) if made is None else made
            pending, read, size, are_enough = [], [], Size(side), False

    def _made(self, epoch: int, image: int, numbers: Sequence[int]) -> list[Sample]:
        """Samples of an image; of the next one that has any, where it is to be skipped.

        Raises:
            ImageError: it cannot be read or processed, or no image can.
        """
        for following in range(len(self._jobs)):
            batch = self._batch(epoch, (image + following) % len(self._jobs), numbers)
            try:
                return self._loader.begin([(batch, *self._loader.read(batch))])[0]()
            except ImageError as error:
                if not self._skips:
                    raise
                warnings.warn(f"skipped: {error}", stacklevel=3)
        raise ImageError("no image of the dataset can be read and developed")

    def _batch(self, epoch: int, image: int, numbers: Sequence[int]) -> SampleBatch:
        """Samples of an image, in an epoch counted from the first one."""
        drawn = numbers[0] if self._draws_by_patch else None
        return SampleBatch(self._jobs[image], self._epoch + epoch, numbers, drawn)

    def __iter__(self) -> Iterator[Sample]:
        """Every sample in order; images are decoded and developed ahead, a few at a time.

        Raises:
            ImageError: an image cannot be read or processed.
            DeviceError: there is no usable device.
        """
        self._next, self._first = self._first, 0
        together = PATCHES if self._draws_by_patch else 1
        begun = begun_ahead(self._loader, self._batches(self._next), self._threads, together)
        with closing(begun):
            for batch, wait in begun:
                try:
                    samples = wait()
                except ImageError as error:
                    if not self._skips:
                        raise
                    warnings.warn(f"skipped: {error}", stacklevel=2)
                    self._next += len(batch.numbers)
                    continue
                for sample in samples:
                    self._next += 1
                    yield sample

    def _numbering(self) -> Numbering:
        """How samples are numbered.

        Raises:
            ImageError: the size of an image is needed, and cannot be read.
        """
        if self._numbered is None:
            self._numbered = Numbering([self._loader.count(job, self._epoch) for job in self._jobs])
        return self._numbered

    def _place(self, index: int) -> tuple[int, int, int]:
        """Epoch, image, and number within the image of a sample.

        Raises:
            IndexError: there is none of that number.
        """
        number = index + len(self) if index < 0 else index
        if number < 0 or not self._jobs or (self._epochs is not None and number >= len(self)):
            raise IndexError(f"found sample {index}; there are {len(self)}")
        return self._numbering().place(number)

    def _batches(self, first: int) -> Iterator[SampleBatch]:
        """What is to be developed, image by image, from a sample on."""
        if self._jobs:
            for epoch, image, numbers in self._numbering().groups(first):
                if epoch == self._epochs:
                    return
                parts = [[n] for n in numbers] if self._draws_by_patch else [numbers]
                yield from (self._batch(epoch, image, part) for part in parts)

    def _digest(self) -> str:
        """What tells the images and patches of one dataset from those of another."""
        named = [self._patches, *(job.key for job in self._jobs)]
        return hashlib.sha256(repr(named).encode()).hexdigest()
