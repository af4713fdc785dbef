"""Camera profiles: a sensor's properties at each ISO, from a TOML file that cites every number."""

import os
from functools import cache, lru_cache
from importlib import resources
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from clpipe.base.errors import RequestError
from clpipe.base.reading import check_exists, parse_toml, read_text
from clpipe.base.text import names_with_words, one_line, similar_names, unknown_name
from clpipe.base.types import Doubles
from clpipe.base.url_text import local_path
from clpipe.base.validation import first_fault
from clpipe.camera.gain_stage import GainStage, NotNegative, Offsets, Positive, TukeyLambda
from clpipe.camera.noise import NoiseModel
from clpipe.camera.sensitivities import Sensitivities
from clpipe.camera.text import normalized_name

DEFAULT_CAMERA = "sony-a7r2"
MAX_LISTED = 5  # cameras that a message lists
PUSH_FACTOR = 4.0  # relative to a camera's highest ISO; the factor is two stops
Coefficient = Annotated[float, Field(ge=-100, le=100)]
Row = tuple[Coefficient, Coefficient, Coefficient]
Matrix = tuple[Row, Row, Row]
IDENTITY: Matrix = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
# Linear sRGB to CIE XYZ, white D65 at Y = 1 (IEC 61966-2-1, 1999).
SRGB_TO_XYZ = np.array(
    [
        [0.4123908, 0.3575843, 0.1804808],
        [0.2126390, 0.7151687, 0.0721923],
        [0.0193308, 0.1191948, 0.9505322],
    ]
)


def srgb_to_camera(xyz_to_camera: Matrix) -> Doubles:
    """Return the matrix of :meth:`Camera.srgb_to_camera`, (3, 3).

    >>> srgb_to_camera(IDENTITY).sum(1).round(6).tolist()
    [1.0, 1.0, 1.0]
    """
    matrix = np.array(xyz_to_camera) @ SRGB_TO_XYZ
    return np.asarray(matrix / matrix.sum(1, keepdims=True))


Share = Annotated[float, Field(ge=0, le=0.1)]
Fraction = Annotated[float, Field(ge=0, le=1)]
Temperature = Annotated[float, Field(ge=-100, le=150)]  # deg C

# Keys that need another key, with a description of that key.
REQUIRED_KEYS = {
    ("hot_pixel_share", "hot_pixel_level"): "the smallest extra charge of a hot pixel in e-",
    ("banding_amplitude", "banding_period"): "in rows",
    ("rts_share", "rts_amplitude"): "the mean distance of two levels in e-",
}


