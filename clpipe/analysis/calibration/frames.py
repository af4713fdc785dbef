"""Frames for a calibration: finds the files, and reads their camera and levels."""

import glob
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from clpipe.analysis.calibration.repeats import Sensor
from clpipe.base.errors import ImageError, RequestError
from clpipe.base.reading import check_input
from clpipe.base.text import one_line
from clpipe.base.types import Floats
from clpipe.base.url_text import local
from clpipe.camera.profile import Matrix
from clpipe.chain.making import make_chain
from clpipe.images.attributes import read_attributes
from clpipe.images.dump import Dump, read_dump
from clpipe.images.raw import RAW_SUFFIXES, RawInfo, read_raw, read_raw_info
from clpipe.images.read import RENDER_SUFFIXES, read_image
from clpipe.inputs.kept import embedded_settings
from clpipe.inputs.raw import may_be_dump
from clpipe.reference.cfa import PATTERNS, Pattern
from clpipe.reference.filter_array import MONO, NAMED
from clpipe.stage import Kind, StageRole

MOSAICS = (*RENDER_SUFFIXES, ".png")  # extensions of mosaics that are not camera raws


@dataclass(frozen=True)
class FrameOverrides:
    """The user's values for all frames, which replace those in files; None is not set.

    Levels are in DN. ``dump`` is the format of headerless dumps.
    """

    black_level: float | None = None
    white_level: float | None = None
    pattern: Pattern | None = None
    iso: float | None = None
    dump: Dump | None = None

    def check(self) -> None:
        """Check that the numbers are possible.

        Raises:
            RequestError: one is not.
        """
        for name, value, low in (
            ("--iso", self.iso, 1.0),
            ("--black-level", self.black_level, 0.0),
            ("--white-level", self.white_level, 1.0),
        ):
            high = 1e7 if name == "--iso" else 65535.0
            if value is not None and not low <= value <= high:
                raise RequestError(
                    f"{name}: found {value:g}, but expected a value from {low:g} to {high:g}"
                )


@dataclass(frozen=True)
class CalibrationFrame:
    """A file with one mosaic, and its metadata. The pixels are read later."""

    path: Path
    make: str
    model: str
    iso: float
    exposure: str  # exposure as text; "" if unknown
    sensor: Sensor
    signal: bool = False  # whether the file has signal units instead of DN
    facts: RawInfo | Dump | None = None  # from a camera raw or a dump
    gains: tuple[float, float] | None = None  # white balance gains of red and blue (green = 1)
    xyz_to_camera: Matrix | None = None

    @property
    def seconds(self) -> float | None:
        """The exposure time in s; None if the file does not state it."""
        return self.facts.exposure if isinstance(self.facts, RawInfo) else None

    def read(self) -> Floats:
        """Return the mosaic in DN, (height, width).

        Raises:
            ImageError: the file cannot be read, or is smaller than 16x16.
        """
        if isinstance(self.facts, Dump):
            mosaic = read_dump(self.path, self.facts)
        elif self.facts:
            mosaic = read_raw(self.path, self.facts)
        else:
            mosaic = read_image(self.path, mosaic=True).pixels.astype(np.float32)
        if self.signal:
            with np.errstate(over="ignore"):
                mosaic = mosaic * np.float32(self.sensor.unit) + np.float32(self.sensor.black_level)
            if not np.isfinite(mosaic).all():
                raise ImageError(
                    f"{self.path}: this file is damaged: its signal exceeds the range of floats"
                )
            nearest = np.rint(mosaic)
            # Signal from whole DN is restored only up to float precision, so it is rounded.
            if np.abs(mosaic - nearest).max() < 0.01:
                mosaic = nearest
        if min(mosaic.shape) < 16:
            height, width = mosaic.shape
            raise ImageError(
                f"{self.path}: this frame has {width}x{height} pixels, but at least 16x16 are "
                "needed"
            )
        return mosaic


def find_frames(inputs: Sequence[str]) -> list[Path]:
    """Return the files of inputs, without duplicates. An input is a file, a folder or a glob.

    In a folder (not below it) and for a glob, only files with the extension of a mosaic or raw are
    used.

    Raises:
        RequestError: an input has no such file.
    """
    paths: list[Path] = []
    for text in map(local, inputs):
        path = Path(text)
        if path.is_dir():
            files = _frames_among(path.iterdir())
        elif glob.has_magic(text) and not path.exists():
            files = _frames_among(Path(p) for p in glob.glob(text, recursive=True))
        else:
            check_input(path)
            files = [path]
        if not files:
            raise RequestError(
                f"{text}: there is no mosaic or raw file; give camera raws, or mosaics kept by "
                "clpipe"
            )
        paths += files
    return list(dict.fromkeys(paths))


