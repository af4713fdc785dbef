"""Baselines: the clean picture with independent noise, as strong as the noise of the noisy picture.

Synthetic data usually has such noise. Baselines make it comparable with a camera's noise.
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
    """Return the chain of a baseline: the clean picture's, and a last step that adds noise.

    The strength of this noise is 0 until :func:`with_noise` sets it.

    Args:
        chain: the chain of the noisy picture.

    Raises:
        RequestError: the chain adds no noise, already adds noise to the finished picture, or has
            no step that can do so.
    """
    step = chain.step_in(StageRole.BASELINE)
    if step is None:
        name = stage_in(StageRole.BASELINE).name
        raise RequestError(
            f"--truth: a baseline adds its noise in the stage {name}, which this chain does not "
            f"have; add {name} to the stages"
        )
    if step.adds_noise:
        raise RequestError(
            f"--truth: {step.name} already adds noise to the picture, so a baseline cannot use it; "
            f"remove iid and intensity from --truth, or skip {step.name}"
        )
    clean = picture_without_noise(CLEAN, chain)
    steps = *(each for each in clean.steps if each.name != step.name), step
    return with_noise(replace(clean, steps=steps), IidGaussian(sigma=(0.0, 0.0, 0.0)))


def noise_matching(chain: Chain) -> NoNoise:
    """Return the method that sets how a baseline's noise is matched to the picture's noise."""
    step = chain.step_in(StageRole.BASELINE)
    assert step and isinstance(step.method, NoNoise)  # checked by baseline_of
    return step.method


def with_noise(chain: Chain, noise: IidGaussian | IntensityDependent) -> Chain:
    """Return the chain of a baseline with its noise set."""
    *others, step = chain.steps
    return replace(chain, steps=(*others, replace(step, method=noise.resolve(step.context))))
