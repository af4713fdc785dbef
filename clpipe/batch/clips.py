"""Clips: video files of sequences, and the records of their frames."""

import json
import os
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from fractions import Fraction
from itertools import groupby
from pathlib import Path, PurePosixPath
from typing import Any

from clpipe.base.errors import RequestError
from clpipe.base.extras import require
from clpipe.base.files import sha256_of, write_atomic
from clpipe.base.reading import check_regular, read_start
from clpipe.batch.outcome import FAILED, Outcome
from clpipe.batch.run_log import log_name
from clpipe.batch.tars import STAGING
from clpipe.chain.formats import CLIP_FORMATS
from clpipe.chain.rendition import FLOAT_MOSAICS, Rendition
from clpipe.images.video import VideoOptions
from clpipe.inputs.find import Job, Shard
from clpipe.inputs.sequences import sequence_of
from clpipe.outputs.existing import OVERWRITTEN, ExistingFiles, Redo, is_marked, match_sidecar
from clpipe.outputs.sidecar import DIGEST_KEY, VERSION_KEY, read_sidecar, to_json
from clpipe.outputs.writer import OutputWriter

RECORDS = ".jsonl"  # next to a clip: the sidecar of each frame, one per line
RECORD_START = b'{"%b": ' % VERSION_KEY.encode()
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
    """

    suffix: str
    video: VideoOptions = field(default_factory=VideoOptions)
    decoded: bool = False
    name: str = ""

    def record(self) -> dict[str, Any]:
        """Return what determines the bytes of a clip, besides its frames, as JSON values."""
        return {**asdict(self.video), "rate": str(self.video.rate)}


def parse_rate(text: str) -> Fraction:
    """Return frames per second, from a number or a fraction.

    >>> parse_rate("24"), parse_rate("30000/1001"), parse_rate("29.97")
    (Fraction(24, 1), Fraction(30000, 1001), Fraction(2997, 100))

    Raises:
        RequestError: the text is neither, or not between 0 and 1000.
    """
    try:
        rate = Fraction(text)
    except (ValueError, ZeroDivisionError):
        rate = Fraction(0)
    if not 0 < rate <= 1000:
        raise RequestError(f"--fps: found {text!r}; expected a number, such as 24 or 30000/1001")
    return rate.limit_denominator(1001)


def parse_bit_rate(text: str) -> int:
    """Return bits per second, from a number that may end in K or M, for powers of 1000.

    >>> parse_bit_rate("8M"), parse_bit_rate("64000")
    (8000000, 64000)

    Raises:
        RequestError: the text is no such number.
    """
    number, scale = text.strip(), 1
    if number[-1:].upper() in ("K", "M"):
        number, scale = number[:-1], {"K": 1000, "M": 1_000_000}[number[-1].upper()]
    try:
        rate = round(float(number) * scale)
    except (ValueError, OverflowError):
        rate = 0
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
    decoded = options.pop("decoded", False)
    output: Path = options["output"]
    formats: Sequence[str] = options.get("format", ())
    suffix = output.suffix.lower()
    is_file = suffix[1:] in CLIP_FORMATS and not output.is_dir()
    if not is_file and not set(formats) & set(CLIP_FORMATS):
        if video or decoded:
            name = next((n for n, to in VIDEO_FIELDS.items() if to in video), "decoded")
            raise RequestError(
                f"--{name.replace('_', '-')}: this option needs a clip; use -o NAME.mp4, or "
                "--format mp4"
            )
        return None
    if len(formats) > 1 or (is_file and formats and formats[0] != suffix[1:]):
        found = ", ".join([*formats, *([str(output)] if is_file else [])])
        raise RequestError(
            f"--format: found {found}, but a run writes either clips of one format or pictures; "
            "use one run for each"
        )
    for name in ("keep", "carry", "patch", "webdataset", "dask"):
        if options.get(name):
            raise RequestError(
                f"--{name}: a clip contains only pictures; remove this option, or write pictures "
                "to a directory, with --sequence"
            )
    if mosaics := [name for name in options.get("truth", ()) if name in FLOAT_MOSAICS]:
        raise RequestError(
            f"--truth: found {mosaics[0]}, but a clip contains only pictures; remove it"
        )
    clips = ClipOptions(
        suffix if is_file else f".{formats[0]}",
        VideoOptions(**video),
        decoded,
        output.stem if is_file else "",
    )
    clips.video.check_suffix(clips.suffix)
    require("a clip", "av")
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
        is_kept: whether it stays as it is.
    """

    path: Path
    rendition: Rendition
    existing: ExistingFiles = ExistingFiles.NOTHING
    is_kept: bool = False

    @property
    def records_path(self) -> Path:
        """The file with the records of its frames."""
        return self.path.with_name(self.path.name.removesuffix(self.path.suffix) + RECORDS)

    def decoded_path(self, job: Job) -> Path:
        """Return the path of a decoded frame."""
        folder = self.path.name.removesuffix(self.path.suffix) + DECODED
        return self.path.with_name(folder) / f"{PurePosixPath(job.stem).name}.png"

    def records(self) -> list[dict[str, Any]]:
        """Return the records of its frames. They are empty if they are missing or damaged."""
        try:
            check_regular(self.records_path)
            lines = self.records_path.read_text("utf-8", "surrogateescape").splitlines()
            records = [json.loads(line) for line in lines]
        except (OSError, ValueError):
            return []
        is_ours = all(isinstance(each, dict) and VERSION_KEY in each for each in records)
        return records if is_ours else []

    def find(
        self, jobs: Sequence[Job], writer: OutputWriter, options: ClipOptions, redo: Redo
    ) -> None:
        """Set whether the clip exists, made of the same frames by the same request.

        Args:
            jobs: the frames of the sequence, with their settings.
            writer: the writer of the run.
            options: how the clip is encoded.
            redo: which existing clips are made again.
        """
        self.existing = self._find(jobs, writer, options, redo.verifies)
        self.is_kept = redo is not Redo.ALL and redo.keeps(self.existing)

    def _find(
        self, jobs: Sequence[Job], writer: OutputWriter, options: ClipOptions, verify: bool
    ) -> ExistingFiles:
        records = self.records()
        clip = records[0].get("clip") if records else None
        if not isinstance(clip, dict) or clip.get("encoding") != options.record():
            return ExistingFiles.NOTHING
        try:
            if sha256_of(self.path) != (clip["sha256"], clip["size"]):
                return ExistingFiles.NOTHING
            pictures = [job for job in jobs if job.stem not in clip["left_out"]]
            if [record["name"] for record in records] != [job.stem for job in pictures]:
                return ExistingFiles.NOTHING
            found = {
                match_sidecar(
                    record,
                    job,
                    writer.request_record(
                        writer.request.for_image(job.key, job.values).record(), self.rendition
                    ),
                    verify,
                )
                for record, job in zip(records, pictures, strict=True)
            }
        except (KeyError, TypeError, OSError, RequestError):
            return ExistingFiles.NOTHING
        order = (ExistingFiles.NOTHING, ExistingFiles.OLD, ExistingFiles.DONE)
        return min(found, key=order.index)

    def write_records(
        self,
        frames: Sequence[tuple[Job, Path]],
        left_out: Sequence[str],
        options: ClipOptions,
    ) -> None:
        """Write the sidecars of the frames as lines. Each names the finished clip and its place.

        Args:
            frames: the frames in temporal order, each with its sidecar.
            left_out: the names of files that are no pictures.
            options: how the clip was encoded.

        Raises:
            ImageError: they cannot be written, or a sidecar cannot be read.
        """
        digest, size = sha256_of(self.path)
        clip = {"name": self.path.name, "size": size, "sha256": digest}
        clip |= {"encoding": options.record(), "left_out": list(left_out)}
        lines = []
        for job, sidecar in frames:
            assert job.place
            record = {**read_sidecar(sidecar), "index": job.place.index, "clip": clip}
            record.pop(DIGEST_KEY)
            lines.append(f"{to_json(record)}\n".encode())
        write_atomic(self.records_path, *lines)


