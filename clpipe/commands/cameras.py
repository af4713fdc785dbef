"""``clpipe cameras``: list cameras, show the noise of one, or import a noise model."""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import click

from clpipe.base.errors import RequestError
from clpipe.camera.profile import (
    Camera,
    built_in_cameras,
    built_in_name,
    cameras_matching,
    load_camera,
)
from clpipe.camera.sensitivities import Sensitivities
from clpipe.commands.completion import cameras_or_import
from clpipe.commands.options import EXISTING, Command, json_option, output_option
from clpipe.commands.printing import Rows, short_text, show, show_json

# The units of the fields of a profile, if they have one.
UNITS = {
    **dict.fromkeys(("black_level", "white_level", "dark_shading_offset"), "DN"),
    **dict.fromkeys(("full_well", "dsnu", "hot_pixel_level", "rts_amplitude"), "e-"),
    "banding_amplitude": "e-",
    "iso_range": "ISO",
    "white_balance_gains": "red, blue",
    "quantum_efficiency": "e-/photon",
    "pixel_pitch": "um",
    "dark_current": "e-/s",
    "dark_current_temperature": "deg C",
    "dark_current_doubling": "K",
    "dark_shading_slope": "DN/ISO",
    "dark_shading_length": "px",
    "banding_period": "rows",
    "xyz_to_camera": "XYZ to camera RGB",
    "sensitivities": "peaks",
}
# Fields that only some sensors have. A profile without them has no unknown values.
SPECIAL: tuple[str, ...] = ("aliases", "filter_array", "row_noise_ratio", "column_noise_ratio")
SPECIAL += ("readout_ratio", "readout_noise", "photodiode_ratio", "photodiode_crosstalk")
DERIVED = ("bits",)  # computed from other fields
# The fields that are the same at every ISO.
OTHERS = ("make", "model", "gain_stages", "sources")
FIXED = tuple(name for name in (*Camera.model_fields, *DERIVED) if name not in OTHERS)
UNKNOWN = "unknown"


@click.command("import", cls=Command)
@click.argument("path", metavar="FILE", type=EXISTING)
@click.option(
    "--camera",
    metavar="NAME",
    help="The make and model of a camera in a noiseprofiles.json. For sensitivities, the camera or "
    "profile whose noise and levels the new profile has.",
)
@output_option("FILE.toml", "The profile to write. [default: it is printed]", required=False)
@json_option
def import_command(path: Path, camera: str | None, output: Path | None, as_json: bool) -> None:
    """Make a camera profile from another program's noise model, or add spectral sensitivities.

    FILE is a DNG with a NoiseProfile, an Android noise model (the text that CameraITS generates and
    that device trees contain), or darktable's noiseprofiles.json. The profile lists which values
    are from the file and which are assumed.

    FILE may also have spectral sensitivities: a JSON of rawtoaces, or a CSV with the columns
    wavelength (nm), R, G and B. They are added to the profile of --camera.

    \b
    clpipe cameras import photo.dng -o my_camera.toml
    clpipe cameras import noiseprofiles.json --camera "Nikon D810"
    clpipe cameras import curves.csv --camera nikon-d800 -o d800.toml
    """
    from clpipe.analysis.noise_models.read import import_camera

    text, profile = import_camera(path, camera, output)
    if as_json:
        written = {"profile": None if output is None else str(output), "toml": text}
        show_json(
            written | {"make": profile.make, "model": profile.model, "iso_range": profile.iso_range}
        )
        return
    if output is None:
        click.echo(text, nl=False)
        return
    low, high = profile.iso_range
    isos = f"ISO {low:g}" if low == high else f"ISO {low:g} to {high:g}"
    click.echo(f"wrote {output}: {make_and_model(profile)}, {isos}")


class CamerasCommand(Command):
    """A command that accepts a camera's name, or "import" with the arguments of that command."""

    def make_context(self, info_name: str | None, args: list[str], *rest: Any, **more: Any) -> Any:
        if args[:1] == [import_command.name]:
            name = f"{info_name} {import_command.name}"
            return import_command.make_context(name, args[1:], *rest, **more)
        return super().make_context(info_name, args, *rest, **more)

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        super().format_options(ctx, formatter)
        with formatter.section("Commands"):
            formatter.write_dl([("import FILE", import_command.get_short_help_str(80))])


@click.command("cameras", cls=CamerasCommand)
@click.argument("names", nargs=-1, metavar="[NAME|FILE]", shell_complete=cameras_or_import)
@click.option("--iso", type=float, help="The ISO. [default: all measured ISOs]")
@json_option
def cameras(names: tuple[str, ...], iso: float | None, as_json: bool) -> None:
    """List cameras, show the noise of one, or import a noise model (cameras import).

    NAME is a name from the list, or a make and model. A part of a name lists all cameras that
    match. Noise is shown in three forms, with the source of each figure.

    \b
    clpipe cameras "Canon 5D Mark III" --iso 3200
    clpipe cameras import photo.dng -o my_camera.toml
    """
    name = " ".join(names)
    if not name:
        if iso is not None:
            raise RequestError(
                f"--iso: found {iso:g}, but no camera is named; name one, as in "
                f"'clpipe cameras nikon-d850 --iso {iso:g}'"
            )
        show_cameras(map(load_camera, built_in_cameras()), as_json)
        return
    matches = [] if built_in_name(name) else cameras_matching(name)
    if iso is None and len(matches) > 1:
        show_cameras(map(load_camera, matches), as_json)
        return
    camera = load_camera(name)
    if as_json:
        show_json({"cameras": [camera_record(camera, iso)]})
        return
    for title, headings, rows in camera_tables(camera, iso):
        click.echo(title)
        show(headings, rows, left=1)
        click.echo("")
    for key, source in camera.sources.items():
        click.echo(f"{key}: {source}")


