"""Draws figures: panels of series, as pages in PNG, or as SVG for web pages.

Modules describe what to draw as :class:`Panel`, and this one draws. It imports Matplotlib, so
import it and the ``plot`` modules only to draw something.

SVG takes the colours of its page: text stays text in the page's font, and axes have the page's
colour (``currentColor``). Drawings are therefore readable on light and dark backgrounds, and in
print.
"""

import io
import re
import zlib
from collections.abc import Callable, Sequence
from typing import Any

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure, SubFigure

from clpipe.base.text import one_line

INK = {
    "R": "#c8102e",
    "G": "#2e8b3d",
    "G1": "#2e8b3d",
    "G2": "#8ab800",
    "B": "#1f5fbf",
    "Y": "#222222",
    "Cb": "#18a0b0",
    "Cr": "#b0389a",
    "mosaic": "#222222",
    "W": "#9a9a9a",
    "C": "#18a0b0",
    "M": "#b0389a",
    "all": "#6b6b6b",
}
BLUE, BLACK, RED, GREY, VIOLET = "#1f5fbf", "#222222", "#c8102e", "#8a8a8a", "#7a5bb5"
COLOURS = ("#1f8a8a", "#d9822b", VIOLET, RED)  # of series without a meaning of their own
AREA, STEPS, BARS = "area", "steps", "bars"  # styles of series other than Matplotlib's formats
PAGE = "#010203"  # placeholder for the page's colour in SVG
PAGE_STYLE = {"font.size": 11, "axes.grid": True, "axes.grid.which": "both", "grid.alpha": 0.3}
SVG_STYLE = {
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


class Series:
    """Values to draw in one colour.

    Args:
        x: the values on the x axis; None draws a horizontal line at ``y``.
        y: the values on the y axis; None draws a vertical line at ``x``.
        ink: the colour.
        label: the name in the legend; "" for none.
        style: Matplotlib's format of lines and markers; or :data:`AREA` below the values,
            :data:`STEPS` between edges ``x``, or horizontal :data:`BARS` of length ``x`` at ``y``.
        more: other properties of Matplotlib's artists, such as standard errors ``yerr``.
    """

    def __init__(
        self, x: Any, y: Any, ink: Any, label: str = "", style: str = "-", **more: Any
    ) -> None:
        self.x, self.y, self.style = x, y, style
        self.properties = {"color": ink, "label": label or None, **more}

    def draw(self, axes: Axes) -> None:
        """Draw the series."""
        x, y, properties = self.x, self.y, self.properties
        if y is None:
            axes.axvline(x, ls=self.style, **properties)
        elif x is None:
            axes.axhline(y, ls=self.style, **properties)
        elif self.style == AREA:
            axes.fill_between(x, y, **properties)
        elif self.style == STEPS:
            axes.stairs(y, x, fill=True, **properties)
        elif self.style == BARS:
            axes.barh(y, x, **properties)
        elif {"xerr", "yerr"} & properties.keys():
            axes.errorbar(x, y, fmt=self.style, **properties)
        else:
            axes.plot(x, y, self.style, **properties)


class Panel:
    """The content of one pair of axes.

    Args:
        series: the series.
        title: the title of the panel.
        x: the label of the x axis.
        y: the label of the y axis.
        tune: called with the axes at the end, for what the other arguments cannot set.
        more: limits, scales and ticks, as arguments of Matplotlib's ``Axes.set``.
    """

    def __init__(
        self,
        series: Sequence[Series],
        title: str = "",
        x: str = "",
        y: str = "",
        tune: Callable[[Axes], object] | None = None,
        **more: Any,
    ) -> None:
        self.series, self.tune = series, tune
        self.properties = {"title": title, "xlabel": x, "ylabel": y, **more}

    def draw(self, axes: Axes, legend: bool = True) -> None:
        """Draw the series, and a legend of the labels, if there are any."""
        for each in self.series:
            each.draw(axes)
        axes.set(**self.properties)
        if legend and axes.get_legend_handles_labels()[1]:
            axes.legend()
        if self.tune:
            self.tune(axes)


def draw_grid(figure: Figure | SubFigure, panels: Sequence[Panel], columns: int) -> None:
    """Draw panels in rows of some columns; places without a panel stay empty."""
    rows = -(-len(panels) // columns)
    places = figure.subplots(rows, columns, squeeze=False).ravel()
    for axes, panel in zip(places, panels, strict=False):
        panel.draw(axes)
    for axes in places[len(panels) :]:
        axes.axis("off")


def page_png(height: float, title: str, draw: Callable[[Figure], None]) -> bytes:
    """Return a page as PNG, 1600 px wide and 100 px high for each unit of ``height``."""
    png = io.BytesIO()
    with mpl.rc_context(PAGE_STYLE):
        figure = Figure(figsize=(16, height), dpi=100, layout="constrained")
        FigureCanvasAgg(figure)
        figure.suptitle(title, fontsize=16)
        draw(figure)
        figure.savefig(png)
    return png.getvalue()


def svg(
    size: tuple[float, float],
    title: str,
    draw: Callable[[Figure], None] | Panel,
    left: float = 0.75,
    right: float = 0.2,
) -> str:
    """Return a drawing without background, as an ``<svg>`` element that fills the available width.

    The margins are fixed, because fitting them to the text takes three times as long.

    Args:
        size: width and height in inches.
        title: a description for screen readers.
        draw: the panel, or a function that draws the figure.
        left: the margin on the left side in inches.
        right: that on the right side.
    """
    width, height = size
    file = io.StringIO()
    with mpl.rc_context(SVG_STYLE):
        figure = Figure(figsize=size)
        margins = {"left": left / width, "right": 1 - right / width}
        margins |= {"bottom": 0.55 / height, "top": 1 - 0.3 / height}
        figure.subplots_adjust(**margins, wspace=0.3, hspace=0.5)
        FigureCanvasSVG(figure)
        figure.patch.set_alpha(0)
        if isinstance(draw, Panel):
            draw.draw(figure.add_subplot())
        else:
            draw(figure)
        for axes in figure.axes:
            axes.patch.set_alpha(0)
        figure.savefig(file, format="svg", metadata={"Date": None, "Creator": None})
    text = file.getvalue()
    text = text[text.index("<svg") :]
    for ink in (PAGE, BLACK):
        text = text.replace(ink, "currentColor")
    text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
    # Ids must be unique in the page, which may have several drawings.
    own = f"d{zlib.crc32(text.encode()):x}"
    text = re.sub(r'(id="|url\(#|href="#)', rf"\g<1>{own}", text)
    text = re.sub(r'width="[\d.]+pt" height="[\d.]+pt"', 'width="100%"', text, count=1)
    label = one_line(title).replace("&", "&amp;").replace("<", "&lt;").replace('"', "&quot;")
    return text.replace("<svg ", f'<svg role="img" aria-label="{label}" ', 1)
