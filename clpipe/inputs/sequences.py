"""Sequences: the frames of a directory in temporal order, by the numbers in their names."""

import logging
import math
import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from fractions import Fraction
from functools import lru_cache
from itertools import pairwise
from pathlib import Path, PurePosixPath

from clpipe.base.digests import stamp_of
from clpipe.base.errors import ImageError, RequestError
from clpipe.base.text import one_line, printable
from clpipe.base.urls import may_be_url
from clpipe.images.layers import find_picture
from clpipe.images.openimageio import open_image
from clpipe.inputs.jobs import Job, Place
from clpipe.inputs.times import decimal_text, seconds_of, standard_rate, timing_of

log = logging.getLogger(__name__)

# A number of a name. A minus after a letter or a digit is a separator, not a sign. Seconds since
# 1970 may have decimals.
NUMBER = re.compile(r"(?:(?<=[._])-|^-)?(?:\d{9,10}\.\d{3,}|\d+)")
WORD = re.compile(r"([A-Za-z]*)[._ -]*\{\}")  # the word before a number of a pattern
FRAME_WORDS = ("f", "fr", "frame", "frm", "img", "image", "t", "time")
# Words before numbers that count something other than frames.
OTHER_WORDS: tuple[str, ...] = ("cam", "camera", "view", "v", "ver", "version", "take", "shot")
OTHER_WORDS += ("sc", "scene", "seq")
OTHER_WORDS += ("sequence", "id", "part", "eye", "rig", "sensor", "run", "obj", "object", "seed")
MAX_GAPS = 5  # the most gaps that a message lists
MAX_PLACES = 10**7  # in a sequence; with more, numbers only order the frames
MAX_NAMES = 3  # sequences that a summary names


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


def numbers_of(job: Job) -> list[Fraction]:
    """Return the numbers in the name of a job's file."""
    return [Fraction(number) for number in split_numbers(job.key)[1]]


def rate_of(job: Job) -> Fraction | None:
    """Return the frames per second of a job's sequence, from the times of its frames, if known."""
    interval = job.place.interval if job.place else None
    return standard_rate(1 / Fraction(interval)) if interval else None


def summary(jobs: Sequence[Job], rate: str = "") -> str:
    """Return a sentence about the sequences of jobs.

    Args:
        jobs: the frames.
        rate: the frame rate of sequences without times, with its source.

    >>> names = [f"cam{camera}_f{number}.exr" for camera in "01" for number in "123"]
    >>> summary(in_sequences([Job(Path(name), name) for name in names]))
    '2 sequences of 3 frames: cam0_f, cam1_f'
    >>> names = [f"{10**9 + n}.250.exr" for n in range(3)]
    >>> summary(in_sequences([Job(Path(name), name) for name in names]))
    '1 sequence of 3 frames, 1 frame per second from their times: frames'
    """
    counts = Counter(map(sequence_of, jobs))
    low, high = min(counts.values()), max(counts.values())
    frames = f"{low}" if low == high else f"{low} to {high}"
    names = ", ".join(list(counts)[:MAX_NAMES])
    more = f" and {len(counts) - MAX_NAMES} more" if len(counts) > MAX_NAMES else ""
    of = f"{len(counts)} sequence{'s' * (len(counts) > 1)} of {frames} frame{'s' * (high > 1)}"
    rates = sorted({each for each in map(rate_of, jobs) if each})
    if rates:
        low_, high_ = (f"{float(each):.6g}" for each in (rates[0], rates[-1]))
        per = low_ if low_ == high_ else f"{low_} to {high_}"
        rate = f"{per} frame{'s' * (per != '1')} per second from their times"
    return f"{of}{', ' * bool(rate)}{rate}: {names}{more}"


def in_sequences(jobs: Sequence[Job]) -> list[Job]:
    """Return jobs with their places in sequences, one sequence after the other, in temporal order.

    Files of one directory are a sequence if their names differ in one number. If they differ in
    several, one of these counts the frames: after a word such as frame, else with leading zeros,
    else the last one, but none after a word such as cam. Each value of the others is then a
    sequence, such as a camera of a rig. Names without numbers keep the order of the jobs.

    Frames have times if all of a sequence have one, or have time stamps as their numbers, see
    :func:`~clpipe.inputs.times.seconds_of`. Their places are then in units of the median interval,
    and no whole numbers if the intervals differ.

    A sequence has the name of its directory, or of its files if the directory has several. Gaps are
    logged. Missing frames keep their places, so that the time between the other frames is right.

    >>> jobs = [Job(Path(name), name) for name in ("f.10.exr", "f.9.exr", "f.12.exr")]
    >>> [(job.key, job.place.index) for job in in_sequences(jobs)]
    [('f.9.exr', 0), ('f.10.exr', 1), ('f.12.exr', 3)]

    Raises:
        RequestError: two frames of a sequence have the same number or time, or only some have a
            time.
    """
    sequences: dict[str, list[tuple[Fraction, Job]]] = {}
    for written, members in by_pattern(jobs).items():
        pattern, names = with_decimals(written, [split_numbers(job.key)[1] for job in members])
        frame = _frame_column(names, words_of(pattern))
        stamp = _stamp_column(names, frame)
        for place, (numbers, member) in enumerate(zip(names, members, strict=True)):
            name = _name(pattern, numbers, (frame, stamp))
            job = member
            if stamp is not None and member.time is None:
                job = replace(member, time=seconds_of(Fraction(numbers[stamp])))
            number = Fraction(numbers[frame]) if numbers else Fraction(place)
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


