"""``clpipe calibrate``: measure a sensor's noise from raw frames, for a camera profile."""

from pathlib import Path

import click

from clpipe.analysis.calibration.files import calibrate_files, write_profile
from clpipe.analysis.calibration.frames import FrameOverrides
from clpipe.analysis.calibration.line_fit import Estimate
from clpipe.analysis.calibration.result import Calibration
from clpipe.analysis.emva.figures import Figures
from clpipe.analysis.emva.files import measure_series, write_emva_profile
from clpipe.base.errors import RequestError
from clpipe.camera.text import check_profile_name
from clpipe.chain.keys import KEYS
from clpipe.commands.chain_options import option
from clpipe.commands.options import (
    EXISTING,
    Command,
    json_option,
    options_on_command_line,
    output_option,
)
from clpipe.commands.printing import show, show_json
from clpipe.images.dump import parse_dump
from clpipe.reference.cfa import PATTERNS, Pattern

HEADINGS = (
    *("ISO", "frames", "K, DN/e-", "read, DN", "row, DN", "column, DN", "DSNU, e-", "PRNU, %"),
    *("hot", "dead", "pixels used"),
)
EMVA_OPTIONS = ("emva", "output", "iso", "as_json")  # options that are allowed with --emva


@click.command("calibrate", cls=Command)
@click.argument("inputs", nargs=-1, metavar="FRAMES...")
@output_option(
    "CAMERA.toml", "The profile to write. A plot of the fit, CAMERA.png, is written next to it."
)
@click.option(
    "--dark",
    multiple=True,
    metavar="FILES",
    help="Frames without light: a file or a quoted glob. May be repeated.",
)
@click.option(
    "--emva",
    type=EXISTING,
    metavar="EMVA1288_Data.txt",
    help="A series of uniform frames according to EMVA 1288, instead of FRAMES.",
)
@click.option(
    "--black-level", type=float, metavar="DN", help="The black level. [default: the files']"
)
@click.option(
    "--white-level", type=float, metavar="DN", help="The white level. [default: the files']"
)
@click.option(
    "--pattern", type=click.Choice(PATTERNS), help="The CFA pattern. [default: the files']"
)
@click.option(
    "--iso",
    type=click.FloatRange(0, min_open=True),
    help="The ISO of all frames. [default: the files']",
)
@option(KEYS["dump"])
@json_option
def calibrate(
    inputs: tuple[str, ...],
    output: Path,
    dark: tuple[str, ...],
    emva: Path | None,
    black_level: float | None,
    white_level: float | None,
    pattern: Pattern | None,
    iso: float | None,
    dump: str | None,
    as_json: bool,
) -> None:
    """Measure a sensor's noise from raw frames, and write it as a camera profile.

    FRAMES are camera raws, kept mosaics, or other mosaics: EXR, 16-bit TIFF or PNG, or headerless
    dumps. Use options for values that the files lack. For each ISO, take two or more frames of one
    static scene with dark and bright areas. A single frame gives less accurate figures. Dark frames
    (lens cap on) add column noise, DSNU, hot pixels and a better b.

    With --emva, figures according to EMVA 1288 (release 3.1) are measured from a series of frames
    of uniform light, and CAMERA.png has the standard's plots. clpipe emva makes such a series.

    \b
    clpipe calibrate scene/*.CR2 --dark 'dark/*.CR2' -o my_camera.toml
    clpipe calibrate --emva EMVA1288_Data.txt -o my_camera.toml
    clpipe run render.exr -o out --camera my_camera.toml --iso 800
    """
    check_profile_name(output)
    if emva:
        disallowed = [
            option for name, option in options_on_command_line().items() if name not in EMVA_OPTIONS
        ]
        if inputs or disallowed:
            other = "FRAMES" if inputs else disallowed[0]
            raise RequestError(
                f"--emva: found {other} as well, but the series already lists its frames; "
                f"remove {other}"
            )
        calibrate_emva(emva, output, iso, as_json)
        return
    if not inputs:
        raise RequestError("FRAMES: no frames are named; name raw frames, or a series with --emva")
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
    show(HEADINGS, map(calibration_row, calibrations), left=0)
    for calibration in calibrations:
        for note in calibration.notes:
            click.echo(f"ISO {calibration.iso:g}: {note}")
    click.echo(f"\nwrote {output} and {picture}")


def calibrate_emva(series: Path, output: Path, iso: float | None, as_json: bool) -> None:
    """Measure a series according to EMVA 1288, write the profile and print the figures."""
    moments, figures = measure_series(series)
    picture = write_emva_profile(output, series, iso, moments, figures)
    if as_json:
        files = {"profile": str(output), "picture": str(picture)}
        show_json({**files, "figures": figures.record()})
        return
    show(("figure", "value", "unit"), emva_rows(figures))
    click.echo(f"\nwrote {output} and {picture}")


def emva_rows(figures: Figures) -> list[tuple[str, str, str]]:
    """Return the rows of a table of figures, with standard errors."""
    errors = figures.linearity
    rows: list[tuple[str, Estimate | None, float, str]] = [
        ("system gain K", figures.system_gain, 1, "DN/e-"),
        ("responsivity R", figures.responsivity, 1, "DN/photon"),
        ("quantum efficiency", figures.quantum_efficiency, 100, "%"),
        ("dark noise", figures.dark_noise, 1, "e-"),
        ("dark noise, rounding included", figures.dark_noise_dn, 1, "DN"),
        ("sensitivity threshold", figures.threshold, 1, "photons"),
        ("saturation capacity", figures.saturation, 1, "photons"),
        ("saturation capacity", figures.saturation_electrons, 1, "e-"),
        ("maximum signal-to-noise ratio", figures.snr_max, 1, ""),
        ("dynamic range", figures.dynamic_range, 1, ""),
        ("linearity error, minimum", errors.least, 1, "%"),
        ("linearity error, maximum", errors.most, 1, "%"),
    ]
    for name, figure, factor, unit in (
        ("DSNU1288", figures.dsnu, 1, "e-"),
        ("PRNU1288", figures.prnu, 100, "%"),
    ):
        rows.append((name, figure.total, factor, unit))
        rows += [
            (f"{name}, {part}s", getattr(figure, part), factor, unit)
            for part in ("row", "column", "pixel")
        ]
    rows += [
        ("dark current, from means", figures.dark_current, 1, "e-/s"),
        ("dark current, from noise", figures.dark_current_of_noise, 1, "e-/s"),
    ]
    return [(name, estimate_text(figure, factor), unit) for name, figure, factor, unit in rows]


def estimate_text(estimate: Estimate | None, factor: float = 1) -> str:
    """Return an estimate with its standard error, or a dash if there is none."""
    if estimate is None:
        return "-"
    return f"{estimate.value * factor:.4g} ± {estimate.error * factor:.1g}"


def calibration_row(calibration: Calibration) -> tuple[str, ...]:
    """Return the row of one ISO: figures with their standard errors."""
    return (
        f"{calibration.iso:g}",
        f"{calibration.scene_frames} + {calibration.dark_frames} dark",
        estimate_text(calibration.pooled.gain),
        estimate_text(calibration.read_noise),
        estimate_text(calibration.row_noise),
        estimate_text(calibration.column_noise),
        estimate_text(calibration.dsnu, 1 / calibration.pooled.gain.value),
        estimate_text(calibration.prnu, 100),
        str(len(calibration.hot.rows)) if calibration.hot else "-",
        str(len(calibration.dead.rows)) if calibration.dead else "-",
        f"{calibration.used:.1%}",
    )
