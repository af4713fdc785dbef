"""Shared parts of this package's PNG figures: page, colours, and the finish of axes.

The module imports Matplotlib, so import it and the ``plot`` modules only to draw something.
"""

from io import BytesIO
from typing import Any

from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

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


def page(height: float, title: str) -> Figure:
    """Return an empty figure, 1600 px wide and 100 px high for each unit of ``height``."""
    figure = Figure(figsize=(16, height), dpi=100, layout="constrained")
    FigureCanvasAgg(figure)
    figure.suptitle(title, fontsize=16)
    return figure


def png_of(figure: Figure) -> bytes:
    """Return a figure as the bytes of a PNG."""
    png = BytesIO()
    figure.savefig(png)
    return png.getvalue()


def finish(axes: Axes, **texts: Any) -> None:
    """Set titles, labels and limits of axes, and add a grid and a legend of labelled artists."""
    axes.set(**texts)
    axes.grid(alpha=0.3, which="both")
    if axes.get_legend_handles_labels()[1]:
        axes.legend()
