"""The sink that encodes the pictures of sequences into clips.

The pictures of a sequence are first written to a hidden directory as PNG, and encoded when all are
there. A run that was interrupted therefore resumes with the missing frames.
"""

import glob
import logging
import os
from collections.abc import Generator, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import groupby
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from clpipe.base.errors import ImageError, RequestError
from clpipe.base.files import create_parents, discard, shorten_name, sync_folder
from clpipe.batch.clips import Clip, ClipOptions, SequenceClips, clips_of
from clpipe.batch.outcome import DONE, FAILED, LEFT_OUT, SKIPPED, Outcome
from clpipe.batch.sinks import Executor, GroupSink
from clpipe.batch.tar_sink import StagedWriter
from clpipe.chain.chain import Chain
from clpipe.chain.formats import extension_of
from clpipe.chain.rendition import Rendition
from clpipe.images.read import SourceImage
from clpipe.images.samples import read_whole_numbers
from clpipe.images.video import VideoOptions, VideoWriter
from clpipe.images.video_reading import read_video
from clpipe.images.write import write_png
from clpipe.inputs.find import Job
from clpipe.inputs.sequences import sequence_of
from clpipe.outputs.existing import OVERWRITTEN, ExistingFiles, Redo, find_existing, is_marked
from clpipe.outputs.writer import OutputWriter

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class ClipWriter(StagedWriter):
    """A writer that puts each picture into the directory of its sequence."""

    video: VideoOptions = field(default_factory=VideoOptions)

    def check_size(self, source: SourceImage, chain: Chain) -> None:
        self.video.check_size(*chain.size(*source.pixels.shape[1::-1]))


class Clips(GroupSink[SequenceClips]):
    """Clips as a sink.

    Args:
        writer: writes the files of a rendition.
        redo: which existing clips are made again.
        jobs: the frames, sorted by sequence.
        options: which clips are written.

    Raises:
        RequestError: see :func:`clpipe.batch.clips.clips_of`.
    """

    def __init__(
        self, writer: OutputWriter, redo: Redo, jobs: Sequence[Job], options: ClipOptions
    ) -> None:
        self._sequences = clips_of(jobs, writer, options)
        folders = {
            job.stem: str(each.staging.relative_to(writer.folder))
            for each in self._sequences.values()
            for job in each.jobs
        }
        super().__init__(ClipWriter(writer.folder, writer.request, folders, options.video), redo)
        self.options = options

    def found(self, job: Job, rendition: Rendition, request: Mapping[str, Any]) -> ExistingFiles:
        """Return what exists of a frame, in its clip or in the directory that will be encoded."""
        clips = self.group(job).clips
        clip = next(each for each in clips if each.rendition == rendition)
        if self.redo.keeps(clip.existing):
            return clip.existing
        # Frames are written without fsync, see `Tars.found`.
        return find_existing(
            self.writer.files(job, rendition), job, request, verify=True, is_exclusive=True
        )

    def receive(self, executor: Executor, jobs: Iterable[Job]) -> Generator[Outcome, None, None]:
        """Let an executor do the jobs, and yield their outcomes.

        The outcomes of a sequence come after its clips have been encoded, and the last one names
        them. If they cannot be encoded, the last one has failed, and the others name no files.

        Raises:
            RequestError: clpipe did not write a file that would be overwritten.
            DeviceError: no device is usable.
            OutputError: nothing more can be written.
        """
        for clip in (clip for each in self._sequences.values() for clip in each.clips):
            for path in (clip.path, clip.records_path):
                if self.redo is not Redo.ALL and os.path.lexists(path) and not is_marked(path):
                    raise RequestError(
                        f"{path}: clpipe did not write this file, and it {OVERWRITTEN}"
                    )
        yield from super().receive(executor, self._searched(jobs))

    def group(self, job: Job) -> SequenceClips:
        return self._sequences[sequence_of(job)]

    def _searched(self, jobs: Iterable[Job]) -> Iterator[Job]:
        """Yield jobs. Before the first one of a sequence, its existing clips are searched.

        A clip is kept only if none of its frames has changed. So if there is one, all frames of the
        sequence must get their settings before the first one is made.
        """
        for name, group in groupby(jobs, key=sequence_of):
            clips, frames = self._sequences[name].clips, iter(group)
            if self.redo is not Redo.ALL and any(clip.records_path.exists() for clip in clips):
                known = [*frames]
                for clip in clips:
                    clip.existing = clip.find(known, self.writer, self.options, self.redo.verifies)
                frames = iter(known)
            yield from frames

    def finish(self, group: SequenceClips, outcomes: list[Outcome]) -> list[Outcome]:
        # The last one names the clips. It is one of those that were made, if there are any.
        named = sorted(map(self.named, outcomes), key=lambda each: each.status == DONE)
        if failed := group.jobs_with(FAILED):
            log.warning(
                "%s: no clip is written, because the frame %s failed. The other frames are kept, "
                "and the same command resumes",
                group.clips[0].path,
                failed[0].label,
            )
        elif named:
            named[-1] = self._finished(group, named[-1])
        return named

    def _finished(self, sequence: SequenceClips, last: Outcome) -> Outcome:
        """Encode the clips of a sequence whose frames are all there.

        Returns:
            The outcome of its last frame.

        Raises:
            OutputError: nothing more can be written.
        """
        pictures = sequence.jobs_with(DONE, SKIPPED)
        written: list[Path] = []
        try:
            for clip in sequence.clips:
                decoded = [clip.decoded_path(job) for job in pictures]
                if not self.redo.keeps(clip.existing):
                    for path in decoded:  # those of an older clip
                        discard(path)
                    self._encode(sequence, clip, pictures)
                    written += [clip.path, clip.records_path]
                if self.options.decoded and not all(path.exists() for path in decoded):
                    create_parents(decoded[0])
                    shown = self.options.shown(pictures)
                    for (_, job), frame in zip(shown, read_video(clip.path), strict=True):
                        if job:
                            write_png(clip.decoded_path(job), frame)
        except ImageError as error:
            self.writer.check_folder()
            return replace(last, status=FAILED, error=str(error))
        discard(sequence.staging)
        outputs = tuple(str(path.relative_to(self.writer.folder)) for path in written)
        return replace(last, status=DONE if written else last.status, outputs=outputs)

    def _encode(self, sequence: SequenceClips, clip: Clip, jobs: Sequence[Job]) -> None:
        """Write a clip and the records of its frames, in this order.

        Raises:
            ImageError: a frame cannot be read, frames have several sizes, or a file cannot be
                written.
        """
        for path in clip.path.parent.glob(f".{glob.escape(shorten_name(clip.path.stem))}.*.part.*"):
            discard(path)  # a killed run left it
        create_parents(clip.path)
        ending = extension_of(self.writer.formats[0])
        with VideoWriter(clip.path, self.options.video_of(jobs[0])) as video:
            for time, job in self.options.shown(jobs):
                if job:
                    path = self.writer.path(job, ending, clip.rendition)
                    frame = read_whole_numbers(path, colours=True)
                video.add(frame if job else np.zeros_like(frame), time)
        clip.write_records(jobs, sequence.jobs_with(LEFT_OUT), self.writer, self.options)
        sync_folder(clip.path.parent)

    def named(self, outcome: Outcome) -> Outcome:
        first = self.group(outcome.job).clips[0]
        clip, frame = first.path.relative_to(self.writer.folder), PurePosixPath(outcome.job.stem)
        return replace(outcome, job=replace(outcome.job, name=f"{clip}/{frame.name}"), outputs=())
