"""Training data straight from renders: each sample is developed when it is needed."""

import copy
import itertools
import os
import threading
import warnings
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal, Self

from clpipe.base.errors import ImageError, RequestError
from clpipe.base.processors import available_processors
from clpipe.base.readonly import ReadOnly
from clpipe.base.text import one_of
from clpipe.base.validation import typed
from clpipe.chain.carry import VALID
from clpipe.chain.chain import Chain
from clpipe.chain.identity import noise_key, of_frame
from clpipe.chain.request import Request
from clpipe.chain.truth import DEVELOPMENT, picture_without_noise
from clpipe.engine.device import Device, open_device
from clpipe.engine.runner import Runner
from clpipe.images.openimageio import set_codec_threads
from clpipe.images.read import TRANSFERS
from clpipe.inputs.find import Job, find_jobs
from clpipe.inputs.loader import ImageLoader, LoadedImage
from clpipe.inputs.raw import RawImage
from clpipe.pipeline import plain
from clpipe.stage import Kind

Sample = dict[str, Any]
NOWHERE = Path(os.devnull)  # nothing is written


class Dataset(ReadOnly):
    """Renders as a camera sees them, sample by sample, with new noise in each epoch.

    Iterate over it, or index it: ``torch.utils.data.DataLoader`` takes it as it is. A sample is a
    dict of

    - "image": (height, width, 3) uint8 where the chain ends in display values, else float32,
    - "truth", with ``truth``: the same without noise; images of ``keep`` by the names of their
      steps, and "truth.NAME" for each of them without noise; float32,
    - "carried.NAME" for each layer of ``carry``, (height, width, channel) as the picture is, and
      "carried.valid", (height, width): 1 where the render has something, else 0,
    - "key": the name of the render, its path below the folder that was given, and "epoch",
    - "iso", "a" and "b": the sensor noise that was added, Var[y] = a*y + b in signal units (1 is
      the white level), zeros where none was.

    All arrays are in the sensor's orientation. The noise of an image in epoch E is that of frame E
    of ``clpipe run --frames``. So a sample depends on its render, the settings and the epoch alone,
    and not on order, sharding, workers or restarts. Draws are made again in each epoch; kept images
    keep theirs.

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
            on; "development", or True, is denoised as strongly as the noisy one is.
        carry: layers that go along with the picture, such as "Depth" or "nn:normal", as ``--carry``
            of ``clpipe run``.
        companions: where they are, as ``--companion``.
        layer: the layer of an EXR that is the picture; None chooses.
        transfer: the transfer curve of renders in whole numbers: "srgb" or "linear".
        exclude: patterns of files that are not taken from folders and globs, such as depth.
        epoch: the number of the first epoch.
        epochs: how many epochs there are; None is no end.
        threads: how many images are decoded at once; None is one for each processor.
        **settings: what a configuration file may hold, over ``config``.

    Raises:
        RequestError: a name or value that is not allowed, a missing input, a folder without images,
            two images of one name, a truth of a chain without noise.
    """

    @typed
    def __init__(
        self,
        inputs: str | Path | Sequence[str | Path],
        config: str | Path | None = None,
        *,
        device: str | int | None = None,
        keep: str | Sequence[str] = (),
        start_at: str | None = None,
        until: str | None = None,
        truth: bool | Literal["development", "clean"] = False,
        carry: str | Sequence[str] = (),
        companions: str | Sequence[str] = (),
        layer: str | None = None,
        transfer: str | None = None,
        exclude: str | Sequence[str] = (),
        epoch: int = 0,
        epochs: int | None = 1,
        threads: int | None = None,
        **settings: Any,
    ) -> None:
        if transfer is not None and transfer not in TRANSFERS:
            raise RequestError(one_of("transfer", transfer, TRANSFERS))
        for name, number in (("epochs", epochs), ("threads", threads)):
            if number is not None and number < 1:
                raise RequestError(f"found {name} {number}; expected 1 or more, or None")
        request = Request.from_options(
            config=None if config is None else str(config),
            values=plain(settings),
            start_at=start_at,
            until=until,
            layer=layer,
            transfer=transfer,
            carry=(carry,) if isinstance(carry, str) else tuple(carry),
            companions=(companions,) if isinstance(companions, str) else tuple(companions),
        )
        self._loader = ImageLoader(request)
        several = [inputs] if isinstance(inputs, str | Path) else inputs
        patterns = [exclude] if isinstance(exclude, str) else exclude
        named = [str(i) for i in several]
        found = find_jobs(named, NOWHERE, self._loader.endings(), patterns)
        self._jobs = self._loader.exposures(found)
        self._loader.check(self._jobs)
        _check_files(self._jobs)
        _check_keys(self._jobs)
        chain = self._loader.first_chain(self._jobs)
        own_truth = DEVELOPMENT if truth is True else truth or None
        if own_truth:
            picture_without_noise(own_truth, chain)  # refuses a chain that adds no noise
        self._keep = chain.select([keep] if isinstance(keep, str) else keep)
        self._encode = chain.result is Kind.DISPLAY
        self._truth = own_truth
        self._selector = None if device is None else str(device)
        self._epochs = epochs
        self._threads = threads or available_processors()
        self._opened: _Developer | None = None
        self.set_epoch(epoch)

    def __repr__(self) -> str:
        epochs = "endless epochs" if self._epochs is None else f"{self._epochs} epochs"
        return f"Dataset({len(self._jobs)} images, {epochs}, {self._loader.settings.label})"

    def set_epoch(self, epoch: int) -> None:
        """Begin with this epoch, from the next sample on; use it to resume a training run.

        Raises:
            RequestError: it is negative.
        """
        if epoch < 0:
            raise RequestError(f"found epoch {epoch}; expected 0 or more")
        self._epoch = epoch

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
        return part

    def __getstate__(self) -> Mapping[str, Any]:
        return {**self.__dict__, "_opened": None}  # a device stays with its process

    def __len__(self) -> int:
        """How many samples there are, over all epochs.

        Raises:
            TypeError: epochs are endless.
        """
        if self._epochs is None:
            raise TypeError("a dataset of endless epochs has no length; set epochs=N")
        return len(self._jobs) * self._epochs

    def __getitem__(self, index: int) -> Sample:
        """A sample; those of the second epoch follow those of the first, and so on.

        Raises:
            IndexError: there is none of that number.
            ImageError: its image cannot be read or processed.
            DeviceError: there is no usable device.
        """
        number = index + len(self) if index < 0 else index
        if number < 0 or not self._jobs or (self._epochs is not None and number >= len(self)):
            raise IndexError(f"found sample {index}; there are {len(self)}")
        return self._begin(*self._place(number), *self._read(*self._place(number)))()

    def __iter__(self) -> Iterator[Sample]:
        """Every sample in order; images are decoded and developed ahead, a few at a time.

        Raises:
            ImageError: an image cannot be read or processed.
            DeviceError: there is no usable device.
        """
        set_codec_threads(max(available_processors() // self._threads, 1))
        ahead: deque[Future[Callable[[], Sample]]] = deque()
        decoders = ThreadPoolExecutor(self._threads, "decode")
        developer = ThreadPoolExecutor(1, "device")
        try:
            endless = self._epochs is None and self._jobs
            for number in itertools.count() if endless else range(len(self)):
                place = self._place(number)
                read = decoders.submit(self._read, *place)
                ahead.append(developer.submit(self._begin_read, *place, read))
                if len(ahead) > self._threads + 1:
                    yield ahead.popleft().result()()
            while ahead:
                yield ahead.popleft().result()()
        finally:
            decoders.shutdown(cancel_futures=True)
            developer.shutdown(cancel_futures=True)
            if self._opened:
                self._opened.drain()

    def _place(self, number: int) -> tuple[Job, int]:
        """The image and the epoch of a sample."""
        epoch, image = divmod(number, len(self._jobs))
        return self._jobs[image], self._epoch + epoch

    def _read(self, job: Job, epoch: int) -> tuple[LoadedImage, Sample]:
        """An image, and the layers that go along with its picture."""
        loader = self._loader
        carried: Sample = {}
        try:
            loader = loader.for_job(replace(job, key=of_frame(job.key, epoch or None)))
            loaded = loader.enter(job, loader.read(job))
            if loaded and loader.request.carry:
                along = loader.carried(job, loaded)
                named = {**along.arrays(), VALID: along.valid}
                carried = {f"carried.{name}": array for name, array in named.items()}
        except (ImageError, RequestError, MemoryError) as error:
            raise ImageError(loader.error_text(job, error)) from None
        if loaded is None:
            raise ImageError(
                f"{job.path}: was kept after another step than the one before "
                f"{loader.request.start_at}; name the images to go on from by a glob"
            )
        for warning in loaded.source.warnings:
            warnings.warn(f"{job.path}: {warning}", stacklevel=2)
        return loaded, carried

    def _begin_read(
        self, job: Job, epoch: int, read: Future[tuple[LoadedImage, Sample]]
    ) -> Callable[[], Sample]:
        return self._begin(job, epoch, *read.result())

    def _begin(
        self, job: Job, epoch: int, loaded: LoadedImage, carried: Sample
    ) -> Callable[[], Sample]:
        """Begin to develop a sample; what is returned waits for it."""
        key = noise_key(loaded.chain.settings, loaded.key, epoch)
        with self._errors_of(job):
            begun = self._developer().begin(loaded, key)

        def finish() -> Sample:
            with self._errors_of(job):
                return {**begun(), **carried, **self._facts(job, epoch, loaded)}

        return finish

    @contextmanager
    def _errors_of(self, job: Job) -> Iterator[None]:
        """Errors within say which image they are of."""
        try:
            yield
        except (ImageError, RequestError, MemoryError) as error:
            raise ImageError(self._loader.error_text(job, error)) from None

    @staticmethod
    def _facts(job: Job, epoch: int, loaded: LoadedImage) -> Sample:
        """What a sample has beside its arrays."""
        chain = loaded.chain
        adds_noise = chain.is_noisy or not isinstance(loaded.source, RawImage)
        noise = chain.noise if adds_noise else None
        a, b = (noise.a, noise.b) if noise else (0.0, 0.0)
        return {"key": job.key, "epoch": epoch, "iso": chain.iso, "a": a, "b": b}

    def _developer(self) -> "_Developer":
        """The developer of this process.

        Raises:
            DeviceError: there is no usable device, or another process had opened it.
        """
        with _opening:
            if self._opened is None or self._opened.process != os.getpid():
                device = open_device(self._selector)
                self._opened = _Developer(device, self._keep, self._encode, self._truth)
            return self._opened


_opening = threading.Lock()


class _Developer:
    """Develops images on a device, in the order in which they are begun."""

    def __init__(
        self, device: Device | None, keep: Sequence[str], encode: bool, truth: str | None
    ) -> None:
        self.process = os.getpid()
        self._device = device
        self._keep = keep
        self._encode = encode
        self._truth = truth
        self._lock = threading.Lock()
        self._chain: Chain | None = None
        self._runners: dict[str, Runner] = {}

    def begin(self, loaded: LoadedImage, noise_key: str) -> Callable[[], Sample]:
        """Begin with the arrays of a sample, "image", "truth" and kept images.

        Returns:
            What waits for them and gives them; it raises the same errors.

        Raises:
            ImageError, RequestError, MemoryError: the image cannot be developed.
        """
        pixels = loaded.source.pixels
        with self._lock:
            self._prepare(loaded.chain)
            begun = {
                name: runner.submit(pixels, noise_key, unchanged=True)
                for name, runner in self._runners.items()
            }

        def finish() -> Sample:
            arrays: Sample = {}
            for name, wait in begun.items():
                with self._lock:
                    result = wait()
                prefix = "" if name == "image" else f"{name}."
                arrays |= {prefix + step: image for step, image in result.kept.items()}
                arrays[name] = result.image
            return arrays

        return finish

    def drain(self) -> None:
        """Wait for what was begun."""
        with self._lock:
            if self._device:
                self._device.drain()

    def _prepare(self, chain: Chain) -> None:
        """Make runners for a chain, unless it is that of the image before."""
        if chain is self._chain:
            return
        chains = {"image": chain}
        if self._truth:
            chains["truth"] = picture_without_noise(self._truth, chain)
        self._runners = {name: self._runner(name, each) for name, each in chains.items()}
        self._chain = chain

    def _runner(self, name: str, chain: Chain) -> Runner:
        kept = tuple(step.name for step in chain.steps if step.name in self._keep)
        latest = self._runners.get(name)
        if latest and latest.keep == kept:
            return latest.of(chain)  # shares its plans
        return Runner(chain, self._device, kept, self._encode, final=not self._encode)


def _check_files(jobs: Sequence[Job]) -> None:
    """See that the files that are named exist; those of a folder were found there.

    Raises:
        RequestError: one does not.
    """
    for job in jobs:
        if job.listed and not job.path.exists():
            raise RequestError(f"{job.label}: no such file or folder")


def _check_keys(jobs: Sequence[Job]) -> None:
    """See that no two images have the same name, and so the same draws.

    Raises:
        RequestError: two have.
    """
    owners: dict[str, Job] = {}
    for job in jobs:
        other = owners.setdefault(job.key, job)
        if other is not job:
            raise RequestError(
                f"{other.label} and {job.label} are both called {job.key}, and what is drawn for "
                "them would be the same; give the folder that both are in"
            )
