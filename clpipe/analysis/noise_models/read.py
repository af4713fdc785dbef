"""A file of others with a noise model, told by what it holds, as the text of a camera profile."""

from pathlib import Path

from clpipe.analysis.noise_models import android, darktable
from clpipe.analysis.noise_models.android import parse_android
from clpipe.analysis.noise_models.darktable import parse_darktable
from clpipe.analysis.noise_models.dng import read_dng
from clpipe.analysis.noise_models.model import SensorModel
from clpipe.base.errors import RequestError
from clpipe.base.files import write_new
from clpipe.base.reading import check_exists, check_regular, parse_json, read_text
from clpipe.camera.profile import Camera, parse_camera
from clpipe.camera.text import check_profile_name

TIFF = (b"II*\0", b"MM\0*")
READ = (
    "read are a DNG with a NoiseProfile, an Android noise model (the text with noise_model_A) and "
    "darktable's noiseprofiles.json"
)


def import_camera(path: Path, camera: str | None, output: Path | None) -> tuple[str, Camera]:
    """Make a camera profile of a file with a noise model, and write it if ``output`` is given.

    Args:
        path: a DNG with a NoiseProfile, an Android noise model, or darktable's noiseprofiles.json.
        camera: which camera of a file that holds several.
        output: of the profile, which is replaced where it exists; its name ends in .toml.

    Returns:
        The text of the profile, and the camera that it is.

    Raises:
        RequestError: the file is none of these, or makes no valid profile; or the name of the
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
    """The noise model of a file.

    Raises:
        RequestError: as :func:`import_camera`.
        ImageError: as :func:`import_camera`.
    """
    check_exists(path)
    try:
        check_regular(path)
        with path.open("rb") as file:
            head = file.read(512)
        is_tiff = head.startswith(TIFF)
        text = "" if is_tiff or b"\0" in head else read_text(path)
    except OSError as error:
        raise RequestError(f"{path}: cannot be read: {error.strerror}; {READ}") from None
    except UnicodeDecodeError:
        text = ""
    is_darktable = text.lstrip().startswith("{") and darktable.MARK in text
    if camera is not None and not is_darktable:
        raise RequestError(
            f"--camera: {path} holds one camera; it picks one of darktable's noiseprofiles.json"
        )
    if is_tiff:
        return read_dng(path)
    if is_darktable:
        try:
            values = parse_json(text)
        except ValueError as error:
            raise RequestError(f"{path}: damaged, or not valid JSON: {error}") from None
        return parse_darktable(values, path, camera)
    if android.MARK in text:
        return parse_android(text, path)
    found = "text without a noise model" if text.strip() else "neither text nor a DNG"
    raise RequestError(f"{path}: holds {found if head else 'nothing'}; {READ}")
