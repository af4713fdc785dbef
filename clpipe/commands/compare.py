"""``clpipe compare``: crops of pictures side by side, as a figure."""

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
    "FIGURE", "The figure to write, as .png, .pdf or .svg; may be repeated.", multiple=True
)
@click.option(
    "--crop",
    "crops",
    multiple=True,
    metavar="PLACE",
    help="A row: [NAME=]X,Y,WxH in pixels, or a place that is found, "
    f"{WIDTH}x{HEIGHT}: {', '.join(FOUND)}; may be repeated. [default: those that are found]",
)
@click.option(
    "--label",
    "labels",
    multiple=True,
    metavar="TEXT",
    help="Of each PICTURE, in the same order. [default: what tells their names apart]",
)
@click.option(
    "--truth",
    "truths",
    multiple=True,
    type=EXISTING,
    metavar="FILE",
    help="The same without noise: one for all PICTUREs, or one for each in the same order.",
)
@click.option(
    "--difference",
    is_flag=True,
    help="Below each row, its difference from the truth, or else from the first PICTURE.",
)
@click.option(
    "--zoom",
    default=4,
    show_default=True,
    type=click.IntRange(1, 32),
    help="The side of a picture's pixel, in pixels of 300 dpi.",
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
    """Compare pictures: labelled crops side by side, as papers print them.

    PICTUREs are of one size: finished ones (JPEG, PNG, TIFF), images that clpipe kept, renders. A
    row shows one place of all of them. Places are found in the mean of the truths or, without, of
    the PICTUREs, averaged over 5x5 pixels: where R, G and B vary least at a middle brightness
    (flat), where luma has most gradient (textured), where the channels are furthest apart
    (saturated), and where it is darkest without being black (dark).

    The noise is written below: with --truth as 'clpipe measure' finds it, and the rms of the whole
    picture; without, that of the flat place.

    \b
    clpipe run render.exr -o shots --iso 100,3200
    clpipe compare shots/iso100/render.jpg shots/iso3200/render.jpg -o figure.pdf
    """
    require("clpipe compare", "matplotlib", "scipy")
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
    if found.noise:
        click.echo()
        show_noise(found)
    for note in found.notes:
        click.echo(note)
    click.echo(f"wrote {' and '.join(map(str, outputs))}")


def show_noise(found: Comparison) -> None:
    """Print the noise of each picture."""
    rows = [
        (label, number(one.rms, ".2f"), number(one.sigma, ".2f"), number(one.left, ".2f"))
        for label, one in zip(found.labels, found.noise, strict=True)
    ]
    show(("picture", "rms", "sigma", "2x2 leaves"), rows, left=1)
