"""Plots of noise for the documentation."""

from pathlib import Path

from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from clpipe.analysis.comparison_plot import METADATA, STYLE
from clpipe.analysis.matching.columns import MAX_LAG
from clpipe.analysis.spatial import LAGS, radial_spectrum
from clpipe.base.types import Doubles


def save(figure: Figure, path: Path) -> None:
    """Write a figure as SVG, PDF or PNG, always with the same bytes."""
    with rc_context(STYLE):
        figure.savefig(path, dpi=110, metadata=METADATA[path.suffix])


def caption(axes: Axes, title: str, x_label: str, y_label: str) -> None:
    """Set the titles and the grid of a plot."""
    axes.set_title(title, fontsize=9)
    axes.set_xlabel(x_label, fontsize=8)
    axes.set_ylabel(y_label, fontsize=8)
    axes.tick_params(labelsize=7)
    axes.grid(alpha=0.3)


def caption_spectrum(axes: Axes, title: str) -> None:
    """Set the titles and the scale of a plot of power spectra."""
    caption(axes, title, "spatial frequency, cycles per pixel", "power (1: independent noise)")
    axes.set_yscale("log")
    axes.yaxis.set_minor_formatter("")
    axes.set_yticks(ticks := (0.1, 0.2, 0.5, 1, 2, 5, 10), [f"{tick:g}" for tick in ticks])


def spectrum(autocorrelation: Doubles) -> tuple[Doubles, Doubles]:
    """Return the power spectrum of noise, as means over rings of equal frequency.

    Args:
        autocorrelation: at lags of -8 to 8 pixels down and right, (17, 17).

    Returns:
        Frequencies in cycles per pixel, and powers. Independent noise has a power of 1.
    """
    near = slice(LAGS - MAX_LAG, LAGS + MAX_LAG + 1)
    return radial_spectrum(autocorrelation[near, near], 0.5, 16)
