"""The sink that encodes the pictures of sequences into clips.

The pictures of a sequence are first written to a hidden directory as PNG, and encoded when all are
there. A run that was interrupted therefore resumes with the missing frames.
"""

import glob
import logging
from collections.abc import Generator, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from itertools import groupby
from pathlib import Path, PurePosixPath
from typing import Any

from clpipe.base.errors import ImageError
from clpipe.base.files import create_parents, discard, shorten_name, sync_folder
from clpipe.batch.clips import (
    Clip,
    ClipOptions,
    SequenceClips,
    check_overwritten,
    clips_of,
)
from clpipe.batch.outcome import DONE, FAILED, LEFT_OUT, Outcome
from clpipe.batch.sinks import Executor, Folder
from clpipe.batch.tar_sink import StagedWriter
from clpipe.chain.chain import Chain
from clpipe.chain.formats import extension_of
from clpipe.chain.rendition import Rendition
from clpipe.images.read import SourceImage
from clpipe.images.samples import read_whole_numbers
from clpipe.images.video import VideoOptions, VideoWriter, read_video
from clpipe.images.write import write_png
from clpipe.inputs.find import Job
from clpipe.inputs.sequences import sequence_of
from clpipe.outputs.existing import ExistingFiles, Redo, find_existing
from clpipe.outputs.sidecar import SIDECAR
from clpipe.outputs.writer import OutputWriter

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class ClipWriter(StagedWriter):
    """A writer that puts each picture into the directory of its sequence."""

    video: VideoOptions = field(default_factory=VideoOptions)

    def check_size(self, source: SourceImage, chain: Chain) -> None:
        self.video.check_size(*chain.size(*source.pixels.shape[1::-1]))


class Clips(Folder):
    """Clips as a sink. Each sequence is encoded while the pictures of the next one are made.

    Args:
        writer: writes the files of a rendition.
        redo: which existing clips are made again.
        jobs: the frames, sorted by sequence.
        options: which clips are written.

    Raises:
        RequestError: see :func:`clpipe.batch.clips.clips_of`.
    """

    allows_processes = False

    def __init__(
        self, writer: OutputWriter, redo: Redo, jobs: Sequence[Job], options: ClipOptions
    ) -> None:
        sequences = clips_of(jobs, writer, options)
        folders = {
            job.stem: str(each.staging.relative_to(writer.folder))
            for each in sequences
            for job in each.jobs
        }
        super().__init__(ClipWriter(writer.folder, writer.request, folders, options.video), redo)
        self.options = options
        self._sequences = {sequence_of(each.jobs[0]): each for each in sequences}

    def found(self, job: Job, rendition: Rendition, request: Mapping[str, Any]) -> ExistingFiles:
        """Return what exists of a frame, in its clip or in the directory that will be encoded."""
        clips = self._sequences[sequence_of(job)].clips
        clip = next(each for each in clips if each.rendition == rendition)
        if clip.is_kept:
            return clip.existing
        # Frames are written without fsync, see `Tars.found`.
        return find_existing(
            self.writer.files(job, rendition), job, request, verify=True, is_exclusive=True
        )

    def receive(self, executor: Executor, jobs: Iterable[Job]) -> Generator[Outcome, None, None]:
        """Let an executor do the jobs, and yield their outcomes.

        The outcome of a sequence's last frame comes after its clips have been encoded, and names
        them. It has failed if they cannot be.

        Raises:
            RequestError: clpipe did not write a file that would be overwritten.
            DeviceError: no device is usable.
            OutputError: nothing more can be written.
        """
        if self.redo is not Redo.ALL:
            check_overwritten([*self._sequences.values()])
        encoding: Future[Outcome] | None = None
        with ThreadPoolExecutor(1, "clip") as pool:
            for outcome in executor.run(self._searched(jobs)):
                sequence = self._sequences[sequence_of(outcome.job)]
                sequence.add(outcome)
                if not sequence.is_complete:
                    yield named(outcome, sequence)
                    continue
                if encoding:
                    yield encoding.result()
                encoding = pool.submit(self._finish, sequence, outcome)
            if encoding:
                yield encoding.result()

    def _searched(self, jobs: Iterable[Job]) -> Iterator[Job]:
        """Yield jobs. Before the first one of a sequence, its existing clips are searched.

        A clip is kept only if none of its frames has changed. So if there is one, all frames of the
        sequence must get their settings before the first one is made.
        """
        for name, group in groupby(jobs, key=sequence_of):
            clips, frames = self._sequences[name].clips, iter(group)
            if any(clip.records_path.exists() for clip in clips):
                known = [*frames]
                for clip in clips:
                    clip.find(known, self.writer, self.options, self.redo)
                frames = iter(known)
            yield from frames

    def _finish(self, sequence: SequenceClips, outcome: Outcome) -> Outcome:
        """Encode the clips of a sequence whose frames are all there.

        Returns:
            The outcome of its last frame.

        Raises:
            OutputError: nothing more can be written.
        """
        if sequence.failed:
            log.warning(
                "%s: no clip is written, because the frame %s failed. The other frames are kept, "
                "and the same command resumes",
                sequence.clips[0].path,
                sequence.failed,
            )
            return named(outcome, sequence)
        pictures = [job for job in sequence.jobs if sequence.statuses[job.stem] != LEFT_OUT]
        written: list[Path] = []
        try:
            for clip in sequence.clips if pictures else ():
                decoded = [clip.decoded_path(job) for job in pictures]
                if not clip.is_kept:
                    for path in decoded:  # those of an older clip
                        discard(path)
                    self._encode(sequence, clip, pictures)
                    written += [clip.path, clip.records_path]
                if self.options.decoded and not all(path.exists() for path in decoded):
                    decode_clip(clip, decoded)
        except ImageError as error:
            self.writer.check_folder()
            return replace(named(outcome, sequence), status=FAILED, error=str(error))
        discard(sequence.staging)
        outputs = tuple(str(path.relative_to(self.writer.folder)) for path in written)
        status = DONE if written else outcome.status
        return replace(named(outcome, sequence), status=status, outputs=outputs)

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
        with VideoWriter(clip.path, self.options.video) as video:
            for job in jobs:
                path = self.writer.path(job, ending, clip.rendition)
                video.add(read_whole_numbers(path, colours=True))
        frames = [(job, self.writer.path(job, SIDECAR, clip.rendition)) for job in jobs]
        stems = {job.stem for job in jobs}
        left_out = [job.stem for job in sequence.jobs if job.stem not in stems]
        clip.write_records(frames, left_out, self.options)
        sync_folder(clip.path.parent)


def decode_clip(clip: Clip, paths: Sequence[Path]) -> None:
    """Write the frames of a clip as PNGs.

    Raises:
        ImageError: the clip cannot be read, or a file cannot be written.
    """
    create_parents(paths[0])
    for path, frame in zip(paths, read_video(clip.path), strict=True):
        write_png(path, frame)


def named(outcome: Outcome, sequence: SequenceClips) -> Outcome:
    """Return the outcome of a frame with the clip in its name, and without the hidden files."""
    clip = sequence.clips[0].path.relative_to(sequence.folder)
    job = replace(outcome.job, name=f"{clip}/{PurePosixPath(outcome.job.stem).name}")
    return replace(outcome, job=job, outputs=())
