"""Cameras: what a sensor does at an ISO, from a small TOML file with the source of every number."""

import tomllib
from functools import cache, cached_property, lru_cache
from importlib import resources
from pathlib import Path
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from clpipe.base.errors import RequestError
from clpipe.base.text import one_of
from clpipe.camera.noise import NoiseModel

DEFAULT_CAMERA = "sony-a7r2"
Row = tuple[float, float, float]
Matrix = tuple[Row, Row, Row]
IDENTITY: Matrix = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))

# Linear sRGB to XYZ, D65 (IEC 61966-2-1, 1999).
SRGB_TO_XYZ = np.array(
    [
        [0.4123908, 0.3575843, 0.1804808],
        [0.2126390, 0.7151687, 0.0721923],
        [0.0193308, 0.1191948, 0.9505322],
    ]
)

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NotNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Share = Annotated[float, Field(ge=0, le=0.1)]


class GainStage(BaseModel):
    """ISOs that share one conversion gain, with what was measured at each, ascending."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    iso: Annotated[tuple[Positive, ...], Field(min_length=1)]
    system_gain: tuple[Positive, ...]  # DN/e-
    read_noise: tuple[Positive, ...]  # DN, of a pixel, before it is rounded to whole DN
    row_noise: tuple[NotNegative, ...] | None = None  # DN, new in each frame
    column_noise: tuple[NotNegative, ...] | None = None  # DN, fixed

    @model_validator(mode="after")
    def _aligned(self) -> "GainStage":
        for name in ("system_gain", "read_noise", "row_noise", "column_noise"):
            values = getattr(self, name)
            if values is not None and len(values) != len(self.iso):
                raise ValueError(
                    f"{name} must be as long as iso; found {len(values)} and {len(self.iso)}"
                )
        if list(self.iso) != sorted(set(self.iso)):
            raise ValueError("iso must ascend")
        return self

    def at(self, iso: float, values: tuple[float, ...]) -> float:
        """One of its tables in DN at an ISO, interpolated in electrons, linearly in log ISO.

        Before the first and after the last ISO, electrons stay what they are there.
        """
        electrons = np.interp(np.log(iso), np.log(self.iso), np.divide(values, self.system_gain))
        return float(electrons) * self.gain_at(iso)

    def gain_at(self, iso: float) -> float:
        """The system gain in DN/e-, interpolated in proportion to the ISO."""
        per_iso = np.divide(self.system_gain, self.iso)
        return float(np.interp(np.log(iso), np.log(self.iso), per_iso)) * iso

    @cached_property
    def adc_noise(self) -> float:
        """The part of the read noise that arises after the gain, in DN; never above the least one.

        Least squares of read_noise^2 = gain^2 * before^2 + after^2, each ISO by its own figure
        (EMVA 1288); 0 where fewer than three ISOs leave it open.
        """
        if len(self.iso) < 3:
            return 0.0
        read2 = np.square(self.read_noise)
        terms = np.stack([np.square(self.system_gain) / read2, 1 / read2], axis=1)
        _, after2 = np.linalg.lstsq(terms, np.ones(len(read2)))[0]
        return float(np.sqrt(np.clip(after2, 0, read2.min())))


class Camera(BaseModel):
    """A camera profile. Levels in DN, gains with green = 1.

    What is None or 0 is either so or not known; ``sources`` says which, and where each figure is
    from.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    name: str
    make: str
    model: str
    black_level: Annotated[float, Field(ge=0, le=65535)]
    white_level: Annotated[float, Field(gt=0, le=65535)]
    white_balance_gains: tuple[Positive, Positive]  # red, blue
    xyz_to_camera: Matrix | None = None  # XYZ to camera RGB at D65, as a DNG's ColorMatrix2
    row_noise_ratio: NotNegative = 0.0  # row sigma over read noise, where there is no table
    column_noise_ratio: NotNegative = 0.0
    full_well: Positive | None = None  # e-; None: the ADC clips first
    tukey_lambda: Annotated[float, Field(gt=-0.5, le=1)] | None = None  # None: Gaussian
    prnu: Annotated[float, Field(ge=0, le=0.5)] = 0.0  # standard deviation over mean
    dsnu: NotNegative = 0.0  # e-
    hot_pixel_share: Share = 0.0
    hot_pixel_level: NotNegative = 0.0  # e-, least extra charge of a hot pixel
    dead_pixel_share: Share = 0.0
    iso_range: tuple[Positive, Positive]
    gain_stages: Annotated[tuple[GainStage, ...], Field(min_length=1)]
    sources: dict[str, str]

    @model_validator(mode="after")
    def _ordered(self) -> "Camera":
        if self.white_level <= self.black_level:
            raise ValueError("white_level must be above black_level")
        if self.xyz_to_camera and abs(np.linalg.det(self.xyz_to_camera)) < 1e-6:
            raise ValueError("xyz_to_camera is singular")
        if self.hot_pixel_share and not self.hot_pixel_level:
            raise ValueError("hot_pixel_share needs hot_pixel_level, the least charge of one in e-")
        low, high = self.iso_range
        if low > high:
            raise ValueError(f"iso_range must ascend; found {low:g} and {high:g}")
        isos = [iso for stage in self.gain_stages for iso in stage.iso]
        if isos != sorted(set(isos)):
            raise ValueError("gain_stages must ascend in iso and not overlap")
        if high < isos[0]:
            raise ValueError(
                f"iso_range ends at {high:g}, before the first gain stage, {isos[0]:g}"
            )
        return self

    @property
    def signal_range(self) -> float:
        """The white level above black, in DN."""
        return self.white_level - self.black_level

    @property
    def bits(self) -> int:
        """The bit depth that its white level needs."""
        return int(self.white_level).bit_length()

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

    def noise(self, iso: float) -> NoiseModel:
        """Shot and read noise at an ISO: a = K / range, b = (read noise / range)^2 (EMVA 1288).

        Between the ISOs of a gain stage, the system gain K is interpolated in proportion to the ISO
        and read noise in electrons linearly in log ISO; a gain stage holds until the next begins.
        Beyond the last measured ISO, K goes on in proportion and read noise stays in electrons.

        Raises:
            RequestError: the ISO is outside the camera's range.
        """
        stage = self.gain_stage(iso)
        unit = self.signal_range
        gain, read_noise = stage.gain_at(iso), stage.at(iso, stage.read_noise)
        base = self.gain_stages[0].gain_at(self.iso_range[0])
        return NoiseModel(
            a=gain / unit,
            b=(read_noise / unit) ** 2,
            signal_range=unit,
            after=min(stage.adc_noise, read_noise) ** 2 / unit**2,
            theta=gain / base,
        )

    def row_noise(self, iso: float) -> float:
        """Standard deviation of the offsets that rows share, signal units; errors as ``noise``."""
        stage = self.gain_stage(iso)
        return self._line_noise(iso, stage, stage.row_noise, self.row_noise_ratio)

    def column_noise(self, iso: float) -> float:
        """Standard deviation of the offsets that columns share, as ``row_noise``."""
        stage = self.gain_stage(iso)
        return self._line_noise(iso, stage, stage.column_noise, self.column_noise_ratio)

    def _line_noise(
        self, iso: float, stage: GainStage, table: tuple[float, ...] | None, ratio: float
    ) -> float:
        dn = stage.at(iso, table) if table else ratio * stage.at(iso, stage.read_noise)
        return dn / self.signal_range

    def signal_of(self, electrons: float, iso: float) -> float:
        """What a charge in e- is worth at an ISO, in signal units; errors as ``noise``."""
        return electrons * self.noise(iso).a

    def gain_stage(self, iso: float) -> GainStage:
        """The gain stage that an ISO belongs to: the last one that begins at or below it.

        Raises:
            RequestError: the ISO is outside the camera's range.
        """
        low, high = self.iso_range
        if not low <= iso <= high:
            raise RequestError(
                f"iso: found {iso:g}, but camera {self.name} goes from {low:g} to {high:g}"
            )
        begun = [s for s in self.gain_stages if s.iso[0] <= iso]
        return begun[-1] if begun else self.gain_stages[0]


