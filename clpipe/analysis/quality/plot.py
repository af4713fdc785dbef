"""Draws the curves of reports on image quality."""

from collections.abc import Sequence

import matplotlib as mpl

from clpipe.analysis.drawing import Panel, Series, svg
from clpipe.analysis.quality.report import Quality

STYLES = "-", "--", ":"  # of the curves of one camera in a plot


def quality_svgs(reports: Sequence[Quality]) -> list[tuple[str, str]]:
    """Return a title and a drawing for each kind of curve, with all cameras and pictures."""
    titles = dict.fromkeys(title for report in reports for title, _ in report.curves)
    colours = mpl.colormaps["viridis"].resampled(len(reports) + 1)
    drawings = []
    for title in titles:
        name, _, x_label = title.partition(" over ")
        series = []
        for number, report in enumerate(reports):
            own = {label: curve for (of, label), curve in report.curves.items() if of == title}
            for style, (label, curve) in zip(STYLES, own.items(), strict=False):
                text = " ".join(filter(None, [report.name, label]))
                ink = mpl.colors.to_hex(colours(number))
                series.append(Series(curve.x, curve.y, ink, text, style, linewidth=1.6))
        drawings.append((name, svg((6.4, 3.4), title, Panel(series, "", x_label, name))))
    return drawings
