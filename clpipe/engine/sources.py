"""The kernel files: where they are, and their text with includes in place."""

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
    """The folder of the kernel files: inside the package, or beside it in a checkout."""
    packaged = Path(str(resources.files("clpipe") / "kernels"))
    return packaged if packaged.is_dir() else Path(__file__).resolve().parents[2] / "kernels"


def file_text(name: str, seen: set[str]) -> str:
    """The text of a kernel file with its includes in place.

    Args:
        name: the file, relative to the kernel folder; a plug-in's file by its absolute path. A
            plug-in's includes are looked up beside its file, then in the kernel folder.
        seen: the files that the source has already, which are left out; this one is added.
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
    """The text of several kernel files; arguments as for :func:`file_text`."""
    return "".join(file_text(name, seen) for name in names)
