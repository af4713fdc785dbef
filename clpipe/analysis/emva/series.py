"""The text that describes a series: ``EMVA1288_Data.txt``.

Each line begins with a letter; ``#`` begins a comment:

    v 3.1                         the release of the standard
    n BITS WIDTH HEIGHT           of all frames
    b TIME PHOTONS                frames with light follow: ns, and the mean per pixel
    d TIME                        frames without light follow
    i PATH                        a frame, relative to the text; / or \\ between folders

Two frames are for temporal figures, more are a stack for spatial ones.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from clpipe.base.errors import ImageError, RequestError
from clpipe.base.reading import read_named_text
from clpipe.base.text import one_line, whole_number
from clpipe.base.types import Array
from clpipe.images.samples import read_whole_numbers

NAME = "EMVA1288_Data.txt"
RELEASE = "3.1"
PAIR = 2  # frames per exposure, to measure temporal noise
MAX_BITS = 16
SIDES = 16, 16_384  # px; the smallest and largest side of a frame
MIN_EXPOSURES = 9  # exposures with light; the standard asks for 50
NS = 1e9  # ns per second
FORMS = {
    "v": "v RELEASE",
    "n": "n BITS WIDTH HEIGHT",
    "b": "b TIME PHOTONS",
    "d": "d TIME",
    "i": "i PATH",
}


@dataclass(frozen=True)
class Exposure:
    """The frames of one exposure: its time in ns, the mean photons per pixel, their paths."""

    time: float
    photons: float  # 0 for dark frames
    frames: tuple[Path, ...]
    line: int = field(default=0, compare=False)  # line number in the text; 0 if there is none


@dataclass(frozen=True)
class Series:
    """A series. ``bright`` and ``dark`` contain pairs, in ascending order of light and time."""

    path: Path
    bits: int
    width: int
    height: int
    bright: tuple[Exposure, ...]
    dark: tuple[Exposure, ...]
    bright_stack: Exposure
    dark_stack: Exposure

    @property
    def full_scale(self) -> int:
        """The largest possible DN."""
        return int(2**self.bits - 1)

    def dark_of(self, exposure: Exposure) -> int:
        """Return the number in ``dark`` of the pair with the same exposure time."""
        if len(self.dark) == 1:
            return 0
        return [each.time for each in self.dark].index(exposure.time)

    def read(self, frame: Path) -> Array:
        """Return a frame in DN, (height, width), whole numbers.

        Raises:
            RequestError: the frame cannot be read, or has another size or more bits.
        """
        try:
            pixels = read_whole_numbers(frame)
        except ImageError as error:
            raise RequestError(str(error)) from None
        height, width = pixels.shape
        if (width, height) != (self.width, self.height):
            raise RequestError(
                f"{frame}: found {width}x{height} pixels, but {self.path} states {self.width}x"
                f"{self.height}"
            )
        if (most := int(pixels.max())) > self.full_scale:
            raise RequestError(
                f"{frame}: found {most} DN, but {self.path} states {self.bits} bits, so at most "
                f"{self.full_scale}"
            )
        return pixels


@dataclass(frozen=True)
class _Line:
    """A line of a text: its number, letter and words."""

    path: Path
    number: int
    letter: str
    words: Sequence[str]

    def error(self, message: str) -> RequestError:
        return RequestError(f"{self.path}, line {self.number}: {message}")

    def value(self, place: int, name: str, low: float, high: float, whole: bool = False) -> float:
        """Return the number in a word, whose decimal separator may be a comma."""
        word = self.words[place]
        try:
            value = whole_number(word) if whole else float(word.replace(",", "."))
        except ValueError:
            value = np.nan
        if not low <= value <= high:
            allowed = f"{low:g} to {high:g}"
            raise self.error(f"{name}: found {one_line(word)!r}; allowed: {allowed}")
        return value


def _lines(path: Path) -> Iterator[_Line]:
    """Yield the lines of a text without comments, after checking their forms."""
    for number, text in enumerate(read_named_text(str(path), path).splitlines(), 1):
        if not text.split("#")[0].strip():
            continue
        letter, *rest = text.split(maxsplit=1)
        line = _Line(path, number, letter, rest if letter == "i" else text.split()[1:])
        form, found = FORMS.get(letter), one_line(text.strip())
        if form is None:
            letters = ", ".join(FORMS)
            raise line.error(f"found {found!r}; expected a line that begins with {letters} or #")
        if len(line.words) != len(form.split()) - 1:
            raise line.error(f"found {found!r}; expected {form}")
        yield line


def read_series(path: Path) -> Series:
    """Read the text of a series.

    Raises:
        RequestError: the text cannot be read, a line is wrong, or required frames are missing.
    """
    size: list[int] = []
    groups: list[tuple[_Line, list[Path]]] = []  # a line b or d, and the frames that follow
    is_open = False  # whether frames may follow
    for line in _lines(path):
        if line.letter == "i":
            if not is_open:
                raise line.error("this frame belongs to no exposure; add a line b or d before it")
            groups[-1][1].append(path.parent / line.words[0].rstrip().replace("\\", "/"))
            continue
        is_open = line.letter in "bd"
        if is_open:
            groups.append((line, []))
        elif line.letter == "n":
            if size:
                raise line.error("this is the second line n; keep only one")
            limits = (("bits", 1, MAX_BITS), ("side", *SIDES), ("side", *SIDES))
            size = [int(line.value(k, *limit, whole=True)) for k, limit in enumerate(limits)]
    exposures: dict[tuple[float, float, bool], Exposure] = {}
    for line, frames in groups:
        own = _exposure(line, frames)
        other = exposures.setdefault((own.time, own.photons, len(own.frames) == PAIR), own)
        if other is not own:
            raise line.error(
                f"this line repeats the exposure of line {other.line}; remove one of the two lines"
            )
    if not size:
        raise RequestError(f"{path}: the line {FORMS['n']} is missing")
    return _checked(path, size, list(exposures.values()))


def _exposure(line: _Line, frames: Sequence[Path]) -> Exposure:
    """Return the exposure of a line b or d, and of the frames that follow it."""
    time = line.value(0, "time", 0, 1e15)
    photons = line.value(1, "photons", 0, 1e12) if line.letter == "b" else 0.0
    if line.letter == "b" and not photons:
        raise line.error("photons: found 0; for frames without light, use a line d")
    if len(frames) < PAIR:
        raise line.error(f"found {len(frames)} frames of this exposure; at least {PAIR} are needed")
    return Exposure(time, photons, tuple(frames), line.number)


def _checked(path: Path, size: Sequence[int], exposures: Sequence[Exposure]) -> Series:
    """Return the series of a text's exposures.

    Raises:
        RequestError: exposures, a dark pair or a stack are missing.
    """

    def of(lit: bool, pair: bool) -> tuple[Exposure, ...]:
        kept = (e for e in exposures if bool(e.photons) is lit and (len(e.frames) == PAIR) is pair)
        return tuple(sorted(kept, key=lambda e: (e.photons, e.time)))

    bright, dark = of(True, True), of(False, True)
    if len(bright) < MIN_EXPOSURES:
        raise RequestError(
            f"{path}: found {len(bright)} exposures of two frames with light; at least "
            f"{MIN_EXPOSURES} are needed, and EMVA 1288 asks for 50"
        )
    if not dark:
        raise RequestError(
            f"{path}: there is no exposure of two frames without light; add a line d with two "
            "frames"
        )
    times = {each.time for each in dark}
    for each in bright:
        if len(dark) > 1 and each.time not in times:
            raise RequestError(
                f"{path}, line {each.line}: this exposure of {each.time:g} ns has no "
                "counterpart without light; add a line d with two frames of this time"
            )
    stacks: list[Exposure] = []
    for is_lit, letter in ((True, "b"), (False, "d")):
        own = of(is_lit, False)
        if len(own) != 1:
            light = "with light" if is_lit else "without light"
            raise RequestError(
                f"{path}: found {len(own)} stacks of more than two frames {light} ({letter}); "
                "expected one"
            )
        stacks += own
    lit, unlit = stacks
    if lit.time != unlit.time:
        raise RequestError(
            f"{path}, lines {lit.line} and {unlit.line}: the stacks were exposed for "
            f"{lit.time:g} and {unlit.time:g} ns; expose both for the same time"
        )
    bits, width, height = size
    return Series(path, bits, width, height, bright, dark, lit, unlit)


def series_text(series: Series, comment: str) -> str:
    """Return the text of a series for :func:`read_series`, which begins with a comment."""
    lines = [
        *(f"# {line}" for line in comment.splitlines()),
        f"v {RELEASE}",
        f"n {series.bits} {series.width} {series.height}",
    ]
    for each in (*series.bright, *series.dark, series.bright_stack, series.dark_stack):
        light = f" {each.photons:.10g}" if each.photons else ""
        lines.append(f"{'b' if each.photons else 'd'} {each.time:.10g}{light}")
        folder = series.path.parent
        lines += [f"i {frame.relative_to(folder).as_posix()}" for frame in each.frames]
    return "\n".join(lines) + "\n"
