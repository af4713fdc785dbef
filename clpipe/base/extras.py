"""Libraries that only some users need, and how to install them."""

from importlib.util import find_spec

from clpipe.base.errors import RequestError


def require(purpose: str, extra: str, *modules: str) -> None:
    """See that the libraries of an extra are installed.

    Args:
        purpose: what needs them, for the message, such as "clpipe calibrate".
        extra: the extra of the package that installs them.
        modules: the modules.

    Raises:
        RequestError: a module is missing; the message says how to install it.

    >>> require("this example", "docs", "no_such_module")
    Traceback (most recent call last):
    clpipe.base.errors.RequestError: this example needs no_such_module; pip install 'clpipe[docs]'
    """
    missing = [name for name in modules if find_spec(name) is None]
    if missing:
        raise RequestError(
            f"{purpose} needs {' and '.join(missing)}; pip install 'clpipe[{extra}]'"
        )
