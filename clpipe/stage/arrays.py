"""Kernel arguments of stages that support filter arrays of any period."""

from functools import lru_cache

from clpipe.base.types import Floats
from clpipe.reference.filter_array import FilterArray, kernel_table
from clpipe.stage.passes import CompileTime

PERIOD = ("rows", "columns")  # arguments of ``kernels/lib/table.h``


def period_of(period: tuple[int, ...]) -> dict[str, CompileTime]:
    """Return a period of rows and columns as compiled-in arguments."""
    return dict(zip(PERIOD, (CompileTime(f"{size}u") for size in period), strict=True))


@lru_cache(maxsize=64)  # equal arrays share one object, so that it is uploaded once
def levels_table(array: FilterArray, inverse: bool) -> Floats:
    """Return the level of white at each position, or its inverse, for kernels: (row, column)."""
    levels = {k: 1 / v if inverse else v for k, v in array.levels.items()}
    return kernel_table(array.by_position(levels))
