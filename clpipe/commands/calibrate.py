"""TODO."""

from pathlib import Path

import click

from clpipe.analysis.calibration.files import calibrate_files, check_profile_name, write_profile
from clpipe.analysis.calibration.frames import FrameOverrides
from clpipe.analysis.calibration.line_fit import Estimate
from clpipe.analysis.calibration.result import Calibration
from clpipe.commands.options import json_option
from clpipe.commands.printing import show, show_json
from clpipe.reference.cfa import PATTERNS, Pattern

CALIBRATION = (
    *("ISO", "frames", "K, DN/e-", "read, DN", "row, DN", "column, DN", "DSNU, e-", "PRNU, %"),
    *("hot", "dead", "pixels used"),
)


def calibration_row(one: Calibration) -> tuple[str, ...]:
    """What was found at an ISO in a line, figures with their standard errors."""

    def told(estimate: Estimate | None, factor: float = 1) -> str:
        if estimate is None:
            return "-"
        return f"{estimate.value * factor:.4g} ± {estimate.error * factor:.1g}"

    return (
        f"{one.iso:g}",
        f"{one.scene_frames} + {one.dark_frames} dark",
        told(one.pooled.gain),
        told(one.read_noise),
        told(one.row_noise),
        told(one.column_noise),
        told(one.dsnu, 1 / one.pooled.gain.value),
        told(one.prnu, 100),
        str(len(one.hot.rows)) if one.hot else "-",
        str(len(one.dead.rows)) if one.dead else "-",
        f"{one.used:.1%}",
    )


@click.command("calibrate")
@click.argument("inputs", nargs=-1, required=True, metavar="FRAMES...")
@click.option(
    "-o",
    "--output",
    required=True,
    type=click.Path(path_type=Path),
    metavar="CAMERA.toml",
    help="The profile; CAMERA.png, a picture of the fit, is written beside it.",
)
@click.option(
    "--dark",
    multiple=True,
    metavar="FILES",
    help="Frames without light, or a quoted glob; may be repeated.",
)
@click.option("--black-level", type=float, metavar="DN", help="Instead of what the files say.")
@click.option("--white-level", type=float, metavar="DN", help="Instead of what the files say.")
@click.option("--pattern", type=click.Choice(PATTERNS), help="Instead of what the files say.")
@click.option(
    "--iso",
    type=click.FloatRange(0, min_open=True),
    help="Of all frames, instead of what the files say.",
)
@json_option
def calibrate(
    inputs: tuple[str, ...],
    output: Path,
    dark: tuple[str, ...],
    black_level: float | None,
    white_level: float | None,
    pattern: Pattern | None,
    iso: float | None,
    as_json: bool,
) -> None:
    """Measure a sensor's noise from raw frames, and write it as a camera profile.

    FRAMES are camera raws, mosaics that clpipe kept, or mosaics from elsewhere (EXR, 16-bit TIFF or
    PNG, with the options for what they do not say): two or more of one static scene that has dark
    and bright places, at each ISO. Dark frames (lens cap on) give column noise, DSNU, hot pixels
    and a better b. A single frame at an ISO is judged alone, which is less exact.

    \b
    clpipe calibrate scene/*.CR2 --dark 'dark/*.CR2' -o my_camera.toml
    clpipe run render.exr -o out --camera my_camera.toml --iso 800
    """
    check_profile_name(output)
    overrides = FrameOverrides(black_level, white_level, pattern, iso)
    frames, found = calibrate_files(inputs, dark, overrides)
    picture = write_profile(output, frames, found)
    if as_json:
        record = {
            "profile": str(output),
            "picture": str(picture),
            "make": frames.make,
            "model": frames.model,
            "isos": [c.record() for c in found],
        }
        show_json(record)
        return
    show(CALIBRATION, map(calibration_row, found), left=0)
    for one in found:
        for note in one.notes:
            click.echo(f"ISO {one.iso:g}: {note}")
    click.echo(f"\nwrote {output} and {picture}")
