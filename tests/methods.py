"""Every method of every stage, for tests of all methods or of one method of each kind.

Methods with the same access pattern differ only in arithmetic. Tests of access patterns need one
method of each kind; the others are marked slow.
"""

import pytest

from clpipe.chain.registry import all_stages
from clpipe.engine.check import chain_for

METHODS = [(stage, method) for stage in all_stages().values() for method in stage.methods]


def access_pattern(stage, method):
    """Return how the passes of a method touch pixels, and whether it is for any filter array."""
    accesses = [pass_.access for pass_ in chain_for(stage, method, {}, "GRBG").steps[0].passes]
    shapes = ("bins", "vectors_per_row")
    touched = {(type(a), *(getattr(a, name, 0) > 0 for name in shapes)) for a in accesses}
    return frozenset(touched), method.any_array


# The first of each way.
REPRESENTATIVES = [*{access_pattern(*each): each for each in reversed(METHODS)}.values()]

ALL = [
    pytest.param(
        stage,
        method,
        id=f"{stage.name}-{method.method}",
        marks=[] if (stage, method) in REPRESENTATIVES else [pytest.mark.slow],
    )
    for stage, method in METHODS
]
ONE_OF_EACH_WAY = [each for each in ALL if not each.marks]
