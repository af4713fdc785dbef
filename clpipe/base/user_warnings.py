"""Warnings that name the user's line, and those of many images that are issued once."""

import re
import sys
import warnings
from collections.abc import Iterable
from types import FrameType
from typing import cast

# Packages without lines of the user. The last two start threads, and contextlib calls functions.
SKIPPED = __name__.partition(".")[0], "contextlib", "concurrent", "threading"


def warn(text: str) -> None:
    """Issue a warning about the innermost line of the user's code.

    In a thread without such a line, the warning is about no line. Python then names "sys".
    """
    level, frame = 2, cast(FrameType | None, sys._getframe(1))
    while frame and frame.f_globals.get("__name__", "").partition(".")[0] in SKIPPED:
        level, frame = level + 1, frame.f_back
    warnings.warn(text, stacklevel=level)


class Issued:
    """The kinds of warnings that were issued. Texts that differ only in numbers are of one kind."""

    def __init__(self) -> None:
        self._kinds: set[str] = set()

    def new(self, texts: Iterable[str]) -> list[str]:
        """Return the texts whose kinds are new. From then on, they are known.

        >>> issued = Issued()
        >>> issued.new(["3.5 % of the picture is black", "no step reads the depth"])
        ['3.5 % of the picture is black', 'no step reads the depth']
        >>> issued.new(["12 % of the picture is black"])
        []
        """
        found = []
        for text in texts:
            kind = re.sub(r"\d+(\.\d+)?", "#", text)
            if kind not in self._kinds:
                self._kinds.add(kind)
                found.append(text)
        return found
