"""Reads a noise model of another program, whose format is detected, as a camera profile."""

from pathlib import Path
from typing import Any

from clpipe.analysis.noise_models import android, darktable, sensitivities
from clpipe.analysis.noise_models.android import parse_android
from clpipe.analysis.noise_models.darktable import parse_darktable
from clpipe.analysis.noise_models.dng import read_dng
from clpipe.analysis.noise_models.model import SensorModel
from clpipe.analysis.noise_models.sensitivities import (
    parse_csv,
    parse_rawtoaces,
    with_sensitivities,
)
from clpipe.base.errors import RequestError
from clpipe.base.files import write_new
from clpipe.base.reading import check_exists, parse_json, read_start, read_text
from clpipe.camera.profile import Camera, parse_camera
from clpipe.camera.sensitivities import Sensitivities
from clpipe.camera.text import check_profile_name

TIFF = (b"II*\0", b"MM\0*")
READ = (
    "give a DNG with a NoiseProfile, an Android noise model (the text with noise_model_A), "
    "darktable's noiseprofiles.json, or spectral sensitivities (rawtoaces' JSON, or a CSV)"
)


def import_camera(path: Path, camera: str | None, output: Path | None) -> tuple[str, Camera]:
    """Make a camera profile from a file with a noise model, and write it if ``output`` is set.

    Args:
        path: a DNG with a NoiseProfile, an Android noise model, darktable's noiseprofiles.json, or
            spectral sensitivities: rawtoaces' JSON or a CSV.
        camera: the camera to choose if the file has several; for sensitivities, the camera whose
            noise and levels the profile has.
        output: the file for the profile, ending in .toml. An existing file is replaced.

    Returns:
        The text of the profile, and its camera.

    Raises:
        RequestError: the file is none of these, the profile would be invalid, or the name of the
            output does not end in .toml.
        ImageError: the DNG cannot be used, or the profile cannot be written.
    """
    if output:
        check_profile_name(output)
    name = output.stem if output else None
    if (found := read_sensitivities(path)) is not None:
        text = with_sensitivities(camera, name, *found, path)
    else:
        model = read_model(path, camera)
        text = model.profile(name or model.name)
    made = parse_camera(text, f"{path}: makes no valid profile")
    if output:
        write_new(output, text.encode())
    return text, made


def read_sensitivities(path: Path) -> tuple[Sensitivities, str] | None:
    """Return the sensitivities of a file with their source; None if it has none.

    Raises:
        RequestError: the file cannot be read, or is damaged.
    """
    check_exists(path)
    try:
        if b"\0" in read_start(path, 512):
            return None
        text = read_text(path)
    except (OSError, UnicodeDecodeError):
        return None
    if text.lstrip().startswith("{") and f'"{sensitivities.MARK}"' in text:
        return parse_rawtoaces(json_of(text, path), path)
    if path.suffix.lower() == ".csv" and text.strip():
        return parse_csv(text, path)
    return None


def json_of(text: str, path: Path) -> Any:
    """Return the values of JSON.

    Raises:
        RequestError: it is not valid.
    """
    try:
        return parse_json(text)
    except ValueError as error:
        raise RequestError(f"{path}: this file is damaged, or not valid JSON: {error}") from None


def read_model(path: Path, camera: str | None) -> SensorModel:
    """Return the noise model of a file.

    Raises:
        RequestError: as for :func:`import_camera`.
        ImageError: as for :func:`import_camera`.
    """
    check_exists(path)
    try:
        head = read_start(path, 512)
        is_tiff = head.startswith(TIFF)
        text = "" if is_tiff or b"\0" in head else read_text(path)
    except OSError as error:
        raise RequestError(f"{path}: cannot be read: {error.strerror}; {READ}") from None
    except UnicodeDecodeError:
        text = ""
    is_darktable = text.lstrip().startswith("{") and darktable.MARK in text
    if camera is not None and not is_darktable:
        raise RequestError(
            f"--camera: {path} has only one camera; remove this option, which selects a camera in "
            "darktable's file"
        )
    if is_tiff:
        return read_dng(path)
    if is_darktable:
        return parse_darktable(json_of(text, path), path, camera)
    if android.MARK in text:
        return parse_android(text, path)
    found = "text without a noise model" if text.strip() else "neither text nor a DNG"
    raise RequestError(f"{path}: this file contains {found if head else 'nothing'}; {READ}")
