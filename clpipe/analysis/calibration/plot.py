"""Draws a calibration."""

import math
from collections.abc import Sequence

import numpy as np
from matplotlib import colormaps
from matplotlib.figure import Figure

from clpipe.analysis.calibration.result import Calibration
from clpipe.analysis.drawing import INK, Panel, Series, draw_grid, page_png

COLUMNS = 3  # columns of panels; there is a panel for each ISO
LIGHT = "mean above black, DN"


def calibration_png(calibrations: Sequence[Calibration], title: str) -> bytes:
    """Return a calibration as a PNG, 1600 px wide.

    For each ISO, it shows variance over mean with the fitted lines. Below are the photon-transfer
    curves of all ISOs (log noise over log light). Values are in DN.

    Args:
        calibrations: one calibration for each ISO.
        title: the name of the camera.
    """
    columns = min(COLUMNS, len(calibrations))
    high = 4.2 * math.ceil(len(calibrations) / columns)

    def draw(figure: Figure) -> None:
        upper, lower = figure.subfigures(2, 1, squeeze=False, height_ratios=[high, 7]).ravel()
        draw_grid(upper, [_variance_over_mean(one) for one in calibrations], columns)
        draw_grid(lower, [_photon_transfer(calibrations)], 1)

    return page_png(7.5 + high, title, draw)


def _variance_over_mean(one: Calibration) -> Panel:
    """Return one ISO: the channels' bins, their lines, and the line of all channels."""
    series = []
    for name, bins in one.bins.items():
        values = [(b.light, b.variance - one.rounding, b.error) for b in bins]
        light, variance, error = np.reshape(values, (-1, 3)).T
        series.append(Series(light, variance, INK.get(name), name, "o", ms=4, lw=1, yerr=error))
    most = max((b.light for bins in one.bins.values() for b in bins), default=0.0)
    ends = np.array([0.0, most * 1.05])
    for name, line in one.lines.items():
        label = "" if name in one.bins else f"fit, {name}"
        fitted = line.gain.value * ends + line.floor.value
        series.append(Series(ends, fitted, INK.get(name), label, lw=0.8, alpha=0.7))
    gain, floor = one.pooled.gain.value, one.pooled.floor.value
    series.append(Series(ends, gain * ends + floor, "black", "fit, all", lw=1.3))
    title = f"ISO {one.iso:g}: variance = {gain:.4g} · mean + {floor:.3g}"
    return Panel(series, title, LIGHT, "variance, DN²", xlim=(0, None), ylim=(0, None))


def _photon_transfer(calibrations: Sequence[Calibration]) -> Panel:
    """Return noise over light, both logarithmic, of all ISOs."""
    unit = calibrations[0].sensor.unit
    shades = colormaps["viridis"](np.linspace(0, 0.85, len(calibrations)))
    light = np.geomspace(unit * 1e-4, unit, 200)
    series = []
    for shade, one in zip(shades, calibrations, strict=True):
        gain, floor = one.pooled.gain.value, one.pooled.floor.value
        label = f"ISO {one.iso:g}: K {gain:.3g} DN/e⁻, read {one.read_noise.value:.3g} DN"
        every = [b for bins in one.bins.values() for b in bins if b.light > light[0]]
        noise = np.sqrt([max(b.variance - one.rounding, 1e-9) for b in every])
        series += [
            Series(light, np.sqrt(np.maximum(gain * light + floor, 1e-9)), shade, label),
            Series([b.light for b in every], noise, shade, "", "o", ms=3.5),
        ]
    title = "Photon transfer: lines as fitted, points as measured"
    texts = title, LIGHT, "noise (standard deviation), DN"
    return Panel(series, *texts, xscale="log", yscale="log")
