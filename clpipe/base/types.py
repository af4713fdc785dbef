"""Names for the array types that the whole package uses, and values without them."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]
Doubles = NDArray[np.float64]
Mask = NDArray[np.bool_]
Array = NDArray[Any]


def plain(values: Any) -> Any:
    """Values without NumPy types, as a configuration file can hold them."""
    if isinstance(values, Mapping):
        return {key: plain(value) for key, value in values.items()}
    if isinstance(values, list | tuple):
        return list(map(plain, values))
    return values.tolist() if isinstance(values, np.ndarray | np.generic) else values
