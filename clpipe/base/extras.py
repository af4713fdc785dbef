"""Optional libraries, and the command that installs them."""

from importlib.util import find_spec

from clpipe.base.errors import RequestError


def require(purpose: str, *modules: str) -> None:
    """Check that modules are installed. Each must have the name of its package.

    Args:
        purpose: the feature that needs them, for the message, such as "clpipe calibrate".
        modules: the names of the modules.

    Raises:
        RequestError: a module is missing. The message contains the command that installs it.

    >>> require("this example", "json", "no_module")
    Traceback (most recent call last):
    clpipe.base.errors.RequestError: this example needs no_module. Run: pip install no_module
    """
    missing = [name for name in modules if not is_installed(name)]
    if missing:
        raise RequestError(
            f"{purpose} needs {' and '.join(missing)}. Run: {install_command(*missing)}"
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
