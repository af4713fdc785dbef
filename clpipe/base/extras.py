"""Optional libraries, and the command that installs them."""

from importlib.util import find_spec

from clpipe.base.errors import RequestError

# The modules of clpipe's extras that several features need. Each has the name of its package.
EXTRAS = {
    "annotations": ("pycocotools", "shapely"),
    "calibrate": ("matplotlib", "scipy"),
    "cloud": ("fsspec",),  # and one for each scheme
    "dask": ("distributed",),
    "explore": ("matplotlib", "scipy", "starlette", "uvicorn"),
    "report": ("jinja2", "matplotlib", "scipy"),
    "video": ("av",),
}


def require(purpose: str, extra: str, *modules: str) -> None:
    """Check that modules are installed. Each must have the name of its package.

    Args:
        purpose: the feature that needs them, for the message, such as "clpipe calibrate".
        extra: the extra of clpipe that contains them. If one is missing, the message names all
            missing modules of this extra.
        modules: the names of the modules; without any, those of the extra.

    Raises:
        RequestError: a module is missing. The message contains the command that installs it.

    >>> try:
    ...     require("this example", "video", "json", "no_module")
    ... except RequestError as error:
    ...     print(str(error).partition(" needs ")[0])
    this example
    """
    needed = modules or EXTRAS[extra]
    if all(map(is_installed, needed)):
        return
    missing = [name for name in dict.fromkeys((*EXTRAS[extra], *needed)) if not is_installed(name)]
    *others, last = missing
    listed = f"{', '.join(others)} and {last}, which are" if others else f"{last}, which is"
    raise RequestError(
        f"{purpose} needs {listed} in the extra '{extra}'. Run: {install_command(*missing)}"
    )


def is_installed(module: str) -> bool:
    """Return whether a module can be imported, without importing it.

    >>> is_installed("json"), is_installed("no_module")
    (True, False)
    """
    return find_spec(module) is not None


def install_command(*packages: str) -> str:
    """Return the command that installs packages.

    The command does not use clpipe's extras, because another project has this name on PyPI.

    >>> install_command("scipy", "matplotlib")
    'pip install scipy matplotlib'
    """
    return f"pip install {' '.join(packages)}"
