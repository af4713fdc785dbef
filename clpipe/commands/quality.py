"""``clpipe quality``: measure sharpness, noise, tone, colour and lens of cameras and pictures."""

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import click

from clpipe.analysis.comparison import distinct_names
from clpipe.analysis.quality.measure import chain_quality
from clpipe.analysis.quality.photographs import picture_quality
from clpipe.analysis.quality.report import Quality, table
from clpipe.base.errors import ImageError, RequestError
from clpipe.base.extras import require
from clpipe.base.files import check_suffix, write_new
from clpipe.chain.isos import check_cameras
from clpipe.chain.options import OPTIONS
from clpipe.chain.request import Request
from clpipe.chain.settings import Settings, overlay
from clpipe.commands.chain_options import (
    SETTINGS,
    described,
    device_option,
    options,
    set_option,
    settings_in,
)
from clpipe.commands.options import EXISTING, Command, Sides, json_option, output_option
from clpipe.commands.printing import show, show_json
from clpipe.commands.progress import status_line
from clpipe.engine.device import open_device
from clpipe.engine.service import Service
from clpipe.inputs.series import split_series

CAMERAS = OPTIONS["camera"]._replace(
    text="A built-in camera, by name or model, or a profile (.toml). Each becomes a column.",
    default_text=described(OPTIONS["camera"]).default_text,
)
ISOS = OPTIONS["iso"]._replace(
    text="The ISO, or several. Each becomes a column.",
    default_text=described(OPTIONS["iso"]).default_text,
)


@click.command("quality", cls=Command)
@click.argument("pictures", nargs=-1, type=EXISTING, metavar="[PICTURE...]")
@options("config", CAMERAS, ISOS, *SETTINGS)
@set_option
@click.option(
    "--roi",
    "areas",
    multiple=True,
    metavar="AREA",
    help="An area of every PICTURE, in px: X,Y,WxH with one edge or chart; or black=, white=, "
    "texture= or grey=X,Y,WxH. May be repeated. [default: charts are found in the picture]",
)
@click.option(
    "--size",
    default="960x640",
    show_default=True,
    type=Sides(480, 4096),
    metavar="WxH",
    help="The size of a simulated picture in px, for the figures of the lens.",
)
@output_option("FILE.html", "Write a page with plots.", required=False)
@device_option
@json_option
def quality(
    pictures: tuple[Path, ...],
    areas: tuple[str, ...],
    size: tuple[int, int],
    output: Path | None,
    selector: str | None,
    as_json: bool,
    **options: Any,
) -> None:
    """Measure sharpness, noise, tone, colour and lens, in the figures of test laboratories.

    Without a PICTURE, clpipe renders charts, develops them with the chain, and measures the result.
    PICTUREs are photographs of real charts (JPEG, PNG, TIFF): slanted edges, a ColorChecker, a grid
    of dots, or a flat field. They are measured in the same way. With both pictures and a camera,
    columns show them side by side.

    For veiling glare, name the areas black= (a light trap) and white=. For texture, name the area
    texture= of a dead leaves chart, and grey=, an even patch next to it.

    \b
    clpipe quality --camera sony-a7r2 --iso 100,800,6400 -o quality.html
    clpipe quality edge.jpg --roi 1200,800,120x160
    clpipe quality chart.jpg --camera nikon-d800 --iso 1600
    """
    if output is None:
        require("clpipe quality", "calibrate", "scipy")
    else:
        require("clpipe quality -o", "report")
    if output is not None:
        check_suffix("-o", output, ".html")
    if areas and not pictures:
        raise RequestError("--roi: this option is for pictures of real charts; name a PICTURE")
    is_chosen = any(value not in (None, (), False) for value in options.values())
    chains = list(chains_of(options)) if is_chosen or not pictures else []
    names = distinct_names(pictures)
    reports, failures = [], 0
    with status_line() as show_status:
        for path, name in zip(pictures, names, strict=True):
            show_status(name)
            try:
                reports.append(picture_quality(path, areas, name))
            except ImageError as error:
                failures += 1
                click.echo(f"clpipe: {error}", err=True)
        service = Service([open_device(selector)]) if chains else None
        for settings in chains:
            show_status(settings.label)
            assert service is not None
            reports.append(chain_quality(settings.label, settings, service, *size))
    if reports:
        write(reports, output, as_json)
    sys.exit(1 if failures else 0)


def chains_of(options: dict[str, Any]) -> Iterator[Settings]:
    """Yield the settings of each combination of camera and ISO.

    Raises:
        RequestError: a setting is not allowed.
    """
    config = options.pop("config")
    series, others = split_series(settings_in(options))
    settings = Request.from_options(config=config, values=others).settings()
    for _, values in series.members():
        own = overlay(settings, values)
        check_cameras(own)
        yield own


def write(reports: list[Quality], output: Path | None, as_json: bool) -> None:
    """Print the reports as a table or JSON, and write them as a page.

    Raises:
        ImageError: the page cannot be written.
    """
    if output is not None:
        from clpipe.reports.quality import quality_html

        write_new(output, quality_html(reports).encode())
    if as_json:
        show_json({"quality": [report.record() for report in reports]})
        return
    rows, section = [], ""
    for of, text, cells in table(reports):
        rows += [("", *[""] * len(cells))] if section and of != section else []
        rows.append((of if of != section else "", text, *cells))
        section = of
    show(["", "figure", *(report.name for report in reports)], rows, left=2)
    for report in reports:
        if report.found:
            click.echo(f"{report.name}: found {', '.join(report.found)}")
        for warning in report.warnings:
            click.echo(f"{report.name}: warning: {warning}")
    if output is not None:
        click.echo(f"wrote {output}")