def with_decimals(
    pattern: str, names: Sequence[Sequence[str]]
) -> tuple[str, Sequence[Sequence[str]]]:
    """Return the pattern and the numbers of names whose last two numbers may be one with decimals.

    They are if the last one has different lengths: 1.25, 1.5.

    >>> with_decimals("f.{}.{}", [["1", "25"], ["1", "5"], ["2", "0"]])
    ('f.{}', [['1.25'], ['1.5'], ['2.0']])
    >>> with_decimals("f.{}.{}", [["1", "0025"], ["2", "0001"]])[0]
    'f.{}.{}'
    """
    lengths = {len(numbers[-1]) for numbers in names if numbers}
    if not pattern.endswith("{}.{}") or len(lengths) < 2:
        return pattern, names
    merged = [[*numbers[:-2], f"{numbers[-2]}.{numbers[-1]}"] for numbers in names]
    if words_of(pattern)[-2] in OTHER_WORDS:
        return pattern, names
    return pattern.removesuffix(".{}"), merged


def words_of(pattern: str) -> list[str]:
    """Return the word before each number of a pattern, in lower case.

    >>> words_of("rig/cam{}_frame-{}.{}")
    ['cam', 'frame', '']
    """
    return [word.lower() for word in WORD.findall(PurePosixPath(pattern).name)]


def _frame_column(names: Sequence[Sequence[str]], words: Sequence[str]) -> int:
    """Return which of the numbers of names counts frames; see :func:`in_sequences`.

    >>> names = [["0001", "0"], ["0001", "1"], ["0002", "0"], ["0002", "1"]]
    >>> _frame_column(names, ["", ""]), _frame_column(names, ["shot", "frame"])
    (0, 1)
    """
    ranks = []
    for n, texts in enumerate(zip(*names, strict=True)):
        word = (words[n] in FRAME_WORDS) - (words[n] in OTHER_WORDS)
        is_padded = len(set(map(len, texts))) == 1 and texts[0].startswith("0") and texts[0] != "0"
        ranks.append((len(set(texts)) > 1, word, is_padded, n))
    return max(ranks)[-1] if ranks else 0


def _stamp_column(names: Sequence[Sequence[str]], frame: int) -> int | None:
    """Return which other numbers of names are time stamps that differ; None if none are.

    >>> _stamp_column([["0001", "1305031102175"], ["0002", "1305031102211"]], 0)
    1
    """
    for n, texts in enumerate(zip(*names, strict=True)):
        stamps = {seconds_of(Fraction(text)) for text in texts}
        if n != frame and None not in stamps and len(stamps) > 1:
            return n
    return None


def _name(pattern: str, numbers: Sequence[str], omitted: Sequence[int | None]) -> str:
    """Return the name of a sequence: the names of its files without some of their numbers.

    >>> _name("rig/frame_{}_cam{}", ["0001", "2"], [0]), _name("{}", ["7"], [0])
    ('rig/frame_cam2', 'frames')
    """
    path = PurePosixPath(pattern)
    filled = path.name.format(*("" if n in omitted else text for n, text in enumerate(numbers)))
    return str(path.with_name(re.sub(r"([._-])[._-]+", r"\1", filled).strip("._-") or "frames"))


