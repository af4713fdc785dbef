"""Tone curves from files: ``.csv`` with two columns and one-dimensional ``.cube``.

Knots are (n, 2): x and y of the curve, x ascending.
"""

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np

from clpipe.base.reading import cached_by_mtime, read_text
from clpipe.base.types import Doubles, Floats
from clpipe.reference.curve import tabulate

Knots = Doubles


def monotone_cubic(knots: Knots, x: Doubles) -> Doubles:
    """Evaluate a monotone cubic (Fritsch and Butland, SIAM J. Sci. Stat. Comput. 1984).

    The slope at an inner knot is the harmonic mean of the slopes of its two chords. The slope at an
    end knot is that of its chord. Outside the ends, the curve is level.

    >>> monotone_cubic(np.array([(0, 0), (1, 1), (2, 1)]), np.array([0.0, 1.0, 1.5])).tolist()
    [0.0, 1.0, 1.0]
    """
    at, value = knots.T
    x = np.clip(x, at[0], at[-1])
    step, chord = np.diff(at), np.diff(value) / np.diff(at)
    left, right = chord[:-1], chord[1:]
    rising = left * right > 0
    mean = 2 * left * right / np.where(rising, left + right, 1)
    slope = np.concatenate([chord[:1], np.where(rising, mean, 0), chord[-1:]])
    i = np.clip(np.searchsorted(at, x, side="right") - 1, 0, len(step) - 1)
    t, h = (x - at[i]) / step[i], step[i]
    return np.asarray(
        value[i] * (1 + 2 * t) * (1 - t) ** 2
        + h * slope[i] * t * (1 - t) ** 2
        + value[i + 1] * t**2 * (3 - 2 * t)
        + h * slope[i + 1] * t**2 * (t - 1)
    )


def linear(knots: Knots, x: Doubles) -> Doubles:
    """Interpolate linearly between knots, level outside the ends.

    >>> linear(np.array([(0, 0), (1, 4)]), np.array([0.25, 3.0])).tolist()
    [1.0, 4.0]
    """
    return np.interp(x, *knots.T)


def parse_csv(text: str) -> Knots:
    """Return knots (n, 2) from lines of ``x,y``, 0..1, x ascending; # comments, one header line.

    >>> parse_csv("x,y\\n0,0\\n1,1\\n").tolist()
    [[0.0, 0.0], [1.0, 1.0]]

    Raises:
        ValueError: a line is not such a pair (the message contains its number), or there are fewer
            than two knots.
    """
    knots: list[tuple[float, float]] = []
    header = True
    for number, line in enumerate(text.splitlines(), 1):
        fields = re.split(r"[,;\s]+", line.partition("#")[0].strip(" ,;\t"))
        if fields == [""]:
            continue
        try:
            pair = [float(field) for field in fields]
        except ValueError:
            if not header:
                raise ValueError(f"line {number}: {line!r} is not of the form x,y") from None
            header = False
            continue
        header = False
        if len(pair) != 2:
            raise ValueError(f"line {number}: expected two columns, x,y; this line has {len(pair)}")
        if not all(0 <= value <= 1 for value in pair):
            raise ValueError(
                f"line {number}: x and y must be within 0 and 1; this line is {line!r}"
            )
        # Equal positions would make the slope infinite.
        if knots and pair[0] < knots[-1][0] + 1e-12:
            before = knots[-1][0]
            raise ValueError(f"line {number}: x is {pair[0]:g} after {before:g}; x must ascend")
        knots.append((pair[0], pair[1]))
    if len(knots) < 2:
        raise ValueError(f"a curve has at least two lines of x,y; this file has {len(knots)}")
    return np.array(knots)


def parse_cube(text: str) -> Knots:
    """Return knots (n, 2) from a 1D .cube file (Adobe Cube LUT Specification 1.0, 2013).

    >>> parse_cube("LUT_1D_SIZE 2\\n0 0 0\\n1 1 1").tolist()
    [[0.0, 0.0], [1.0, 1.0]]

    Raises:
        ValueError: the table has three dimensions, or red, green and blue differ. Or its size is
            not LUT_1D_SIZE, or a line is not in the format (the message contains its number).
    """
    low, high = 0.0, 1.0
    size: float | None = None
    rows: list[float] = []
    for number, line in enumerate(text.splitlines(), 1):
        fields = line.partition("#")[0].split()
        if not fields or fields[0] == "TITLE":
            continue
        try:
            values = [float(field) for field in fields[1 if fields[0][0].isalpha() else 0 :]]
        except ValueError:
            raise ValueError(f"line {number}: {line!r} does not consist of numbers") from None
        match fields[0]:
            case "LUT_3D_SIZE":
                raise ValueError(
                    f"line {number}: the table has three dimensions; use a one-dimensional table"
                )
            case "LUT_1D_SIZE":
                size = values[0] if values else 0
            case "LUT_1D_INPUT_RANGE" if len(values) == 2:
                low, high = values
            case "DOMAIN_MIN" | "DOMAIN_MAX" if len(set(values)) == 1:
                low, high = (values[0], high) if fields[0][-1] == "N" else (low, values[0])
            case word if word[0].isalpha():
                raise ValueError(
                    f"line {number}: {line!r} is not valid in a one-dimensional .cube file"
                )
            case _ if len(values) != 3:
                raise ValueError(
                    f"line {number}: expected three numbers; this line has {len(values)}"
                )
            case _ if not np.allclose(values, values[0], rtol=0, atol=1e-6):
                raise ValueError(
                    f"line {number}: red, green and blue differ; they must share one tone curve"
                )
            case _:
                rows.append(values[0])
    if size is None or size != len(rows) or size < 2:
        declared = "no LUT_1D_SIZE" if size is None else f"LUT_1D_SIZE {size:g}"
        raise ValueError(
            f"{declared}, but {len(rows)} rows; set LUT_1D_SIZE to the number of rows, "
            "which must be at least 2"
        )
    if not low < high or not np.isfinite([low, high, *rows]).all():
        raise ValueError(
            f"its domain is {low:g} to {high:g}; the domain must ascend, and every number "
            "must be finite"
        )
    return np.stack([np.linspace(low, high, len(rows)), rows], axis=1)


# By file extension: the parser, and the interpolation of the knots.
FORMATS: dict[str, tuple[Callable[[str], Knots], Callable[[Knots, Doubles], Doubles]]] = {
    ".csv": (parse_csv, monotone_cubic),
    ".cube": (parse_cube, linear),
}


def load_table(path: str) -> Floats:
    """Return the table of a file's curve, see :mod:`clpipe.reference.curve`.

    A changed file is read again.

    Raises:
        ValueError: the file cannot be read, has an unknown format, or contains no curve.
    """
    try:
        return _load_table(path)
    except OSError as error:
        raise ValueError(f"cannot be read: {error.strerror}") from None
    except UnicodeDecodeError:
        raise ValueError("not a text file") from None


@cached_by_mtime
def _load_table(path: str) -> Floats:
    ending = Path(path).suffix.lower()
    if ending not in FORMATS:
        raise ValueError(f"expected a file with the extension {' or '.join(FORMATS)}")
    parse, interpolate = FORMATS[ending]
    knots = parse(read_text(Path(path)))
    return tabulate(lambda x: interpolate(knots, x))
