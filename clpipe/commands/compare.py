"""``clpipe compare``: a figure with crops of pictures side by side."""

from pathlib import Path

import click

from clpipe.analysis.comparison import Comparison
from clpipe.analysis.comparison import compare as compare_pictures
from clpipe.analysis.crops import FOUND, HEIGHT, WIDTH
from clpipe.base.extras import require
from clpipe.commands.options import EXISTING, Command, json_option, output_option
from clpipe.commands.printing import number, show, show_json


@click.command("compare", cls=Command)
@click.argument("pictures", nargs=-1, required=True, type=EXISTING, metavar="PICTURE...")
@output_option(
    "FIGURE", "The figure to write, a .png, .pdf or .svg. May be repeated.", multiple=True
)
@click.option(
    "--crop",
    "crops",
    multiple=True,
    metavar="PLACE",
    help="The crop of a row: [NAME=]X,Y,WxH in pixels, or an area of "
    f"{WIDTH}x{HEIGHT} pixels that clpipe chooses: {', '.join(FOUND)}. May be repeated. "
    "[default: all areas that clpipe chooses]",
)
@click.option(
    "--label",
    "labels",
    multiple=True,
    metavar="TEXT",
    help="The label of each PICTURE, in the same order. May be repeated. [default: the parts in "
    "which their names differ]",
)
@click.option(
    "--truth",
    "truths",
    multiple=True,
    type=EXISTING,
    metavar="FILE",
    help="The picture without noise: one for all PICTUREs, or one for each in the same order. May "
    "be repeated.",
)
@click.option(
    "--difference",
    is_flag=True,
    help="Show the difference from the truth below each row; without --truth, from the first "
    "PICTURE.",
)
@click.option(
    "--zoom",
    default=4,
    show_default=True,
    type=click.IntRange(1, 32),
    help="The side of a picture's pixel, in pixels at 300 dpi.",
)
@json_option
def compare(
    pictures: tuple[Path, ...],
    outputs: tuple[Path, ...],
    crops: tuple[str, ...],
    labels: tuple[str, ...],
    truths: tuple[Path, ...],
    difference: bool,
    zoom: int,
    as_json: bool,
) -> None:
    """Compare pictures in a figure with labelled crops side by side, like those in papers.

    PICTUREs have one size. They are finished pictures (JPEG, PNG, TIFF), kept images or renders. A
    row shows the same area of all of them. clpipe chooses areas in the mean of the truths, or of
    the PICTUREs without --truth, averaged over 5x5 pixels:

    \b
    flat        R, G and B vary least, at a medium brightness
    textured    the gradient of luma is largest
    saturated   the channels differ most
    dark        darkest, but not black

    The noise of each picture is printed below its crops. With --truth it is measured like in
    'clpipe measure', with the rms of the whole picture. Without --truth it is that of the flat
    area. The printed table also has MTF50 and overshoot of the sharpest quarter of edges, and the
    median level.

    \b
    clpipe run render.exr -o shots --iso 100,3200
    clpipe compare shots/iso100/render.jpg shots/iso3200/render.jpg -o figure.pdf
    """
    require("clpipe compare", "calibrate")
    from clpipe.analysis.comparison_plot import check_name, draw

    for output in outputs:
        check_name(output, (*pictures, *truths))
    found = compare_pictures(pictures, crops, labels, truths, difference)
    for output in outputs:
        draw(found, output, zoom)
    if as_json:
        show_json({"figures": [str(output) for output in outputs], **found.record()})
        return
    show(("place", "crop"), [(place.name, place.box) for place in found.places])
    click.echo()
    show_figures(found)
    for note in found.notes:
        click.echo(note)
    click.echo(f"wrote {' and '.join(map(str, outputs))}")


def show_figures(found: Comparison) -> None:
    """Print a table with the noise, the sharpness and the tone of each picture."""
    headings = ["picture", "rms", "sigma", "2x2 leaves", "MTF50", "overshoot", "level"]
    rows = [
        (number(look.mtf50, ".3f"), number(look.overshoot, ".1%"), number(look.level, ".0f"))
        for look in found.looks
    ]
    noise = [
        (number(one.rms, ".2f"), number(one.sigma, ".2f"), number(one.left, ".2f"))
        for one in found.noise
    ]
    columns = [found.labels, *zip(*noise, strict=True), *zip(*rows, strict=True)]
    show(
        headings[:1] + headings[len(headings) - len(columns) + 1 :],
        zip(*columns, strict=True),
        left=1,
    )
