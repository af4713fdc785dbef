"""Libraries that only some users need, and how to install them."""

from importlib.util import find_spec

from clpipe.base.errors import RequestError


def require(purpose: str, *modules: str) -> None:
    """See that libraries are installed whose packages have the names of their modules.

    Args:
        purpose: what needs them, for the message, such as "clpipe calibrate".
        modules: the modules.

    Raises:
        RequestError: a module is missing; the message says how to install it.

    >>> require("this example", "json", "no_such_module")
    Traceback (most recent call last):
    clpipe.base.errors.RequestError: this example needs no_such_module; pip install no_such_module
    """
    missing = [name for name in modules if find_spec(name) is None]
    if missing:
        raise RequestError(f"{purpose} needs {' and '.join(missing)}; {installing(*missing)}")


def installing(*packages: str) -> str:
    """The command that installs packages.

    It names no extra of clpipe, since on the public index that name is another project's.

    >>> installing("scipy", "matplotlib")
    'pip install scipy matplotlib'
    """
    return f"pip install {' '.join(packages)}"