class Camera(BaseModel):
    """A camera profile. Levels are in DN, and white balance gains are relative to green = 1.

    Use :func:`load_camera` to load one. A value of None or 0 is either a fact or unknown:
    ``sources`` states which, and gives the source of each figure.

    >>> camera = load_camera("sony-a7r2")
    >>> camera.bits, camera.black_level, camera.white_level, camera.iso_range
    (14, 512.0, 16383.0, (100.0, 25600.0))
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    name: str
    make: str
    model: str
    aliases: tuple[str, ...] = ()  # other names of the model
    black_level: Annotated[float, Field(ge=0, le=65535)]
    white_level: Annotated[float, Field(gt=0, le=65535)]
    white_balance_gains: tuple[Positive, Positive]  # red, blue
    filter_array: str = ""  # a name or rows of letters, see the stage mosaic; "" is a Bayer pattern
    xyz_to_camera: Matrix | None = None  # XYZ to camera RGB at D65, like a DNG's ColorMatrix2
    # Row noise relative to read noise, for stages without a table.
    row_noise_ratio: NotNegative = 0.0
    column_noise_ratio: NotNegative = 0.0
    quantum_efficiency: Annotated[float, Field(gt=0, le=1)] | None = None  # electrons per photon
    full_well: Positive | None = None  # e-; None: the ADC clips first
    tukey_lambda: TukeyLambda | None = None  # distribution of read noise; None: Gaussian
    prnu: Annotated[float, Field(ge=0, le=0.5)] = 0.0  # standard deviation relative to the mean
    crosstalk: Share = 0.0  # share of a pixel's charge that leaks to each side
    dsnu: NotNegative = 0.0  # e-
    hot_pixel_share: Share = 0.0
    hot_pixel_level: NotNegative = 0.0  # e-, the smallest extra charge of a hot pixel
    dead_pixel_share: Share = 0.0
    rts_share: Share = 0.0  # share of pixels with random telegraph noise
    rts_amplitude: NotNegative = 0.0  # e-; the mean distance between the two levels of such a pixel
    dark_current: NotNegative = 0.0  # e-/s
    dark_current_temperature: Temperature = 20.0  # deg C; at which dark_current was measured
    dark_current_doubling: Positive | None = None  # K; None: the same at every temperature
    dark_current_spread: Fraction = 0.0  # standard deviation over pixels, relative to the mean
    dark_shading_slope: NotNegative = 0.0  # DN per unit of ISO; standard deviation over the sensor
    # DN; standard deviation over the sensor of the part that does not depend on the ISO.
    dark_shading_offset: NotNegative = 0.0
    dark_shading_length: Positive = 500.0  # px; the distance over which both parts change
    banding_amplitude: NotNegative = 0.0  # e-; the amplitude of a wave along the columns
    banding_period: Positive | None = None  # rows; the period of that wave
    # Several readouts: the ratio between the sensitivities of successive ones, and the read noise
    # in DN of later ones relative to the first. The gain stages describe the first.
    readout_ratio: Annotated[float, Field(gt=1, le=1024)] | None = None
    readout_noise: NotNegative | None = None
    # Two photodiodes per pixel: the large one's light relative to the small one's, and the share of
    # the large one's charge that leaks into the small one.
    photodiode_ratio: Annotated[float, Field(gt=1, le=10_000)] | None = None
    photodiode_crosstalk: Annotated[float, Field(ge=0, le=0.5)] | None = None
    pixel_pitch: Positive | None = None  # um; between the centres of adjacent photosites
    sensitivities: Sensitivities | None = None  # response of each colour by wavelength
    iso_range: tuple[Positive, Positive]
    gain_stages: Annotated[tuple[GainStage, ...], Field(min_length=1)]
    sources: dict[str, str]

    def __repr__(self) -> str:
        low, high = self.iso_range
        return f"Camera({self.name}, ISO {low:g} to {high:g})"

    @model_validator(mode="after")
    def _check_consistency(self) -> "Camera":
        if self.white_level <= self.black_level:
            raise ValueError("white_level must be above black_level")
        if self.xyz_to_camera and abs(np.linalg.det(self.xyz_to_camera)) < 1e-6:
            raise ValueError("xyz_to_camera is singular")
        for (key, needed), text in REQUIRED_KEYS.items():
            if getattr(self, key) and not getattr(self, needed):
                raise ValueError(f"{key} needs {needed}, {text}")
        if self.tukey_lambda is not None and any(s.tukey_lambda for s in self.gain_stages):
            raise ValueError(
                "tukey_lambda is set both for every ISO and in gain_stages; set one of them"
            )
        low, high = self.iso_range
        if low > high:
            raise ValueError(f"iso_range must ascend; it is {low:g} to {high:g}")
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
        """The white level minus the black level, in DN: the DN of signal 1."""
        return self.white_level - self.black_level

    @property
    def bits(self) -> int:
        """The number of bits that the white level needs."""
        return int(self.white_level).bit_length()

    def srgb_to_camera(self) -> Doubles:
        """Return the matrix from linear sRGB to white-balanced camera RGB, (3, 3); keeps grey.

        It is the product of sRGB to XYZ and XYZ to camera RGB, with each row scaled to the sum 1,
        like by white balance (Coffin, dcraw: cam_xyz_coeff).

        Raises:
            RequestError: the profile has no ``xyz_to_camera``.
        """
        if self.xyz_to_camera is None:
            raise RequestError(f"camera {self.name}: its profile contains no xyz_to_camera matrix")
        return srgb_to_camera(self.xyz_to_camera)

    def noise(self, iso: float) -> NoiseModel:
        """Return shot and read noise at an ISO: a = K / range, b = (read noise / range)^2.

        The formulas come from EMVA 1288, with K the system gain. Between the ISOs of a gain
        stage, K / ISO is interpolated. Read noise is interpolated in electrons, linearly in log
        ISO. A gain stage is valid until the next one begins. Above the last measured ISO, K stays
        proportional to the ISO, and read noise is constant in electrons.

        Raises:
            RequestError: the ISO is outside the camera's range, pushed by two stops.
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
        """Return the standard deviation of row offsets in signal units; see :meth:`noise`."""
        return self._offset_noise(iso, "row_noise", self.row_noise_ratio)

    def column_noise(self, iso: float) -> float:
        """Return the standard deviation of column offsets in signal units; see :meth:`noise`."""
        return self._offset_noise(iso, "column_noise", self.column_noise_ratio)

    def _offset_noise(self, iso: float, name: str, ratio: float = 0.0) -> float:
        """Return the value of a gain stage's table, else a multiple of its read noise."""
        stage = self.gain_stage(iso)
        table = getattr(stage, name)
        dn = stage.at(iso, table) if table else ratio * stage.at(iso, stage.read_noise)
        return dn / self.signal_range

    def tukey_lambda_at(self, iso: float) -> float | None:
        """Return the shape of the read noise at an ISO; None is Gaussian. See :meth:`noise`."""
        stage = self.gain_stage(iso)
        table = stage.tukey_lambda
        return stage.interpolate(iso, table) if table else self.tukey_lambda

    def color_bias(self, iso: float) -> Offsets:
        """Return fixed errors of the black level, in signal: R, G in R's rows, G in B's rows, B.

        Raises like :meth:`noise`.
        """
        stage = self.gain_stage(iso)
        if not stage.color_bias:
            return 0.0, 0.0, 0.0, 0.0
        offsets = (stage.interpolate(iso, row) for row in zip(*stage.color_bias, strict=True))
        one, two, three, four = (offset / self.signal_range for offset in offsets)
        return one, two, three, four

    def black_level_error(self, iso: float) -> float:
        """Return the standard deviation of the black level's error in a frame, in signal units.

        Raises like :meth:`noise`.
        """
        return self._offset_noise(iso, "black_level_error")

    def signal_of(self, electrons: float, iso: float) -> float:
        """Return the signal of a charge in e- at an ISO; raises like :meth:`noise`."""
        return electrons * self.noise(iso).a

    @property
    def pushed_range(self) -> tuple[float, float]:
        """The range plus two stops, to which cameras push without more gain in the sensor."""
        low, high = self.iso_range
        return low, high * PUSH_FACTOR

    def check_iso(self, iso: float, pushed: bool = False) -> None:
        """Check that the camera has an ISO, or may be pushed to it.

        Raises:
            RequestError: it does not.
        """
        low, high = self.pushed_range if pushed else self.iso_range
        if not low <= iso <= high:
            low, high = self.iso_range
            raise RequestError(
                f"iso: found {iso:g}, but camera {self.name} goes from {low:g} to "
                f"{high:g}; use {min(max(iso, low), high):g}{_cameras_with_iso(self, iso)}"
            )

    def gain_stage(self, iso: float) -> GainStage:
        """Return the gain stage of an ISO: the last one that begins at or below it, else the first.

        Raises:
            RequestError: the ISO is outside the camera's range, pushed by two stops.
        """
        self.check_iso(iso, pushed=True)
        lower = [stage for stage in self.gain_stages if stage.iso[0] <= iso]
        return lower[-1] if lower else self.gain_stages[0]