@dataclass
class SequenceClips:
    """The clips of a sequence, one for each rendition.

    Args:
        name: the path of the sequence in the output directory, without extension.
        folder: the output directory.
        jobs: its frames in temporal order.
        clips: the clips.
        statuses: the status of each finished frame, by its stem.
        failed: the label of the first frame that failed; "" if none did.
    """

    name: str
    folder: Path
    jobs: Sequence[Job]
    clips: Sequence[Clip]
    statuses: dict[str, str] = field(default_factory=dict)
    failed: str = ""

    @property
    def staging(self) -> Path:
        """The directory of the frames until they are encoded."""
        path = self.folder / self.name
        return path.with_name(f"{STAGING}{path.name}")

    @property
    def is_complete(self) -> bool:
        """Whether all frames have an outcome."""
        return len(self.statuses) == len(self.jobs)

    def add(self, outcome: Outcome) -> None:
        """Add the outcome of a frame."""
        self.statuses[outcome.job.stem] = outcome.status
        if outcome.status == FAILED:
            self.failed = self.failed or outcome.job.label


def clips_of(
    jobs: Sequence[Job], writer: OutputWriter, options: ClipOptions
) -> list[SequenceClips]:
    """Return the clips of each sequence.

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
    found = []
    paths: dict[Path, str] = {}
    for sequence, frames in groups.items():
        name = options.name or sequence
        clips = [
            Clip(writer.folder / f"{name}{each.suffix}{options.suffix}", each)
            for each in writer.renditions_of(frames[0])
        ]
        for path in (clip.records_path for clip in clips):
            other = paths.setdefault(path, sequence)
            is_log = path == writer.folder / log_name(Shard())
            if other != sequence or is_log:
                owner = "the log of the run" if is_log else f"the sequence {other}"
                raise RequestError(
                    f"{path}: {owner} and the sequence {sequence} would both write this file; "
                    "rename the directory of the sequence"
                )
        found.append(SequenceClips(name, writer.folder, frames, clips))
    return found


def check_overwritten(sequences: Sequence[SequenceClips]) -> None:
    """Check that clpipe wrote the files that clips would overwrite.

    Raises:
        RequestError: it did not write one.
    """
    for clip in (clip for sequence in sequences for clip in sequence.clips):
        checks = ((clip.path, is_marked), (clip.records_path, _holds_records))
        for path, is_ours in checks:
            if os.path.lexists(path) and not is_ours(path):
                raise RequestError(f"{path}: clpipe did not write this file, and it {OVERWRITTEN}")


def _holds_records(path: Path) -> bool:
    """Return whether a file begins like :meth:`Clip.write_records`, or is zeros."""
    try:
        start = read_start(path, len(RECORD_START))
    except OSError:
        return False
    return start == RECORD_START or not start.strip(b"\0")