@cache
def built_in_cameras() -> dict[str, Path]:
    """The profiles inside the package, by name."""
    folder = Path(str(resources.files("clpipe.camera") / "profiles"))
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
        return _parsed(path.read_text())
    except OSError as error:
        raise RequestError(f"{path}: cannot read this camera profile: {error.strerror}") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise RequestError(f"{path}: not valid TOML: {error}") from None
    except ValidationError as error:
        raise RequestError(f"{path}: {_reason(error)}") from None


@lru_cache(maxsize=64)  # a batch asks again for each image
def _parsed(text: str) -> Camera:
    return Camera.model_validate(tomllib.loads(text))


def _reason(error: ValidationError) -> str:
    """What is wrong with a profile first, with the key, what was found and what is allowed."""
    first = error.errors()[0]
    key = "".join(f"[{p}]" if isinstance(p, int) else f".{p}" for p in first["loc"]).lstrip(".")
    last = str(first["loc"][-1]) if first["loc"] else ""
    if first["type"] == "extra_forbidden":
        model = GainStage if "." in key else Camera
        return f"{key.removesuffix(last)}{one_of('key', last, model.model_fields)}"
    if first["type"] == "missing":
        return f"{key}: it is missing, and a profile needs it"
    reason = first["msg"].removeprefix("Value error, ").removeprefix("Input ")
    found = "" if isinstance(first["input"], dict) else f" found {first['input']!r}:"
    return f"{key}:{found} {reason}" if key else reason