def _frames_among(paths: Iterable[Path]) -> list[Path]:
    """Return the files with the extension of a mosaic or raw, sorted, without hidden ones."""
    endings = (*MOSAICS, *RAW_SUFFIXES)
    matches = (p for p in paths if p.suffix.lower() in endings and not p.name.startswith("."))
    return sorted(p for p in matches if p.is_file())


def read_frame(path: Path, overrides: FrameOverrides) -> CalibrationFrame:
    """Read the metadata of a frame: a camera raw, a mosaic that clpipe kept, or another mosaic.

    A headerless dump counts as another mosaic if the user states its format.

    Raises:
        ImageError: the file cannot be read, or is not a mosaic.
        RequestError: a value is missing that neither the file nor the user states.
    """
    has_header = path.suffix.lower() in MOSAICS
    dump = overrides.dump if may_be_dump(path) and not has_header else None
    if not (has_header or dump):
        return _from_raw(path, overrides)
    attributes = read_attributes(path) if has_header else {}
    if "settings" in attributes:
        return _from_kept(path, attributes, overrides)
    missing = [
        f"--{name.replace('_', '-')}"
        for name in ("black_level", "white_level", "pattern", "iso")
        if getattr(overrides, name) is None
    ]
    if missing:
        raise RequestError(
            f"{path}: this file does not state how it was taken; add {', '.join(missing)}"
        )
    assert overrides.pattern and overrides.iso is not None
    assert overrides.black_level is not None and overrides.white_level is not None
    sensor = Sensor(overrides.pattern, overrides.black_level, overrides.white_level)
    return CalibrationFrame(path, "unknown", "unknown", overrides.iso, "", sensor, facts=dump)


def _from_raw(path: Path, overrides: FrameOverrides) -> CalibrationFrame:
    """Return the frame of a camera raw."""
    facts = read_raw_info(path)
    iso = overrides.iso or facts.iso
    if iso is None:
        raise RequestError(f"{path}: this file does not state its ISO; add --iso")
    exposure = ""
    if facts.exposure:
        short = facts.exposure < 0.3
        exposure = f"1/{1 / facts.exposure:.0f} s" if short else f"{facts.exposure:.3g} s"
    return CalibrationFrame(
        path,
        facts.make,
        facts.model,
        iso,
        exposure,
        _sensor(overrides, facts.pattern, facts.black_level, facts.white_level),
        facts=facts,
        gains=facts.gains,
        xyz_to_camera=facts.xyz_to_camera,
    )


def _from_kept(
    path: Path, attributes: dict[str, str], overrides: FrameOverrides
) -> CalibrationFrame:
    """Return the frame of a mosaic that clpipe kept."""
    kind = attributes.get("kind", "")
    if kind not in (Kind.RAW.label, Kind.MOSAIC.label):
        found = one_line(f"{kind}, kept after {attributes.get('stage')}")
        raise ImageError(
            f"{path}: this file contains {found}; give a mosaic (clpipe run --until quantize)"
        )
    try:
        settings = embedded_settings(attributes)
        assert settings is not None
        chain = make_chain(settings)
        step = chain.step_named(attributes.get("stage", ""))
    except RequestError as error:
        raise ImageError(f"{path}: its settings cannot be used: {error}") from None
    context, camera = step.method.next_context(step.context), chain.camera
    black = camera.black_level if context.black_level is None else context.black_level
    white = camera.white_level if context.white_level is None else context.white_level
    exposure = chain.step_in(StageRole.EXPOSURE)
    ev = getattr(exposure.method, "ev", 0) if exposure else 0
    return CalibrationFrame(
        path,
        camera.make,
        camera.model,
        overrides.iso or chain.iso,
        f"{ev:+g} EV",
        _sensor(overrides, context.filter_array.pattern, black, white),
        signal=kind == Kind.MOSAIC.label,
        gains=camera.white_balance_gains,
        xyz_to_camera=camera.xyz_to_camera,
    )


def _sensor(overrides: FrameOverrides, pattern: str, black: float, white: float) -> Sensor:
    """Return pattern and levels: the user's, or else the file's."""
    stated = overrides.pattern or pattern
    name = "" if stated in PATTERNS else next((n for n, r in NAMED.items() if r == stated), stated)
    return Sensor(
        # A mono sensor's sites are all equal, so any pattern fits.
        PATTERNS[0] if stated == MONO else stated,
        black if overrides.black_level is None else overrides.black_level,
        white if overrides.white_level is None else overrides.white_level,
        name,
    )
