"""Draws a noise report: noise by intensity, tails, autocorrelation, spectrum, correlations."""

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.image import AxesImage

from clpipe.analysis.drawing import (
    AREA,
    BARS,
    INK,
    PAGE,
    VIOLET,
    Panel,
    Series,
    draw_grid,
    page_png,
    svg,
)
from clpipe.analysis.report import UNITS, NoiseReport
from clpipe.analysis.spatial import LAGS, radial_spectrum
from clpipe.analysis.statistics import HISTOGRAM, Channel, gaussian_beyond
from clpipe.base.files import write_new
from clpipe.base.types import Doubles

# The channels whose autocorrelation is drawn, for each kind of picture and for mosaics.
MAPS = {"display": ("Y", "Cb", "Cr"), "rgb": ("Y", "Cb", "Cr")}
SITE_MAPS = ("mosaic", "R", "G1", "B")


def draw(report: NoiseReport, path: Path) -> None:
    """Draw a report as a PNG, 1600 px wide.

    Raises:
        ImageError: the file cannot be written.
    """
    first, *more = report.images
    subject = short_name(first) + (f" and {len(more)} more" if more else "")
    against = short_name(report.truth) if report.truth else "their mean"
    title = f"Noise of {subject} against {against} ({report.kind}, {report.share_used:.0%} used)"

    def draw_page(figure: Figure) -> None:
        above, below = figure.subfigures(2, 1, squeeze=False, height_ratios=(1.15, 1)).ravel()
        draw_grid(above, [intensity_panel(report), tails_panel(report)], 2)
        shown = mapped(report)
        limit = max(peak(one) for one in shown)
        axes = below.subplots(1, len(shown))
        for axis, one in zip(axes, shown, strict=True):
            picture = draw_autocorrelation(axis, one, limit, report)
        below.colorbar(picture, ax=axes, shrink=0.85, label="correlation (lag 0 is 1)")

    write_new(path, page_png(11, title, draw_page))


def noise_svg(report: NoiseReport) -> str:
    """Return sigma over intensity, autocorrelation, power spectrum and tails of pictures."""
    shown = mapped(report)
    lags = [lag_series(one.autocorrelation, INK[one.name], one.name) for one in shown]
    spectra = [spectrum_series(one.autocorrelation, INK[one.name], one.name) for one in shown]
    zero = Series(None, 0, PAGE, linewidth=0.8)
    white = Series(None, 1, PAGE, style=":", linewidth=0.8)
    panels = (
        intensity_panel(report),
        Panel([*lags, zero], "", "lag to the right, px", "autocorrelation"),
        Panel(
            [*spectra, white], "", "frequency, cycles/px", "power; white noise is 1", ylim=(0, None)
        ),
        tails_panel(report),
        correlations_panel(report),
    )

    def draw_figure(figure: Figure) -> None:
        above, below = figure.subplots(2, 3)
        for axes, panel in zip((*above, below[0], below[2]), panels, strict=True):
            panel.draw(axes, legend=False)  # a legend would cover a curve
        figure.legend(*above[0].get_legend_handles_labels(), loc="center right")
        picture = draw_autocorrelation(below[1], shown[0], peak(shown[0]), report)
        figure.colorbar(picture, ax=below[1], shrink=0.8)

    title = "Noise by intensity, its autocorrelation, spectrum, tails and colours"
    return svg((11, 5.6), title, draw_figure, right=0.9)


def law_svg(report: NoiseReport, a: float, b: float, title: str) -> str:
    """Return the variance of a mosaic's sites over intensity, and the requested law a y + b.

    Args:
        report: the report of a mosaic in signal, 0 to 1.
        a: a in signal units.
        b: b in squared signal units.
        title: a description for screen readers.
    """
    curves = {one.name: one.intensity for one in report.channels if one.name != "mosaic"}
    sites = [
        Series(curve.mean, curve.sigma**2, INK[name], name, "o", markersize=4)
        for name, curve in curves.items()
    ]
    ends = np.array([0, max(curve.mean.max() for curve in curves.values())])
    law = Series(ends, a * ends + b, PAGE, "model", linewidth=1.2)

    def tune(axes: Axes) -> None:
        axes.ticklabel_format(axis="y", scilimits=(0, 0))

    texts = "", "intensity (signal)", "variance (signal²)"
    return svg((3.8, 2.4), title, Panel([*sites, law], *texts, tune, ylim=(0, None)))


def mapped(report: NoiseReport) -> list[Channel]:
    """Return the channels whose autocorrelation is drawn."""
    by_name = {one.name: one for one in report.channels}
    return [by_name[name] for name in MAPS.get(report.kind, SITE_MAPS)]


