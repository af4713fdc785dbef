"""No stage turns little light into much: a sweep over the tails of blurs and reflections."""

import numpy as np
import pytest

from clpipe.engine.check import chain_for, example, last_frame
from clpipe.engine.runner import Runner
from clpipe.stage import variants
from tests.methods import METHODS

VARIANTS = [
    pytest.param(stage, method, values, id=f"{stage.name}-{method.method}-{number}")
    for stage, method in METHODS
    for number, values in enumerate(variants(method))
]


@pytest.mark.parametrize(("stage", "method", "values"), VARIANTS)
def test_a_stage_spreads_little_light_no_more_than_darkness(stage, method, values):
    chain = chain_for(stage, method, values, "GRBG")
    runner = Runner(chain, None, encode=False, final=True)
    image = example(chain.source, (24, 32), False, 0, chain.bands)

    def spread(level):
        found = last_frame(runner, np.full(image.shape, level, image.dtype))
        assert found is None or np.isfinite(found).all()
        return 0.0 if found is None else float(np.ptp(np.asarray(found, np.float64)))

    dark = spread(0)
    for level in (1e-38, 1e-30, 1e-22, 1e-16, 1e-10):
        assert spread(level) <= 1.5 * dark + 1e-5
