"""``clpipe calibrate``: the noise of a sensor from raw frames, as a camera profile."""

from pathlib import Path

import click

from clpipe.analysis.calibration.files import calibrate_files, write_profile
from clpipe.analysis.calibration.frames import FrameOverrides
from clpipe.analysis.calibration.line_fit import Estimate
from clpipe.analysis.calibration.result import Calibration
from clpipe.camera.text import check_profile_name
from clpipe.commands.options import Command, dump_option, json_option, output_option
from clpipe.commands.printing import show, show_json
from clpipe.images.dump import parse_dump
from clpipe.reference.cfa import PATTERNS, Pattern

CALIBRATION = (
    *("ISO", "frames", "K, DN/e-", "read, DN", "row, DN", "column, DN", "DSNU, e-", "PRNU, %"),
    *("hot", "dead", "pixels used"),
)


@click.command("calibrate", cls=Command)
@click.argument("inputs", nargs=-1, required=True, metavar="FRAMES...")
@output_option(
    "CAMERA.toml", "The profile to write; CAMERA.png, a picture of the fit, is written beside it."
)
@click.option(
    "--dark",
    multiple=True,
    metavar="FILES",
    help="Frames without light, or a quoted glob; may be repeated.",
)
@click.option("--black-level", type=float, metavar="DN", help="In place of what the files say.")
@click.option("--white-level", type=float, metavar="DN", help="In place of what the files say.")
@click.option("--pattern", type=click.Choice(PATTERNS), help="In place of what the files say.")
@click.option(
    "--iso",
    type=click.FloatRange(0, min_open=True),
    help="The ISO of all frames, in place of what the files say.",
)
@dump_option
@json_option
def calibrate(
    inputs: tuple[str, ...],
    output: Path,
    dark: tuple[str, ...],
    black_level: float | None,
    white_level: float | None,
    pattern: Pattern | None,
    iso: float | None,
    dump: str | None,
    as_json: bool,
) -> None:
    """Measure a sensor's noise from raw frames, and write it as a camera profile.

    FRAMES are camera raws, mosaics that clpipe kept, or mosaics from elsewhere (EXR, 16-bit TIFF or
    PNG, headerless dumps, with options for what they do not say). For each ISO, take two or more of
    one static scene that has dark and bright places; a single frame gives less exact figures. Dark
    frames (lens cap on) add column noise, DSNU, hot pixels and a better b.

    \b
    clpipe calibrate scene/*.CR2 --dark 'dark/*.CR2' -o my_camera.toml
    clpipe run render.exr -o out --camera my_camera.toml --iso 800
    """
    check_profile_name(output)
    dumped = parse_dump(dump) if dump else None
    overrides = FrameOverrides(black_level, white_level, pattern, iso, dumped)
    frames, calibrations = calibrate_files(inputs, dark, overrides)
    picture = write_profile(output, frames, calibrations)
    if as_json:
        record = {
            "profile": str(output),
            "picture": str(picture),
            "make": frames.make,
            "model": frames.model,
            "isos": [each.record() for each in calibrations],
        }
        show_json(record)
        return
    show(CALIBRATION, map(calibration_row, calibrations), left=0)
    for one in calibrations:
        for note in one.notes:
            click.echo(f"ISO {one.iso:g}: {note}")
    click.echo(f"\nwrote {output} and {picture}")


def calibration_row(one: Calibration) -> tuple[str, ...]:
    """The row of one ISO, figures with their standard errors."""

    def text(estimate: Estimate | None, factor: float = 1) -> str:
        if estimate is None:
            return "-"
        return f"{estimate.value * factor:.4g} ± {estimate.error * factor:.1g}"

    return (
        f"{one.iso:g}",
        f"{one.scene_frames} + {one.dark_frames} dark",
        text(one.pooled.gain),
        text(one.read_noise),
        text(one.row_noise),
        text(one.column_noise),
        text(one.dsnu, 1 / one.pooled.gain.value),
        text(one.prnu, 100),
        str(len(one.hot.rows)) if one.hot else "-",
        str(len(one.dead.rows)) if one.dead else "-",
        f"{one.used:.1%}",
    )
