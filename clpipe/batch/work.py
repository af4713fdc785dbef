"""The work on one image: decode it, develop each of its renditions, encode the results."""

import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import TypeVar

from clpipe.base.errors import DeviceError, ImageError, OutputError, RequestError
from clpipe.base.files import FileGroup, deferred_files
from clpipe.base.types import Array
from clpipe.batch.job_loader import JobLoader
from clpipe.batch.job_state import JobState, Written
from clpipe.batch.memory_budget import host_bytes
from clpipe.batch.outcome import Span
from clpipe.batch.runners import Runners, SpareArrays
from clpipe.batch.sinks import Folder
from clpipe.chain.baseline import with_noise
from clpipe.chain.chain import Chain
from clpipe.chain.exposures import exposures_of
from clpipe.chain.formats import DNG
from clpipe.chain.layers import layer_steps
from clpipe.engine.clipping import clipped_share
from clpipe.engine.device import Device
from clpipe.engine.options import RunOptions, Timing
from clpipe.engine.runner import Result, Runner, submit_batch
from clpipe.inputs.find import Job
from clpipe.inputs.loader import ImageLoader
from clpipe.outputs.recipes import Recipe
from clpipe.outputs.record import picture_record
from clpipe.outputs.sidecar import SIDECAR, write_sidecar
from clpipe.stage import Kind

T = TypeVar("T")


