"""TODO."""

import numpy as np
from numpy.typing import NDArray

from clpipe.base.errors import RequestError
from clpipe.camera.profile import IDENTITY
from clpipe.chain.chain import Chain
from clpipe.images.dng import Negative, xyz_to_camera
from clpipe.stage import Context, Kind


def negative_of(chain: Chain) -> Negative:
    """The raw of a chain: what its last stage that gives DN makes, else the raw that enters it.

    Raises:
        RequestError: the chain has no raw, or one that DNG cannot hold.
    """
    makers = [step for step in chain.steps if step.stage.writes is Kind.RAW]
    first, last = chain.steps[0], chain.steps[-1]
    entered = not makers
    if entered and chain.source is not Kind.RAW:
        raise RequestError(
            "--format dng writes the raw in DN that quantize makes, but this chain starts on "
            f"{chain.source.label} and has no quantize; put it in, or use another format"
        )
    known = first.context if entered else makers[-1].method.after(makers[-1].context)
    end = last.method.after(last.context)
    balanced = any(step.stage.name == "white_balance" for step in chain.steps)
    gains = end.applied_gains if entered and balanced else known.gains
    levels = first.method if entered else known  # those of an image that enters, normalize is told
    black = _given(levels, "black_level", chain.camera.black_level)
    white = _given(levels, "white_level", chain.camera.white_level)
    if white != int(white):
        raise RequestError(
            f"--format dng: found a white level of {white:g}, but DNG wants whole DN; "
            f"--set quantize.white_level={white:.0f}"
        )
    return Negative(
        step=None if entered else makers[-1].name,
        pattern=known.pattern,
        black_level=black,
        white_level=int(white),
        gains=gains,
        xyz_to_camera=xyz_to_camera(_colours(known, end, entered), gains),
        noise=known.noise,
    )


def _given(of: object, name: str, otherwise: float) -> float:
    value = getattr(of, name, None)
    return otherwise if value is None else float(value)


def _colours(known: Context, end: Context, entered: bool) -> NDArray[np.float64]:
    """From linear sRGB to the mosaic's own colours, white-balanced.

    A render is in linear sRGB, and what color_matrix made of it before the mosaic is known. Of a
    camera's raw it is not known, but which matrix leads back to sRGB.
    """
    if entered and known.colours == IDENTITY:
        return np.asarray(np.linalg.inv(end.colours), np.float64)
    return np.array(known.colours)
