"""Clips: video files of sequences, and the records of their frames."""

import json
import re
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, field, replace
from fractions import Fraction
from itertools import groupby
from pathlib import Path, PurePosixPath
from typing import Any

from clpipe.base.about import __version__
from clpipe.base.errors import RequestError
from clpipe.base.extras import require
from clpipe.base.files import sha256_of, write_atomic
from clpipe.base.reading import check_regular
from clpipe.batch.outcome import Outcome
from clpipe.batch.tars import STAGING
from clpipe.chain.formats import CLIP_FORMATS
from clpipe.chain.options import Gaps
from clpipe.chain.rendition import FLOATS, Rendition
from clpipe.images.video import VideoOptions
from clpipe.images.video_reading import VIDEO_SUFFIXES
from clpipe.inputs.find import Job
from clpipe.inputs.sequences import rate_of, sequence_of
from clpipe.inputs.times import standard_rate
from clpipe.outputs.existing import ExistingFiles, match_sidecar
from clpipe.outputs.sidecar import DIGEST_KEY, SIDECAR, read_sidecar, to_json
from clpipe.outputs.writer import OutputWriter

SETTINGS = ".csv"  # next to a named clip: the settings of its frames, instead of run.csv
MAX_RATE = 1000  # frames per second
MAX_BLACK = 10_000  # frames that fill the gaps of a clip
RECORDS = ".jsonl"  # next to a clip: the sidecar of each frame, one per line
DECODED = ".decoded"  # the directory of a clip's decoded frames

# Options that only clips have, with their names in VideoOptions.
VIDEO_FIELDS = {
    "codec": "codec",
    "bit_depth": "bits",
    "crf": "crf",
    "bit_rate": "bit_rate",
    "fps": "rate",
}


@dataclass(frozen=True)
class ClipOptions:
    """Which clips are written.

    Args:
        suffix: the extension of the files, ".mp4" or ".mkv".
        video: how they are encoded.
        decoded: whether each clip is decoded to PNGs.
        name: the name of the only clip. "" names clips like their sequences.
        gaps: what is shown at the places of missing frames.
        has_rate: whether the user has set the frame rate.
    """

    suffix: str
    video: VideoOptions
    decoded: bool
    name: str
    gaps: Gaps
    has_rate: bool

    def shown(self, jobs: Sequence[Job]) -> Iterator[tuple[Fraction, Job | None]]:
        """Yield the frames of a clip, each with its time in s. None is a black frame."""
        places = [job.place for job in jobs if job.place]
        video = self.video_of(jobs[0])
        interval = Fraction(places[0].interval or 0) if video.has_times else 1 / video.rate
        last = Fraction(0)
        for count, (job, place) in enumerate(zip(jobs, places, strict=True)):
            shown = Fraction(count if self.gaps == "cut" else place.index - places[0].index)
            missing = round(shown - last) - 1 if self.gaps == "black" else 0
            yield from (((last + each) * interval, None) for each in range(1, missing + 1))
            yield shown * interval, job
            last = shown

    def video_of(self, job: Job) -> VideoOptions:
        """Return how the clip of a frame's sequence is encoded, with the rate of its times.

        Raises:
            RequestError: the sequence has times, but the user has set a frame rate.
        """
        rate = rate_of(job)
        if rate is None:
            return self.video
        if rate > MAX_RATE:
            raise RequestError(
                f"the times of {sequence_of(job)} are of {float(rate):.6g} frames per second, but "
                f"clips have {MAX_RATE} at most; correct the times"
            )
        if self.has_rate and rate != self.video.rate:
            raise RequestError(
                f"--fps: found {float(self.video.rate):.6g}, but the times of {sequence_of(job)} "
                f"are of {float(rate):.6g} frames per second; remove --fps, or the times"
            )
        return replace(self.video, rate=rate, has_times=self.gaps != "cut")

    def record(self, job: Job) -> dict[str, Any]:
        """Return what determines the bytes of a clip, besides its frames, as JSON values."""
        video = self.video_of(job)
        return {**asdict(video), "rate": str(video.rate), "gaps": self.gaps}


def parse_rate(text: str) -> Fraction:
    """Return frames per second, from a number or a fraction.

    Numbers near a rate of NTSC mean that rate.

    >>> parse_rate("24"), parse_rate("30000/1001"), parse_rate("29.97")
    (Fraction(24, 1), Fraction(30000, 1001), Fraction(30000, 1001))

    Raises:
        RequestError: the text is neither, or not between 0 and 1000.
    """
    is_rate = re.fullmatch(r"\d+(\.\d+)?|\d+/0*[1-9]\d*", text)
    rate = Fraction(text) if is_rate else Fraction(0)
    if not 0 < rate <= MAX_RATE:
        raise RequestError(f"--fps: found {text!r}; expected a number, such as 24 or 30000/1001")
    return standard_rate(rate)


