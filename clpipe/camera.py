"""Cameras: what a sensor does at an ISO, from a small TOML file with the source of every number."""

import tomllib
from importlib import resources
from pathlib import Path
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from clpipe.errors import RequestError
from clpipe.suggest import one_of

DEFAULT_CAMERA = "sony-a7r2"
Row = tuple[float, float, float]
Matrix = tuple[Row, Row, Row]

# Linear sRGB to XYZ, D65 (IEC 61966-2-1, 1999).
SRGB_TO_XYZ = np.array(
    [
        [0.4123908, 0.3575843, 0.1804808],
        [0.2126390, 0.7151687, 0.0721923],
        [0.0193308, 0.1191948, 0.9505322],
    ]
)

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]


class GainStage(BaseModel):
    """ISOs that share one conversion gain, with what was measured at each, ascending."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    iso: Annotated[tuple[Positive, ...], Field(min_length=1)]
    system_gain: tuple[Positive, ...]  # DN/e-
    read_noise: tuple[Positive, ...]  # DN

    @model_validator(mode="after")
    def _aligned(self) -> "GainStage":
        if not len(self.iso) == len(self.system_gain) == len(self.read_noise):
            raise ValueError("iso, system_gain and read_noise must be equally long")
        if list(self.iso) != sorted(set(self.iso)):
            raise ValueError("iso must ascend")
        return self


class Camera(BaseModel):
    """A camera profile. Levels and read noise in DN, gains with green = 1."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    name: str
    make: str
    model: str
    black_level: Annotated[float, Field(ge=0)]
    white_level: Positive
    white_balance_gains: tuple[Positive, Positive]  # red, blue
    xyz_to_camera: Matrix | None = None  # XYZ to camera RGB at D65, as a DNG's ColorMatrix2
    row_noise_ratio: Annotated[float, Field(ge=0)]  # row sigma over read noise sigma
    column_noise_ratio: Annotated[float, Field(ge=0)]
    iso_range: tuple[Positive, Positive]
    gain_stages: Annotated[tuple[GainStage, ...], Field(min_length=1)]
    sources: dict[str, str]

    @model_validator(mode="after")
    def _ordered(self) -> "Camera":
        if self.white_level <= self.black_level:
            raise ValueError("white_level must be above black_level")
        if self.xyz_to_camera and abs(np.linalg.det(self.xyz_to_camera)) < 1e-6:
            raise ValueError("xyz_to_camera is singular")
        return self

    def srgb_to_camera(self) -> NDArray[np.float64]:
        """The matrix from linear sRGB to white-balanced camera RGB; a grey stays what it is.

        sRGB goes to XYZ and from there to the camera's RGB; each row is then scaled to the sum 1,
        which is what white balance does (Coffin, dcraw: cam_xyz_coeff).

        Raises:
            RequestError: the profile has no ``xyz_to_camera``.
        """
        if self.xyz_to_camera is None:
            raise RequestError(f"camera {self.name}: its profile has no xyz_to_camera")
        matrix = np.array(self.xyz_to_camera) @ SRGB_TO_XYZ
        return matrix / matrix.sum(1, keepdims=True)

    def noise(self, iso: float) -> tuple[float, float]:
        """The a and b of Var[y] = a*y + b at an ISO, in signal units (y = 1 at the white level).

        a = K / range and b = (read noise / range)^2, K the system gain in DN/e- (EMVA 1288).
        Between the ISOs of a gain stage, K is interpolated in proportion to the ISO and read noise
        in electrons linearly in log ISO; a gain stage holds until the next one begins.
        Beyond the last measured ISO, K goes on in proportion and read noise stays in electrons.

        Raises:
            RequestError: the ISO is outside the camera's range.
        """
        low, high = self.iso_range
        if not low <= iso <= high:
            raise RequestError(
                f"iso: found {iso:g}, but camera {self.name} goes from {low:g} to {high:g}"
            )
        stage = [s for s in self.gain_stages if s.iso[0] <= iso or s is self.gain_stages[0]][-1]
        log_iso = np.log(stage.iso)
        gain = np.interp(np.log(iso), log_iso, np.divide(stage.system_gain, stage.iso)) * iso
        electrons = np.interp(np.log(iso), log_iso, np.divide(stage.read_noise, stage.system_gain))
        signal_range = self.white_level - self.black_level
        return float(gain / signal_range), float((electrons * gain / signal_range) ** 2)


def built_in_cameras() -> dict[str, Path]:
    """The profiles inside the package, by name."""
    folder = Path(str(resources.files("clpipe") / "cameras"))
    return {path.stem: path for path in sorted(folder.glob("*.toml"))}


def load_camera(name: str) -> Camera:
    """A built-in camera by its name, or a profile file by its path (ending in .toml).

    Raises:
        RequestError: no such camera or file, or a file that is not a valid profile.
    """
    built_in = built_in_cameras()
    path = built_in.get(name, Path(name))
    if path.suffix != ".toml":
        raise RequestError(one_of("camera", name, built_in) + ", or a .toml file")
    try:
        return Camera.model_validate(tomllib.loads(path.read_text()))
    except OSError as error:
        raise RequestError(f"{path}: cannot read this camera profile: {error.strerror}") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise RequestError(f"{path}: not valid TOML: {error}") from None
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(str(part) for part in first["loc"])
        reason = first["msg"].removeprefix("Value error, ")
        raise RequestError(f"{path}: {key + ': ' if key else ''}{reason}") from None
