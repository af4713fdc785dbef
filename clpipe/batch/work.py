"""One image's work: decode it, develop each rendition of it, encode the results."""

import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence, Set
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import Any, TypeVar

import numpy as np

from clpipe.base.digests import stamp_of
from clpipe.base.errors import ImageError, NoPictureError, RequestError
from clpipe.base.types import Array
from clpipe.batch.outcome import DONE, FAILED, LEFT_OUT, SKIPPED, Outcome, Span
from clpipe.chain.baseline import STEP, with_noise
from clpipe.chain.chain import Chain
from clpipe.chain.depth import lenses_of
from clpipe.chain.formats import DNG
from clpipe.chain.rendition import FIRST, Rendition
from clpipe.engine.clipping import clipped_share
from clpipe.engine.device import Device
from clpipe.engine.extents import Box
from clpipe.engine.options import RunOptions, Timing
from clpipe.engine.runner import Result, Runner
from clpipe.images.read import SourceImage
from clpipe.inputs.carry import Carried
from clpipe.inputs.find import Job
from clpipe.inputs.loader import ImageLoader
from clpipe.outputs.existing import Found, Redo
from clpipe.outputs.patches import Patch, every_patch
from clpipe.outputs.recipes import Recipe
from clpipe.outputs.sealed import SIDECAR, write_sidecar
from clpipe.outputs.sidecar import intrinsics_of, sidecar
from clpipe.outputs.writer import OutputWriter
from clpipe.stage import Kind

T = TypeVar("T")


@dataclass
class Task:
    """A job from the start of its decoding to its outcome."""

    job: Job
    loader: ImageLoader
    began: float = field(default_factory=time.time)
    spans: list[Span] = field(default_factory=list)
    source: SourceImage | None = None
    stamps: Sequence[tuple[int, int]] = ()  # of the files of its exposure
    request: Mapping[str, Any] = field(default_factory=dict)  # its record
    recipes: list[Recipe] = field(default_factory=list)
    unwritten: int = 0  # renditions
    status: str = DONE
    error: str = ""
    reason: str = ""
    outputs: list[str] = field(default_factory=list)
    carried: Carried | None = None  # until it is written
    clipped: float = 0.0  # the share of clipped pixels, of the rendition that has most
    patches: list[Patch] = field(default_factory=list)  # that are made in place of pictures
    old: int = 0  # renditions that another program has made

    @contextmanager
    def timed(self, step: str) -> Iterator[None]:
        """Note when a step was done, and by which thread."""
        start = time.perf_counter()
        try:
            yield
        finally:
            self.note(step, start)

    def note(self, step: str, start: float) -> None:
        """Note that this thread has done a step that was begun at ``start``."""
        name = threading.current_thread().name
        self.spans.append(Span(step, name, start, time.perf_counter() - start))

    def outcome(self) -> Outcome:
        """What became of the job."""
        width, height = self.source.pixels.shape[1::-1] if self.source else (0, 0)
        return Outcome(
            self.job,
            FAILED if self.error else self.status,
            width * height / 1e6,
            self.source.warnings if self.source else (),
            self.error,
            self.reason,
            tuple(self.outputs),
            self.began,
            tuple(self.spans),
            self.clipped,
            self.old,
        )


