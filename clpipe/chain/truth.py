"""The truth beside a noisy picture: what it would be without noise, and how large the noise is."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import takewhile

import numpy as np

from clpipe.base.errors import RequestError
from clpipe.base.types import Floats
from clpipe.chain.chain import Chain, Step
from clpipe.chain.registry import user_code_errors
from clpipe.stage import Frame, Kind


def adds_noise(step: Step) -> bool:
    """Whether a step is another one where there is no noise."""
    return step.method.without_noise() is not step.method


def noisy_mosaic(chain: Chain) -> Chain:
    """The chain up to the mosaic whose truth can be known: noisy, and in signal.

    It is that of ``normalize``; without a ``quantize`` behind the first noise, that of the last
    stage which adds noise to a mosaic.

    Raises:
        RequestError: there is no such mosaic.
    """
    chain.without_noise()  # refuses a chain without noise
    first = [adds_noise(step) for step in chain.steps].index(True)
    noisy = chain.steps[first:]
    ends = [s for s in noisy if (s.stage.reads, s.stage.writes) == (Kind.RAW, Kind.MOSAIC)][:1]
    if not ends and any(s.stage.writes is Kind.RAW for s in noisy):
        raise RequestError(
            f"the chain ends in DN, at {noisy[-1].name}, but the truth of a mosaic is in signal; "
            "end it with normalize or a later stage"
        )
    ends = ends or [s for s in noisy if adds_noise(s) and s.stage.writes is Kind.MOSAIC][-1:]
    if not ends:
        raise RequestError(
            f"the first noise of this chain is that of {noisy[0].name}, behind the mosaic; "
            "there is no noise in the mosaic to know the truth of"
        )
    return replace(chain, steps=chain.steps[: chain.steps.index(ends[0]) + 1])


def signal_and_noise(chain: Chain) -> tuple[Chain, tuple[Step, ...]]:
    """The chain that makes the clean image which the first noise falls on, and the steps from there
    to the :func:`noisy_mosaic`, for :func:`variance_of`.

    Raises:
        RequestError: there is no such mosaic, or a step does not say what variance it makes.
    """
    steps = noisy_mosaic(chain).steps
    first = [adds_noise(step) for step in steps].index(True)
    noise = steps[first:]
    channels = len(noise[0].stage.reads.channels)
    variance_of(noise, np.zeros((2, 2, 3) if channels == 3 else (2, 2), np.float32))
    return replace(chain, steps=steps[: first + 1]).without_noise(), noise


def variance_of(noise: Sequence[Step], signal: Floats) -> Floats:
    """The variance of the noise in each pixel of a mosaic, (height, width), in signal squared.

    It is that of the noisy mosaic about the clean one, over images and over cameras: what is fixed
    to a sensor (PRNU, DSNU, columns) counts as much as what is new in each image, for the clean
    mosaic has none of it. The rounding of the clean mosaic itself is left out. As each stage says
    it, in the default chain

        a*y + b + (prnu*y)^2 + dsnu^2 + row^2 + column^2 + 1/(12 range^2)

    with y the clean signal that the noise falls on, neither rounded nor cut at black, but at most 1
    where the ADC follows; ``a*y + b`` is that of Foi et al. (IEEE TIP 2008, eq. 2), of Poisson
    noise and of heavy-tailed read noise alike; ``range`` is the white level over black in DN, of
    which rounding takes its twelfth. That clipping (at 0 DN, at white, in a full well) takes noise
    away is not modelled, and hot and dead pixels are left out.

    Args:
        noise: the steps from the first that draws to the one that makes the mosaic.
        signal: the clean image that enters the first of them, (height, width[, channel]).

    Raises:
        RequestError: a step does not say what variance it makes.
    """
    analogue = list(takewhile(lambda step: step.stage.writes is not Kind.RAW, noise))
    if len(analogue) < len(noise) and all(adds_noise(s) or not s.method.passes() for s in analogue):
        signal = np.minimum(signal, np.float32(1))
    last = max(i for i, step in enumerate(noise) if adds_noise(step))
    found: Floats = np.zeros((), np.float32)
    for i, step in enumerate(noise):
        with user_code_errors(f"stage {step.name}", step.stage.folder):
            after = step.method.variance(found, signal, step.context)
            clean = (
                step.method.without_noise() if i < last else None
            )  # behind it nobody asks for it
            if clean and clean.passes():
                signal = clean.reference(signal, Frame(step.context, {}, {}))
        if after is None:
            raise RequestError(
                f"--truth variance: {step.name} ({step.method.method}) does not say what it makes "
                "of the variance of noise; skip it, or move it before the noise"
            )
        found = after
    return np.ascontiguousarray(np.broadcast_to(found, signal.shape[:2]))