@cache
def built_in_cameras() -> dict[str, Path]:
    """The paths of the profiles inside the package, by name.

    >>> built_in_cameras()["sony-a7r2"].name
    'sony-a7r2.toml'
    """
    folder = Path(str(resources.files("clpipe.camera") / "profiles"))
    return {path.stem: path for path in sorted(folder.glob("*.toml"), key=lambda path: path.stem)}


@cache
def camera_names() -> dict[str, str]:
    """Return the built-in cameras by all their names, in the form of :func:`normalized_name`."""
    names: dict[str, str] = {}
    for name in built_in_cameras():
        camera = load_camera(name)
        for model in (camera.model, camera.model.removeprefix(camera.make), *camera.aliases):
            names |= {normalized_name(model): name, normalized_name(f"{camera.make} {model}"): name}
    return names | {normalized_name(name): name for name in built_in_cameras()}


def built_in_name(name: str) -> str | None:
    """Return the name of a built-in camera by name, model, or make and model; else None.

    >>> built_in_name("Canon 5D Mark II"), built_in_name("sony ilce-7rm2"), built_in_name("D1")
    ('canon-5d2', 'sony-a7r2', None)
    """
    if name in built_in_cameras():
        return name
    return None if name.endswith(".toml") else camera_names().get(normalized_name(name))


