"""Draws SVGs for web pages: lines, histograms and noise, in the colours of the page.

Text stays text in the page's font, and axes have the page's colour (``currentColor``). Drawings are
therefore readable on light and dark backgrounds, and in print.
"""

import io
import re
import zlib
from collections.abc import Mapping, Sequence
from importlib import resources

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from clpipe.analysis.drawing import INK
from clpipe.analysis.plot import (
    draw_autocorrelation,
    draw_intensity,
    draw_tails,
    mapped,
    peak,
)
from clpipe.analysis.report import NoiseReport
from clpipe.analysis.spatial import LAGS
from clpipe.base.text import one_line

NEUTRAL = INK["mosaic"]
PAGE_FILES = resources.files("clpipe.analysis") / "page"  # files that report and explorer share
PAGE = "#010203"  # placeholder for the page's colour
COLOURS = ("#1f8a8a", "#d9822b", "#7a5bb5", "#c8102e")
LONG = 18  # characters of the longest name next to a bar
SETTINGS = {
    "svg.fonttype": "none",
    "svg.hashsalt": "clpipe",
    "font.family": "sans-serif",
    "font.size": 11,
    "axes.titlesize": 11,
    "legend.fontsize": 9,
    "axes.edgecolor": PAGE,
    "axes.labelcolor": PAGE,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": PAGE,
    "grid.alpha": 0.15,
    "legend.frameon": False,
    "text.color": PAGE,
    "xtick.color": PAGE,
    "ytick.color": PAGE,
}


def _figure(width: float, height: float, right: float = 0.2) -> Figure:
    """Return a figure without background, sized in inches; ``right`` is the margin on that side.

    The margins are fixed, because fitting them to the text takes three times as long.
    """
    figure = Figure(figsize=(width, height))
    margins = {"left": 0.75 / width, "right": 1 - right / width}
    figure.subplots_adjust(
        **margins, bottom=0.55 / height, top=1 - 0.3 / height, wspace=0.3, hspace=0.5
    )
    FigureCanvasSVG(figure)
    figure.patch.set_alpha(0)
    return figure


def _text(figure: Figure, title: str) -> str:
    """Return a figure as an ``<svg>`` element that fills the available width."""
    for axes in figure.axes:
        axes.patch.set_alpha(0)
    file = io.StringIO()
    figure.savefig(file, format="svg", metadata={"Date": None, "Creator": None})
    text = file.getvalue()
    text = text[text.index("<svg") :]
    for ink in (PAGE, NEUTRAL):
        text = text.replace(ink, "currentColor")
    text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
    # Ids must be unique in the page, which may have several drawings.
    own = f"d{zlib.crc32(text.encode()):x}"
    text = re.sub(r'(id="|url\(#|href="#)', rf"\g<1>{own}", text)
    text = re.sub(r'width="[\d.]+pt" height="[\d.]+pt"', 'width="100%"', text, count=1)
    label = one_line(title).replace("&", "&amp;").replace("<", "&lt;").replace('"', "&quot;")
    return text.replace("<svg ", f'<svg role="img" aria-label="{label}" ', 1)


def lines_svg(
    x: Sequence[float], lines: Mapping[str, Sequence[float]], labels: tuple[str, str], title: str
) -> str:
    """Return lines over x, with axes that start at 0.

    Args:
        x: the values on the x axis.
        lines: the values of each line, by name.
        labels: labels of the axes.
        title: a description for screen readers.
    """
    with mpl.rc_context(SETTINGS):
        figure = _figure(7, 2.6)
        axes = figure.add_subplot()
        for colour, (name, values) in zip(COLOURS, lines.items(), strict=False):
            axes.plot(x, values, color=colour, label=name, linewidth=1.8)
        axes.set(ylim=(0, None), xlabel=labels[0], ylabel=labels[1])
        if len(lines) > 1:
            axes.legend()
        return _text(figure, title)


def shares_svg(
    x: Sequence[float], shares: Mapping[str, Sequence[float]], label: str, title: str
) -> str:
    """Return stacked shares over x, which add up to 1."""
    with mpl.rc_context(SETTINGS):
        figure = _figure(7, 2.6, right=1.3)
        axes = figure.add_subplot()
        used = COLOURS[: len(shares)]
        axes.stackplot(x, *shares.values(), labels=list(shares), colors=used, alpha=0.8)
        axes.set(ylim=(0, 1), xlabel=label)
        axes.yaxis.set_major_formatter("{x:.0%}")
        axes.set_ylabel("share of time")
        axes.legend(loc="center left", bbox_to_anchor=(1, 0.5))
        return _text(figure, title)


