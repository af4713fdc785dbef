"""Draws a calibration."""

import math
from collections.abc import Sequence

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes

from clpipe.analysis.calibration.result import Calibration
from clpipe.analysis.drawing import INK, finish, page, png_of

COLUMNS = 3  # columns of panels; there is a panel for each ISO


def calibration_png(calibrations: Sequence[Calibration], title: str) -> bytes:
    """Return a calibration as a PNG, 1600 px wide.

    For each ISO, it shows variance over mean with the fitted lines. Below are the photon-transfer
    curves of all ISOs (log noise over log light). Values are in DN.

    Args:
        calibrations: one calibration for each ISO.
        title: the name of the camera.
    """
    columns = min(COLUMNS, len(calibrations))
    rows = math.ceil(len(calibrations) / columns)
    figure = page(7.5 + 4.2 * rows, title)
    upper, lower = figure.subfigures(2, 1, squeeze=False, height_ratios=[4.2 * rows, 7]).ravel()
    panels = np.ravel(upper.subplots(rows, columns, squeeze=False))
    for panel, one in zip(panels, calibrations, strict=False):
        _variance_over_mean(panel, one)
    for panel in panels[len(calibrations) :]:
        panel.axis("off")
    _photon_transfer(lower.subplots(), calibrations)
    return png_of(figure)


def _variance_over_mean(panel: Axes, one: Calibration) -> None:
    """Draw one ISO: the channels' bins, their lines, and the line of all channels."""
    rounding = one.rounding
    most = 0.0
    for name, bins in one.bins.items():
        light = np.array([b.light for b in bins])
        variance = np.array([b.variance for b in bins]) - rounding
        errors = np.array([b.error for b in bins])
        most = max(most, *light) if len(light) else most
        panel.errorbar(
            light, variance, errors, fmt="o", ms=4, lw=1, color=INK.get(name), label=name
        )
    ends = np.array([0.0, most * 1.05])
    gain, floor = one.pooled.gain, one.pooled.floor
    for name, line in one.lines.items():
        own = line.gain.value * ends + line.floor.value
        label = None if name in one.bins else f"fit, {name}"
        panel.plot(ends, own, color=INK.get(name), lw=0.8, alpha=0.7, label=label)
    panel.plot(ends, gain.value * ends + floor.value, color="black", lw=1.3, label="fit, all")
    finish(
        panel,
        title=f"ISO {one.iso:g}: variance = {gain.value:.4g} · mean + {floor.value:.3g}",
        xlabel="mean above black, DN",
        ylabel="variance, DN²",
        xlim=(0, None),
        ylim=(0, None),
    )


def _photon_transfer(panel: Axes, calibrations: Sequence[Calibration]) -> None:
    """Draw noise over light, both logarithmic, of all ISOs."""
    unit = calibrations[0].sensor.unit
    shades = colormaps["viridis"](np.linspace(0, 0.85, len(calibrations)))
    light = np.geomspace(unit * 1e-4, unit, 200)
    for shade, one in zip(shades, calibrations, strict=True):
        gain, floor = one.pooled.gain.value, one.pooled.floor.value
        label = f"ISO {one.iso:g}: K {gain:.3g} DN/e⁻, read {one.read_noise.value:.3g} DN"
        panel.plot(light, np.sqrt(np.maximum(gain * light + floor, 1e-9)), color=shade, label=label)
        every = [b for bins in one.bins.values() for b in bins if b.light > light[0]]
        noise = np.sqrt([max(b.variance - one.rounding, 1e-9) for b in every])
        panel.plot([b.light for b in every], noise, "o", ms=3.5, color=shade)
    finish(
        panel,
        xscale="log",
        yscale="log",
        title="Photon transfer: lines as fitted, points as measured",
        xlabel="mean above black, DN",
        ylabel="noise (standard deviation), DN",
    )
