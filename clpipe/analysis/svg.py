"""Draws charts of a run as SVG for web pages: lines, shares, histograms and bars."""

from collections.abc import Mapping, Sequence
from importlib import resources

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator

from clpipe.analysis.drawing import AREA, BARS, COLOURS, STEPS, Panel, Series, svg

PAGE_FILES = resources.files("clpipe.analysis") / "page"  # files that report and explorer share
LONG = 18  # characters of the longest name next to a bar


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
    series = [
        Series(x, values, colour, name if len(lines) > 1 else "", linewidth=1.8)
        for colour, (name, values) in zip(COLOURS, lines.items(), strict=False)
    ]
    return svg((7, 2.6), title, Panel(series, "", *labels, ylim=(0, None)))


def shares_svg(
    x: Sequence[float], shares: Mapping[str, Sequence[float]], label: str, title: str
) -> str:
    """Return stacked shares over x, which add up to 1."""
    tops = np.cumsum([np.zeros(len(x)), *shares.values()], axis=0)
    series = [
        Series(x, top, colour, name, AREA, y2=below, alpha=0.8)
        for colour, name, below, top in zip(COLOURS, shares, tops, tops[1:], strict=False)
    ]

    def tune(axes: Axes) -> None:
        axes.yaxis.set_major_formatter("{x:.0%}")
        axes.legend(loc="center left", bbox_to_anchor=(1, 0.5))

    panel = Panel(series, "", label, "share of time", tune, ylim=(0, 1))
    return svg((7, 2.6), title, panel, right=1.3)


def histogram_svg(values: Sequence[float], label: str) -> str:
    """Return a histogram of values, with logarithmic bins if they span a factor of 30."""
    data = np.asarray(values, float)
    low, high = float(data.min()), float(data.max())
    logarithmic = low > 0 and high / low > 30
    count = min(max(int(len(data) ** 0.5), 5), 30)
    edges = np.geomspace(low, high, count + 1) if logarithmic else np.linspace(low, high, count + 1)
    ticks = list(MaxNLocator(4).tick_values(low, high))
    if logarithmic:
        ticks = [float(f"{tick:.2g}") for tick in np.geomspace(low, high, 4)]
    bars = Series(edges, np.histogram(data, edges)[0], COLOURS[0], style=STEPS)

    def tune(axes: Axes) -> None:
        axes.minorticks_off()
        axes.set_xticks(ticks, [f"{tick:,.0f}" if tick >= 100 else f"{tick:.3g}" for tick in ticks])
        axes.set_xlim(edges[0], edges[-1])
        axes.locator_params(axis="y", nbins=4, integer=True)

    panel = Panel([bars], "", label, "", tune, xscale="log" if logarithmic else "linear")
    return svg((3.4, 1.9), f"Histogram of {label}", panel, right=0.4)


def bars_svg(counts: Mapping[str, int], label: str) -> str:
    """Return bars with the count of each value."""
    names = [name if len(name) <= LONG else f"{name[: LONG - 1]}…" for name in counts]
    places = range(len(names))
    bars = Series(list(counts.values()), places, COLOURS[0], style=BARS, tick_label=names)

    def tune(axes: Axes) -> None:
        axes.locator_params(axis="x", nbins=4, integer=True)

    panel = Panel([bars], "", label, "", tune)
    return svg((3.4, 1.9), f"How often each value of {label} occurs", panel, left=1.36)
