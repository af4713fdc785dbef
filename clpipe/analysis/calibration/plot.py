"""The picture of a calibration."""

import math
from collections.abc import Sequence
from io import BytesIO

import numpy as np

from clpipe.analysis.calibration.result import Calibration

COLOURS = {"R": "#c8312b", "G1": "#2f9e44", "G2": "#8fb339", "B": "#2b62c8", "all": "#6b6b6b"}
# Of the filters of other arrays.
COLOURS |= {"G": "#2f9e44", "W": "#9a9a9a", "Y": "#c9a227", "C": "#1aa0b0", "M": "#b0409a"}
OTHER = "#6b6b6b"
WIDTH = 1600  # px
COLUMNS = 3  # of panels, one for each ISO


def calibration_png(calibrations: Sequence[Calibration], title: str) -> bytes:
    """A calibration as a PNG, 1600 px wide.

    For each ISO it shows variance over mean with the fitted lines, and below the photon-transfer
    curves of all ISOs (log noise over log light), all in DN.

    Args:
        calibrations: one calibration for each ISO.
        title: the name of the camera.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    columns = min(COLUMNS, len(calibrations))
    rows = math.ceil(len(calibrations) / columns)
    figure = Figure(figsize=(16, 7.5 + 4.2 * rows), dpi=WIDTH / 16, layout="constrained")
    figure.suptitle(title, fontsize=17)
    upper, lower = figure.subfigures(2, 1, squeeze=False, height_ratios=[4.2 * rows, 7]).ravel()
    panels = np.ravel(upper.subplots(rows, columns, squeeze=False))
    for panel, one in zip(panels, calibrations, strict=False):
        _variance_over_mean(panel, one)
    for panel in panels[len(calibrations) :]:
        panel.axis("off")
    _photon_transfer(lower.subplots(), calibrations)
    canvas = FigureCanvasAgg(figure)
    picture = BytesIO()
    canvas.print_png(picture)
    return picture.getvalue()


def _variance_over_mean(panel: object, one: Calibration) -> None:
    """Draw one ISO: the channels' bins, their lines, and the line of all channels."""
    from matplotlib.axes import Axes

    assert isinstance(panel, Axes)
    rounding = one.rounding
    most = 0.0
    for name, bins in one.bins.items():
        light = np.array([b.light for b in bins])
        variance = np.array([b.variance for b in bins]) - rounding
        errors = np.array([b.error for b in bins])
        most = max(most, *light) if len(light) else most
        panel.errorbar(
            light, variance, errors, fmt="o", ms=4, lw=1, color=COLOURS.get(name, OTHER), label=name
        )
    ends = np.array([0.0, most * 1.05])
    gain, floor = one.pooled.gain, one.pooled.floor
    for name, line in one.lines.items():
        own = line.gain.value * ends + line.floor.value
        label = None if name in one.bins else f"fit, {name}"
        panel.plot(ends, own, color=COLOURS.get(name, OTHER), lw=0.8, alpha=0.7, label=label)
    panel.plot(ends, gain.value * ends + floor.value, color="black", lw=1.3, label="fit, all")
    panel.set(
        title=f"ISO {one.iso:g}: variance = {gain.value:.4g} · mean + {floor.value:.3g}",
        xlabel="mean above black, DN",
        ylabel="variance, DN²",
    )
    panel.set_ylim(0)
    panel.set_xlim(0)
    panel.grid(alpha=0.25)
    panel.legend(fontsize=9, loc="upper left")


def _photon_transfer(panel: object, calibrations: Sequence[Calibration]) -> None:
    """Draw noise over light, both logarithmic, of all ISOs."""
    from matplotlib import colormaps
    from matplotlib.axes import Axes

    assert isinstance(panel, Axes)
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
    panel.set(
        xscale="log",
        yscale="log",
        title="Photon transfer: lines as fitted, points as measured",
        xlabel="mean above black, DN",
        ylabel="noise (standard deviation), DN",
    )
    panel.grid(alpha=0.25, which="both")
    panel.legend(fontsize=10, loc="upper left")
