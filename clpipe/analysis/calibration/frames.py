"""Frames for a calibration: which files, what each says of its camera, in groups of one ISO."""

import glob
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from clpipe.analysis.calibration.calibrate import Calibration, calibrate
from clpipe.analysis.calibration.plot import plot_calibration
from clpipe.analysis.calibration.profile import profile_text
from clpipe.analysis.calibration.repeats import Sensor
from clpipe.base.errors import ImageError, RequestError
from clpipe.base.files import write_new
from clpipe.base.types import Floats
from clpipe.camera.profile import Matrix, load_camera
from clpipe.chain.chain import make_chain
from clpipe.images.attributes import read_attributes
from clpipe.images.raw import RAW_SUFFIXES, RawFacts, read_facts, read_raw
from clpipe.images.read import RENDER_SUFFIXES, read_image
from clpipe.inputs.kept import carried_settings
from clpipe.reference.cfa import Pattern
from clpipe.stage import Kind

MOSAICS = (*RENDER_SUFFIXES, ".png")


@dataclass(frozen=True)
class Given:
    """What the user says of the frames; it wins over what they say themselves."""

    black_level: float | None = None
    white_level: float | None = None
    pattern: Pattern | None = None
    iso: float | None = None

    def check(self) -> None:
        """See that the numbers can be.

        Raises:
            RequestError: one cannot.
        """
        for name, value, low in (
            ("--iso", self.iso, 1.0),
            ("--black-level", self.black_level, 0.0),
            ("--white-level", self.white_level, 1.0),
        ):
            high = 1e7 if name == "--iso" else 65535.0
            if value is not None and not low <= value <= high:
                raise RequestError(f"{name}: found {value:g}; allowed: {low:g} to {high:g}")


@dataclass(frozen=True)
class CalibrationFrame:
    """A file with one mosaic, and what is known of it before its pixels are read."""

    path: Path
    make: str
    model: str
    iso: float
    exposure: str  # as it is told, "" if it is not known
    sensor: Sensor
    signal: bool = False  # holds signal, not DN
    facts: RawFacts | None = None  # of a camera's raw
    gains: tuple[float, float] | None = None
    xyz_to_camera: Matrix | None = None

    def read(self) -> Floats:
        """The mosaic in DN, (height, width).

        Raises:
            ImageError: it cannot be read, or is too small.
        """
        if self.facts:
            mosaic = read_raw(self.path, self.facts)
        else:
            mosaic = read_image(self.path, mosaic=True).pixels.astype(np.float32)
        if self.signal:
            mosaic = mosaic * np.float32(self.sensor.unit) + np.float32(self.sensor.black_level)
            nearest = np.rint(mosaic)
            # What normalize made of whole DN comes back to them but for float's last bits.
            if np.abs(mosaic - nearest).max() < 0.01:
                mosaic = nearest
        if min(mosaic.shape) < 16:
            height, width = mosaic.shape
            raise ImageError(f"{self.path}: {width}x{height} pixels; at least 16x16 are needed")
        return mosaic


def find_frames(inputs: Sequence[str]) -> list[Path]:
    """The files that inputs name, each once: files, folders and globs.

    Of what is right in a folder, or matches a glob, those count that end as mosaics and raws do.

    Raises:
        RequestError: nothing matches.
    """
    found: list[Path] = []
    for text in inputs:
        path = Path(text)
        if path.is_dir():
            files = _frames_among(path.iterdir())
        elif glob.has_magic(text) and not path.exists():
            files = _frames_among(Path(p) for p in glob.glob(text, recursive=True))
        else:
            files = [path]
        if not files:
            raise RequestError(f"{text}: no mosaic or raw file there")
        found += files
    return list(dict.fromkeys(found))


def _frames_among(paths: Iterable[Path]) -> list[Path]:
    """Those that are files and end as mosaics or raws do, by name."""
    endings = (*MOSAICS, *RAW_SUFFIXES)
    known = (p for p in paths if p.suffix.lower() in endings and not p.name.startswith("."))
    return sorted(p for p in known if p.is_file())


