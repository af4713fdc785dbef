"""The truth beside a noisy picture: what it would be without noise, and how large the noise is."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import takewhile

import numpy as np

from clpipe.base.errors import RequestError
from clpipe.base.types import Floats
from clpipe.chain.chain import Chain, Step
from clpipe.chain.registry import user_code_errors
from clpipe.chain.rendition import CLEAN
from clpipe.stage import Kind, ReferenceContext


def picture_without_noise(truth: str, chain: Chain) -> Chain:
    """The chain of a truth that is a picture, :data:`~clpipe.chain.rendition.PICTURES`.

    "development" is developed exactly as the noisy picture is: denoised as strongly, and sharpened
    as much. So their difference is the noise that is left. "clean" is the picture that is wanted:
    its development has nothing to do against noise. Without noise and denoising it is the same
    picture at every ISO.

    Raises:
        RequestError: the chain adds no noise.
    """
    if truth == CLEAN and any(step.adds_noise for step in chain.steps):
        return chain.cleaned()
    return chain.without_noise()


def noisy_mosaic(chain: Chain) -> Chain:
    """The chain up to its noisy mosaic in signal, whose truth is the same mosaic without noise.

    It ends with ``normalize``; without a ``quantize`` behind the first noise, with the last stage
    that adds noise to a mosaic.

    Raises:
        RequestError: the chain has no such mosaic.
    """
    chain.without_noise()  # refuses a chain without noise
    first = [step.adds_noise for step in chain.steps].index(True)
    noisy = chain.steps[first:]
    ends = [s for s in noisy if (s.stage.reads, s.stage.writes) == (Kind.RAW, Kind.MOSAIC)][:1]
    if not ends and any(s.stage.writes is Kind.RAW for s in noisy):
        raise RequestError(
            f"the chain ends in DN, at {noisy[-1].name}, but the truth of a mosaic is in signal; "
            "end it with normalize or a later stage"
        )
    ends = ends or [s for s in noisy if s.adds_noise and s.stage.writes is Kind.MOSAIC][-1:]
    if not ends:
        raise RequestError(
            f"the first noise of this chain is that of {noisy[0].name}, behind the mosaic; "
            "there is no noise in the mosaic to know the truth of"
        )
    return replace(chain, steps=chain.steps[: chain.steps.index(ends[0]) + 1])


def signal_and_noise(chain: Chain) -> tuple[Chain, tuple[Step, ...]]:
    """What :func:`variance_of` needs: the chain to the clean image that the first noise falls on,
    and the steps from there to the :func:`noisy_mosaic`.

    Raises:
        RequestError: the chain has no such mosaic, or a step does not know its variance.
    """
    steps = noisy_mosaic(chain).steps
    first = [step.adds_noise for step in steps].index(True)
    noise = steps[first:]
    channels = len(noise[0].stage.reads.channels)
    variance_of(noise, np.zeros((2, 2, 3) if channels == 3 else (2, 2), np.float32))
    return replace(chain, steps=steps[: first + 1]).without_noise(), noise


def variance_of(noise: Sequence[Step], signal: Floats) -> Floats:
    """The variance of the noise in each pixel of a mosaic, (height, width), in signal squared.

    The noisy mosaic varies about the clean one by this much, over images and over cameras. Noise
    that is fixed to a sensor (PRNU, DSNU, columns) is a part of it, because the clean mosaic is
    that of an ideal sensor. Each stage gives its own share; the default chain has

        a*y + b + (prnu*y)^2 + dsnu^2 + row^2 + column^2 + 1/(12 range^2)

    with y the clean signal that the noise falls on, neither rounded nor cut at black, but at most
    white, that of the last of several readouts, where the ADC follows. ``a*y + b`` is that of Foi
    et al. (IEEE TIP 2008, eq. 2), with Poisson noise and with heavy-tailed read noise, too.
    ``range`` is the white level above black in DN; rounding has the variance 1/12 DN^2. Clipping
    (at 0 DN, at white, in a full well) removes noise, which is not modelled; hot and dead pixels,
    and the rounding of the clean mosaic, are left out.

    Args:
        noise: the steps from the first that adds noise to the last one of the mosaic.
        signal: the clean image that enters the first of them, (height, width[, channel]).

    Raises:
        RequestError: a step does not know its variance.
    """
    analogue = list(takewhile(lambda step: step.stage.writes is not Kind.RAW, noise))
    if len(analogue) < len(noise) and all(s.adds_noise or not s.passes for s in analogue):
        signal = np.minimum(signal, np.float32(noise[len(analogue)].context.full_scale))
    last = max(i for i, step in enumerate(noise) if step.adds_noise)
    variance: Floats = np.zeros((), np.float32)
    for i, step in enumerate(noise):
        with user_code_errors(f"stage {step.name}", step.stage.folder):
            after = step.method.variance(variance, signal, step.context)
            # Behind the last noise no variance depends on the signal.
            clean = step.method.without_noise() if i < last else None
            if clean and clean.passes():
                signal = clean.reference(signal, ReferenceContext(step.context, {}, {}))
        if after is None:
            raise RequestError(
                f"--truth variance: {step.name} ({step.method.method}) does not say what it makes "
                "of the variance of noise; skip it, or move it before the noise"
            )
        variance = after
    return np.ascontiguousarray(np.broadcast_to(variance, signal.shape[:2]))