class ImageWorker(JobLoader):
    """Does the work on images. Several threads call it at the same time, each for its own image.

    Args:
        loader: loads images.
        sink: where pictures go, and which exist already.
        chain: the chain of the first image, whose kernels are compiled first.
        trace: whether to record each launch and transfer.
    """

    def __init__(
        self, loader: ImageLoader, sink: Folder, chain: Chain, trace: bool = False
    ) -> None:
        super().__init__(loader, sink, chain)
        self._trace = trace
        self._spare = SpareArrays(0)

    def reserve(self, count: int) -> None:
        """Set how many arrays of results are kept for later images."""
        self._spare = SpareArrays(count)

    @property
    def layer_count(self) -> int:
        """The number of layers that are read with an image: carried layers, and those of steps."""
        return len(self.writer.request.carry) + len(layer_steps(self.chain))

    @property
    def later_exposures(self) -> int:
        """The number of exposures after the first one, if the light changes between them."""
        exposures = exposures_of(self.chain)
        return len(exposures.spans) - 1 if exposures else 0

    def bytes_of(self, job: Job, most: int, in_numpy: bool) -> int:
        """Return the bytes that a job's image takes; see :func:`host_bytes`.

        Args:
            job: the image.
            most: the most results that exist at a time.
            in_numpy: whether NumPy develops it.
        """
        writer = self.writer
        results = min(len(writer.renditions_of(job)), most)
        extra_images = 2 * self.layer_count + self.later_exposures
        if shutter := self.loader.shutter(job):
            extra_images += 1 + self.later_exposures + bool(shutter.light_layer)
        # The noise of baselines is measured in floats.
        formats = (*writer.formats, *(["exr"] if writer.request.baselines else []))
        kinds = results, formats, writer.request.keep, extra_images, in_numpy
        return host_bytes(self.loader.claim(job), self.chain, *kinds)

    def runners(self, device: Device | None) -> "Runners":
        """Return the runners of a device, with the kernels of the first chain compiled.

        Raises:
            RequestError: the memory of the device is too small for any image.
            DeviceError: a kernel does not compile.
        """
        half = self.loader.kept is None and self.chain.source is Kind.RGB
        return Runners(self.writer, device, self.chain, half)

    @staticmethod
    def with_matched_noise(state: JobState, recipe: Recipe) -> Recipe:
        """Return a recipe with its noise, if that follows from the results of earlier recipes."""
        if not recipe.matcher:
            return recipe
        method, estimates = recipe.matcher.method(recipe.rendition.role)
        chain = with_noise(recipe.chain, method)
        completed = replace(recipe, chain=chain, matcher=None, estimates=estimates)
        state.recipes[state.recipes.index(recipe)] = completed
        return completed

    def start(
        self, requested: Sequence[tuple[JobState, Recipe, Runner]]
    ) -> list[Callable[[], Result | None]]:
        """Begin to develop renditions on one device. Small ones share launches.

        Returns:
            For each rendition, a function that waits for its result and returns it. Call them in
            order. A function returns None if the rendition fails, and may raise DeviceError.

        Raises:
            DeviceError: the device cannot be used any more.
        """
        start = time.perf_counter()
        orders = [self._attempt(each[0], partial(self._order, *each)) for each in requested]
        ready = [order for order in orders if order]
        waits: list[Callable[[], Result] | None]
        if len(requested) == 1:
            waits = [
                self._attempt(requested[0][0], lambda: submit_batch(ready)[0]) if ready else None
            ]
        else:
            try:
                results = iter(submit_batch(ready) if ready else ())
                waits = [next(results) if order else None for order in orders]
            except DeviceError:
                raise
            except Exception:  # it does not identify the image, so each one is run separately
                waits = [partial(o[0].run, *o[1:]) if o else None for o in orders]
        return [
            partial(self._finish, state, recipe, start, order[3].timings if order else None, wait)
            for (state, recipe, _), order, wait in zip(requested, orders, waits, strict=True)
        ]

    def _order(
        self, state: JobState, recipe: Recipe, runner: Runner
    ) -> tuple[Runner, Array, str, RunOptions]:
        """Return the arguments of a rendition's run. Nobody changes its image's pixels."""
        source = state.source
        assert source
        pixels, device = source.pixels, runner.device
        width, height = runner.chain.size(*pixels.shape[1::-1])
        boxes = [patch.box for patch in state.patches]
        is_used_again = (
            runner.encode and not boxes and device and not device.can_stack(width, height)
        )
        reused = self._spare.take((height, width, *pixels.shape[2:])) if is_used_again else None
        timings: list[Timing] | None = [] if self._trace and device else None
        options = RunOptions(
            timings,
            into=reused,
            unchanged=True,
            boxes=boxes,
            later_exposures=source.later,
            state=self.frames.state(state.job, recipe),
        )
        return runner, pixels, recipe.noise_key, options

    def _finish(
        self,
        state: JobState,
        recipe: Recipe,
        start: float,
        timings: list[Timing] | None,
        wait: Callable[[], Result] | None,
    ) -> Result | None:
        """Wait for the result of a rendition."""
        result = self._attempt(state, wait) if wait else None
        state.note("device", start)
        if result and result.final is not None:
            for matcher in {each.matcher for each in state.recipes if each.matcher}:
                matcher.take(recipe.rendition, result.final)
        if result and recipe.estimates:
            result.estimates[recipe.chain.steps[-1].name] = dict(recipe.estimates)
        name = threading.current_thread().name
        state.spans += [Span(t.name, name, t.start, t.seconds) for t in timings or []]
        if result and recipe is state.recipes[-1] and DNG not in self.writer.formats:
            state.drop_pixels()
        return result

    @staticmethod
    def _attempt(state: JobState, work: Callable[[], T]) -> T | None:
        """Return the result of some work. If it fails, note the state's error and return None."""
        try:
            return work()
        except (ImageError, RequestError, MemoryError) as error:
            state.fail(error)
            return None

    def encode(
        self, state: JobState, recipe: Recipe, result: Result, device: Device | None
    ) -> Written | None:
        """Write one rendition and then its sidecar.

        Returns:
            The files under temporary names, see :meth:`commit`. None if it fails.

        Raises:
            OutputError: nothing more can be written.
        """
        written = None
        state.device = device.info.name if device else "numpy"
        with state.timed("encode"):
            try:
                with deferred_files() as group:
                    written = Written(group, self._encode(state, recipe, result, device))
            except (ImageError, MemoryError) as error:
                self.fail(state, error)
        if result.encoded is not None and device and not state.patches:
            self._spare.give(result.encoded)
        return written

    def commit(self, encoded: Sequence[tuple[JobState, Written]]) -> None:
        """Synchronise renditions to the disk, all at once, and rename their files into place.

        Raises:
            OutputError: nothing more can be written. The states say which files failed.
        """
        failure: OutputError | None = None
        errors = FileGroup.commit([written.group for _, written in encoded])
        for (state, written), error in zip(encoded, errors, strict=True):
            if error is None:
                state.outputs += written.files
                continue
            try:
                self.fail(state, error)
            except OutputError as reason:
                state.fail(reason)
                failure = reason
        if failure:
            raise failure

    def fail(self, state: JobState, error: Exception) -> None:
        """Note that a state's files cannot be written.

        Raises:
            OutputError: nothing more can be written.
        """
        self.writer.check_folder()
        state.fail(error)

    def _encode(
        self, state: JobState, recipe: Recipe, result: Result, device: Device | None
    ) -> list[str]:
        """Write one rendition and then its sidecar.

        Returns:
            The files, relative to the output directory.

        Raises:
            ImageError, MemoryError: it cannot be written.
        """
        writer, job = self.writer, state.job
        assert state.source
        carried = None
        if writer.carries(recipe.rendition):
            carried, state.carried_layers = state.carried_layers, None
        files = writer.write(job, recipe, state.source, result, carried, state.patches)
        clipped = None if recipe.noise else clipped_share(result, recipe.chain)
        if recipe.chain.source is not Kind.DISPLAY:  # photographs are clipped already
            state.clipped = max(state.clipped, clipped or 0.0)
        path = writer.path(job, SIDECAR, recipe.rendition)
        record = picture_record(
            job,
            writer.request_record(state.request, recipe.rendition),
            state.stamps,
            recipe,
            device,
            state.source,
            result,
            files,
            clipped,
            carried,
            state.patches,
        )
        write_sidecar(path, record)
        return [str(f.relative_to(writer.folder)) for f in (*files, path)]
