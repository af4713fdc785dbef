"""The HTML file of a report on image quality. It is self-contained and needs no network."""

from collections.abc import Sequence

from clpipe.analysis.quality.plot import quality_svgs
from clpipe.analysis.quality.report import Quality, table
from clpipe.base.about import __version__
from clpipe.reports.page import page_environment, page_text


def quality_html(reports: Sequence[Quality]) -> str:
    """Return the page of cameras and pictures, with a table of their figures and plots."""
    rows = table(reports)
    sections = {section: [row[1:] for row in rows if row[0] == section] for section, *_ in rows}
    return (
        page_environment()
        .get_template("quality.html")
        .render(
            version=__version__,
            names=[report.name for report in reports],
            found=[(report.name, ", ".join(report.found)) for report in reports if report.found],
            sections=sections,
            drawings=quality_svgs(reports),
            style=page_text("css"),
        )
    )