def _placed(key: str, frames: Sequence[tuple[Fraction, Job]]) -> Iterator[Job]:
    """Yield the jobs of a sequence with their places, in temporal order.

    Raises:
        RequestError: two frames have the same number, or only some have a time.
    """
    times = _times(frames)
    if times:
        frames = [(time, job) for time, (_, job) in zip(times, frames, strict=True)]
    numbers = sorted({number for number, _ in frames})
    timing = timing_of(numbers) if times and len(numbers) > 1 else None
    places = timing.places if timing else _places(numbers)
    count = math.ceil(places[numbers[-1]]) + 1
    interval = float(timing.interval) if timing else None
    if count > MAX_PLACES:
        log.warning("%s: its numbers only order the frames, which are far apart", printable(key))
        places, count, interval = (
            {number: n for n, number in enumerate(numbers)},
            len(numbers),
            None,
        )
    elif gaps := _gaps(places):
        found = [
            f"{n} after {decimal_text(a - numbers[0])} s" if times else _missing_text(a, b, n + 1)
            for a, b, n in gaps[:MAX_GAPS]
        ]
        more = f", and {len(gaps) - MAX_GAPS} more gaps" if len(gaps) > MAX_GAPS else ""
        missing = f"{sum(gap[2] for gap in gaps)} of {count} frames are missing: {', '.join(found)}"
        log.warning("%s: %s%s", printable(key), missing, more)
    by_place: dict[Place, Job] = {}
    first = min(frames, key=lambda frame: frame[0])[1].path
    for number, job in sorted(frames, key=lambda frame: frame[0]):
        # A directory for an ISO or a camera may precede the key.
        folder = PurePosixPath(job.stem).parent
        is_folder = folder.name == PurePosixPath(key).name
        sequence = str(folder if is_folder else folder / PurePosixPath(key).name)
        place = Place(key, sequence, places[number], count, interval)
        # The run itself rejects two jobs with the same outputs.
        if place in by_place and by_place[place].stem != job.stem:
            at = f"at {decimal_text(number)} s" if times else f"frame {float(number):g}"
            raise RequestError(
                f"{by_place[place].label} and {job.label} are both {at} of the sequence "
                f"{sequence}; remove or rename one of them"
            )
        by_place[place] = job
        yield replace(job, place=place, first=first)


def _times(frames: Sequence[tuple[Fraction, Job]]) -> list[Fraction]:
    """Return the times of frames in s: their own, or else the time stamps in their names.

    Returns:
        The time of each frame; nothing if they have none.

    Raises:
        RequestError: only some have a time of their own.
    """
    own = [job.time for _, job in frames]
    found = [time for time in own if time is not None]
    if 0 < len(found) < len(own):
        raise RequestError(
            f"{frames[own.index(None)][1].label}: this frame has no time, but others of its "
            "sequence have; give each of them one in the column time"
        )
    stamps = [seconds_of(number) for number, _ in frames]
    return found or ([each for each in stamps if each] if all(stamps) else [])


def _places(numbers: Sequence[Fraction]) -> dict[Fraction, float]:
    """Return the place of each number, in steps of their greatest common divisor."""
    unit = math.lcm(*(number.denominator for number in numbers))
    step = Fraction(math.gcd(*(int((n - numbers[0]) * unit) for n in numbers)) or unit, unit)
    return {number: int((number - numbers[0]) / step) for number in numbers}


def _gaps(places: Mapping[Fraction, float]) -> list[tuple[Fraction, Fraction, int]]:
    """Return the numbers on both sides of each gap, and how many frames are missing there."""
    found = pairwise(places.items())
    return [(a, b, missing) for (a, p), (b, q) in found if (missing := round(q - p) - 1) > 0]


def _missing_text(before: Fraction, after: Fraction, steps: int) -> str:
    """Return the missing numbers between two.

    >>> _missing_text(Fraction(2), Fraction(4), 2), _missing_text(Fraction(2), Fraction(8), 3)
    ('3', '4 to 6')
    """
    step = (after - before) / steps
    first, last = float(before + step), float(after - step)
    return f"{first:g}" if first == last else f"{first:g} to {last:g}"


def check_same_layer(path: Path, layer: str, first: Path) -> None:
    """Check that the picture of a frame is the same layer as that of its sequence's first frame.

    Raises:
        ImageError: it is another layer.
    """
    expected = None if path == first else picture_layer(first)
    if expected not in (None, layer):
        own, other = (
            f"the layer {one_line(each)!r}" if each else "no layer" for each in (layer, expected)
        )
        raise ImageError(
            f"{path}: its picture is {own}, but that of the first frame of its sequence, {first}, "
            f"is {other}; choose one for all frames with --layer"
        )


def picture_layer(path: Path) -> str | None:
    """Return the name of the layer that contains the picture of an OpenEXR file.

    It is None if the file has no picture, is at a URL, or has another format.
    """
    if path.suffix.lower() != ".exr" or may_be_url(path):
        return None
    try:
        return _picture_layer(path, stamp_of(path))
    except (ImageError, OSError):
        return None


@lru_cache(maxsize=64)
def _picture_layer(path: Path, _stamp: object) -> str:
    with open_image(path) as file:
        return find_picture(path, file, False, None).layer
