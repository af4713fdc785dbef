"""The kernel files: their folder, and their text with includes expanded."""

import re
from collections.abc import Sequence
from functools import cache
from importlib import resources
from pathlib import Path

LIBRARY = (
    "builtins",
    "lanes",
    "math",
    "image",
    "cfa",
    "median",
    "demosaic",
    "colour",
    "random",
    "curve",
    "display",
    "source",
    "sums",
)


@cache
def kernel_folder() -> Path:
    """Return the folder of the kernel files: in the package or, in a checkout, next to it."""
    packaged = Path(str(resources.files("clpipe") / "kernels"))
    return packaged if packaged.is_dir() else Path(__file__).resolve().parents[2] / "kernels"


def file_text(name: str, seen: set[str]) -> str:
    """Return the text of a kernel file with includes expanded.

    Args:
        name: the file, relative to the kernel folder, or the absolute path of a plug-in's file. A
            plug-in's includes are searched first next to its file, then in the kernel folder.
        seen: the files that the source already contains. They are skipped, and this file is added.
    """
    if name in seen:
        return ""
    seen.add(name)
    path = kernel_folder() / name  # an absolute path stays as it is
    text = path.read_text("utf-8")
    label = name if Path(name).is_absolute() else f"kernels/{name}"

    def include(match: re.Match[str]) -> str:
        line = text[: match.start()].count("\n") + 2
        beside = path.parent / match[1]
        own = Path(name).is_absolute() and beside.is_file()
        return f'{file_text(str(beside) if own else match[1], seen)}#line {line} "{label}"\n'

    included = re.sub(r'^#include "(.*)"\n', include, text, flags=re.MULTILINE)
    return f'#line 1 "{label}"\n{included}'


def files_text(names: Sequence[str], seen: set[str]) -> str:
    """Return the text of several kernel files. The arguments are those of :func:`file_text`."""
    return "".join(file_text(name, seen) for name in names)
