"""How visible noise is, and how sharp texture looks, at a viewing distance."""

import numpy as np

from clpipe.base.types import Doubles
from clpipe.camera.profile import SRGB_TO_XYZ
from clpipe.reference.transfer import inverse_srgb_curve

PIXELS_PER_DEGREE = 41.2  # a screen of 100 pixels per inch, seen at full size from 60 cm
OPPONENT = np.array([[0, 1, 0], [1, -1, 0], [0, 0.4, -0.4]])  # from XYZ under E to A, C1, C2
WEIGHTS = 1.0, 0.852, 0.323  # of the noise of L*, u* and v*

# a1, b1, c1, a2, b2, c2 of the sensitivity to C1 and C2: a1 exp(-b1 f^c1) + a2 exp(-b2 f^c2)
CHROMATIC = (
    (109.1413, 0.00038, 3.42436, 93.59711, 0.00367, 2.16771),
    (7.0328, 0.000004, 4.2582, 40.6910, 0.1039, 1.6487),
)


def sensitivity(frequency: Doubles) -> Doubles:
    """Return the eye's sensitivity to luminance contrast, at most 3, of cycles per degree.

    It is that of ISO 15739:2013, B.2.4 (Johnson and Fairchild, "A top down description of S-CIELAB
    and CIEDE2000", 2003).

    >>> sensitivity(np.array([0.0, 4.0, 30.0])).round(2).tolist()
    [0.0, 3.0, 0.08]
    """
    return 75 * frequency**0.8 * np.exp(-0.2 * frequency) / 34.05


def visual_noise(levels: Doubles) -> float:
    """Return the visual noise of pictures of a grey patch (ISO 15739:2013, annex B).

    The patch is filtered with the sensitivities of the eye to luminance and to two differences of
    colours. The result is the weighted sum of the standard deviations of L*, u* and v*. The edition
    of 2023 has other constants, which no public text contains.

    >>> round(visual_noise(np.full((1, 8, 8, 3), 100.0)), 6)
    0.0

    Args:
        levels: sRGB levels, (frame, height, width, 3).
    """
    height, width = levels.shape[1:3]
    xyz = inverse_srgb_curve(levels / 255) @ SRGB_TO_XYZ.T
    white = SRGB_TO_XYZ.sum(1)
    opponent = xyz / white @ OPPONENT.T
    mean = opponent.mean((1, 2), keepdims=True)
    down, across = np.fft.fftfreq(height), np.fft.rfftfreq(width)
    frequency = np.hypot(across, down[:, None]) * PIXELS_PER_DEGREE
    chromatic = [
        (a * np.exp(-b * frequency**c) + d * np.exp(-e * frequency**f)) / (a + d)
        for a, b, c, d, e, f in CHROMATIC
    ]
    filters = np.stack([sensitivity(frequency), *chromatic], axis=-1)
    spectra = np.fft.rfft2(opponent - mean, axes=(1, 2)) * filters
    seen = np.fft.irfft2(spectra, (height, width), axes=(1, 2)) + mean
    luv = _luv_of(np.maximum(seen @ np.linalg.inv(OPPONENT).T, 0) * white, white)
    return float((luv.std((1, 2)).mean(0) * WEIGHTS).sum())


def _luv_of(xyz: Doubles, white: Doubles) -> Doubles:
    """Convert XYZ to CIELUV (CIE 15:2018, eq. 8.25 to 8.31)."""

    def chromaticity(each: Doubles) -> Doubles:
        total = np.maximum(each @ (1, 15, 3), 1e-12)[..., None]
        return np.asarray(each[..., :2] * (4, 9) / total)

    y = xyz[..., 1] / white[1]
    lightness = np.where(y > (6 / 29) ** 3, 116 * np.cbrt(y) - 16, y * (29 / 3) ** 3)[..., None]
    colour = 13 * lightness * (chromaticity(xyz) - chromaticity(white))
    return np.concatenate([lightness, colour], axis=-1)


def acutance(mtf: Doubles, frequency: Doubles) -> float:
    """Return the acutance: an MTF weighted with the eye's sensitivity (IEEE 1858, CPIQ).

    >>> round(acutance(np.ones(65), np.linspace(0, 0.5, 65)), 3)
    1.0

    Args:
        mtf: the MTF.
        frequency: its frequencies, cycles/px, evenly from 0.
    """
    weight = sensitivity(frequency * PIXELS_PER_DEGREE)
    return float((mtf * weight).sum() / weight.sum())