class ImageWorker:
    """Does the work of one image at a time, in each of the threads that call it.

    Args:
        loader: how images are loaded.
        writer: how pictures are written.
        chain: that of the first image, for which kernels are compiled early.
        redo: which pictures that are there already are made again.
        trace: note each launch and transfer.
    """

    def __init__(
        self,
        loader: ImageLoader,
        writer: OutputWriter,
        chain: Chain,
        redo: Redo = Redo.OLD,
        trace: bool = False,
    ) -> None:
        self.writer = writer
        self.loader = loader
        self.chain = chain
        self._redo = redo
        self._trace = trace
        self._spare = SpareArrays(0)

    def reserve(self, count: int) -> None:
        """Keep so many arrays of results for later images."""
        self._spare = SpareArrays(count)

    @property
    def layers(self) -> int:
        """How many layers are read beside an image: those that go along with it, and its depth."""
        return len(self.writer.request.carry) + bool(lenses_of(self.chain))

    def runners(self, device: Device | None) -> "Runners":
        """The runners of a device; the kernels of the first chain are compiled here.

        Raises:
            RequestError: the memory of the device is too small for any image.
            DeviceError: a kernel does not compile.
        """
        half = self.loader.kept is None and self.chain.source is Kind.RGB
        return Runners(self.writer, device, self.chain, half)

    def decode(self, job: Job, begin: Callable[[], None]) -> Task:
        """Load a job's image, unless all of its pictures are done already.

        Args:
            job: the image.
            begin: called where something is to be made; it may raise ImageError.
        """
        task = Task(job, self.loader)
        with task.timed("decode"):
            try:
                task.loader = self.loader.for_job(job)
                task.request = self._request_of(task)
                renditions = self._missing(task)
                if renditions:
                    begin()
                    self._load(task, renditions)
                else:
                    task.status = SKIPPED
            except (ImageError, RequestError, MemoryError) as error:
                if task.loader.is_left_out(job, error):
                    task.status = LEFT_OUT
                    task.reason = str(error) if isinstance(error, NoPictureError) else ""
                else:
                    task.error = task.loader.error_text(job, error)
        return task

    def _request_of(self, task: Task) -> Mapping[str, Any]:
        """The record of the request for a task's image."""
        job = task.job
        if task.loader is self.loader:
            return {**self._general_request, "image_name": job.key}
        return self.writer.request.for_image(job.key, job.values).record()

    @cached_property
    def _general_request(self) -> Mapping[str, Any]:
        return self.writer.request.record()

    def _missing(self, task: Task) -> Set[Rendition]:
        """A job's renditions that are to be made."""
        renditions = self.writer.renditions_of(task.job)
        if self._redo is Redo.ALL:
            return set(renditions)
        found = {
            each: self.found(task.job, each, self.writer.record_of(task.request, each))
            for each in renditions
        }
        task.old = sum(there is Found.OLD for there in found.values())
        missing = [each for each, there in found.items() if not self._redo.keeps(there)]
        return self.writer.plan_of(task.job).needed(missing)

    def found(self, job: Job, rendition: Rendition, request: Mapping[str, Any]) -> Found:
        """Whether a rendition is there already, made by the same request.

        Args:
            job: the image.
            rendition: which it is.
            request: its record, see :meth:`OutputWriter.record_of`.

        Raises:
            ImageError: a file of its name is somebody else's.
        """
        return self.writer.existing(job, rendition).found(job, request, self._redo.verifies)

    def _load(self, task: Task, renditions: Set[Rendition]) -> None:
        """Load a task's image, and decide which renditions are made of it.

        Raises:
            ImageError, RequestError, MemoryError: it cannot be read, or cannot enter the chain.
        """
        job = task.job
        task.stamps = [stamp_of(path) for path in job.paths]
        source = task.loader.read(job)
        loaded = task.loader.enter(job, source)
        if loaded is None:
            task.status = LEFT_OUT
            return
        self.writer.check_size(loaded.source, loaded.chain)
        intrinsics_of(loaded.chain, loaded.source)  # or they are refused
        if patches := self.writer.patches:
            height, width = loaded.source.pixels.shape[:2]
            task.patches = every_patch(patches, loaded.chain, width, height, job.key)
        if any(map(self.writer.carries, renditions)):
            orientation = self.writer.picture_orientation(loaded.source, loaded.chain)
            task.carried = task.loader.carried(job, loaded, orientation)
        task.source = loaded.source
        recipes = self.writer.plan_of(job).recipes(loaded.chain, loaded.key)
        task.recipes = [recipe for recipe in recipes if recipe.rendition in renditions]
        task.unwritten = len(task.recipes)

    @staticmethod
    def measured(task: Task, recipe: Recipe) -> Recipe:
        """A recipe with its noise, where that is measured on the results of those before it."""
        if not recipe.spread:
            return recipe
        method, estimates = recipe.spread.method(recipe.rendition.role)
        chain = with_noise(recipe.chain, method)
        known = replace(recipe, chain=chain, spread=None, estimates=estimates)
        task.recipes[task.recipes.index(recipe)] = known
        return known

    def develop(self, task: Task, recipe: Recipe, runner: Runner) -> Result | None:
        """Develop one rendition; None where it fails."""
        return self.begin(task, recipe, runner)()

    def begin(self, task: Task, recipe: Recipe, runner: Runner) -> Callable[[], Result | None]:
        """Begin to develop one rendition.

        Returns:
            What waits for the result and gives it; None where it fails. It raises DeviceError, too.

        Raises:
            DeviceError: the device cannot be used any more.
        """
        assert task.source
        start, pixels = time.perf_counter(), task.source.pixels
        timings: list[Timing] | None = [] if self._trace and runner.device else None
        boxes = [patch.box for patch in task.patches]
        work = partial(self._submit, pixels, recipe, runner, timings, boxes)
        wait = self._tried(task, work)

        def finish() -> Result | None:
            result = self._tried(task, wait) if wait else None
            task.note("device", start)
            if result and result.final is not None:
                for spread in {each.spread for each in task.recipes if each.spread}:
                    spread.take(recipe.rendition, result.final)
            if result and recipe.estimates:
                result.estimates[STEP] = dict(recipe.estimates)
            name = threading.current_thread().name
            task.spans += [Span(t.name, name, t.start, t.seconds) for t in timings or []]
            if result and recipe is task.recipes[-1] and DNG not in self.writer.formats:
                # Of the pixels only their shape is still needed; their memory is not.
                assert task.source
                empty = np.broadcast_to(np.float16(0), task.source.pixels.shape)
                task.source = replace(task.source, pixels=empty)
            return result

        return finish

    def _submit(
        self,
        pixels: Array,
        recipe: Recipe,
        runner: Runner,
        timings: list[Timing] | None,
        boxes: Sequence[Box],
    ) -> Callable[[], Result]:
        """Have a runner begin with an image, whose pixels nobody changes."""
        width, height = runner.chain.size(*pixels.shape[1::-1])
        shape = (height, width, *pixels.shape[2:])
        reused = runner.encode and runner.device and not boxes
        into = self._spare.take(shape) if reused else None
        key = recipe.noise_key
        options = RunOptions(timings, into=into, unchanged=True, boxes=boxes)
        return runner.submit(pixels, key, options)

    @staticmethod
    def _tried(task: Task, work: Callable[[], T]) -> T | None:
        """What some work gives; None where it fails, which is noted as the task's error."""
        try:
            return work()
        except (ImageError, RequestError, MemoryError) as error:
            task.error = task.loader.error_text(task.job, error)
            return None

    def encode(self, task: Task, recipe: Recipe, result: Result, device: Device | None) -> None:
        """Write one rendition and then its sidecar.

        Raises:
            OutputError: nothing can be written any more.
        """
        writer, job = self.writer, task.job
        assert task.source
        with task.timed("encode"):
            try:
                carried = None
                if writer.carries(recipe.rendition):
                    carried, task.carried = task.carried, None
                files = writer.write(job, recipe, task.source, result, carried, task.patches)
                clipped = None if recipe.noise else clipped_share(result, recipe.chain)
                task.clipped = max(task.clipped, clipped or 0.0)
                path = writer.path(job, SIDECAR, recipe.rendition)
                record = sidecar(
                    job,
                    writer.record_of(task.request, recipe.rendition),
                    task.stamps,
                    recipe,
                    device,
                    task.source,
                    result,
                    files,
                    clipped,
                    carried,
                    task.patches,
                )
                write_sidecar(path, record)
                task.outputs += [str(f.relative_to(writer.folder)) for f in (*files, path)]
            except (ImageError, MemoryError) as error:
                writer.check_folder()
                task.error = task.loader.error_text(job, error)
        if result.encoded is not None and device and not task.patches:
            self._spare.give(result.encoded)