def read_frame(path: Path, given: Given) -> CalibrationFrame:
    """What is known of a frame.

    Raises:
        ImageError: the file cannot be read, or holds no mosaic.
        RequestError: it does not say what must be known, and the user does not either.
    """
    if path.suffix.lower() not in MOSAICS:
        return _of_raw(path, given)
    attributes = read_attributes(path)
    if "settings" in attributes:
        return _of_clpipe(path, attributes, given)
    missing = [
        f"--{name.replace('_', '-')}"
        for name in ("black_level", "white_level", "pattern", "iso")
        if getattr(given, name) is None
    ]
    if not path.is_file():
        raise ImageError(f"{path}: no such file")
    if missing:
        raise RequestError(f"{path}: does not say how it was taken; give {', '.join(missing)}")
    assert given.pattern and given.iso is not None
    assert given.black_level is not None and given.white_level is not None
    sensor = Sensor(given.pattern, given.black_level, given.white_level)
    return CalibrationFrame(path, "unknown", "unknown", given.iso, "", sensor)


def _of_raw(path: Path, given: Given) -> CalibrationFrame:
    """A camera's raw."""
    facts = read_facts(path)
    iso = given.iso or facts.iso
    if iso is None:
        raise RequestError(f"{path}: does not say its ISO; give --iso")
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
        _sensor(given, facts.pattern, facts.black_level, facts.white_level),
        facts=facts,
        gains=facts.gains,
        xyz_to_camera=facts.xyz_to_camera,
    )


def _of_clpipe(path: Path, attributes: dict[str, str], given: Given) -> CalibrationFrame:
    """A mosaic that clpipe kept."""
    kind = attributes.get("kind", "")
    if kind not in (Kind.RAW.label, Kind.MOSAIC.label):
        raise ImageError(
            f"{path}: holds {kind}, kept after {attributes.get('stage')}; a mosaic is needed, such "
            "as clpipe run --until quantize writes"
        )
    try:
        settings = carried_settings(attributes)
        assert settings is not None
        chain = make_chain(settings)
        step = chain.step_named(attributes.get("stage", ""))
    except RequestError as error:
        raise ImageError(f"{path}: what it was made with cannot be used: {error}") from None
    context, camera = step.method.after(step.context), chain.camera
    black = camera.black_level if context.black_level is None else context.black_level
    white = camera.white_level if context.white_level is None else context.white_level
    ev = next((getattr(s.method, "ev", 0) for s in chain.steps if s.stage.name == "exposure"), 0)
    return CalibrationFrame(
        path,
        camera.make,
        camera.model,
        given.iso or chain.iso,
        f"{ev:+g} EV",
        _sensor(given, context.pattern, black, white),
        signal=kind == Kind.MOSAIC.label,
        gains=camera.white_balance_gains,
        xyz_to_camera=camera.xyz_to_camera,
    )


def _sensor(given: Given, pattern: Pattern, black: float, white: float) -> Sensor:
    """Pattern and levels: the user's, else the file's."""
    return Sensor(
        given.pattern or pattern,
        black if given.black_level is None else given.black_level,
        white if given.white_level is None else given.white_level,
    )


@dataclass(frozen=True)
class Group:
    """The frames of one ISO."""

    iso: float
    scene: tuple[CalibrationFrame, ...]
    dark: tuple[CalibrationFrame, ...]


def grouped(scene: Sequence[CalibrationFrame], dark: Sequence[CalibrationFrame]) -> list[Group]:
    """Frames by ISO, ascending.

    Raises:
        RequestError: frames differ in camera, pattern or levels, or those of one ISO in exposure;
            an ISO has dark frames only; levels that cannot be.
    """
    frames = [*scene, *dark]
    first = frames[0]
    for frame in frames:
        for what, one, other in (
            ("the camera", f"{first.make} {first.model}", f"{frame.make} {frame.model}"),
            ("the pattern", first.sensor.pattern, frame.sensor.pattern),
            ("the levels", _levels(first.sensor), _levels(frame.sensor)),
        ):
            if one != other:
                raise RequestError(
                    f"{frame.path} has {what} {other}, but {first.path} has {one}; "
                    "calibrate one camera at a time"
                )
    if first.sensor.unit <= 0:
        raise RequestError(f"the white level must be above black; found {_levels(first.sensor)}")
    groups = []
    for iso in sorted({frame.iso for frame in frames}):
        own = tuple(f for f in scene if f.iso == iso)
        if not own:
            raise RequestError(
                f"ISO {iso:g} has dark frames only; give frames of a scene at that ISO too"
            )
        for frame in own[1:]:
            if frame.exposure != own[0].exposure:
                raise RequestError(
                    f"ISO {iso:g}: {frame.path} was exposed {frame.exposure or 'unknown'}, "
                    f"{own[0].path} {own[0].exposure or 'unknown'}; frames of one ISO must have "
                    "one exposure"
                )
        groups.append(Group(iso, own, tuple(f for f in dark if f.iso == iso)))
    return groups


