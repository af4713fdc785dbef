"""Baselines: the clean picture with independent noise, as strong as the noise of the noisy one.

It is what synthetic data usually has, to be compared with a camera's noise.
"""

from dataclasses import replace

from clpipe.base.errors import RequestError
from clpipe.chain.chain import Chain
from clpipe.chain.registry import stage_in
from clpipe.chain.rendition import CLEAN
from clpipe.chain.truth import picture_without_noise
from clpipe.stage import StageRole
from clpipe.stages.picture_noise import IidGaussian, IntensityDependent, NoNoise


def baseline_of(chain: Chain) -> Chain:
    """The chain of a baseline: the clean picture's, with noise behind it that is not known yet.

    Args:
        chain: of the noisy picture.

    Raises:
        RequestError: the chain adds no noise, has noise on the finished picture already, or has no
            step for it.
    """
    step = chain.step_in(StageRole.BASELINE)
    if step is None:
        name = stage_in(StageRole.BASELINE).name
        raise RequestError(f"--truth: a baseline has the noise of {name}, which this chain has not")
    if step.adds_noise:
        raise RequestError(f"--truth: {step.name} adds noise already; leave one of them out")
    clean = picture_without_noise(CLEAN, chain)
    steps = *(each for each in clean.steps if each.name != step.name), step
    return with_noise(replace(clean, steps=steps), IidGaussian(sigma=(0.0, 0.0, 0.0)))


def matching_of(chain: Chain) -> NoNoise:
    """The matching of a baseline's noise to that of the picture, as the chain says it."""
    step = chain.step_in(StageRole.BASELINE)
    assert step and isinstance(step.method, NoNoise)  # as baseline_of has seen
    return step.method


def with_noise(chain: Chain, noise: IidGaussian | IntensityDependent) -> Chain:
    """The chain of a baseline, with its noise."""
    *others, step = chain.steps
    return replace(chain, steps=(*others, replace(step, method=noise.resolve(step.context))))
