"""The kernel files: their folder, and their text with includes expanded."""

import re
from collections.abc import Iterable, Sequence
from functools import cache
from importlib import resources
from pathlib import Path

from clpipe.base.errors import RequestError

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
# Names at the beginning of a line: of functions with a body, of macros, and of types.
FUNCTION = re.compile(r"^[A-Za-z_][\w \t*]*[ \t*](\w+)[ \t]*\([^;{}]*\)\s*\{", re.MULTILINE)
MACRO_OR_TYPE = re.compile(r"^#define (\w+)|^typedef [^;{]*\b(\w+);|^\} (\w+);", re.MULTILINE)


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


@cache
def _names_in(text: str) -> frozenset[str]:
    """Return the functions, macros and types that the text of a kernel file defines."""
    found = MACRO_OR_TYPE.findall(text)
    return functions_in(text) | {name for names in found for name in names if name}


@cache
def functions_in(text: str) -> frozenset[str]:
    """Return the functions that the text of a kernel file defines.

    >>> sorted(functions_in("INLINE vf twice(vf v) {\\n    return add(v, v);\\n}\\n"))
    ['twice']
    """
    return frozenset(FUNCTION.findall(text))


def check_plugin_names(names: Iterable[str], launch: str) -> None:
    """Check that the functions of plug-ins have names of their own.

    Args:
        names: the files of a kernel's source; those of plug-ins are absolute paths.
        launch: the generated part of the source.

    Raises:
        RequestError: another file defines a function's name, or the generated part uses it for
            something else.
    """
    launch = re.sub(r"//.*", "", launch)
    plugins = sorted(name for name in names if Path(name).is_absolute())
    for plugin in plugins:
        for function in sorted(functions_in(Path(plugin).read_text("utf-8"))):
            for other in names:
                text = (kernel_folder() / other).read_text("utf-8")
                if other != plugin and function in _names_in(text):
                    owner = other if other in plugins else f"clpipe's kernels/{other}"
                    raise _taken(plugin, function, f"{owner} also defines this name")
            if re.search(rf"(?<![\w.]){function}\b(?! *\()", launch):
                raise _taken(plugin, function, "clpipe uses this name for a variable")


def _taken(plugin: str, function: str, reason: str) -> RequestError:
    return RequestError(
        f"{plugin}: it defines the function {function}, but {reason}; rename the function, for "
        f"example to my_{function}"
    )
