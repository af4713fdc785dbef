"""``clpipe emva``: a series of uniform frames of a camera, as EMVA 1288 asks for it."""

from pathlib import Path

import click

from clpipe.analysis.emva.series import LEAST_EXPOSURES, SIDES
from clpipe.analysis.emva.simulation import SeriesSize, simulate
from clpipe.base.errors import RequestError
from clpipe.base.extras import require
from clpipe.base.text import whole_number
from clpipe.chain.keys import KEYS
from clpipe.commands.chain_options import device_option, option
from clpipe.commands.options import Command, json_option, output_option
from clpipe.commands.printing import show_json
from clpipe.commands.progress import told
from clpipe.engine.device import open_device

USUAL = SeriesSize()


@click.command("emva", cls=Command)
@option(KEYS["camera"]._replace(usual=""), required=True)
@option(KEYS["iso"]._replace(text="The ISO.", usual="the camera's lowest"))
@output_option("DIR", "The folder of the series; it is made where it is missing.")
@click.option(
    "--size",
    default=f"{USUAL.width}x{USUAL.height}",
    show_default=True,
    metavar="WxH",
    help="Of a frame.",
)
@click.option(
    "--exposures",
    default=USUAL.exposures,
    show_default=True,
    type=click.IntRange(LEAST_EXPOSURES, 10_000),
    help="From dark to the saturation, evenly; a tenth as many follow.",
)
@click.option(
    "--stack",
    default=USUAL.stack,
    show_default=True,
    type=click.IntRange(3, 10_000),
    help="Frames at half the saturation, and as many dark ones, for DSNU and PRNU.",
)
@option(KEYS["seed"], default=0)
@device_option
@json_option
def emva(
    camera: str,
    iso: float | None,
    output: Path,
    size: str,
    exposures: int,
    stack: int,
    seed: int,
    selector: str | None,
    as_json: bool,
) -> None:
    """Make a series of uniform frames of a camera, as EMVA 1288 asks for it.

    DIR/EMVA1288_Data.txt describes the frames, PNGs of the camera's bits, as programs for the
    standard read it, clpipe calibrate --emva among them: pairs from dark to past the saturation,
    dark pairs of the same times, and a stack each. Light falls on all pixels alike, behind the
    colour filters, and goes through the raw's stages as a render does. Where a profile does not
    know the quantum efficiency, photons are electrons.

    \b
    clpipe emva --camera nikon-d850 --iso 400 -o series
    clpipe calibrate --emva series/EMVA1288_Data.txt -o again.toml
    """
    require("clpipe emva", "scipy")
    columns, rows = map(whole_number, size.partition("x")[::2])
    least, most = SIDES
    if not least <= min(columns, rows) <= max(columns, rows) <= most:
        raise RequestError(
            f"--size: found {size!r}; expected WIDTHxHEIGHT, such as 640x480, "
            f"each {least} to {most}"
        )
    of = SeriesSize(columns, rows, exposures, stack)
    with told() as tell:
        series = simulate(
            camera,
            iso,
            seed,
            output,
            of,
            open_device(selector),
            lambda done, total: tell(f"{done} of {total} frames"),
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
