"""The work on one image: decode it, develop each of its renditions, encode the results."""

import threading
from collections import deque
from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property

from clpipe.base.errors import ImageError, OutputError, RequestError
from clpipe.base.files import FileGroup, deferred_files
from clpipe.base.types import Array
from clpipe.batch.job_loader import JobLoader
from clpipe.batch.job_state import JobState, Written
from clpipe.batch.memory_budget import host_bytes
from clpipe.batch.outcome import Span
from clpipe.batch.sinks import Folder
from clpipe.chain.baseline import with_noise
from clpipe.chain.chain import Chain
from clpipe.chain.exposures import exposures_of
from clpipe.chain.formats import DNG
from clpipe.chain.layers import layer_steps
from clpipe.chain.rendition import DEFAULT_RENDITION
from clpipe.engine.clipping import clipped_share
from clpipe.engine.device import Device
from clpipe.engine.options import RunOptions
from clpipe.engine.runner import Result, Runner
from clpipe.engine.service import Development, Frame
from clpipe.inputs.find import Job
from clpipe.inputs.loader import ImageLoader
from clpipe.outputs.recipes import Recipe
from clpipe.outputs.record import picture_record
from clpipe.outputs.shared import share
from clpipe.outputs.sidecar import SIDECAR, write_sidecar
from clpipe.stage import Kind, StageRole


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

    def _shares_response(self, job: Job) -> bool:
        """Return whether the pictures of a run have one response to greys, or a few."""
        steps, are_drawn = self._response_steps
        return not are_drawn and steps.isdisjoint(job.values)

    @cached_property
    def _response_steps(self) -> tuple[frozenset[str], bool]:
        """The steps of the response to greys, and whether a parameter of one is drawn."""
        response = StageRole.RESPONSE
        steps = frozenset(s.name for s in self.chain.steps if s.stage.role is response)
        draws = self.loader.request.settings().draws
        return steps, any(key.partition(".")[0] in steps for key in draws)

    def compile(self, device: Device | None) -> None:
        """Compile the kernels of the first chain for a device.

        Raises:
            RequestError: the memory of the device is too small for any image.
            DeviceError: a kernel does not compile.
        """
        half = self.loader.kept is None and self.chain.source is Kind.RGB
        results = self.writer.results(Recipe(DEFAULT_RENDITION, self.chain, (), ""))
        try:
            Runner(self.chain, device, *results).compile(half)
        except ImageError as error:  # the memory is not enough for 8x8 pixels
            raise RequestError(f"--memory: too little for any image: {error}") from None

    def order(self, state: JobState, recipe: Recipe, is_small: bool) -> tuple[Recipe, Frame] | None:
        """Return the frame of a rendition, and its recipe with its noise. None if it fails.

        Call it for the frames of a sequence in temporal order.
        """
        source = state.source
        if state.error or not source:
            return None
        try:
            # Its noise may follow from the results of earlier recipes.
            if recipe.matcher:
                method, estimates = recipe.matcher.method(recipe.rendition.role)
                matched = with_noise(recipe.chain, method)
                completed = replace(recipe, chain=matched, matcher=None, estimates=estimates)
                state.recipes[state.recipes.index(recipe)] = completed
                recipe = completed
            keep, encode, final = self.writer.results(recipe)
            width, height = recipe.chain.size(*source.pixels.shape[1::-1])
            boxes = [patch.box for patch in state.patches]
            reused = None
            if encode and not boxes and not is_small:
                reused = self._spare.take((height, width, *source.pixels.shape[2:]))
            options = RunOptions(
                [] if self._trace else None,
                into=reused,
                unchanged=True,  # nobody changes the pixels of an image
                boxes=boxes,
                later_exposures=source.later,
                state=self.frames.state(state.job, recipe),
            )
            key = recipe.noise_key
            return recipe, Frame(recipe.chain, source.pixels, key, keep, encode, final, options)
        except BaseException as error:  # an error of an image must not end the thread
            state.fail(error)
            return None

    def finish(self, state: JobState, recipe: Recipe, development: Development) -> Result | None:
        """Return the result of a rendition that was developed. None if it failed."""
        state.note("device", development.began)
        if error := development.exception():
            state.fail(error)
            return None
        result, timings = development.result(), development.frame.options.timings
        if result.final is not None:
            for matcher in {each.matcher for each in state.recipes if each.matcher}:
                matcher.take(recipe.rendition, result.final)
        if recipe.estimates:
            result.estimates[recipe.chain.steps[-1].name] = dict(recipe.estimates)
        name = threading.current_thread().name
        state.spans += [Span(t.name, name, t.start, t.seconds) for t in timings or []]
        if recipe is state.recipes[-1] and DNG not in self.writer.formats:
            state.drop_pixels()
        return result

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
        write_sidecar(path, share(record, writer.shared_place(path), self._shares_response(job)))
        return [str(f.relative_to(writer.folder)) for f in (*files, path)]


class SpareArrays:
    """Arrays to be used again, because allocating new memory costs time.

    >>> import numpy as np
    >>> spare = SpareArrays(2)
    >>> spare.give(np.zeros((2, 3)))
    >>> spare.take((3, 2)) is None, spare.take((2, 3)).shape, spare.take((2, 3)) is None
    (True, (2, 3), True)
    """

    def __init__(self, count: int) -> None:
        self._arrays: deque[Array] = deque(maxlen=count)
        self._lock = threading.Lock()  # guards the arrays

    def take(self, shape: tuple[int, ...]) -> Array | None:
        """Return an array of a shape, or None if there is none."""
        with self._lock:
            for place, array in enumerate(self._arrays):
                if array.shape == shape:
                    del self._arrays[place]
                    return array
        return None

    def give(self, array: Array) -> None:
        """Add an array. If there are more than ``count``, the oldest is dropped."""
        with self._lock:
            self._arrays.append(array)
