"""Draws a match: the noise of the camera, and the noise of the development."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes

from clpipe.analysis.drawing import finish, page, png_of
from clpipe.analysis.matching.columns import (
    COLUMNS,
    MAX_LAG,
    Noise,
    ValidPixels,
)
from clpipe.analysis.matching.result import Match, Row
from clpipe.analysis.spatial import spectrum_of
from clpipe.base.files import write_new
from clpipe.base.types import Doubles

INKS = {"theirs": "#222222", "ours": "#c8102e"}
STEP = 16  # levels between two points of noise by intensity
MIN_SAMPLES = 500  # samples that a point needs


def draw(match: Match, path: Path) -> None:
    """Draw a match as a PNG, 1600 px wide.

    Raises:
        ImageError: the file cannot be written.
    """
    first = match.scenes.each[0].name
    more = f" and {len(match.noises) - 1} more" if len(match.noises) > 1 else ""
    figure = page(11, f"Noise of {first}{more}, and of the development that was found")
    grid = figure.subplots(2, 2)
    draw_lags(grid[0, 0], match)
    draw_spectrum(grid[0, 1], match)
    draw_intensity(grid[1, 0], match)
    draw_residuals(grid[1, 1], match.unseen)
    write_new(path, png_of(figure))


def mean_table(match: Match, who: str, planes: Sequence[int]) -> Doubles:
    """Return the mean autocorrelation of planes (0 luma, 1 Cb, 2 Cr) of "theirs" or "ours"."""
    tables = [
        ValidPixels(scene.mask, scene.theirs.level).autocorrelation(
            getattr(scene, who).planes[plane]
        )
        for scene in match.noises
        for plane in planes
    ]
    return np.asarray(np.nanmean(tables, axis=0))


def draw_lags(axes: Axes, match: Match) -> None:
    """Draw the autocorrelation of luma and chroma to the right."""
    lags = np.arange(MAX_LAG + 1)
    for who, ink in INKS.items():
        for planes, style, what in (((0,), "-o", "luma"), ((1, 2), "--s", "chroma")):
            table = mean_table(match, who, planes)
            axes.plot(lags, table[MAX_LAG, MAX_LAG:], style, color=ink, label=f"{what}, {who}")
    finish(axes, title="Autocorrelation", xlabel="lag right, px", ylabel="correlation")


def draw_spectrum(axes: Axes, match: Match) -> None:
    """Draw the power spectrum of luma over the distance from frequency 0."""
    edges = np.linspace(0, 0.7, 15)
    for who, ink in INKS.items():
        spectrum, radius = spectrum_of(mean_table(match, who, (0,)))
        rings = np.digitize(radius, edges)
        power = [spectrum[rings == k].mean() for k in range(1, len(edges))]
        axes.plot((edges[1:] + edges[:-1]) / 2, power, "-o", color=ink, label=who)
    title = "Power spectrum of luma; independent noise: 1"
    finish(axes, title=title, xlabel="cycles/px", ylabel="power over variance", ylim=(0, None))


def draw_intensity(axes: Axes, match: Match) -> None:
    """Draw the luma noise of all scenes over their luma."""
    for who, ink in INKS.items():
        squares, count = np.zeros(256 // STEP), np.zeros(256 // STEP)
        for scene in match.noises:
            noise: Noise = getattr(scene, who)
            bins = (noise.level[scene.mask] // STEP).astype(int)
            power = (noise.planes[0][:, scene.mask] ** 2).mean(0)
            squares += np.bincount(bins, power, minlength=len(squares))
            count += np.bincount(bins, minlength=len(count))
        kept = count >= MIN_SAMPLES
        middle = (np.arange(len(count)) + 0.5) * STEP
        sigma = np.sqrt(squares[kept] / count[kept])
        axes.plot(middle[kept], sigma, "-o", color=ink, label=who)
    title = "Noise of luma by intensity"
    finish(axes, title=title, xlabel="luma, levels", ylabel="sigma, levels", ylim=(0, None))


def draw_residuals(axes: Axes, rows: Sequence[Row]) -> None:
    """Draw the residuals in the areas held out of the search, with their standard errors."""
    shown = [row for row in rows if not np.isnan(row.residual) and row.name != "beyond_4_sigma"]
    places = np.arange(len(shown))[::-1]
    residuals, errors = ([getattr(row, key) for row in shown] for key in ("residual", "error"))
    axes.axvspan(-0.1, 0.1, color="0.92")
    axes.axvline(0, color="0.4", linewidth=1)
    axes.errorbar(
        residuals, places, xerr=np.nan_to_num(errors), fmt="o", color=INKS["ours"], capsize=3
    )
    names = [COLUMNS[r.name].text + (" (share)" if r.relative else "") for r in shown]
    axes.set_yticks(places, names, fontsize=9)
    finish(axes, title="Ours less theirs in places that were not searched; grey: within 0.1")
