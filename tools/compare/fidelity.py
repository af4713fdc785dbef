"""Measures the fidelity of finished pictures: colours, brightness, edges and sharpness.

All pictures are in sRGB levels, 0 to 255.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from clpipe.base.types import Doubles
from clpipe.camera.profile import SRGB_TO_XYZ
from clpipe.reference.colour import luma
from tools.compare.charts import GREY, linear

HAS_HUE = 10.0  # the lowest CIELAB chroma at which hues are compared
DOT = 32  # levels of luma between a dot and the median of its 3x3
SMOOTH = 16  # the largest such difference in the reference, so that a dot is visible


def cielab(levels: NDArray[np.number]) -> Doubles:
    """Convert sRGB levels to CIELAB under D65, (..., 3): L*, a*, b* (CIE 15:2018, eq. 8.3 to 8.11).

    >>> cielab(np.array([[255, 255, 255], [122, 122, 122], [255, 0, 0]])).round(1).tolist()
    [[100.0, 0.0, 0.0], [51.2, 0.0, 0.0], [53.2, 80.1, 67.2]]
    """
    ratio = linear(levels) @ (SRGB_TO_XYZ / SRGB_TO_XYZ.sum(1, keepdims=True)).T
    x, y, z = np.moveaxis(
        np.where(ratio > (6 / 29) ** 3, np.cbrt(ratio), ratio * (29 / 6) ** 2 / 3 + 4 / 29), -1, 0
    )
    return np.stack([116 * y - 16, 500 * (x - y), 200 * (y - z)], axis=-1)


@dataclass(frozen=True)
class ColourErrors:
    """Errors of a chart's patches in CIELAB.

    Hue and chroma are compared only for patches with a chroma of at least 10.
    """

    grey: float  # level of green of the grey patch; 122 in the chart
    lightness: float  # mean difference of L*
    hue: float  # median error, degrees
    largest_hue: float  # degrees
    chroma: float  # median ratio to the chart's


def colour_errors(pictured: NDArray[np.number], true: NDArray[np.number]) -> ColourErrors:
    """Compare the patches of a picture of a ColorChecker with their true colours.

    Args:
        pictured: (24, 3).
        true: (24, 3), as from :func:`~tools.compare.charts.chart_patches`.

    >>> from tools.compare.charts import chart_patches
    >>> true = chart_patches()
    >>> colour_errors(true, true)
    ColourErrors(grey=122.0, lightness=0.0, hue=0.0, largest_hue=0.0, chroma=1.0)
    """
    found, expected = cielab(pictured), cielab(true)
    (found_chroma, found_hue), (chroma, hue) = (
        (np.hypot(lab[:, 1], lab[:, 2]), np.arctan2(lab[:, 2], lab[:, 1]))
        for lab in (found, expected)
    )
    coloured = chroma >= HAS_HUE
    hue_errors = np.degrees(np.abs((found_hue - hue + np.pi) % (2 * np.pi) - np.pi))[coloured]
    return ColourErrors(
        grey=float(pictured[GREY, 1]),
        lightness=float((found[:, 0] - expected[:, 0]).mean()),
        hue=float(np.median(hue_errors)),
        largest_hue=float(hue_errors.max()),
        chroma=float(np.median(found_chroma[coloured] / chroma[coloured])),
    )


def dots(picture: NDArray[np.number], reference: NDArray[np.number]) -> float:
    """Return the number of isolated pixels per 10,000 that the reference lacks.

    A dot's luma differs by more than 32 from the median of its 3x3. The reference's luma at the
    same place differs by at most 16.

    Args:
        picture: (height, width, 3).
        reference: the same picture without the cause of dots, such as a mosaic or noise.

    >>> grey = np.full((100, 100, 3), 128.0)
    >>> spotted = grey.copy()
    >>> spotted[50, 50] += 40
    >>> dots(spotted, grey), dots(spotted, spotted)
    (1.0, 0.0)
    """
    from scipy import ndimage

    def isolation(levels: NDArray[np.number]) -> Doubles:
        y = luma(levels)
        return np.abs(y - ndimage.median_filter(y, 3))

    return float(1e4 * ((isolation(picture) > DOT) & (isolation(reference) <= SMOOTH)).mean())


def psnr(one: NDArray[np.number], two: NDArray[np.number]) -> float:
    """Return the peak signal-to-noise ratio over all channels, dB; infinite if both are equal.

    >>> round(psnr(np.zeros((2, 2, 3)), np.ones((2, 2, 3))), 2)
    48.13
    """
    error = ((one.astype(np.float64) - two) ** 2).mean()
    return float(10 * np.log10(255**2 / error)) if error else np.inf
