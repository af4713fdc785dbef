"""Pure functions: their result depends only on their arguments."""

from collections.abc import Callable
from functools import wraps
from typing import Any, TypeVar

from clpipe.base.tracing import call

T = TypeVar("T")


def pure(function: Callable[..., T]) -> Callable[..., T]:
    """Mark a function of numbers whose result depends only on them.

    If a parameter is drawn for each image, clpipe repeats this function, and not the code around
    it. NumPy's functions of numbers, such as ``np.sqrt``, need no mark.

    >>> from math import gamma
    >>> pure(gamma)(5.0)
    24.0
    """

    @wraps(function)
    def called(*arguments: Any) -> T:
        result: T = call(function, *arguments)
        return result

    return called