def show_cameras(cameras: Iterable[Camera], as_json: bool) -> None:
    """Print a list of cameras, as a table or as JSON."""
    if as_json:
        show_json({"cameras": list(map(camera_record, cameras))})
    else:
        show(("camera", "make and model", "also called", "ISO"), map(camera_row, cameras))


def make_and_model(camera: Camera) -> str:
    """Return the make and model of a camera, without repeating the make if the model has it."""
    model, make = camera.model, camera.make
    return model if model.startswith(make) else f"{make} {model}"


def camera_row(camera: Camera) -> tuple[str, ...]:
    """Return the row of a camera: name, make and model, other names of the model, ISOs."""
    low, high = camera.iso_range
    aliases = ", ".join(camera.aliases)
    return camera.name, make_and_model(camera), aliases, f"{low:g} to {high:g}"


def camera_tables(camera: Camera, iso: float | None) -> list[tuple[str, tuple[str, ...], Rows]]:
    """Return tables of a camera's noise at an ISO, or at all measured ISOs.

    Each table has a title, headings and rows.

    Raises:
        RequestError: the ISO is outside the camera's range.
    """
    signal: Rows = []
    paper: Rows = []
    dark: Rows = []
    for record in records_at(camera, iso):
        i, names = record["iso"], ("dark_noise", "row_noise", "column_noise")
        lines = (record[name] for name in names)
        signal.append(figures(i, *record["signal"].values(), *record["emva1288"].values(), *lines))
        paper.append(figures(i, *record["paper"].values()))
        dark.append(dark_frames_row(camera, record))
    return [
        (
            f"{make_and_model(camera)}: Var[y] = a*y + b, y = 1 at the white level; EMVA 1288",
            ("ISO", "a", "b", "system_gain", "read_noise", "adc_noise", "both", "row", "column"),
            [("", "", "", "DN/e-", "e-", "DN", "DN", "DN", "DN"), *signal],
        ),
        (
            "Dark frames: shape of the read noise, errors of the black level",
            ("ISO", "tukey_lambda", "color_bias: R, G, G, B", "black_level_error"),
            [("", "", "DN", "DN"), *dark],
        ),
        (
            "The paper's form: a = theta/chi, b = theta^2 b' + b'' - theta^2 p0/chi",
            ("ISO", "chi", "theta", "b'", "b''", "p0"),
            paper,
        ),
        (
            "At every ISO",
            ("", "value", "unit"),
            [
                # A matrix has a row per line.
                (key, known_text(camera, key).replace("], [", "],\n["), UNITS.get(key, ""))
                for key in FIXED
                if key not in SPECIAL or key in camera.model_fields_set
            ],
        ),
    ]


def known_text(camera: Camera, key: str) -> str:
    """Return a value of a profile that is the same at every ISO, or "unknown".

    >>> known_text(load_camera("sony-a7s2"), "prnu")
    'unknown'
    """
    is_known = key in camera.model_fields_set or key in DERIVED
    value = getattr(camera, key)
    if isinstance(value, Sensitivities):
        return value.summary
    return short_text(value) if is_known and value is not None else UNKNOWN


def dark_frames_row(camera: Camera, record: Mapping[str, Any]) -> tuple[str, ...]:
    """Return the row of one ISO with values of dark frames other than their noise."""
    iso, shape = record["iso"], record["tukey_lambda"]
    stage = camera.gain_stage(iso)
    return (
        f"{iso:g}",
        UNKNOWN if shape is None else f"{shape:.3g}",
        ", ".join(f"{x:.3g}" for x in record["color_bias"]) if stage.color_bias else UNKNOWN,
        f"{record['black_level_error']:.3g}" if stage.black_level_error else UNKNOWN,
    )


def figures(iso: float, *values: float) -> tuple[str, ...]:
    """Return an ISO and other numbers, to four digits, as a row."""
    return (f"{iso:g}", *(f"{value:.4g}" for value in values))


def noise_at(camera: Camera, iso: float) -> dict[str, Any]:
    """Return the noise at an ISO in all three forms, and the noise of dark frames in DN.

    Raises:
        RequestError: the ISO is outside the camera's range.
    """
    camera.check_iso(iso)
    unit, model = camera.signal_range, camera.noise(iso)
    return {
        "iso": iso,
        **model.record(),
        "dark_noise": model.b**0.5 * unit,
        "row_noise": camera.row_noise(iso) * unit,
        "column_noise": camera.column_noise(iso) * unit,
        "tukey_lambda": camera.tukey_lambda_at(iso),
        "color_bias": [offset * unit for offset in camera.color_bias(iso)],
        "black_level_error": camera.black_level_error(iso) * unit,
    }


def records_at(camera: Camera, iso: float | None) -> list[dict[str, Any]]:
    """Return the noise at an ISO, or at all measured ISOs, see :func:`noise_at`."""
    isos = [iso] if iso is not None else [i for stage in camera.gain_stages for i in stage.iso]
    return [noise_at(camera, i) for i in isos]


def camera_record(camera: Camera, iso: float | None = None) -> dict[str, Any]:
    """Return a camera as JSON values, with its noise at an ISO or at all measured ISOs.

    Raises:
        RequestError: the ISO is outside the camera's range.
    """
    return {
        "make": camera.make,
        "model": camera.model,
        **{key: getattr(camera, key) for key in FIXED if key != "sensitivities"},
        "sensitivities": camera.sensitivities and camera.sensitivities.model_dump(),
        "unknown": [k for k in FIXED if k not in SPECIAL and known_text(camera, k) == UNKNOWN],
        "noise": records_at(camera, iso),
        "sources": camera.sources,
    }
