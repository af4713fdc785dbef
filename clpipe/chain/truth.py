"""Ground truth of a noisy picture: the picture without noise, and the variance of its noise."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import takewhile

import numpy as np

from clpipe.base.errors import RequestError
from clpipe.base.types import Floats
from clpipe.chain.chain import Chain, Step
from clpipe.chain.registry import user_code_errors
from clpipe.chain.rendition import CLEAN, XYZ
from clpipe.stage import Kind, ReferenceContext, StageRole
from clpipe.stages.spectral_response import ToSrgb, ToXyz


def picture_without_noise(truth: str, chain: Chain) -> Chain:
    """Return the chain of a truth that is a picture, see :data:`~clpipe.chain.rendition.PICTURES`.

    "development" is developed exactly like the noisy picture, with the same denoising and
    sharpening. Their difference is therefore the remaining noise. "clean" has neither noise nor
    denoising, so it is the same picture at every ISO.

    Raises:
        RequestError: the chain adds no noise.
    """
    if truth == CLEAN and any(step.adds_noise for step in chain.steps):
        return chain.without_noise_or_denoising()
    return chain.without_noise()


def light_of(truth: str, chain: Chain) -> Chain:
    """Return the chain of the light that reaches the sensor, through the lens.

    "xyz" is in CIE XYZ, and "srgb" in linear sRGB. Both are in units of the render.

    Raises:
        RequestError: the image has no spectral bands, or the chain does not read them.
    """
    if not chain.bands:
        raise RequestError(
            f"--truth {truth}: this truth needs the bands of a spectral render, but the image is "
            "in red, green and blue; remove it"
        )
    before = takewhile(lambda step: step.stage.role is not StageRole.PATTERN, chain.steps)
    first, *others = before
    observer = (ToXyz if truth == XYZ else ToSrgb)().resolve(first.context)
    optics = StageRole.VIEW, StageRole.SHUTTER, StageRole.LENS, StageRole.FALLOFF
    kept = [s for s in others if s.stage.role in optics or s.method.geometry()]
    return replace(chain, steps=(replace(first, method=observer), *kept))


def noisy_mosaic(chain: Chain) -> Chain:
    """Return the chain up to its noisy mosaic in signal. Its truth is this mosaic without noise.

    The chain ends with ``normalize``. If no ``quantize`` follows the first noise, it ends with the
    last stage that adds noise to a mosaic.

    Raises:
        RequestError: the chain has no such mosaic.
    """
    chain.without_noise()  # rejects a chain without noise
    first = [step.adds_noise for step in chain.steps].index(True)
    noisy = chain.steps[first:]
    ends = [s for s in noisy if (s.stage.reads, s.stage.writes) == (Kind.RAW, Kind.MOSAIC)][:1]
    if not ends and any(s.stage.writes is Kind.RAW for s in noisy):
        raise RequestError(
            f"the chain ends in DN, at {noisy[-1].name}, but the ground truth of a mosaic is in "
            "signal; end the chain with normalize or a later stage"
        )
    ends = ends or [s for s in noisy if s.adds_noise and s.stage.writes is Kind.MOSAIC][-1:]
    if not ends:
        raise RequestError(
            f"the first stage that adds noise, {noisy[0].name}, comes after the mosaic, so the "
            "mosaic has no noise; use --truth clean or development"
        )
    return replace(chain, steps=chain.steps[: chain.steps.index(ends[0]) + 1])


def signal_and_noise(chain: Chain) -> tuple[Chain, tuple[Step, ...]]:
    """Return the arguments of :func:`variance_of`: a chain and steps.

    The chain makes the clean image to which the first noise is added. The steps lead from there to
    the :func:`noisy_mosaic`.

    Raises:
        RequestError: the chain has no such mosaic, or a step cannot compute its variance.
    """
    steps = noisy_mosaic(chain).steps
    first = [step.adds_noise for step in steps].index(True)
    noise = steps[first:]
    channels = len(noise[0].stage.reads.channels)
    variance_of(noise, np.zeros((2, 2, 3) if channels == 3 else (2, 2), np.float32))
    return replace(chain, steps=steps[: first + 1]).without_noise(), noise


def variance_of(noise: Sequence[Step], signal: Floats) -> Floats:
    """Return the variance of the noise in each pixel of a mosaic, in signal squared.

    This is the expected squared difference between the noisy and the clean mosaic, over images and
    cameras. The clean mosaic is from an ideal sensor, so fixed patterns (PRNU, DSNU, columns) count
    as noise.

    Derivation: a stage reads x + n, where x is the clean image and n has the mean 0 and the
    variance v. It draws its own noise independently of n. By the law of total variance, the
    variance after it is the mean variance of its own noise plus the variance of its mean:

    | operation of the stage, k of variance 1   | variance after it      |
    | ----------------------------------------- | ---------------------- |
    | adds noise of the variance w(x) = a x + b | v + w(x)               |
    | multiplies by a gain g                    | g^2 v                  |
    | multiplies each pixel by 1 + s k          | (1 + s^2) v + s^2 x^2  |
    | rounds to whole DN                        | v + 1/12, in DN^2      |

    The first row is exact for any n, because w is linear in x and the mean of n is 0. Each stage's
    ``variance`` applies its row. This function starts with v = 0, applies the stages in order, and
    runs each one without its noise to get the next x. With white at ``range`` DN above black, the
    rows of the default chain give (Foi et al., IEEE TIP 2008, eq. 2, for the first two terms)

        a y + b + (prnu y)^2 + dsnu^2 + row^2 + column^2 + 1/(12 range^2)

    y is the clean signal that enters the first of them. It is not rounded or cut at black. The ADC
    writes white for everything brighter, so y is at most white. This limit applies only if no stage
    changes the scale before the ADC. Clipping at 0 DN, at white and in a full well would reduce the
    variance, which is not modelled. Hot and dead pixels, and the rounding of the clean mosaic, do
    not count.

    Args:
        noise: the steps from the first that adds noise to the last one of the mosaic.
        signal: the clean image that enters the first of them, (height, width[, channel]).

    Returns:
        float32, (height, width).

    Raises:
        RequestError: a step cannot compute its variance.
    """
    before_adc = list(takewhile(lambda step: step.stage.writes is not Kind.RAW, noise))
    keeps_scale = all(step.adds_noise or not step.passes for step in before_adc)
    if keeps_scale and len(before_adc) < len(noise):
        signal = np.minimum(signal, np.float32(noise[len(before_adc)].context.full_scale))
    last = max(i for i, step in enumerate(noise) if step.adds_noise)
    variance: Floats = np.zeros((), np.float32)
    for i, step in enumerate(noise):
        with user_code_errors(f"stage {step.name}", step.stage.folder):
            after = step.method.variance(variance, signal, step.context)
            # After the last noise stage, no variance depends on the signal.
            clean = step.method.without_noise() if i < last else None
            if clean and clean.passes():
                signal = clean.reference(signal, ReferenceContext(step.context, {}, {}))
        if after is None:
            raise RequestError(
                f"--truth variance: {step.name} ({step.method.method}) cannot compute the variance "
                "of the noise after it; skip it, or move it before the noise"
            )
        variance = after
    return np.ascontiguousarray(np.broadcast_to(variance, signal.shape[:2]))