class Runners:
    """The runners of one device. Chains of one structure share plans and compiled kernels.

    Args:
        writer: what of a rendition is written.
        device: where to run; None is NumPy.
        chain: that of the first image; its kernels are compiled.
        half: whether images are expected in half floats.

    Raises:
        RequestError: the memory of the device is too small for any image.
        DeviceError: a kernel does not compile.
    """

    def __init__(
        self, writer: OutputWriter, device: Device | None, chain: Chain, half: bool
    ) -> None:
        self._writer = writer
        self._device = device
        first = writer.runner(Recipe(FIRST, chain, (), ""), device)
        try:
            first.compile(half)
        except ImageError as error:  # not even one of 8x8 pixels fits
            raise RequestError(f"--memory: too little for any image: {error}") from None
        self._latest = [(chain, first)]
        self._by_results = {(first.keep, first.encode, first.final): first}

    def of(self, recipe: Recipe) -> Runner:
        """The runner of a rendition."""
        for chain, runner in self._latest:
            if chain is recipe.chain:
                return runner
        runner = self._writer.runner(recipe, self._device)
        alike = self._by_results.setdefault((runner.keep, runner.encode, runner.final), runner)
        if alike is not runner:
            runner = alike.for_chain(recipe.chain)  # shares the plans
        self._latest.insert(1, (recipe.chain, runner))
        del self._latest[4:]
        return runner


class SpareArrays:
    """Arrays that are not used any more, to be used again: new memory costs time.

    >>> spare = SpareArrays(2)
    >>> spare.give(np.zeros((2, 3)))
    >>> spare.take((3, 2)) is None, spare.take((2, 3)).shape, spare.take((2, 3)) is None
    (True, (2, 3), True)
    """

    def __init__(self, count: int) -> None:
        self._arrays: deque[Array] = deque(maxlen=count)
        self._lock = threading.Lock()

    def take(self, shape: tuple[int, ...]) -> Array | None:
        """An array of that shape; None where there is none."""
        with self._lock:
            for place, array in enumerate(self._arrays):
                if array.shape == shape:
                    del self._arrays[place]
                    return array
        return None

    def give(self, array: Array) -> None:
        """Take back an array that may be used again; beyond ``count`` the oldest is dropped."""
        with self._lock:
            self._arrays.append(array)
