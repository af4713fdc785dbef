"""Samples of images: decoding, or the cache, and development."""

import os
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NoReturn

from clpipe.base.digests import stamp_of
from clpipe.base.errors import ImageError, RequestError
from clpipe.base.user_warnings import Issued, warn
from clpipe.chain.camera_info import camera_info
from clpipe.chain.carry import VALID
from clpipe.chain.identity import frame_key, noise_key
from clpipe.chain.python_words import python_words
from clpipe.dataset.developer import DevelopTask, Sample, SampleSpec
from clpipe.dataset.render_cache import RenderCache
from clpipe.engine.device import open_device
from clpipe.engine.service import Development, Service
from clpipe.images.read import SourceImage
from clpipe.inputs.find import Job
from clpipe.inputs.loader import ImageLoader, LoadedImage
from clpipe.inputs.raw import RawImage
from clpipe.outputs.patches import Patch, Patches
from clpipe.outputs.record import intrinsics_of

Read = tuple[LoadedImage, Sample]  # an image, and its layers

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
        self._opened: tuple[int, Service] | None = None  # with the process that opened the device
        self._warned = Issued()

    def __getstate__(self) -> Mapping[str, Any]:
        return {**self.__dict__, "_opened": None}  # a device cannot leave its process

    def count(self, job: Job, epoch: int) -> int:
        """Return the number of samples of an image. A grid needs to read the image.

        Raises:
            ImageError: the image cannot be read, or is smaller than a patch.
        """
        if self.patches is None:
            return 1
        if self.patches.per_image != "grid":
            return self.patches.per_image
        loaded, _ = self.read(SampleBatch(job, epoch, ()))
        try:
            return self.patches.layout(loaded.chain, *loaded.source.pixels.shape[1::-1]).count
        except RequestError as error:
            raise ImageError(self._loader.error_text(job, error)) from None

    def read(self, batch: SampleBatch) -> Read:
        """Read an image and its layers, which are warped like its picture.

        Raises:
            ImageError: it cannot be read, or does not fit the chain.
        """
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
        self, read: Sequence[tuple[SampleBatch, Read | ImageError]]
    ) -> list[Callable[[], list[Sample]]]:
        """Begin to develop samples of images. Small ones are developed together.

        Args:
            read: batches, each with the result of :meth:`read`, or its error.

        Returns:
            For each batch, a callable that waits for its samples. It raises ImageError if its image
            cannot be read or developed.

        Raises:
            DeviceError: there is no usable device, or a parent process has opened it.
        """
        tasks = [self._task(*each) for each in read]
        service = self._service()
        frames = [
            f for task in tasks if isinstance(task, DevelopTask) for f in task.frames.values()
        ]
        pending = iter(service.develop(frames))
        waits: list[Callable[[], list[Sample]]] = []
        for (batch, _), task in zip(read, tasks, strict=True):
            if isinstance(task, ImageError):
                waits.append(partial(fail, task))
            else:
                results = {name: next(pending) for name in task.frames}
                waits.append(partial(self._finish, batch, task, results))
        return waits

    def _task(self, batch: SampleBatch, read: Read | ImageError) -> DevelopTask | ImageError:
        """Return the development task of a batch, or the error of its image."""
        if isinstance(read, ImageError):
            return read
        job, (loaded, carried) = batch.job, read
        chain, source = loaded.chain, loaded.source
        size = source.pixels.shape[1::-1]
        patches: list[Patch] = []
        try:
            if self.patches:
                layout = self.patches.layout(chain, *size)
                patches = layout.patches_for(batch.numbers, job.key, batch.epoch)
            else:
                self._spec.arrays.check_size(*chain.size(*size))
            key = noise_key(chain.settings, loaded.key, batch.epoch)
            frames = self._spec.frames(chain, source, key, patches)
        except (ImageError, RequestError, MemoryError) as error:
            return ImageError(self._loader.error_text(job, error))
        facts = self._metadata(batch, loaded)
        return DevelopTask(self._spec, chain, source, patches, frames, carried, facts)

    def _finish(
        self, batch: SampleBatch, task: DevelopTask, pending: Mapping[str, Development]
    ) -> list[Sample]:
        """Return the samples of a batch that was started."""
        try:
            return task.samples({name: each.result() for name, each in pending.items()})
        except (ImageError, RequestError, MemoryError) as error:
            raise ImageError(self._loader.error_text(batch.job, error)) from None

    @staticmethod
    def _metadata(batch: SampleBatch, loaded: LoadedImage) -> Sample:
        """Return the facts of an image for its samples."""
        chain = loaded.chain
        adds_noise = chain.is_noisy or not isinstance(loaded.source, RawImage)
        noise = chain.noise if adds_noise else None
        a, b = (noise.a, noise.b) if noise else (0.0, 0.0)
        height, width = loaded.source.pixels.shape[:2]
        camera = camera_info(chain, {}, (width, height), intrinsics_of(chain, loaded.source))
        facts = {"key": batch.job.key, "epoch": batch.epoch, "iso": chain.iso, "a": a, "b": b}
        return facts | camera.arrays()

    def _service(self) -> Service:
        """Return the service of this process.

        Raises:
            DeviceError: there is no usable device, or a parent process has opened it.
        """
        with _open_lock:
            if not self._opened or self._opened[0] != os.getpid():
                self._opened = os.getpid(), Service([open_device(self._device)])
            return self._opened[1]


def fail(error: ImageError) -> NoReturn:
    """Raise an error."""
    raise error
