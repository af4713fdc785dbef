"""Draws a match: the noise of the camera, and the noise of the development."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes

from clpipe.analysis.drawing import AREA, BLACK, RED, Panel, Series, draw_grid, page_png
from clpipe.analysis.matching.columns import COLUMNS, Noise, ValidPixels
from clpipe.analysis.matching.result import Match, Row
from clpipe.analysis.plot import lag_series, spectrum_series
from clpipe.base.files import write_new
from clpipe.base.types import Doubles

INKS = {"theirs": BLACK, "ours": RED}
STEP = 16  # levels between two points of noise by intensity
MIN_SAMPLES = 500  # samples that a point needs


def draw(match: Match, path: Path) -> None:
    """Draw a match as a PNG, 1600 px wide.

    Raises:
        ImageError: the file cannot be written.
    """
    first = match.scenes.each[0].name
    more = f" and {len(match.noises) - 1} more" if len(match.noises) > 1 else ""
    title = f"Noise of {first}{more}, and of the development that was found"
    luma = {who: mean_table(match, who, (0,)) for who in INKS}
    chroma = {who: mean_table(match, who, (1, 2)) for who in INKS}
    lags = [
        lag_series(tables[who], INKS[who], f"{what}, {who}", style)
        for who in INKS
        for tables, style, what in ((luma, "-o", "luma"), (chroma, "--s", "chroma"))
    ]
    spectra = [spectrum_series(table, INKS[who], who) for who, table in luma.items()]
    texts = "Power spectrum of luma; independent noise: 1", "cycles/px", "power over variance"
    panels = (
        Panel(lags, "Autocorrelation", "lag right, px", "correlation"),
        Panel(spectra, *texts, ylim=(0, None)),
        intensity_panel(match),
        residuals_panel(match.unseen),
    )
    write_new(path, page_png(11, title, lambda figure: draw_grid(figure, panels, 2)))


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


def intensity_panel(match: Match) -> Panel:
    """Return the luma noise of all scenes over their luma."""
    series = []
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
        series.append(Series(middle[kept], np.sqrt(squares[kept] / count[kept]), ink, who, "-o"))
    texts = "Noise of luma by intensity", "luma, levels", "sigma, levels"
    return Panel(series, *texts, ylim=(0, None))


def residuals_panel(rows: Sequence[Row]) -> Panel:
    """Return the residuals in the areas held out of the search, with their standard errors."""
    shown = [row for row in rows if not np.isnan(row.residual) and row.name != "beyond_4_sigma"]
    places = np.arange(len(shown))[::-1]
    residuals, errors = ([getattr(row, key) for row in shown] for key in ("residual", "error"))
    names = [COLUMNS[r.name].text + (" (share)" if r.relative else "") for r in shown]
    within = Series([-0.1, 0.1], [-1, -1], "0.92", style=AREA, y2=len(shown))
    points = Series(residuals, places, RED, style="o", xerr=np.nan_to_num(errors), capsize=3)
    title = "Ours less theirs in places that were not searched; grey: within 0.1"
    series = [within, Series(0, None, "0.4", lw=1), points]

    def tune(axes: Axes) -> None:
        axes.set_yticks(places, names, fontsize=8)

    return Panel(series, title, tune=tune, ylim=(-1, len(shown)))
