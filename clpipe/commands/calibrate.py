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
from clpipe.commands.options import EXISTING, Command, json_option, options_set, output_option
from clpipe.commands.printing import show, show_json
from clpipe.images.dump import parse_dump
from clpipe.reference.cfa import PATTERNS, Pattern

CALIBRATION = (
    *("ISO", "frames", "K, DN/e-", "read, DN", "row, DN", "column, DN", "DSNU, e-", "PRNU, %"),
    *("hot", "dead", "pixels used"),
)
WITH_EMVA = ("emva", "output", "iso", "as_json")  # options that are allowed with --emva


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
        others = [option for name, option in options_set().items() if name not in WITH_EMVA]
        if inputs or others:
            found = "FRAMES" if inputs else others[0]
            raise RequestError(
                f"--emva: found {found} as well, but the series names its frames; remove {found}"
            )
        calibrate_emva(emva, output, iso, as_json)
        return
    if not inputs:
        raise RequestError("FRAMES: none is named; name raw frames, or a series with --emva")
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


def calibrate_emva(series: Path, output: Path, iso: float | None, as_json: bool) -> None:
    """Measure a series according to EMVA 1288, write the profile and print the figures."""
    moments, found = measure_series(series)
    picture = write_emva_profile(output, series, iso, moments, found)
    if as_json:
        files = {"profile": str(output), "picture": str(picture)}
        show_json({**files, "figures": found.record()})
        return
    show(("figure", "value", "unit"), emva_rows(found))
    click.echo(f"\nwrote {output} and {picture}")


def emva_rows(found: Figures) -> list[tuple[str, str, str]]:
    """Return the rows of a table of figures, with standard errors."""
    errors = found.linearity
    rows: list[tuple[str, Estimate | None, float, str]] = [
        ("system gain K", found.system_gain, 1, "DN/e-"),
        ("responsivity R", found.responsivity, 1, "DN/photon"),
        ("quantum efficiency", found.quantum_efficiency, 100, "%"),
        ("dark noise", found.dark_noise, 1, "e-"),
        ("dark noise, rounding included", found.dark_noise_dn, 1, "DN"),
        ("sensitivity threshold", found.threshold, 1, "photons"),
        ("saturation capacity", found.saturation, 1, "photons"),
        ("saturation capacity", found.saturation_electrons, 1, "e-"),
        ("maximum signal-to-noise ratio", found.snr_max, 1, ""),
        ("dynamic range", found.dynamic_range, 1, ""),
        ("linearity error, minimum", errors.least, 1, "%"),
        ("linearity error, maximum", errors.most, 1, "%"),
    ]
    for name, figure, factor, unit in (
        ("DSNU1288", found.dsnu, 1, "e-"),
        ("PRNU1288", found.prnu, 100, "%"),
    ):
        rows.append((name, figure.total, factor, unit))
        rows += [
            (f"{name}, {part}s", getattr(figure, part), factor, unit)
            for part in ("row", "column", "pixel")
        ]
    rows += [
        ("dark current, from means", found.dark_current, 1, "e-/s"),
        ("dark current, from noise", found.dark_current_of_noise, 1, "e-/s"),
    ]
    return [(name, estimate_text(figure, factor), unit) for name, figure, factor, unit in rows]


def estimate_text(estimate: Estimate | None, factor: float = 1) -> str:
    """Return an estimate with its standard error; a dash if there is none."""
    if estimate is None:
        return "-"
    return f"{estimate.value * factor:.4g} ± {estimate.error * factor:.1g}"


def calibration_row(one: Calibration) -> tuple[str, ...]:
    """Return the row of one ISO: figures with their standard errors."""

    return (
        f"{one.iso:g}",
        f"{one.scene_frames} + {one.dark_frames} dark",
        estimate_text(one.pooled.gain),
        estimate_text(one.read_noise),
        estimate_text(one.row_noise),
        estimate_text(one.column_noise),
        estimate_text(one.dsnu, 1 / one.pooled.gain.value),
        estimate_text(one.prnu, 100),
        str(len(one.hot.rows)) if one.hot else "-",
        str(len(one.dead.rows)) if one.dead else "-",
        f"{one.used:.1%}",
    )
