"""Every method of every stage, for tests that go over all of them or over some of each kind.

Methods whose passes touch pixels in the same ways differ in arithmetic alone. Where a test is about
the ways, one method for each is enough; the others are marked slow.
"""

import pytest

from clpipe.chain.registry import all_stages
from clpipe.engine.check import chain_for

METHODS = [(stage, method) for stage in all_stages().values() for method in stage.methods]


def accesses(stage, method):
    """Return how the passes of a method touch pixels."""
    chain = chain_for(stage, method, {}, "GRBG")
    own = [pass_.access for pass_ in chain.steps[0].method.passes()]
    shapes = [getattr(each, name, 0) > 0 for each in own for name in ("bins", "vectors_per_row")]
    return *map(type, own), *shapes


# The first of each way.
REPRESENTATIVES = {*{accesses(*each): each for each in reversed(METHODS)}.values()}

ALL = [
    pytest.param(
        stage,
        method,
        id=f"{stage.name}-{method.method}",
        marks=[] if (stage, method) in REPRESENTATIVES else [pytest.mark.slow],
    )
    for stage, method in METHODS
]
