"""Samples of images: decoding, or the cache, and development."""

import os
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from typing import Any

from clpipe.base.digests import stamp_of
from clpipe.base.errors import ImageError, RequestError
from clpipe.base.user_warnings import Issued, warn
from clpipe.chain.carry import VALID
from clpipe.chain.identity import frame_key, noise_key
from clpipe.chain.python_words import python_words
from clpipe.dataset.developer import Developer, DevelopTask, Sample, SampleSpec
from clpipe.dataset.render_cache import RenderCache
from clpipe.engine.device import open_device
from clpipe.images.read import SourceImage
from clpipe.inputs.find import Job
from clpipe.inputs.loader import ImageLoader, LoadedImage
from clpipe.inputs.raw import RawImage
from clpipe.outputs.patches import Patch, Patches

_open_lock = threading.Lock()  # lets one thread open the device of a process


@dataclass(frozen=True)
class SampleBatch:
    """Samples of one image that are developed together.

    Args:
        job: the image.
        epoch: the epoch.
        numbers: the numbers of the samples within the image.
        drawn: the number of the patch whose draws are used. None is the draws of the image.
    """

    job: Job
    epoch: int
    numbers: Sequence[int]
    drawn: int | None = None

    @property
    def draw_key(self) -> str:
        """The key of draws."""
        key = frame_key(self.job.key, self.epoch or None)
        return key if self.drawn is None else f"{key}, patch {self.drawn}"


class SampleLoader:
    """Makes the samples of images, in the order of :meth:`begin`.

    Args:
        loader: reads the images.
        spec: the contents of samples.
        patches: the patches. None is whole pictures.
        cache: the bytes of decoded images to keep.
        device: as for :func:`open_device`. The process that makes the first sample opens it.
    """

    def __init__(
        self,
        loader: ImageLoader,
        spec: SampleSpec,
        patches: Patches | None,
        cache: int,
        device: str | None,
    ) -> None:
        self.patches = patches
        self.renders = RenderCache(cache)
        self._loader = loader
        self._spec = spec
        self._device = device
        self._open_developer: Developer | None = None
        self._warned = Issued()

    def __getstate__(self) -> Mapping[str, Any]:
        return {**self.__dict__, "_open_developer": None}  # a device cannot leave its process

    def drain(self) -> None:
        """Wait for all samples whose development was started."""
        if self._open_developer:
            self._open_developer.drain()

    def count(self, job: Job, epoch: int) -> int:
        """Return the number of samples of an image. A grid needs to read the image.

        Raises:
            ImageError: the image cannot be read, or is smaller than a patch.
        """
        if self.patches is None:
            return 1
        if self.patches.per_image != "grid":
            return self.patches.per_image
        with self._errors_of(job):
            loaded, _ = self.read(SampleBatch(job, epoch, ()))
            return self.patches.layout(loaded.chain, *loaded.source.pixels.shape[1::-1]).count

    def read(self, batch: SampleBatch) -> tuple[LoadedImage, Sample]:
        """Read an image and its layers, which are warped like its picture."""
        job = batch.job
        loader = self._loader
        carried: Sample = {}
        warnings: list[str] = []
        try:
            loader = self._loader.for_job(job, batch.draw_key)
            loaded = loader.enter(job, self._source(job, loader))
            if loaded and loader.request.carry:
                layers = loader.carried_layers(job, loaded)
                named = {**layers.arrays(), VALID: layers.valid}
                warnings += layers.warnings
                carried = {f"carried.{name}": array for name, array in named.items()}
                if self.patches and self.patches.augment:
                    layers.check_no_vectors()
        except (ImageError, RequestError, MemoryError) as error:
            raise ImageError(loader.error_text(job, error)) from None
        if loaded is None:
            raise ImageError(
                f"{job.path}: this image was not kept directly before "
                f"{loader.request.start_at}. Select such images with a glob"
            )
        for warning in self._warned.new([*loaded.source.warnings, *warnings]):
            warn(f"{job.path}: {python_words(warning)}")
        return loaded, carried

    def _source(self, job: Job, loader: ImageLoader) -> SourceImage:
        """Return the image of a job, from the cache unless sub-frames are combined."""
        if loader.shutter(job):  # the shutter's settings may be drawn, so the image is not cached
            return loader.read(job)
        overscan = not loader.raw.is_raw(job.path) and loader.reads_overscan
        key = job.key, stamp_of(job.path), overscan
        return self.renders.get(key, lambda: loader.read(job))

    def begin(
        self, read: Sequence[tuple[SampleBatch, LoadedImage, Sample]]
    ) -> list[Callable[[], list[Sample]]]:
        """Begin to develop samples of images. Small ones are developed together.

        Args:
            read: batches, each with the result of :meth:`read`.

        Returns:
            For each batch, a callable that waits for its samples. Call them in order.

        Raises:
            ImageError: an image cannot be developed. With several images, the error names none.
        """
        tasks = [self._task(batch, loaded) for batch, loaded, _ in read]
        with self._errors_of(*(batch.job for batch, *_ in read)):
            pending = self._developer().begin(tasks)
        return [
            partial(self._finish, *each, task.patches, wait)
            for each, task, wait in zip(read, tasks, pending, strict=True)
        ]

    def _task(self, batch: SampleBatch, loaded: LoadedImage) -> DevelopTask:
        """Return the development task of a batch."""
        job, chain, pixels = batch.job, loaded.chain, loaded.source.pixels
        patches: list[Patch] = []
        with self._errors_of(job):
            if self.patches:
                layout = self.patches.layout(chain, *pixels.shape[1::-1])
                patches = layout.patches_for(batch.numbers, job.key, batch.epoch)
            else:
                self._spec.arrays.check_size(*chain.size(*pixels.shape[1::-1]))
        key = noise_key(chain.settings, loaded.key, batch.epoch)
        return DevelopTask(chain, loaded.source, key, patches)

    def _finish(
        self,
        batch: SampleBatch,
        loaded: LoadedImage,
        carried: Sample,
        patches: Sequence[Patch],
        pending: Callable[[], list[Sample]],
    ) -> list[Sample]:
        """Return the samples of a batch that was started."""
        with self._errors_of(batch.job):
            samples = pending()
        arrays, metadata = self._spec.arrays, self._metadata(batch, loaded)
        for i, sample in enumerate(samples):
            for name, layer in carried.items():
                sample[name] = arrays.ordered(patches[i].crop(layer) if patches else layer)
            sample.update(metadata)
        return samples

    @contextmanager
    def _errors_of(self, *jobs: Job) -> Iterator[None]:
        """Add the name of the image to errors of the body, if there is one image."""
        try:
            yield
        except (ImageError, RequestError, MemoryError) as error:
            job, *others = jobs
            text = str(error) if others else self._loader.error_text(job, error)
            raise ImageError(text) from None

    @staticmethod
    def _metadata(batch: SampleBatch, loaded: LoadedImage) -> Sample:
        """Return the facts of an image for its samples."""
        chain = loaded.chain
        adds_noise = chain.is_noisy or not isinstance(loaded.source, RawImage)
        noise = chain.noise if adds_noise else None
        a, b = (noise.a, noise.b) if noise else (0.0, 0.0)
        return {"key": batch.job.key, "epoch": batch.epoch, "iso": chain.iso, "a": a, "b": b}

    def _developer(self) -> Developer:
        """Return the developer of this process.

        Raises:
            DeviceError: there is no usable device, or a parent process has opened it.
        """
        with _open_lock:
            if self._open_developer is None or self._open_developer.process != os.getpid():
                self._open_developer = Developer(open_device(self._device), self._spec)
            return self._open_developer
