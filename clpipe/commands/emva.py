"""``clpipe emva``: make a series of uniform frames of a camera according to EMVA 1288."""

from pathlib import Path

import click

from clpipe.analysis.emva.series import MIN_EXPOSURES, SIDES
from clpipe.analysis.emva.simulation import SeriesSize, simulate
from clpipe.base.extras import require
from clpipe.chain.keys import KEYS
from clpipe.commands.chain_options import device_option, option
from clpipe.commands.options import Command, Sides, json_option, output_option
from clpipe.commands.printing import show_json
from clpipe.commands.progress import status_line
from clpipe.engine.device import open_device

DEFAULT = SeriesSize()


@click.command("emva", cls=Command)
@option(KEYS["camera"]._replace(default_text=""), required=True)
@option(KEYS["iso"]._replace(text="The ISO.", default_text="the camera's lowest"))
@output_option("DIR", "The directory of the series. It is created if it does not exist.")
@click.option(
    "--size",
    default=f"{DEFAULT.width}x{DEFAULT.height}",
    show_default=True,
    type=Sides(*SIDES),
    metavar="WxH",
    help="The size of a frame in px.",
)
@click.option(
    "--exposures",
    default=DEFAULT.exposures,
    show_default=True,
    type=click.IntRange(MIN_EXPOSURES, 10_000),
    help="The number of exposures, evenly from dark to saturation. A tenth as many follow above "
    "saturation.",
)
@click.option(
    "--stack",
    default=DEFAULT.stack,
    show_default=True,
    type=click.IntRange(3, 10_000),
    help="The number of frames at half saturation, and of dark frames, for DSNU and PRNU.",
)
@option(KEYS["seed"], default=0)
@device_option
@json_option
def emva(
    camera: str,
    iso: float | None,
    output: Path,
    size: tuple[int, int],
    exposures: int,
    stack: int,
    seed: int,
    selector: str | None,
    as_json: bool,
) -> None:
    """Make a series of uniform frames of a camera according to EMVA 1288.

    Frames are PNGs with the camera's bits. The series has pairs from dark to above saturation, dark
    pairs with the same exposure times, and a stack of each. DIR/EMVA1288_Data.txt describes them in
    the standard's format, for clpipe calibrate --emva and other programs.

    All pixels receive the same light after the colour filters. The light goes through the raw's
    stages like a render. If the profile has no quantum efficiency, photons count as electrons.

    \b
    clpipe emva --camera nikon-d850 --iso 400 -o series
    clpipe calibrate --emva series/EMVA1288_Data.txt -o again.toml
    """
    require("clpipe emva", "calibrate", "scipy")
    series_size = SeriesSize(*size, exposures, stack)
    with status_line() as show:
        series = simulate(
            camera,
            iso,
            seed,
            output,
            series_size,
            open_device(selector),
            lambda finished, total: show(f"{finished} of {total} frames"),
        )
    if as_json:
        stacks = len(series.bright_stack.frames), len(series.dark_stack.frames)
        pairs = {"bright_pairs": len(series.bright), "dark_pairs": len(series.dark)}
        show_json({"series": str(series.path), "bits": series.bits, **pairs, "stacks": stacks})
        return
    click.echo(
        f"wrote {series.path}: {len(series.bright)} exposures of two frames with light and as many "
        f"without, and stacks of {stack}"
    )