def histogram_svg(values: Sequence[float], label: str) -> str:
    """Return a histogram of values, with logarithmic bins if they span a factor of 30."""
    data = np.asarray(values, float)
    low, high = float(data.min()), float(data.max())
    logarithmic = low > 0 and high / low > 30
    count = min(max(int(len(data) ** 0.5), 5), 30)
    edges = np.geomspace(low, high, count + 1) if logarithmic else np.linspace(low, high, count + 1)
    with mpl.rc_context(SETTINGS):
        figure = _figure(3.4, 1.9, right=0.4)
        axes = figure.add_subplot()
        axes.hist(data, list(edges), color=COLOURS[0])
        ticks = list(MaxNLocator(4).tick_values(low, high))
        if logarithmic:
            axes.set_xscale("log")
            axes.minorticks_off()
            ticks = [float(f"{tick:.2g}") for tick in np.geomspace(low, high, 4)]
        axes.set_xticks(ticks, [f"{tick:,.0f}" if tick >= 100 else f"{tick:.3g}" for tick in ticks])
        axes.set_xlim(edges[0], edges[-1])
        axes.set_xlabel(label)
        axes.locator_params(axis="y", nbins=4, integer=True)
        return _text(figure, f"Histogram of {label}")


def bars_svg(counts: Mapping[str, int], label: str) -> str:
    """Return bars with the count of each value."""
    with mpl.rc_context(SETTINGS):
        figure = _figure(3.4, 1.9)
        figure.subplots_adjust(left=0.4)
        axes = figure.add_subplot()
        names = [name if len(name) <= LONG else f"{name[: LONG - 1]}…" for name in counts]
        axes.barh(range(len(names)), list(counts.values()), color=COLOURS[0], tick_label=names)
        axes.set_xlabel(label)
        axes.locator_params(axis="x", nbins=4, integer=True)
        return _text(figure, f"How often each value of {label} occurs")


def noise_svg(report: NoiseReport) -> str:
    """Return sigma over intensity, autocorrelation, power spectrum and tails of pictures."""
    with mpl.rc_context(SETTINGS):
        figure = _figure(11, 5.6, right=0.9)
        above, below = figure.subplots(2, 3)
        draw_intensity(above[0], report)
        _draw_lags(above[1], report)
        _draw_spectrum(above[2], report)
        draw_tails(below[0], report)
        figure.legend(*above[0].get_legend_handles_labels(), loc="center right")
        for axes in (above[0], below[0]):
            axes.get_legend().remove()  # a legend would cover a curve
        first = mapped(report)[0]
        picture = draw_autocorrelation(below[1], first, peak(first), report)
        figure.colorbar(picture, ax=below[1], shrink=0.8)
        _draw_correlations(below[2], report)
        return _text(figure, "Noise by intensity, its autocorrelation, spectrum, tails and colours")


def law_svg(report: NoiseReport, a: float, b: float, title: str) -> str:
    """Return the variance of a mosaic's sites over intensity, and the requested law a y + b.

    Args:
        report: the report of a mosaic in signal, 0 to 1.
        a: a in signal units.
        b: b in squared signal units.
        title: a description for screen readers.
    """
    with mpl.rc_context(SETTINGS):
        figure = _figure(3.8, 2.4)
        axes = figure.add_subplot()
        sites = [one for one in report.channels if one.name != "mosaic"]
        for one in sites:
            variance = one.curve.sigma**2
            axes.plot(
                one.curve.mean, variance, "o", markersize=4, color=INK[one.name], label=one.name
            )
        ends = np.array([0, max(one.curve.mean.max() for one in sites)])
        axes.plot(ends, a * ends + b, color=PAGE, linewidth=1.2, label="model")
        axes.set(ylim=(0, None), xlabel="intensity (signal)", ylabel="variance (signal²)")
        axes.ticklabel_format(axis="y", scilimits=(0, 0))
        axes.legend()
        return _text(figure, title)


def _draw_lags(axes: Axes, report: NoiseReport) -> None:
    for one in mapped(report):
        right = one.autocorrelation[LAGS, LAGS:]
        axes.plot(range(LAGS + 1), right, "-o", markersize=3, color=INK[one.name], label=one.name)
    axes.axhline(0, color=PAGE, linewidth=0.8)
    axes.set(xlabel="lag to the right, px", ylabel="autocorrelation")


def _draw_spectrum(axes: Axes, report: NoiseReport) -> None:
    """Draw the power spectrum along rows: the Fourier transform of the windowed autocorrelation.

    A Hann window over the known lags prevents ringing. White noise is 1 everywhere.
    """
    frequency = np.linspace(0, 0.5, 65)
    lags = np.arange(1, LAGS + 1)
    window = 0.5 + 0.5 * np.cos(np.pi * lags / (LAGS + 1))
    waves = np.cos(2 * np.pi * np.outer(frequency, lags))
    for one in mapped(report):
        right = np.nan_to_num(one.autocorrelation[LAGS, LAGS + 1 :])
        axes.plot(frequency, 1 + 2 * waves @ (window * right), color=INK[one.name], label=one.name)
    axes.axhline(1, color=PAGE, linewidth=0.8, linestyle=":")
    axes.set(
        ylim=(0, None), xlabel="frequency along rows, cycles/px", ylabel="power; white noise is 1"
    )


def _draw_correlations(axes: Axes, report: NoiseReport) -> None:
    pairs = [pair for pair in report.correlations if set(pair) <= {"R", "G", "B"}]
    pairs = pairs or list(report.correlations)
    values = [float(np.nan_to_num(report.correlations[pair])) for pair in pairs]
    axes.barh(["-".join(pair) for pair in pairs], values, color=COLOURS[2])
    axes.set_xlim(min(0, *values), 1)
    axes.set_title("correlation between channels")
