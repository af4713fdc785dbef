"""The text that describes a series: ``EMVA1288_Data.txt``.

Each line begins with a letter; ``#`` begins a comment:

    v 3.1                         the release of the standard
    n BITS WIDTH HEIGHT           of all frames
    b TIME PHOTONS                frames with light follow: ns, and the mean per pixel
    d TIME                        frames without light follow
    i PATH                        a frame, relative to the text; / or \\ between folders

Two frames are for temporal figures, more are a stack for spatial ones.
"""

from collections.abc import Sequence
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


class _Lines:
    """Reads the lines of a text one by one, with their numbers."""

    def __init__(self, path: Path, text: str) -> None:
        self._path = path
        numbered = enumerate(text.splitlines(), 1)
        self._lines = [(n, line.strip()) for n, line in numbered if line.split("#")[0].strip()]
        self._at = 0

    def next(self, only: str = "") -> tuple[int, list[str]] | None:
        """Return number and words of the next line; None at the end, or at another letter."""
        if self._at == len(self._lines):
            return None
        number, line = self._lines[self._at]
        letter, *rest = line.split(maxsplit=1)
        form = FORMS.get(letter)
        if form is None:
            letters = ", ".join(FORMS)
            raise self.error(
                number, f"found {one_line(line)!r}; expected a line that begins with {letters} or #"
            )
        if only and letter != only:
            return None
        words = rest if letter == "i" else line.split()[1:]
        if len(words) != len(form.split()) - 1:
            raise self.error(number, f"found {one_line(line)!r}; expected {form}")
        self._at += 1
        return number, [letter, *words]

    def error(self, number: int, message: str) -> RequestError:
        return RequestError(f"{self._path}, line {number}: {message}")

    def number(
        self, number: int, word: str, name: str, low: float, high: float, whole: bool = False
    ) -> float:
        """Return a number in a line, whose decimal separator may be a comma, or a whole number."""
        try:
            value = whole_number(word) if whole else float(word.replace(",", "."))
        except ValueError:
            value = np.nan
        if not low <= value <= high:
            allowed = f"{low:g} to {high:g}"
            raise self.error(number, f"{name}: found {one_line(word)!r}; allowed: {allowed}")
        return value


def read_series(path: Path) -> Series:
    """Read the text of a series.

    Raises:
        RequestError: the text cannot be read, a line is wrong, or required frames are missing.
    """
    lines = _Lines(path, read_named_text(str(path), path))
    size: list[int] = []
    exposures: dict[tuple[float, float, bool], Exposure] = {}
    while found := lines.next():
        number, (letter, *words) = found
        if letter == "n":
            if size:
                raise lines.error(number, "this is the second line n; keep only one")
            limits = (("bits", 1, MAX_BITS), ("side", *SIDES), ("side", *SIDES))
            size = [
                int(lines.number(number, word, *limit, whole=True))
                for word, limit in zip(words, limits, strict=True)
            ]
        elif letter == "i":
            raise lines.error(
                number, "this frame belongs to no exposure; add a line b or d before it"
            )
        elif letter in "bd":
            own = _exposure(lines, number, words, path.parent)
            key = own.time, own.photons, len(own.frames) == PAIR
            if key in exposures:
                raise lines.error(
                    number,
                    f"this line repeats the exposure of line {exposures[key].line}; remove one "
                    "of the two lines",
                )
            exposures[key] = own
    if not size:
        raise RequestError(f"{path}: the line {FORMS['n']} is missing")
    return _checked(path, size, list(exposures.values()))


def _exposure(lines: _Lines, number: int, words: Sequence[str], folder: Path) -> Exposure:
    """Return the exposure of a line b or d, and of the frames that follow it.

    Args:
        lines: the lines of the text.
        number: the number of the line.
        words: the words of the line: a time and, with light, photons.
        folder: the folder of the text.
    """
    time = lines.number(number, words[0], "time", 0, 1e15)
    photons = [lines.number(number, word, "photons", 0, 1e12) for word in words[1:]]
    if photons == [0.0]:
        raise lines.error(number, "photons: found 0; for frames without light, use a line d")
    frames = []
    while frame := lines.next(only="i"):
        frames.append(folder / frame[1][1].replace("\\", "/"))
    if len(frames) < PAIR:
        raise lines.error(
            number, f"found {len(frames)} frames of this exposure; at least {PAIR} are needed"
        )
    return Exposure(time, sum(photons), tuple(frames), number)


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
