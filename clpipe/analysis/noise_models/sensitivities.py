"""Reads spectral sensitivities of cameras: rawtoaces' JSON, and CSV."""

import csv
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from clpipe.base.errors import RequestError
from clpipe.base.validation import first_fault
from clpipe.camera.profile import Camera, load_camera
from clpipe.camera.sensitivities import FILTERS, Sensitivities
from clpipe.camera.text import profile_text

MARK = "spectral_data"  # in rawtoaces' JSON
WAVELENGTH = "wavelength"  # the heading of the first column of a CSV
EXPECTED = (
    f"expected a first column '{WAVELENGTH}' in nm, and one column for each colour of the filter "
    "array, such as R, G and B"
)


def parse_rawtoaces(values: Any, path: Path) -> tuple[Sensitivities, str]:
    """Return the sensitivities of rawtoaces' JSON, and their source with its licence.

    Args:
        values: the values of the JSON.
        path: the file, for messages.

    Raises:
        RequestError: the file is not in this format.
    """
    try:
        table = values["spectral_data"]
        colours, rows = table["index"]["main"], table["data"]["main"]
        ordered = sorted((float(nm), row) for nm, row in rows.items())
        curves = {c: [row[i] for _, row in ordered] for i, c in enumerate(colours)}
        header = values["header"]
        about = [f"{header['manufacturer']} {header['model']}"]
    except (KeyError, IndexError, TypeError, ValueError, AttributeError) as error:
        raise RequestError(
            f"{path}: this JSON has {MARK}, but not like rawtoaces' files: {error!r} is missing or "
            "has another form"
        ) from None
    found = validated({"wavelengths": [nm for nm, _ in ordered], "curves": curves}, path)
    about += [str(header[key]) for key in ("laboratory", "license") if header.get(key)]
    return found, f"{path.name}: {', '.join(about)}"


def parse_csv(text: str, path: Path) -> tuple[Sensitivities, str]:
    """Return the sensitivities of a CSV, and their source.

    The first row has the headings: ``wavelength``, and the letters of the filter array. Further
    columns may be ``lens_transmission`` and ``infrared_cut``.

    Raises:
        RequestError: a row has another number of values, or one is not a number.
    """
    heads, *rows = [[cell.strip() for cell in row] for row in csv.reader(text.splitlines()) if row]
    if heads[0].lower() != WAVELENGTH or len(heads) < 2:
        raise RequestError(f"{path}: found the headings {', '.join(heads)}; {EXPECTED}")
    if repeated := [head for head in heads if heads.count(head) > 1]:
        raise RequestError(f"{path}: the headings have {repeated[0]} twice; {EXPECTED}")
    for number, row in enumerate(rows, 2):
        if len(row) != len(heads):
            raise RequestError(
                f"{path}: row {number} has {len(row)} values, but there are {len(heads)} headings"
            )
    columns = dict(zip(heads, zip(*rows, strict=True), strict=True)) if rows else {}
    wavelengths = columns.pop(heads[0], ())
    filters = {name: columns.pop(name) for name in FILTERS if name in columns}
    return validated({"wavelengths": wavelengths, "curves": columns, **filters}, path), path.name


def validated(values: Any, path: Path) -> Sensitivities:
    """Return sensitivities.

    Raises:
        RequestError: a value is not allowed.
    """
    try:
        return Sensitivities.model_validate(values)
    except ValidationError as error:
        fault = first_fault(error)
        raise RequestError(f"{path}: {fault.key}: {fault.text}".replace(": :", ":")) from None


def with_sensitivities(
    camera: str | None, name: str | None, found: Sensitivities, source: str, path: Path
) -> str:
    """Return the text of a camera's profile with sensitivities.

    Args:
        camera: the camera whose noise and levels the profile has.
        name: of the profile; None is that of the camera.
        found: the sensitivities.
        source: their source.
        path: their file, for messages.

    Raises:
        RequestError: no camera is named, or there is none of this name.
    """
    if camera is None:
        raise RequestError(
            f"{path}: sensitivities alone make no profile; add --camera with the built-in camera "
            "or profile whose noise and levels the new profile has"
        )
    known: Camera = load_camera(camera)
    values = known.model_dump(
        exclude_unset=True, exclude={"gain_stages", "sources", "sensitivities"}
    )
    tables = {"sensitivities": found.model_dump()}
    stages = [stage.model_dump(exclude_unset=True) for stage in known.gain_stages]
    kept = {key: text for key, text in known.sources.items() if key != "sensitivities"}
    sources = {**kept, "sensitivities": source}
    return profile_text({**values, "name": name or known.name}, stages, sources, tables)