def parse_bit_rate(text: str) -> int:
    """Return bits per second, from a number that may end in K or M, for powers of 1000.

    >>> parse_bit_rate("8M"), parse_bit_rate("64000")
    (8000000, 64000)

    Raises:
        RequestError: the text is no such number.
    """
    match = re.fullmatch(r"(\d+(?:\.\d+)?)([KM]?)", text.strip().upper())
    scale = {"": 1, "K": 1000, "M": 1_000_000}
    rate = round(float(match[1]) * scale[match[2]]) if match else 0
    if not 1000 <= rate <= 10**9:
        raise RequestError(
            f"--bit-rate: found {text!r}; expected bits per second, such as 800K or 8M"
        )
    return rate


def take_clip_options(options: dict[str, Any]) -> ClipOptions | None:
    """Return which clips a run writes, and replace their options by those of their frames.

    Args:
        options: options of :func:`clpipe.run`, converted. Options of clips are removed. The output
            becomes a directory, the format that of frames, and the run one of sequences.

    Returns:
        The clips, or None if the run writes no clips.

    Raises:
        RequestError: options contradict each other, or PyAV is missing.
    """
    video = {to: options.pop(name) for name, to in VIDEO_FIELDS.items() if name in options}
    single = {name: options.pop(name) for name in ("gaps", "decoded") if name in options}
    output: Path = options["output"]
    suffix = output.suffix.lower()[1:]
    is_file = suffix in CLIP_FORMATS and not output.is_dir()
    if f".{suffix}" in VIDEO_SUFFIXES and not is_file and not output.is_dir():
        raise RequestError(
            f"--output: found {output.name}, but clpipe writes clips as "
            f"{' or '.join(f'.{each}' for each in CLIP_FORMATS)}; use one of these"
        )
    formats = dict.fromkeys([*options.get("format", ()), *([suffix] if is_file else [])])
    if not formats.keys() & CLIP_FORMATS:
        given = [n for n, to in VIDEO_FIELDS.items() if to in video]
        given += [name for name, value in single.items() if value]
        if given:
            raise RequestError(
                f"--{given[0].replace('_', '-')}: this option needs a clip; use -o NAME.mp4, or "
                "--format mp4"
            )
        return None
    if len(formats) > 1:
        raise RequestError(
            f"--format: found {', '.join(formats)}, but a run writes either clips of one format or "
            "pictures; use one run for each"
        )
    for name in ("keep", "carry", "patch", "webdataset", "dask"):
        if options.get(name):
            raise RequestError(
                f"--{name}: a clip contains only pictures; remove this option, or write pictures "
                "to a directory, with --sequence"
            )
    if mosaics := [name for name in options.get("truth", ()) if name in FLOATS]:
        raise RequestError(
            f"--truth: found {mosaics[0]}, but a clip contains only pictures; remove it"
        )
    name = output.stem if is_file else ""
    clips = ClipOptions(
        f".{next(iter(formats))}",
        VideoOptions(**video),
        single.get("decoded", False),
        name,
        single.get("gaps", "hold"),
        "rate" in video,
    )
    clips.video.check_suffix(clips.suffix)
    require("a clip", "video")
    options["output"] = output.parent if is_file else output
    options["format"] = ("png" if clips.video.bits == 8 else "png16",)
    options["sequence"] = True
    return clips


