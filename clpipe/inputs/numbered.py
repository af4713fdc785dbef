"""Inputs that name numbered files with a pattern, as renderers and compositors write them."""

import glob
import logging
import os
import re
from itertools import islice

from clpipe.base.errors import RequestError
from clpipe.base.text import printable

log = logging.getLogger(__name__)

# A minus after a letter or a digit is a separator, not a sign.
RANGE = r"(?:(?<![A-Za-z0-9])-)?\d+-(?:-?\d+)(?:x\d+)?"
# %04d as in C, #### and @@@@ as in Nuke, $F4 as in Houdini; before it perhaps 1001-1100x2.
TOKEN = re.compile(
    rf"(?P<ranges>(?<!\d){RANGE}(?:,{RANGE})*)?(?:%(?P<width>0\d+)?d|(?P<marks>#+|@+)|\$F(?P<places>\d*))"
)
MAX_LISTED = 5  # missing numbers that a message lists


def numbered_files(text: str) -> list[str] | None:
    """Return the files that a pattern of numbered files names, in the order of the numbers.

    The pattern is in the file's name: ``f.%04d.exr``, ``f.####.exr``, ``f.@@@@.exr`` or
    ``f.$F4.exr``. A single ``#`` is any number. Ranges before it choose numbers:
    ``f.1001-1100x2####.exr`` is every second one.

    Args:
        text: the input.

    Returns:
        The files; None if the text is no pattern, or names a file.

    Raises:
        RequestError: no file matches, or a range has no numbers.
    """
    folder, name = os.path.split(text)
    tokens = [*TOKEN.finditer(name)]
    if not tokens or os.path.lexists(text) or glob.has_magic(name):
        return None
    token = tokens[-1]
    folder = glob.escape(folder) if os.path.isdir(folder) else folder
    before, after = name[: token.start()], name[token.end() :]
    ranges = [_range(text, each) for each in (token["ranges"] or "").split(",") if each]
    width = int(token["width"] or token["places"] or 0) or len(token["marks"] or "1")
    files: dict[int, list[str]] = {}
    for path in glob.glob(os.path.join(folder, f"{glob.escape(before)}*{glob.escape(after)}")):
        digits = os.path.basename(path)[len(before) :].removesuffix(after)
        if not re.fullmatch(r"-?\d+", digits) or not os.path.isfile(path):
            continue
        is_padded = digits.lstrip("-").startswith("0") and digits != "0"
        number = int(digits)
        fits = (
            len(digits) == width or (len(digits) > width and not is_padded) or token["marks"] == "#"
        )
        if fits and (not ranges or any(number in each for each in ranges)):
            files.setdefault(number, []).append(path)
    if not files:
        raise RequestError(f"{text}: no file matches this pattern of numbers; correct it")
    wanted = {number: None for each in ranges for number in islice(each, 10**6)}
    if missing := [number for number in wanted if number not in files]:
        more = ", ..." * (len(missing) > MAX_LISTED)
        listed = ", ".join(map(str, missing[:MAX_LISTED]))
        log.warning(
            "%s: %d of %d frames are missing: %s%s",
            printable(text),
            len(missing),
            len(wanted),
            listed,
            more,
        )
    return [path for number in sorted(files) for path in sorted(files[number])]


def _range(text: str, part: str) -> range:
    """Return the numbers of a range.

    >>> [*_range("", "1001-1005x2")], [*_range("", "-1-1")]
    ([1001, 1003, 1005], [-1, 0, 1])

    Raises:
        RequestError: it has no numbers.
    """
    match = re.fullmatch(r"(-?\d+)-(-?\d+)(?:x(\d+))?", part)
    assert match
    first, last, step = int(match[1]), int(match[2]), int(match[3] or 1)
    if last < first or step < 1:
        raise RequestError(f"{text}: the range {part} has no numbers; use FIRST-LASTxSTEP")
    return range(first, last + 1, step)
