"""TODO."""

import re
from collections.abc import Sequence
from functools import cache
from importlib import resources
from pathlib import Path

LIBRARY = (
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
    """Where the kernel files are: in the package, or beside it in a checkout."""
    packaged = Path(str(resources.files("clpipe") / "kernels"))
    return packaged if packaged.is_dir() else Path(__file__).resolve().parents[2] / "kernels"


def file_text(name: str, seen: set[str]) -> str:
    """A kernel file with its includes in place, each file once.

    A stage of somebody else's has its kernels by whole paths; what they include is looked for
    beside them, then among clpipe's own.
    """
    if name in seen:
        return ""
    seen.add(name)
    path = kernel_folder() / name  # a whole path stays what it is
    text = path.read_text()
    label = name if Path(name).is_absolute() else f"kernels/{name}"

    def include(match: re.Match[str]) -> str:
        line = text[: match.start()].count("\n") + 2
        beside = path.parent / match[1]
        own = Path(name).is_absolute() and beside.is_file()
        return f'{file_text(str(beside) if own else match[1], seen)}#line {line} "{label}"\n'

    included = re.sub(r'^#include "(.*)"\n', include, text, flags=re.MULTILINE)
    return f'#line 1 "{label}"\n{included}'


def files_text(names: Sequence[str], seen: set[str]) -> str:
    """These kernel files, each once, one after the other."""
    return "".join(file_text(name, seen) for name in names)
