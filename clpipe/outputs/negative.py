"""The raw of a chain as a negative: what a DNG stores beside the samples."""

from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from clpipe.base.errors import RequestError
from clpipe.camera.noise import NoiseModel
from clpipe.chain.chain import Chain
from clpipe.images.dng import Negative, check_array, check_channels, xyz_to_camera
from clpipe.stage import Context, Kind, StageRole, run_reference
from clpipe.stages.tone_curve.neutral import Neutral

MOST_DN = 2**16 - 1


def negative_of(chain: Chain) -> Negative:
    """The raw of a chain: what its last stage that gives DN makes, else the raw that enters it.

    Its tone curve is ``neutral``, whatever the chain does behind the raw: others lay a curve over
    colours in their own way, and what is steeper would saturate them.

    Raises:
        RequestError: the chain has no raw, or one that DNG cannot hold.
    """
    makers = [step for step in chain.steps if step.stage.writes is Kind.RAW]
    first, last = chain.steps[0], chain.steps[-1]
    is_input = not makers
    if is_input and chain.source is not Kind.RAW:
        raise RequestError(
            "--format dng writes the raw in DN that quantize makes, but this chain starts on "
            f"{chain.source.label} and has no quantize; put it in, or use another format"
        )
    context = first.context if is_input else makers[-1].method.next_context(makers[-1].context)
    end = last.method.next_context(last.context)
    is_balanced = chain.step_in(StageRole.BALANCE) is not None
    gains = end.applied_gains if is_input and is_balanced else context.gains
    levels = first.method if is_input else context  # normalize has the levels of a raw that enters
    black = _level(levels, "black_level", chain.camera.black_level)
    white = _level(levels, "white_level", chain.camera.white_level)
    if white != int(white):
        raise RequestError(
            f"--format dng: found a white level of {white:g}, but DNG wants whole DN; "
            f"--set {(first if is_input else makers[-1]).name}.white_level={white:.0f}"
        )
    if context.knots:
        raise RequestError(
            "--format dng: the raw has fewer DN by a curve, which converters do not take; use "
            "--format npy, or keep it as an EXR"
        )
    if white > MOST_DN:
        raise RequestError(
            f"--format dng: found a white level of {white:.0f}, but it holds DN of 16 bits; use "
            "--format npy, or fewer bits"
        )
    array = replace(context.filters, gains=gains, is_balanced=True)
    check_array(array)
    return Negative(
        step=None if is_input else makers[-1].name,
        array=array,
        black_level=black,
        white_level=int(white),
        xyz_to_camera=xyz_to_camera(_colours(context, end, is_input), array),
        noise=_of_white(context),
        tone=partial(run_reference, Neutral()),
    )


def dng_of(chain: Chain) -> Negative:
    """The raw of a chain, as :func:`negative_of`, to be written as a DNG.

    Raises:
        RequestError: as there, or converters would not open it.
    """
    negative = negative_of(chain)
    check_channels(negative.array)
    return negative


def _of_white(context: Context) -> NoiseModel | None:
    """The noise in units of the white level, near black."""
    noise, full = context.noise, context.full_scale
    if noise is None or full == 1:
        return noise
    return NoiseModel(noise.a / full, noise.b / full**2, noise.signal_range * full)


def _level(owner: object, name: str, default: float) -> float:
    value = getattr(owner, name, None)
    return default if value is None else float(value)


def _colours(context: Context, end: Context, is_input: bool) -> NDArray[np.float64]:
    """The matrix from linear sRGB to the mosaic's own colours, white-balanced.

    It is what was done to a render before the mosaic. For a raw that enters it is the inverse of
    what is done to it behind, if anything is.

    Args:
        context: at the raw.
        end: at the end of the chain.
        is_input: whether the raw is the image that enters.
    """
    if is_input and end.colours != context.colours:
        return np.asarray(np.array(context.colours) @ np.linalg.inv(end.colours), np.float64)
    return np.array(context.colours)
