"""Loads a job's image: which renditions are missing, its files, and its pixels."""

import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from functools import cached_property
from typing import Any

from clpipe.base.digests import stamp_of
from clpipe.base.errors import ImageError, NoPictureError, RequestError
from clpipe.base.urls import fetched_files, may_be_url
from clpipe.batch.frames import Frames
from clpipe.batch.job_state import DecodedFrame, JobState, Stamps
from clpipe.batch.outcome import LEFT_OUT, SKIPPED
from clpipe.batch.sinks import Folder
from clpipe.chain.chain import Chain
from clpipe.chain.rendition import Rendition
from clpipe.inputs.find import Job
from clpipe.inputs.loader import ImageLoader, LoadedImage
from clpipe.outputs.existing import ExistingFiles, Redo
from clpipe.outputs.patches import all_patches
from clpipe.outputs.recipes import recipes
from clpipe.outputs.record import intrinsics_of


class JobLoader:
    """Loads the images of jobs. Several threads call it at the same time, each for its own image.

    Args:
        loader: loads images.
        sink: where pictures go, and which exist already.
        chain: the chain of the first image, whose kernels are compiled first.
    """

    def __init__(self, loader: ImageLoader, sink: Folder, chain: Chain) -> None:
        self._sink = sink
        self.writer = sink.writer
        self.loader = loader
        self.chain = chain
        self.frames = Frames(chain, self.is_done)

    def begin(self, job: Job, decoded: DecodedFrame | None = None) -> JobState:
        """Find what a job's image needs, and fetch its files if they are at URLs.

        Args:
            job: the image.
            decoded: the image, if it was decoded to be metered.

        Returns:
            The state of the job, for :meth:`decode`. A skipped or failed job has no renditions.
        """
        state = JobState(job, self.loader, job, decoded=decoded)
        if decoded:
            state.files = decoded.files
        try:
            job.check()
            state.request = self._request_of(job)
            if renditions := self._missing(state):
                paths = decoded.paths if decoded else job.paths
                if any(map(may_be_url, paths)):
                    start = time.perf_counter()
                    state.files = state.files or ExitStack()
                    first, *others = state.files.enter_context(fetched_files(paths))
                    state.here = replace(job, path=first, subframes=tuple(others))
                    state.note("fetch", start)
                state.renditions = renditions
            else:
                state.status = SKIPPED
        except Exception as error:  # an error of an image must not end the thread
            state.fail(error)
        return state

    def decode(self, state: JobState, admit: Callable[[Job], None]) -> None:
        """Load a job's image, if renditions of it are made.

        Args:
            state: what :meth:`begin` returned.
            admit: called before the image is loaded. Gets the job with local files; may raise
                ImageError.
        """
        job = state.job
        with state.timed("decode"):
            try:
                if state.renditions:
                    state.loader = self.loader.for_job(job)
                    admit(state.here)
                    self._load(state)
            except (ImageError, RequestError, MemoryError) as error:
                if state.loader.is_skipped(job, error):
                    state.status = LEFT_OUT
                    state.reason = str(error) if isinstance(error, NoPictureError) else ""
                else:
                    state.fail(error)
            finally:
                if state.files:
                    state.files.close()

    def _request_of(self, job: Job) -> Mapping[str, Any]:
        """Return the record of the request for a job's image."""
        if not self.loader.has_own_values(job):
            return {**self._general_request, "image_name": job.key}
        own = self.writer.request.for_image(job.key, job.values)
        return own.record_over(self._general_request)

    @cached_property
    def _general_request(self) -> Mapping[str, Any]:
        return self.writer.request.record()

    def is_done(self, job: Job) -> bool:
        """Return whether nothing of a job is made: its pictures are kept, or it will fail."""
        try:
            return not self._missing(JobState(job, self.loader, job, request=self._request_of(job)))
        except (ImageError, RequestError):
            return True

    def _missing(self, state: JobState) -> Sequence[Rendition]:
        """Return the renditions of a job that must be made."""
        renditions, redo = self.writer.renditions_of(state.job), self._sink.redo
        if redo is Redo.ALL:
            return self.writer.needed(state.job, renditions)
        found = {
            each: self._sink.found(state.job, each, self.writer.request_record(state.request, each))
            for each in renditions
        }
        state.old = sum(existing is ExistingFiles.OLD for existing in found.values())
        is_recomputed = self.frames.is_recomputed(state.job)
        missing = [e for e, existing in found.items() if is_recomputed or not redo.keeps(existing)]
        return self.writer.needed(state.job, missing)

    @staticmethod
    def read(loader: ImageLoader, job: Job) -> tuple[Stamps, LoadedImage | None]:
        """Return the image of a job with local files, and the stamps of the files.

        Raises:
            ImageError, RequestError, MemoryError: the image cannot be read, or does not fit the
                chain.
        """
        stamps = [stamp_of(path) for path in job.paths]
        return stamps, loader.enter(job, loader.read(job))

    def _load(self, state: JobState) -> None:
        """Load a state's image, and set the recipes of its renditions.

        Raises:
            ImageError, RequestError, MemoryError: the image cannot be read, or does not fit the
                chain.
        """
        job, renditions, decoded = state.here, state.renditions, state.decoded
        loaded: LoadedImage | None
        if decoded:
            state.stamps, state.spans = decoded.stamps, [decoded.span]
            loaded = state.loader.enter(job, decoded.source)
        else:
            state.stamps, loaded = self.read(state.loader, job)
        if loaded is None:
            state.status = LEFT_OUT
            return
        self.writer.check_size(loaded.source, loaded.chain)
        intrinsics_of(loaded.chain, loaded.source)  # raises an error for impossible intrinsics
        if patches := self.writer.patches:
            height, width = loaded.source.pixels.shape[:2]
            state.patches = all_patches(patches, loaded.chain, width, height, job.key)
        if any(map(self.writer.carries, renditions)):
            upright = self.writer.picture_orientation(loaded.source, loaded.chain)
            state.carried_layers = state.loader.carried_layers(
                job, loaded, 1 if patches else upright
            )
            if patches and patches.augment:
                state.carried_layers.check_no_vectors()
            warnings = (*loaded.source.warnings, *state.carried_layers.warnings)
            loaded = replace(loaded, source=replace(loaded.source, warnings=warnings))
        state.source = loaded.source
        state.recipes = recipes(renditions, loaded.chain, loaded.key)
