"""Sequences: the frames of a directory in temporal order, by the numbers in their names."""

import logging
import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path, PurePosixPath

from clpipe.base.errors import RequestError
from clpipe.base.text import printable
from clpipe.inputs.find import Job, Place

log = logging.getLogger(__name__)

# A number of a name. A minus after a letter or a digit is a separator, not a sign.
NUMBER = re.compile(r"(?:(?<=[._])-|^-)?\d+")
MAX_GAPS = 5  # the most gaps that a message lists


def split_numbers(key: str) -> tuple[str, list[str]]:
    """Split the numbers of a file's name off, and return the rest and the numbers.

    All names without numbers have the rest "frames".

    >>> split_numbers("cam0/frame_-5.exr"), split_numbers("shot-12.exr"), split_numbers("a.exr")
    (('cam0/frame_{}', ['-5']), ('shot-{}', ['12']), ('frames', []))
    """
    stem = Path(key).stem
    numbers = NUMBER.findall(stem)
    pattern = NUMBER.sub("{}", stem.replace("{", "(").replace("}", ")")) if numbers else "frames"
    return str(PurePosixPath(key).with_name(pattern)), numbers


def by_pattern(jobs: Sequence[Job]) -> dict[str, list[Job]]:
    """Return jobs by the pattern of their names, each in the order of the numbers in the names.

    >>> jobs = [Job(Path(name), name) for name in ("f.10.exr", "f.9.exr", "g.exr")]
    >>> {pattern: [job.key for job in jobs] for pattern, jobs in by_pattern(jobs).items()}
    {'f.{}': ['f.9.exr', 'f.10.exr'], 'frames': ['g.exr']}
    """
    grouped: dict[str, list[Job]] = {}
    for job in jobs:
        grouped.setdefault(split_numbers(job.key)[0], []).append(job)
    return {pattern: sorted(each, key=numbers_of) for pattern, each in grouped.items()}


def numbers_of(job: Job) -> list[int]:
    """Return the numbers in the name of a job's file."""
    return [int(number) for number in split_numbers(job.key)[1]]


def in_sequences(jobs: Sequence[Job]) -> list[Job]:
    """Return jobs with their places in sequences, one sequence after the other, in temporal order.

    Files of one directory are a sequence if their names differ in one number. If they differ in
    several, the number with the most values counts the frames. Each value of the others is then a
    sequence, such as a camera of a rig. Names without numbers keep the order of the jobs.

    A sequence has the name of its directory, or of its files if the directory has several. Gaps are
    logged. Missing frames keep their places, so that the time between the other frames is right.

    >>> jobs = [Job(Path(name), name) for name in ("f.10.exr", "f.9.exr", "f.12.exr")]
    >>> [(job.key, job.place.index) for job in in_sequences(jobs)]
    [('f.9.exr', 0), ('f.10.exr', 1), ('f.12.exr', 3)]

    Raises:
        RequestError: two frames of a sequence have the same number.
    """
    sequences: dict[str, list[tuple[int, Job]]] = {}
    for pattern, members in by_pattern(jobs).items():
        names = [split_numbers(job.key)[1] for job in members]
        frame = _frame_column(names)
        for place, (numbers, job) in enumerate(zip(names, members, strict=True)):
            name = _name(pattern, numbers, frame)
            number = int(numbers[frame]) if numbers else place
            sequences.setdefault(name, []).append((number, job))
    folders = [PurePosixPath(name).parent for name in sequences]
    placed: list[Job] = []
    for name, frames in sequences.items():
        folder = PurePosixPath(name).parent
        placed += _placed(
            str(folder) if folder.name and folders.count(folder) == 1 else name, frames
        )
    order: dict[str, int] = {}  # several ISOs or cameras of a frame belong to different sequences
    return sorted(placed, key=lambda job: order.setdefault(sequence_of(job), len(order)))


def sequence_of(job: Job) -> str:
    """Return the path of a job's sequence in the output directory, without extension."""
    assert job.place
    return job.place.sequence


def _frame_column(names: Sequence[Sequence[str]]) -> int:
    """Return which of the numbers of names counts frames.

    It has the most values. If several have, it has the most digits, or is the last one.

    >>> _frame_column([["0001", "0"], ["0001", "1"], ["0002", "0"], ["0002", "1"]])
    0
    """
    columns = list(zip(*names, strict=True))
    ranks = [(len(set(texts)), max(map(len, texts)), n) for n, texts in enumerate(columns)]
    return max(ranks)[2] if ranks else 0


def _name(pattern: str, numbers: Sequence[str], frame: int) -> str:
    """Return the name of a sequence: the names of its files without the frame's number.

    >>> _name("rig/frame_{}_cam{}", ["0001", "2"], 0), _name("{}", ["7"], 0)
    ('rig/frame_cam2', 'frames')
    """
    path = PurePosixPath(pattern)
    filled = path.name.format(*("" if n == frame else text for n, text in enumerate(numbers)))
    return str(path.with_name(re.sub(r"([._-])[._-]+", r"\1", filled).strip("._-") or "frames"))


def _placed(key: str, frames: Sequence[tuple[int, Job]]) -> Iterator[Job]:
    """Yield the jobs of a sequence with their places, in temporal order."""
    numbers = sorted({number for number, _ in frames})
    step = math.gcd(*(number - numbers[0] for number in numbers)) or 1
    count = (numbers[-1] - numbers[0]) // step + 1
    gaps = [(a + step, b - step) for a, b in pairwise(numbers) if b > a + step]
    if gaps:
        texts = [f"{a}" if a == b else f"{a} to {b}" for a, b in gaps[:MAX_GAPS]]
        more = f", and {len(gaps) - MAX_GAPS} more gaps" if len(gaps) > MAX_GAPS else ""
        missing = f"{count - len(numbers)} of {count} frames are missing: {', '.join(texts)}{more}"
        log.warning("%s: %s", printable(key), missing)
    by_place: dict[Place, Job] = {}
    for number, job in sorted(frames, key=lambda frame: frame[0]):
        # A directory for an ISO or a camera may precede the key.
        folder = PurePosixPath(job.stem).parent
        is_folder = folder.name == PurePosixPath(key).name
        sequence = str(folder if is_folder else folder / PurePosixPath(key).name)
        place = Place(key, sequence, (number - numbers[0]) // step, count)
        # The run itself rejects two jobs with the same outputs.
        if place in by_place and by_place[place].stem != job.stem:
            raise RequestError(
                f"{by_place[place].label} and {job.label} are both frame {number} of the sequence "
                f"{sequence}; remove or rename one of them"
            )
        by_place[place] = job
        yield replace(job, place=place)
