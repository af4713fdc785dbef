"""Reads a noise model of another program, whose format is detected, as a camera profile."""

from pathlib import Path

from clpipe.analysis.noise_models import android, darktable
from clpipe.analysis.noise_models.android import parse_android
from clpipe.analysis.noise_models.darktable import parse_darktable
from clpipe.analysis.noise_models.dng import read_dng
from clpipe.analysis.noise_models.model import SensorModel
from clpipe.base.errors import RequestError
from clpipe.base.files import write_new
from clpipe.base.reading import check_exists, parse_json, read_start, read_text
from clpipe.camera.profile import Camera, parse_camera
from clpipe.camera.text import check_profile_name

TIFF = (b"II*\0", b"MM\0*")
READ = (
    "give a DNG with a NoiseProfile, an Android noise model (the text with noise_model_A) or "
    "darktable's noiseprofiles.json"
)


def import_camera(path: Path, camera: str | None, output: Path | None) -> tuple[str, Camera]:
    """Make a camera profile from a file with a noise model, and write it if ``output`` is set.

    Args:
        path: a DNG with a NoiseProfile, an Android noise model, or darktable's noiseprofiles.json.
        camera: the camera to choose if the file has several.
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
    model = read_model(path, camera)
    text = model.profile(output.stem if output else model.name)
    made = parse_camera(text, f"{path}: makes no valid profile")
    if output:
        write_new(output, text.encode())
    return text, made


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
        try:
            values = parse_json(text)
        except ValueError as error:
            raise RequestError(
                f"{path}: this file is damaged, or not valid JSON: {error}"
            ) from None
        return parse_darktable(values, path, camera)
    if android.MARK in text:
        return parse_android(text, path)
    found = "text without a noise model" if text.strip() else "neither text nor a DNG"
    raise RequestError(f"{path}: this file contains {found if head else 'nothing'}; {READ}")
