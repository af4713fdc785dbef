"""Every method of every stage, for tests that go over all of them or over some of each kind.

Methods whose passes touch pixels in the same ways differ in arithmetic alone. Where a test is about
the ways, one method for each is enough; the others are marked slow.
"""

import pytest

from clpipe.chain.registry import all_stages
from clpipe.engine.check import chain_for

METHODS = [(stage, method) for stage in all_stages().values() for method in stage.methods]


def ways(stage, method):
    """Return how the passes of a method touch pixels, and whether it is for any filter array."""
    accesses = [pass_.access for pass_ in chain_for(stage, method, {}, "GRBG").steps[0].passes]
    shapes = ("bins", "vectors_per_row")
    touched = {(type(a), *(getattr(a, name, 0) > 0 for name in shapes)) for a in accesses}
    return frozenset(touched), method.any_array


# The first of each way.
REPRESENTATIVES = [*{ways(*each): each for each in reversed(METHODS)}.values()]

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
