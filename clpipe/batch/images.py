"""The images of a run: which files, which part of them, and the tars or clips that they go into."""

import logging
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from clpipe.base.errors import RequestError
from clpipe.batch.clips import ClipOptions
from clpipe.batch.tars import Tar, split_into_tars
from clpipe.chain.python_words import python_words
from clpipe.inputs.find import Job, Shard, find_jobs
from clpipe.inputs.loader import ImageLoader
from clpipe.inputs.poses import assign_views
from clpipe.inputs.sequences import in_sequences, sequence_of, summary
from clpipe.inputs.series import Series

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Images:
    """The images of a run.

    Args:
        inputs: files, directories, globs, URLs and manifests.
        exclude: patterns of files that are skipped in directories and globs.
        poses: the file with the renders' cameras and poses, if any.
        series: several cameras and ISOs, whose pictures go to directories of their own.
        shard: the part of the images to make.
        per_tar: the number of images per tar. None writes no tars.
        repeat: the number of pictures of each image, each with its own noise and draws. None is
            one picture, with the name of the image.
        sequence: whether the images are frames of sequences.
        clips: the clips that the frames of sequences go into. None writes no clips.
        known_jobs: jobs that are known already, instead of inputs.
    """

    inputs: Sequence[str] = ()
    exclude: Sequence[str] = ()
    poses: Path | None = None
    repeat: int | None = None
    series: Series = field(default_factory=Series)
    shard: Shard = field(default_factory=Shard)
    per_tar: int | None = None
    sequence: bool = False
    clips: ClipOptions | None = None
    known_jobs: Sequence[Job] = ()

    @property
    def is_whole(self) -> bool:
        """Whether the output directory will hold all pictures, as files, when the run ends."""
        return bool(self.inputs) and not self.per_tar and not self.clips and self.shard.of == 1

    def _rate_text(self) -> str:
        """Return the frame rate of clips without times, with its source; "" without clips."""
        if not self.clips:
            return ""
        rate, source = self.clips.video.rate, "--fps" if self.clips.has_rate else "the default"
        return python_words(f"{rate} frames per second from {source}")

    def jobs(self, loader: ImageLoader, output: Path) -> tuple[list[Job], list[Tar]]:
        """Return the jobs of this part of the run, and the tars that they go into.

        Raises:
            RequestError: an input, a camera or an ISO does not exist, or two outputs have one name.
        """
        jobs = self.known_jobs
        if not jobs:
            known_jobs = find_jobs(self.inputs, output, loader.endings(), self.exclude)
            jobs = loader.exposures(known_jobs, self.sequence)
        jobs = assign_views(jobs, self.poses, loader.settings.render, loader.request.truth_at)
        if self.repeat:
            if self.sequence:
                raise RequestError(
                    "--repeat: the frames of a sequence are not repeated; run the sequence with "
                    "another --seed and output directory instead"
                )
            jobs = [repetition(job, number) for job in jobs for number in range(self.repeat)]
        jobs = self.series.jobs(jobs, loader.settings)
        if self.sequence:
            if self.per_tar and self.shard.of > 1:
                raise RequestError(
                    "--shard: a tar may hold frames of two sequences, so --sequence with "
                    "--webdataset has no shards; remove one of the three options"
                )
            jobs = in_sequences(jobs)
            if jobs and not self.known_jobs:
                log.info(summary(jobs, self._rate_text()))
            names = self.shard.select(list(dict.fromkeys(map(sequence_of, jobs))))
            if not self.per_tar:
                return [job for job in jobs if sequence_of(job) in names], []
        if self.per_tar:
            tars = self.shard.select(split_into_tars(jobs, self.per_tar, output))
            return [job for tar in tars for job in tar.jobs], tars
        return self.shard.select(jobs), []


def repetition(job: Job, number: int) -> Job:
    """Return a job for one of several pictures of an image. Its noise and draws are its own.

    >>> again = repetition(Job(Path("in/a.exr"), "a.exr"), 3)
    >>> again.key, again.stem
    ('a_0003.exr', 'a_0003')
    """
    key = Path(job.key)
    name = f"{job.name}_{number:04}" if job.name else ""
    return replace(job, key=key.with_stem(f"{key.stem}_{number:04}").as_posix(), name=name)