def cameras_matching(name: str) -> list[str]:
    """Return the built-in cameras that have all words of a text in one of their names.

    >>> cameras_matching("nikon d8"), cameras_matching("canon 5d mark")
    ([], ['canon-5d2', 'canon-5d3', 'canon-5d4'])
    """
    names = _full_names()
    return list(dict.fromkeys(names[each] for each in names_with_words(name, names)))


def similar_cameras(name: str) -> list[str]:
    """Return the built-in cameras that a shortened or misspelt name may mean."""
    by_name = camera_names()
    near = (by_name[found] for found in similar_names(normalized_name(name), by_name))
    return cameras_matching(name) or list(dict.fromkeys(near))


@cache
def _full_names() -> dict[str, str]:
    """Return the built-in cameras by each of their names, with the maker."""
    full: dict[str, str] = {}
    for name in built_in_cameras():
        camera = load_camera(name)
        models = (f"{camera.make} {model}" for model in (camera.model, *camera.aliases))
        full |= dict.fromkeys((name, *models), name)
    return full


def _cameras_with_iso(camera: Camera, iso: float) -> str:
    """Return the part of a message that lists cameras with an ISO, or the nearest one."""
    others = [load_camera(name) for name in built_in_cameras() if name != camera.name]
    matching = [o.name for o in others if o.iso_range[0] <= iso <= o.iso_range[1]]
    if matching:
        more = f" or {len(matching) - MAX_LISTED} others" if len(matching) > MAX_LISTED else ""
        return f", or a camera that has this ISO: {', '.join(matching[:MAX_LISTED])}{more}"
    is_high = iso > camera.iso_range[1]
    closest = (max if is_high else min)(others, key=lambda other: other.iso_range[is_high])
    end = closest.iso_range[is_high]
    if (end > camera.iso_range[1]) if is_high else (end < camera.iso_range[0]):
        return f"; the built-in camera that comes closest is {closest.name}, with ISO {end:g}"
    return "; no built-in camera comes closer"


def load_camera(name: str | Path) -> Camera:
    """Load a built-in camera by :func:`built_in_name`, or a file by its path (ending in .toml).

    >>> load_camera("sony-a7r2")
    Camera(sony-a7r2, ISO 100 to 25600)

    Raises:
        RequestError: there is no such camera or file, or the file is not a valid profile.
    """
    built_in, name = built_in_cameras(), str(name)
    if built_in_path := built_in.get(built_in_name(name) or ""):
        return _built_in(built_in_path)
    path = local_path("camera", name)
    if path.suffix != ".toml" and os.path.isfile(path):
        raise RequestError(
            f"{path}: not a camera profile, because these end in .toml; to make one from a DNG "
            "or a noise model, use 'clpipe cameras import'"
        )
    if path.suffix != ".toml":
        similar = similar_cameras(name)
        hint = f" (most similar: {', '.join(similar)})" if similar else ""
        raise RequestError(
            f"unknown camera '{one_line(name)}': it is not built in{hint}. 'clpipe cameras' lists "
            "those that are. For another camera, make a profile with 'clpipe cameras import' or "
            "'clpipe calibrate', and name its .toml file"
        )
    check_exists(path)
    try:
        return parse_camera(read_text(path), str(path))
    except OSError as error:
        raise RequestError(f"{path}: cannot read this camera profile: {error.strerror}") from None
    except UnicodeDecodeError as error:
        raise RequestError(f"{path}: not valid TOML: {error}") from None


@cache
def _built_in(path: Path) -> Camera:
    return parse_camera(read_text(path), str(path))


@lru_cache(maxsize=64)  # a batch loads the camera once per image
def parse_camera(text: str, source: str) -> Camera:
    """Return the camera of a profile's text. ``source`` names it in messages.

    Raises:
        RequestError: the text is not a valid profile.
    """
    try:
        return Camera.model_validate(parse_toml(text))
    except ValidationError as error:
        raise RequestError(f"{source}: {_reason(error)}") from None
    except ValueError as error:
        raise RequestError(f"{source}: not valid TOML: {error}") from None


def _reason(error: ValidationError) -> str:
    """Return the first problem of a profile: its key, its value and what is allowed."""
    fault = first_fault(error)
    if fault.problem == "unknown":
        fields = (GainStage if "." in fault.key else Camera).model_fields
        return fault.key.removesuffix(fault.name) + unknown_name("key", fault.name, fields)
    if fault.problem == "missing":
        return f"{fault.key}: missing; every profile needs this key"
    return f"{fault.key}: {fault.text}" if fault.path else fault.text