def short_name(path: str) -> str:
    """Return the last folder and the file of a path, which distinguish truth and noisy image.

    >>> short_name("a/b/c.exr")
    'b/c.exr'
    """
    return "/".join(Path(path).parts[-2:])


def peak(one: Channel) -> float:
    """Return the largest absolute autocorrelation of a channel without lag 0; at least 0.05."""
    table = np.nan_to_num(one.autocorrelation.copy())
    table[LAGS, LAGS] = 0
    return float(np.clip(np.abs(table).max(), 0.05, 1.0))


def lag_series(table: Doubles, ink: str, label: str, style: str = "-o") -> Series:
    """Return the autocorrelation to the right, from a table with lag 0 in the middle."""
    lags = len(table) // 2
    return Series(range(lags + 1), table[lags, lags:], ink, label, style, markersize=4)


def spectrum_series(table: Doubles, ink: str, label: str) -> Series:
    """Return the power spectrum of an autocorrelation over the distance from frequency 0."""
    return Series(*radial_spectrum(table, 0.7, 14), ink, label, "-o", markersize=4)


def intensity_panel(report: NoiseReport) -> Panel:
    """Return sigma over intensity, and the fitted sqrt(a*y + b) if there is one."""
    series = []
    for one in report.channels:
        ink, curve, law = INK[one.name], one.intensity, one.law
        style = "o" if law else "--o" if one.name in ("Y", "Cb", "Cr") else "-o"
        series.append(Series(curve.mean, curve.sigma, ink, one.name, style, markersize=5))
        if law:
            y = np.linspace(report.edges[0], report.edges[-1], 200)
            series.append(Series(y, np.sqrt(np.maximum(law.a * y + law.b, 0)), ink, linewidth=1))
    fitted = any(one.law for one in report.channels)
    title = "Noise by intensity" + ("; lines: sqrt(a·y + b)" if fitted else "")
    return Panel(series, title, f"intensity ({UNITS[report.kind]})", "sigma", ylim=(0, None))


def tails_panel(report: NoiseReport) -> Panel:
    """Return the share of standardised noise beyond each value, and that of a Gaussian."""
    beyond = [gaussian_beyond(abs(z)) / 2 for z in HISTOGRAM]
    series = [Series(HISTOGRAM, beyond, "0.85", "Gaussian", AREA, y2=1e-12)]
    for one in report.channels:
        below = np.concatenate([[0], np.cumsum(one.tails.histogram)]) / one.samples
        share = np.minimum(below, 1 - below)
        known = np.where(share * one.samples > 0.5, share, np.nan)
        series.append(Series(HISTOGRAM, known, INK[one.name], one.name, linewidth=1.5))
    texts = "Tails", "noise / its sigma at that intensity", "share of samples further out"
    ends = 0.3 / max(one.samples for one in report.channels), 0.7
    return Panel(series, *texts, yscale="log", ylim=ends, xlim=(-6, 6))


def correlations_panel(report: NoiseReport) -> Panel:
    """Return the correlations of red, green and blue; without them, of all pairs of channels."""
    pairs = [pair for pair in report.correlation if set(pair) <= set("RGB-")]
    pairs = pairs or list(report.correlation)
    values = [float(np.nan_to_num(report.correlation[pair])) for pair in pairs]
    bars = Series(values, pairs, VIOLET, style=BARS)
    return Panel([bars], "correlation between channels", xlim=(min(0, *values), 1))


def draw_autocorrelation(axes: Axes, one: Channel, limit: float, report: NoiseReport) -> AxesImage:
    """Draw the autocorrelation of one channel as a map; lag 0 is white."""
    table = one.autocorrelation.copy()
    table[LAGS, LAGS] = np.nan
    extent = (-LAGS - 0.5, LAGS + 0.5, LAGS + 0.5, -LAGS - 0.5)
    picture = axes.imshow(table, cmap="RdBu_r", vmin=-limit, vmax=limit, extent=extent)
    axes.grid(visible=False)
    axes.set_title(f"{one.name}: left after 2x2: {one.energy_left_2x2:.3f}")
    per_site = report.kind not in MAPS and one.name != "mosaic"
    axes.set_xlabel("lag right, pixels" + (" of this site" if per_site else ""))
    axes.set_ylabel("lag down")
    axes.set_xticks(range(-LAGS, LAGS + 1, 4))
    axes.set_yticks(range(-LAGS, LAGS + 1, 4))
    return picture
