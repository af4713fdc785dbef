"""The raw of a chain as a negative: what a DNG stores beside the samples."""

from dataclasses import replace
from functools import lru_cache, partial

import numpy as np

from clpipe.base.errors import RequestError
from clpipe.base.types import Doubles
from clpipe.camera.noise import NoiseModel
from clpipe.camera.profile import Matrix
from clpipe.chain.chain import Chain
from clpipe.images.dng import Negative, check_array, check_channels, xyz_to_camera
from clpipe.reference.filter_array import FilterArray
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
    is_input = chain.maker_of_raw is None
    if is_input and chain.source is not Kind.RAW:
        raise RequestError(
            "--format dng writes the raw in DN that quantize makes, but this chain starts on "
            f"{chain.source.label} and has no quantize; put it in, or use another format"
        )
    context, end = chain.context_of_raw, chain.context_after
    is_balanced = is_input and chain.step_in(StageRole.BALANCE) is not None
    gains = end.applied_gains if is_balanced else context.gains
    # normalize has the levels of a raw that enters
    levels = chain.steps[0].method if is_input else context
    black = _level(levels, "black_level", chain.camera.black_level)
    white = _level(levels, "white_level", chain.camera.white_level)
    if white != int(white):
        raise RequestError(
            f"--format dng: found a white level of {white:g}, but DNG wants whole DN; "
            f"--set {chain.maker_of_raw or chain.step_names[0]}.white_level={white:.0f}"
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
    undone = end.colours if is_input and end.colours != context.colours else None
    array = _balanced(context.filters, gains)
    check_array(array)
    return Negative(
        step=chain.maker_of_raw,
        array=array,
        black_level=black,
        white_level=int(white),
        xyz_to_camera=_xyz_to_camera(context.colours, undone, array),
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


@lru_cache(maxsize=64)  # one object, whose channels are found once
def _balanced(array: FilterArray, gains: tuple[float, float]) -> FilterArray:
    return replace(array, gains=gains, is_balanced=True)


@lru_cache(maxsize=64)
def _xyz_to_camera(colours: Matrix, undone: Matrix | None, array: FilterArray) -> Doubles:
    """The ColorMatrix of a raw, see :func:`~clpipe.images.dng.xyz_to_camera`.

    Args:
        colours: linear sRGB to the mosaic's own colours, white-balanced: what was done to a render
            before the mosaic.
        undone: for a raw that enters, what is done to it later, of which this is the inverse.
        array: its filter array.
    """
    own = np.array(colours)
    return xyz_to_camera(own if undone is None else own @ np.linalg.inv(undone), array)
