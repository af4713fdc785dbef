"""Draws a noise report: noise by intensity, tails, autocorrelation."""

from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.image import AxesImage

from clpipe.analysis.drawing import INK, page, png_of
from clpipe.analysis.report import UNITS, NoiseReport
from clpipe.analysis.spatial import LAGS
from clpipe.analysis.statistics import HISTOGRAM, Channel, gaussian_beyond
from clpipe.base.files import write_new

# The channels whose autocorrelation is drawn, for each kind of picture and for mosaics.
MAPS = {"display": ("Y", "Cb", "Cr"), "rgb": ("Y", "Cb", "Cr")}
SITE_MAPS = ("mosaic", "R", "G1", "B")


def draw(report: NoiseReport, path: Path) -> None:
    """Draw a report as a PNG, 1600 px wide.

    Raises:
        ImageError: the file cannot be written.
    """
    with mpl.rc_context({"font.size": 12, "axes.grid": True, "grid.alpha": 0.3}):
        write_new(path, png_of(_figure(report)))


def _figure(report: NoiseReport) -> Figure:
    first, *more = report.images
    subject = short_name(first) + (f" and {len(more)} more" if more else "")
    against = short_name(report.truth) if report.truth else "their mean"
    title = f"Noise of {subject} against {against} ({report.kind}, {report.share:.0%} used)"
    figure = page(11, title)
    grid = figure.add_gridspec(2, 1, height_ratios=(1.15, 1))
    above, below = figure.add_subfigure(grid[0]), figure.add_subfigure(grid[1])
    intensity, tails = above.subplots(1, 2)
    draw_intensity(intensity, report)
    draw_tails(tails, report)
    shown = mapped(report)
    limit = max(peak(one) for one in shown)
    axes = below.subplots(1, len(shown))
    for axis, one in zip(axes, shown, strict=True):
        picture = draw_autocorrelation(axis, one, limit, report)
    below.colorbar(picture, ax=axes, shrink=0.85, label="correlation (lag 0 is 1)")
    return figure


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


def draw_intensity(axes: Axes, report: NoiseReport) -> None:
    """Draw sigma over intensity, and the fitted sqrt(a*y + b) if there is one."""
    for one in report.channels:
        ink, curve = INK[one.name], one.curve
        dashed = one.name in ("Y", "Cb", "Cr")
        axes.plot(
            curve.mean,
            curve.sigma,
            marker="o",
            markersize=5,
            linestyle=("--" if dashed else "-") if one.law is None else "",
            color=ink,
            label=one.name,
        )
        if one.law:
            y = np.linspace(report.edges[0], report.edges[-1], 200)
            variance = np.maximum(one.law.a * y + one.law.b, 0)
            axes.plot(y, np.sqrt(variance), color=ink, linewidth=1)
    fitted = any(one.law for one in report.channels)
    axes.set(
        ylim=(0, None),
        xlabel=f"intensity ({UNITS[report.kind]})",
        ylabel="sigma",
        title="Noise by intensity" + ("; lines: sqrt(a·y + b)" if fitted else ""),
    )
    axes.legend()


def draw_tails(axes: Axes, report: NoiseReport) -> None:
    """Draw the share of standardised noise beyond each value, for the image and for a Gaussian."""
    beyond = [gaussian_beyond(abs(z)) / 2 for z in HISTOGRAM]
    axes.fill_between(HISTOGRAM, beyond, 1e-12, color="0.85", label="Gaussian")
    for one in report.channels:
        below = np.concatenate([[0], np.cumsum(one.tails.histogram)]) / one.count
        share = np.minimum(below, 1 - below)
        axes.plot(
            HISTOGRAM,
            np.where(share * one.count > 0.5, share, np.nan),
            color=INK[one.name],
            linewidth=1.5,
            label=one.name,
        )
    axes.set(
        yscale="log",
        ylim=(0.3 / max(one.count for one in report.channels), 0.7),
        xlim=(-6, 6),
        xlabel="noise / its sigma at that intensity",
        ylabel="share of samples further out",
        title="Tails",
    )
    axes.legend()


def draw_autocorrelation(axes: Axes, one: Channel, limit: float, report: NoiseReport) -> AxesImage:
    """Draw the autocorrelation of one channel as a map; lag 0 is white."""
    table = one.autocorrelation.copy()
    table[LAGS, LAGS] = np.nan
    extent = (-LAGS - 0.5, LAGS + 0.5, LAGS + 0.5, -LAGS - 0.5)
    picture = axes.imshow(table, cmap="RdBu_r", vmin=-limit, vmax=limit, extent=extent)
    axes.grid(visible=False)
    axes.set_title(f"{one.name}: left after 2x2: {one.energy_left:.3f}")
    per_site = report.kind not in MAPS and one.name != "mosaic"
    axes.set_xlabel("lag right, pixels" + (" of this site" if per_site else ""))
    axes.set_ylabel("lag down")
    axes.set_xticks(range(-LAGS, LAGS + 1, 4))
    axes.set_yticks(range(-LAGS, LAGS + 1, 4))
    return picture
