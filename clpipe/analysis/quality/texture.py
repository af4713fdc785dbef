"""Texture: how much of the detail of a dead leaves chart is left in a picture."""

import numpy as np

from clpipe.analysis.sharpness import FREQUENCIES, LUMINANCE
from clpipe.base.types import Doubles

LOW = (0.01, 0.04)  # cycles/px, relative to whose contrast that of finer detail is
STEP = 1 / 64  # cycles/px
EXPONENT, REFERENCE = 1.857, 0.04  # of the power spectrum of dead leaves; cycles/px


def texture_mtf(pictured: Doubles, chart: Doubles) -> Doubles:
    """Return the MTF of a texture at :data:`~clpipe.analysis.sharpness.FREQUENCIES` up to 0.5.

    It is the cross power spectrum of picture and chart over the power spectrum of the chart. The
    source is Kirk, Herzer, Artmann and Kunz, "Description of texture loss using the dead leaves
    target: current issues and a new intrinsic approach" (2014). It excludes noise and invented
    detail. The MTF of the chart's square pixel is included.

    Args:
        pictured: linear RGB, (side, side, 3).
        chart: the chart as a render, of the same shape, aligned with the picture.
    """
    side = len(chart)
    window = np.hanning(side) * np.hanning(side)[:, None]
    across = np.fft.fftfreq(side)
    frequency = np.hypot(across, across[:, None])
    before, after = (
        np.fft.fft2((p - p.mean()) * window) for p in (chart @ LUMINANCE, pictured @ LUMINANCE)
    )
    pixel = np.sinc(across) * np.sinc(across)[:, None]
    cross, power = (after * before.conj()).real * pixel, np.abs(before) ** 2

    def share(low: float, high: float) -> float:
        at = (frequency > low) & (frequency <= high)
        return float(cross[at].sum() / power[at].sum())

    centres = np.arange(0.5, 0.5 / STEP) * STEP
    shares = [share(f - STEP / 2, f + STEP / 2) / share(*LOW) for f in centres]
    half = FREQUENCIES[FREQUENCIES <= 0.5]
    return np.interp(half, [0.0, *centres], [1.0, *shares])


def printed_texture_mtf(pictured: Doubles, grey: Doubles | None = None) -> Doubles:
    """Return the MTF of a texture of which only the power spectrum is known, as above.

    It is the root of the picture's power over f^-1.857, the spectrum of dead leaves, and is 1 at
    0.04 cycles/px. The source is McElvain, Campbell, Miller and Jin, "Texture-based measurement of
    spatial frequency response using the dead leaves target" (2010). Noise counts as texture, unless
    ``grey`` shows its power. Detail that sharpening adds always counts.

    Args:
        pictured: linear RGB, (height, width, 3).
        grey: an even part of the same picture, whose noise is subtracted.
    """

    def power(light: Doubles) -> Doubles:
        luma = light @ LUMINANCE
        height, width = luma.shape
        window = np.hanning(width) * np.hanning(height)[:, None]
        spectrum = np.abs(np.fft.fft2((luma - luma.mean()) * window)) ** 2 / (window**2).sum()
        frequency = np.hypot(np.fft.fftfreq(width), np.fft.fftfreq(height)[:, None])
        rings = np.round(frequency / STEP).astype(int).ravel()
        return (np.bincount(rings, spectrum.ravel()) / np.bincount(rings))[: round(0.5 / STEP) + 1]

    at = np.arange(round(0.5 / STEP) + 1) * STEP
    noise = 0.0 if grey is None else power(grey)
    shares = np.sqrt(np.maximum(power(pictured) - noise, 0)[1:] * at[1:] ** EXPONENT)
    shares = shares / np.interp(REFERENCE, at[1:], shares)
    half = FREQUENCIES[FREQUENCIES <= 0.5]
    return np.interp(half, at, [1.0, *shares])
