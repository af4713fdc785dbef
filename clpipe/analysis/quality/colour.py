"""Colour differences in CIELAB, and the errors of a ColorChecker."""

from dataclasses import dataclass

import numpy as np

from clpipe.analysis.quality.charts import GREYS
from clpipe.base.types import Doubles
from clpipe.camera.colorimetry import lab_of
from clpipe.reference.transfer import inverse_srgb_curve

HAS_HUE = 10.0  # the lowest chroma at which hues are compared
GREY = 21  # the number of the grey patch of 19.5 % of white


def cielab(levels: Doubles) -> Doubles:
    """Convert sRGB levels to CIELAB under D65, (..., 3): L*, a*, b* (CIE 15:2018, eq. 8.3 to 8.11).

    >>> cielab(np.array([[255, 255, 255], [122, 122, 122], [255, 0, 0]])).round(1).tolist()
    [[100.0, 0.0, 0.0], [51.2, 0.0, 0.0], [53.2, 80.1, 67.2]]
    """
    return lab_of(inverse_srgb_curve(np.asarray(levels) / 255))


def delta_e_2000(one: Doubles, two: Doubles, lightness: bool = True) -> Doubles:
    """Return the differences CIEDE2000 of CIELAB colours (CIE 142:2001; Sharma et al., 2005).

    >>> float(delta_e_2000(np.array([50, 2.6772, -79.7751]), np.array([50, 0, -82.7485])).round(4))
    2.0425

    Args:
        one: (..., 3).
        two: (..., 3).
        lightness: whether the difference of lightness is part of it.
    """
    (l1, a1, b1), (l2, a2, b2) = (
        np.moveaxis(np.asarray(each, float), -1, 0) for each in (one, two)
    )
    mean_c7 = ((np.hypot(a1, b1) + np.hypot(a2, b2)) / 2) ** 7
    wider = 1.5 - 0.5 * np.sqrt(mean_c7 / (mean_c7 + 25.0**7))
    a1, a2 = wider * a1, wider * a2
    c1, c2 = np.hypot(a1, b1), np.hypot(a2, b2)
    h1, h2 = (np.degrees(np.arctan2(b, a)) % 360 for a, b in ((a1, b1), (a2, b2)))
    grey = c1 * c2 == 0
    turn = h2 - h1
    turn = np.where(np.abs(turn) > 180 + 1e-9, turn - 360 * np.sign(turn), turn) * ~grey
    hue = 2 * np.sqrt(c1 * c2) * np.sin(np.radians(turn / 2))
    mean_h = np.where(grey, h1 + h2, h1 + turn / 2) % 360
    mean_l, mean_c = (l1 + l2) / 2, (c1 + c2) / 2
    cosines = ((-0.17, 1, -30), (0.24, 2, 0), (0.32, 3, 6), (-0.2, 4, -63))
    weight = 1 + sum(k * np.cos(np.radians(n * mean_h + at)) for k, n, at in cosines)
    s_l = 1 + 0.015 * (mean_l - 50) ** 2 / np.sqrt(20 + (mean_l - 50) ** 2)
    s_c, s_h = 1 + 0.045 * mean_c, 1 + 0.015 * mean_c * weight
    turned = np.radians(60 * np.exp(-(((mean_h - 275) / 25) ** 2)))
    rotation = -2 * np.sqrt(mean_c**7 / (mean_c**7 + 25.0**7)) * np.sin(turned)
    by_l, by_c, by_h = (l2 - l1) / s_l * lightness, (c2 - c1) / s_c, hue / s_h
    return np.sqrt(by_l**2 + by_c**2 + by_h**2 + rotation * by_c * by_h)


@dataclass(frozen=True)
class CheckerErrors:
    """Errors of the patches of a ColorChecker, in CIELAB.

    Args:
        delta_e: mean CIEDE2000.
        most_delta_e: the largest CIEDE2000.
        delta_c: mean CIEDE2000 without the difference of lightness.
        lightness: mean difference of L*.
        hue: median error of hue, degrees, of patches with a chroma of at least 10.
        most_hue: the largest error of hue.
        chroma: median ratio of their chroma to the chart's.
        white_balance: the chroma of the mean of the grey patches; 0 is neutral.
        grey_axis: the largest chroma of a grey patch after this mean is subtracted.
        grey_level: the green level of the patch of 19.5 % of white, 0 to 255; 122 in the chart.
    """

    delta_e: float
    most_delta_e: float
    delta_c: float
    lightness: float
    hue: float
    most_hue: float
    chroma: float
    white_balance: float
    grey_axis: float
    grey_level: float


def checker_errors(pictured: Doubles, true: Doubles) -> CheckerErrors:
    """Compare the patches of a picture of a ColorChecker with their true colours.

    >>> from clpipe.analysis.quality.charts import CHECKER
    >>> true = np.array(CHECKER, float)
    >>> found = checker_errors(true, true)
    >>> found.delta_e, found.hue, found.chroma, found.grey_level
    (0.0, 0.0, 1.0, 122.0)

    Args:
        pictured: sRGB levels, (24, 3).
        true: sRGB levels, (24, 3).
    """
    found, expected = cielab(pictured), cielab(true)
    (found_chroma, found_hue), (chroma, hue) = (
        (np.hypot(lab[:, 1], lab[:, 2]), np.degrees(np.arctan2(lab[:, 2], lab[:, 1])))
        for lab in (found, expected)
    )
    coloured = chroma >= HAS_HUE
    hues = np.abs((found_hue - hue + 180) % 360 - 180)[coloured]
    difference = delta_e_2000(expected, found)
    greys = found[GREYS, 1:]
    cast = greys.mean(0)
    return CheckerErrors(
        delta_e=float(difference.mean()),
        most_delta_e=float(difference.max()),
        delta_c=float(delta_e_2000(expected, found, lightness=False).mean()),
        lightness=float((found - expected)[:, 0].mean()),
        hue=float(np.median(hues)),
        most_hue=float(hues.max()),
        chroma=float(np.median(found_chroma[coloured] / chroma[coloured])),
        white_balance=float(np.hypot(*cast)),
        grey_axis=float(np.hypot(*(greys - cast).T).max()),
        grey_level=float(pictured[GREY, 1]),
    )