@dataclass
class Clip:
    """The clip of one rendition of a sequence.

    Args:
        path: the video file.
        rendition: which picture of each frame.
        existing: what exists of it, see :meth:`find`.
    """

    path: Path
    rendition: Rendition
    existing: ExistingFiles = ExistingFiles.NOTHING

    @property
    def records_path(self) -> Path:
        """The file with the records of its frames."""
        return self.path.with_name(f"{self.path.name}{RECORDS}")

    def decoded_path(self, job: Job) -> Path:
        """Return the path of a decoded frame."""
        folder = self.path.with_name(f"{self.path.name}{DECODED}")
        return folder / f"{PurePosixPath(job.stem).name}.png"

    def find(
        self, jobs: Sequence[Job], writer: OutputWriter, options: ClipOptions, verify: bool
    ) -> ExistingFiles:
        """Return whether the clip exists, made of the same frames by the same request.

        Args:
            jobs: the frames of the sequence, with their settings.
            writer: the writer of the run.
            options: how the clip is encoded.
            verify: whether to check the SHA-256 of each input.
        """

        def matched(job: Job, record: dict[str, Any]) -> ExistingFiles:
            request = writer.request.for_image(job.key, job.values).record()
            request = writer.request_record(request, self.rendition)
            return match_sidecar(record, job, request, verify)

        try:
            check_regular(self.records_path)
            lines = self.records_path.read_text("utf-8", "surrogateescape").splitlines()
            records = [json.loads(line) for line in lines]
            clip = records[0]["clip"]
            pictures = [job for job in jobs if job.stem not in clip["left_out"]]
            names = [record["name"] for record in records]
            stems = [job.stem for job in pictures]
            if (clip["encoding"], names) != (options.record(jobs[0]), stems):
                return ExistingFiles.NOTHING
            if (clip["sha256"], clip["size"]) != sha256_of(self.path):
                return ExistingFiles.NOTHING
            if any(
                record | _times(job) != record
                for record, job in zip(records, pictures, strict=True)
            ):
                return ExistingFiles.NOTHING
            found = [*map(matched, pictures, records)]
        except (OSError, ValueError, LookupError, TypeError, RequestError):
            return ExistingFiles.NOTHING  # they are missing or damaged
        return min(found, key=[*ExistingFiles].index)

    def write_records(
        self,
        jobs: Sequence[Job],
        left_out: Sequence[Job],
        writer: OutputWriter,
        options: ClipOptions,
    ) -> None:
        """Write the sidecars of the frames as lines. Each names the finished clip and its place.

        Args:
            jobs: the frames in temporal order.
            left_out: files that are no pictures.
            writer: the writer of the sidecars.
            options: how the clip was encoded.

        Raises:
            ImageError: they cannot be written, or a sidecar cannot be read.
        """
        digest, size = sha256_of(self.path)
        clip = {"name": self.path.name, "size": size, "sha256": digest}
        clip |= {"encoding": options.record(jobs[0]), "left_out": [job.stem for job in left_out]}
        clip["software"] = f"clpipe {__version__}"  # marks the file as written by clpipe
        lines = []
        for job in jobs:
            sidecar = read_sidecar(writer.path(job, SIDECAR, self.rendition))
            del sidecar[DIGEST_KEY]
            record = {**sidecar, **_times(job), "clip": clip}
            lines.append(f"{to_json(record)}\n".encode())
        write_atomic(self.records_path, *lines)


def _times(job: Job) -> dict[str, float | None]:
    """Return the place of a frame in its sequence, and its time in s if it has one."""
    assert job.place
    index, interval = job.place.index, job.place.interval
    return {"index": index, "time": round(index * interval, 9) if interval else None}


@dataclass
class SequenceClips:
    """The clips of a sequence, one for each rendition.

    Args:
        staging: the directory of the frames until they are encoded.
        jobs: its frames in temporal order.
        clips: the clips.
        statuses: the status of each finished frame, by its stem.
    """

    staging: Path
    jobs: Sequence[Job]
    clips: Sequence[Clip]
    statuses: dict[str, str] = field(default_factory=dict)

    def add(self, outcome: Outcome) -> bool:
        """Add the outcome of a frame. Return whether it was the last one."""
        self.statuses[outcome.job.stem] = outcome.status
        return len(self.statuses) == len(self.jobs)

    def jobs_with(self, *statuses: str) -> list[Job]:
        """Return the frames with some statuses, in temporal order."""
        return [job for job in self.jobs if self.statuses[job.stem] in statuses]


def clips_of(
    jobs: Sequence[Job], writer: OutputWriter, options: ClipOptions
) -> dict[str, SequenceClips]:
    """Return the clips of each sequence, by the name of the sequence.

    Args:
        jobs: frames, sorted by sequence.
        writer: the writer of the run.
        options: which clips are written.

    Raises:
        RequestError: one clip is named, but there are several sequences; or two files would have
            the same name.
    """
    groups = {name: list(group) for name, group in groupby(jobs, key=sequence_of)}
    if options.name and len(groups) > 1:
        raise RequestError(
            f"--output: found {options.name}{options.suffix} for {len(groups)} sequences "
            f"({', '.join([*groups][:3])}); use -o OUT --format {options.suffix[1:]}"
        )
    for sequence, frames in groups.items():
        options.video_of(frames[0])
        place = frames[0].place
        if options.gaps == "black" and place and place.count - len(frames) > MAX_BLACK:
            raise RequestError(
                f"--gaps: {place.count - len(frames)} frames of {sequence} are missing, but "
                f"{MAX_BLACK} black frames are allowed; use hold or cut"
            )
    found = {}
    owners: dict[Path, str] = {}
    for sequence, frames in groups.items():
        path = writer.folder / (options.name or sequence)
        clips = [
            Clip(path.with_name(f"{path.name}{each.suffix}{options.suffix}"), each)
            for each in writer.renditions_of(frames[0])
        ]
        owner = f"the sequence {sequence}"
        for records in (clip.records_path for clip in clips):
            if (other := owners.setdefault(records, owner)) != owner:
                raise RequestError(
                    f"{records}: {other} and {owner} would both write this file; "
                    "rename the directory of the sequence"
                )
        found[sequence] = SequenceClips(path.with_name(f"{STAGING}{path.name}"), frames, clips)
    return found
