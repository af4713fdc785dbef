"""Colour spaces of files: from the chromaticities that a file states to linear sRGB."""

from collections.abc import Sequence

import numpy as np

from clpipe.base.errors import ImageError
from clpipe.base.types import Array, Floats
from clpipe.camera.colorimetry import adaptation

# x and y of red, green, blue and white: ITU-R BT.709-6 (2015), which sRGB shares.
SRGB = (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3127, 0.3290)
MAX_CHROMATICITY = (
    100.0  # the largest absolute x or y; wide colour spaces have values within -1 to 2
)
CIE_XYZ = (1.0, 0.0, 0.0, 1.0, 0.0, 0.0, 1 / 3, 1 / 3)


def rgb_to_xyz(chromaticities: Sequence[float]) -> Array:
    """The 3x3 matrix from linear RGB to CIE XYZ, with white at Y = 1 (SMPTE RP 177-1993).

    Its middle row holds the luminances of red, green and blue.

    >>> rgb_to_xyz(SRGB)[1].round(4).tolist()
    [0.2126, 0.7152, 0.0722]

    Args:
        chromaticities: x and y of red, green, blue and white, eight numbers.

    Raises:
        ImageError: no such colours exist.
    """
    x, y = _numbers("chromaticities", chromaticities, 8).reshape(4, 2).T
    colours = np.stack([x, y, 1 - x - y])
    primaries, white = colours[:, :3], colours[:, 3]
    with np.errstate(all="ignore"):
        is_near = bool((np.abs(colours) < MAX_CHROMATICITY).all())  # False for NaN
        if is_near and abs(np.linalg.det(primaries)) > 1e-6 < white[1]:
            matrix: Array = primaries * np.linalg.solve(primaries, white / white[1])
            if np.isfinite(matrix).all() and abs(np.linalg.det(matrix)) > 1e-6:
                return matrix
    found = ", ".join(f"{value:g}" for value in chromaticities)
    raise ImageError(
        f"its chromaticities, {found}, do not describe a red, green, blue and white; correct the "
        "file's attribute"
    )


def _numbers(name: str, values: object, count: int) -> Array:
    """Return an attribute of a file as an array of ``count`` numbers.

    Raises:
        ImageError: the attribute is anything else.
    """
    try:
        numbers = np.asarray(values, np.float64)
    except (TypeError, ValueError):
        numbers = np.empty(0)
    if numbers.shape != (count,):
        raise ImageError(f"its attribute {name} must be {count} numbers, but is not")
    return numbers


def to_linear_srgb(
    chromaticities: Sequence[float], neutral: Sequence[float] | None = None
) -> Floats | None:
    """Return the 3x3 matrix from a file's RGB to linear sRGB; None if the file is in linear sRGB.

    The file's neutral colour stays neutral: ``neutral``, or the white of its chromaticities. CIE
    XYZ itself has no white. Its values are taken as seen under D65, like in the OpenEXR project's
    definition of the conversion and its test image (openexr issue 686, 2020).

    >>> p3 = (0.68, 0.32, 0.265, 0.69, 0.15, 0.06, 0.314, 0.351)
    >>> to_linear_srgb(p3).sum(axis=1).round(4).tolist()
    [1.0, 1.0, 1.0]
    >>> to_linear_srgb(CIE_XYZ)[1].astype(float).round(3).tolist()
    [-0.969, 1.876, 0.042]

    Args:
        chromaticities: x and y of red, green, blue and white, eight numbers.
        neutral: x and y of the colour that becomes neutral (OpenEXR's adoptedNeutral).

    Raises:
        ImageError: no such colours exist.
    """
    to_xyz, srgb_to_xyz = rgb_to_xyz(chromaticities), rgb_to_xyz(SRGB)
    d65 = srgb_to_xyz.sum(axis=1)
    if neutral is not None:
        white = rgb_to_xyz((*SRGB[:6], *_numbers("adoptedNeutral", neutral, 2))).sum(axis=1)
    else:
        white = d65 if np.allclose(chromaticities, CIE_XYZ, atol=2e-3) else to_xyz.sum(axis=1)
    near_d65 = np.allclose(white, d65, atol=5e-3)
    if near_d65 and np.allclose(chromaticities, SRGB, atol=2e-3):
        return None
    adapted = to_xyz if near_d65 else adaptation(white, d65) @ to_xyz
    return np.linalg.solve(srgb_to_xyz, adapted).astype(np.float32)
