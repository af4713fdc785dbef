"""Names for array types, and the conversion of NumPy values to plain Python values."""

from collections.abc import Mapping
from pathlib import PurePath
from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]
Doubles = NDArray[np.float64]
Mask = NDArray[np.bool_]
Array = NDArray[Any]


def plain(values: Any) -> Any:
    """Return values without NumPy types and paths, suitable for a configuration file."""
    if isinstance(values, Mapping):
        return {key: plain(value) for key, value in values.items()}
    if isinstance(values, list | tuple):
        return list(map(plain, values))
    if isinstance(values, PurePath):
        return str(values)
    return values.tolist() if isinstance(values, np.ndarray | np.generic) else values