def _levels(sensor: Sensor) -> str:
    return f"black {sensor.black_level:g}, white {sensor.white_level:g}"


def calibrate_group(group: Group) -> Calibration:
    """The noise at one ISO.

    Raises:
        ImageError: a file cannot be read, or nothing can be found from the frames.
        RequestError: the frames differ in size.
    """
    scene = stack(group.scene)
    dark = stack(group.dark) if group.dark else None
    if dark is not None and dark.shape[1:] != scene.shape[1:]:
        raise RequestError(_sizes(group.dark[0], dark[0], group.scene[0], scene[0]))
    brightest, black = float(scene.max()), group.scene[0].sensor.black_level
    if brightest <= black:
        raise ImageError(
            f"{group.scene[0].path}: its largest sample is {brightest:g}, not above the black "
            f"level of {black:g} DN; dark frames are given with --dark"
        )
    whole = bool((scene[0] == np.rint(scene[0])).all())
    return calibrate(group.iso, scene, dark, group.scene[0].sensor, whole)


def stack(frames: Sequence[CalibrationFrame]) -> Floats:
    """The frames in DN, (frames, height, width).

    Raises:
        ImageError: a file cannot be read.
        RequestError: they differ in size.
    """
    first = frames[0].read()
    found = np.empty((len(frames), *first.shape), np.float32)
    found[0] = first
    for place, frame in zip(found[1:], frames[1:], strict=True):
        mosaic = frame.read()
        if mosaic.shape != first.shape:
            raise RequestError(_sizes(frame, mosaic, frames[0], first))
        place[...] = mosaic
    return found


def _sizes(one: CalibrationFrame, own: Floats, other: CalibrationFrame, its: Floats) -> str:
    """That two frames differ in size."""
    return (
        f"{one.path}: {own.shape[1]}x{own.shape[0]} pixels, but {other.path} has "
        f"{its.shape[1]}x{its.shape[0]}; all frames must have one size"
    )


def calibrate_files(
    inputs: Sequence[str], dark: Sequence[str], given: Given
) -> tuple[CalibrationFrame, list[Calibration]]:
    """The noise at each ISO of which there are frames.

    Args:
        inputs: files, folders and globs; those that are dark frames too count as these.
        dark: files, folders and globs of frames without light.
        given: what holds whatever the files say.

    Returns:
        The first frame, for what it says of the camera, and the calibrations by ascending ISO.

    Raises:
        RequestError: the frames do not belong together, or do not say what must be known.
        ImageError: a file cannot be read, or nothing can be found from the frames.
    """
    given.check()
    dark_paths = find_frames(dark)
    without_light = {path.resolve() for path in dark_paths}
    scene_paths = [p for p in find_frames(inputs) if p.resolve() not in without_light]
    if not scene_paths:
        raise RequestError("all frames are dark frames; give frames of a scene too")
    scene = [read_frame(path, given) for path in scene_paths]
    groups = grouped(scene, [read_frame(path, given) for path in dark_paths])
    return scene[0], [calibrate_group(group) for group in groups]


def check_profile_name(path: Path) -> None:
    """See that a profile can have that name.

    Raises:
        RequestError: it does not end in .toml.
    """
    if path.suffix != ".toml":
        raise RequestError(f"{path}: a camera profile's name ends in .toml, such as camera.toml")


def write_profile(path: Path, frame: CalibrationFrame, found: Sequence[Calibration]) -> Path:
    """Write the profile, and the picture of the fit beside it.

    Returns:
        Where the picture is.

    Raises:
        ImageError: a file cannot be written, or what was found makes no valid profile.
    """
    text = profile_text(path.stem, frame.make, frame.model, found, frame.gains, frame.xyz_to_camera)

    def write(to: Path) -> None:
        to.write_text(text, "utf-8")
        load_camera(str(to))  # refuses what it could not use

    picture = path.with_suffix(".png")
    title = f"{frame.make} {frame.model}"
    write_new(picture, lambda to: plot_calibration(to, found, title))
    try:
        write_new(path, write)
    except RequestError as error:
        raise ImageError(f"what was found makes no valid profile: {error}") from None
    return picture
