"""The raw of a chain as a negative: the metadata that a DNG stores with the samples."""

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

MAX_DN = 2**16 - 1


def negative_of(chain: Chain) -> Negative:
    """Return the raw of a chain: the output of its last stage that produces DN, or its input.

    Its tone curve is always ``neutral``. Converters apply a curve to colours differently from
    clpipe, and a steeper curve would saturate them.

    Raises:
        RequestError: the chain has no raw, or one that DNG cannot hold.
    """
    is_input = chain.raw_step_name is None
    if is_input and chain.source is not Kind.RAW:
        raise RequestError(
            "--format dng: a DNG contains the DN that quantize produces, but this chain "
            f"starts on {chain.source.label} and has no quantize; add quantize, or use another "
            "format"
        )
    context, final_context = chain.raw_context, chain.context_after
    is_balanced = is_input and chain.step_in(StageRole.BALANCE) is not None
    gains = final_context.applied_gains if is_balanced else context.gains
    # If the input is a raw, its levels are the input levels of normalize.
    levels = chain.steps[0].method if is_input else context
    black = _level(levels, "black_level", chain.camera.black_level)
    white = _level(levels, "white_level", chain.camera.white_level)
    if white != int(white):
        raise RequestError(
            f"--format dng: found a white level of {white:g}, but DNG needs whole DN; use "
            f"--set {chain.raw_step_name or chain.step_names[0]}.white_level={white:.0f}"
        )
    if context.knots:
        raise RequestError(
            "--format dng: a curve compresses the DN of this raw, but raw converters cannot "
            "undo this curve; use --format npy, or keep the raw as an EXR"
        )
    if white > MAX_DN:
        raise RequestError(
            f"--format dng: found a white level of {white:.0f}, but a DNG holds at most "
            f"{MAX_DN}; use --format npy, or set fewer bits"
        )
    later_matrix = (
        final_context.colours if is_input and final_context.colours != context.colours else None
    )
    array = _balanced(context.filter_array, gains)
    check_array(array)
    return Negative(
        step=chain.raw_step_name,
        array=array,
        black_level=black,
        white_level=int(white),
        xyz_to_camera=_xyz_to_camera(context.colours, later_matrix, array),
        noise=_noise_in_white_levels(context),
        tone=partial(run_reference, Neutral()),
        camera=context.camera if _is_seen(context, array) else None,
    )


def _is_seen(context: Context, array: FilterArray) -> bool:
    """Return whether the colours of a raw follow from the sensitivities of red, green and blue."""
    sight = context.sight
    if sight is None or not sight.has_colours or set(array.channels) != set("RGB"):
        return False
    return np.allclose(np.linalg.inv(context.colours), sight.to_srgb)


def dng_of(chain: Chain) -> Negative:
    """Return the result of :func:`negative_of` after checking that converters can open its DNG.

    Raises:
        RequestError: as for :func:`negative_of`, or converters cannot open the DNG.
    """
    negative = negative_of(chain)
    check_channels(negative.array)
    return negative


def _noise_in_white_levels(context: Context) -> NoiseModel | None:
    """Return the noise of a raw near black, in units of the white level."""
    noise, full = context.noise, context.full_scale
    if noise is None or full == 1:
        return noise
    return NoiseModel(noise.a / full, noise.b / full**2, noise.signal_range * full)


def _level(source: object, name: str, default: float) -> float:
    value = getattr(source, name, None)
    return default if value is None else float(value)


@lru_cache(maxsize=64)  # equal arguments share an object, which finds its channels once
def _balanced(array: FilterArray, gains: tuple[float, float]) -> FilterArray:
    return replace(array, gains=gains, is_balanced=True)


@lru_cache(maxsize=64)
def _xyz_to_camera(colours: Matrix, later_matrix: Matrix | None, array: FilterArray) -> Doubles:
    """Return the ColorMatrix of a raw, see :func:`~clpipe.images.dng.xyz_to_camera`.

    Args:
        colours: the matrix from linear sRGB to the mosaic's colours after white balance, which was
            applied to a render.
        later_matrix: for a raw that is the input, the matrix that the chain applies to it. Its
            inverse is used.
        array: the filter array.
    """
    matrix = np.array(colours)
    return xyz_to_camera(
        matrix if later_matrix is None else matrix @ np.linalg.inv(later_matrix), array
    )
