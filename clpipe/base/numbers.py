"""Numbers of kernels: conversions of scalars, and functions of them.

If an ISO or a parameter is drawn for each image, clpipe records once how the numbers of a stage
follow from it, and repeats only these calculations (:mod:`clpipe.base.tracing`). NumPy's functions
of scalars are recorded as they are. The functions here record conversions, which NumPy's own types
would not.
"""

from collections.abc import Callable
from functools import wraps
from typing import Any, TypeVar

import numpy as np

from clpipe.base.tracing import call, value_of

T = TypeVar("T")


def pure(function: Callable[..., T]) -> Callable[..., T]:
    """Decorate a function whose result depends only on its arguments.

    The arguments are numbers, or objects that stay the same, such as tables. The result is a number
    or a tuple of numbers. The function may then use them in any way, for example in loops.

    >>> import math
    >>> pure(math.hypot)(3.0, 4.0)
    5.0
    """

    @wraps(function)
    def recorded(*arguments: Any) -> T:
        result: T = call(function, *arguments)
        return result

    return recorded


float32 = pure(np.float32)
int32 = pure(np.int32)


def is_float(number: Any) -> bool:
    """Return whether a number is a Python float.

    >>> is_float(0.5), is_float(np.float32(0.5)), is_float(1)
    (True, False, False)
    """
    return isinstance(value_of(number), float)
