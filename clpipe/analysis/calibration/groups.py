"""Groups frames by ISO, and calibrates each group."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from clpipe.analysis.calibration.calibrate import calibrate
from clpipe.analysis.calibration.dark_current import DarkCurrent, dark_current
from clpipe.analysis.calibration.frames import CalibrationFrame
from clpipe.analysis.calibration.repeats import Sensor
from clpipe.analysis.calibration.result import Calibration
from clpipe.base.errors import ImageError, RequestError
from clpipe.base.types import Floats


@dataclass(frozen=True)
class Group:
    """The frames of a scene and the dark frames of one ISO; ``longer`` have other times."""

    iso: float
    scene: tuple[CalibrationFrame, ...]
    dark: tuple[CalibrationFrame, ...]
    longer: tuple[tuple[CalibrationFrame, ...], ...] = ()


def group_frames(
    scene: Sequence[CalibrationFrame], dark: Sequence[CalibrationFrame]
) -> list[Group]:
    """Return groups of frames by ISO, in ascending order.

    Raises:
        RequestError: frames differ in camera, pattern or levels; frames of one ISO differ in
            exposure; an ISO has only dark frames; or the levels are impossible.
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
        raise RequestError(
            f"found {_levels(first.sensor)}, but the white level must be above black"
        )
    groups = []
    for iso in sorted({frame.iso for frame in frames}):
        scene_at_iso = tuple(f for f in scene if f.iso == iso)
        if not scene_at_iso:
            raise RequestError(
                f"ISO {iso:g} has only dark frames; add frames of a scene at that ISO"
            )
        first = scene_at_iso[0]
        for frame in scene_at_iso[1:]:
            if frame.exposure != first.exposure:
                raise RequestError(
                    f"ISO {iso:g}: the exposure of {frame.path} is "
                    f"{frame.exposure or 'unknown'}, but the exposure of {first.path} is "
                    f"{first.exposure or 'unknown'}; use one exposure for all frames of an ISO"
                )
        own, *longer = by_time([f for f in dark if f.iso == iso], first.seconds)
        groups.append(Group(iso, scene_at_iso, own, tuple(longer)))
    return groups


def by_time(
    dark: Sequence[CalibrationFrame], seconds: float | None
) -> list[tuple[CalibrationFrame, ...]]:
    """Return lists of dark frames of one ISO by exposure time.

    The first list has the exposure time of the scene, or else the shortest time.

    Args:
        dark: the frames; without any, there is one empty list.
        seconds: the exposure time of the scene in s.
    """
    times = sorted({frame.seconds or 0.0 for frame in dark})
    if seconds in times:
        times.remove(seconds)
        times.insert(0, seconds)
    return [tuple(f for f in dark if (f.seconds or 0.0) == time) for time in times] or [()]


def _levels(sensor: Sensor) -> str:
    """Return the levels as text."""
    return f"black {sensor.black_level:g}, white {sensor.white_level:g}"


def calibrate_group(group: Group) -> Calibration:
    """Estimate the noise at one ISO.

    Raises:
        ImageError: a file cannot be read, or the frames do not allow an estimate.
        RequestError: the frames differ in size.
    """
    scene = read_frames(group.scene)
    dark = read_frames(group.dark) if group.dark else None
    if dark is not None and dark.shape[1:] != scene.shape[1:]:
        raise _different_sizes(group.dark[0], dark[0], group.scene[0], scene[0])
    brightest, black = float(scene.max()), group.scene[0].sensor.black_level
    if brightest <= black:
        raise ImageError(
            f"{group.scene[0].path}: its largest sample is {brightest:g}, not above the black "
            f"level of {black:g} DN; pass dark frames with --dark"
        )
    whole = bool((scene[0] == np.rint(scene[0])).all())
    found = calibrate(group.iso, scene, dark, group.scene[0].sensor, whole)
    return replace(found, dark_current=current_of(group, found)) if group.longer else found


def current_of(group: Group, found: Calibration) -> DarkCurrent | None:
    """Return the dark current of a group with dark frames of several exposure times."""
    every = (group.dark, *group.longer)
    stacks = {frames[0].seconds or 0.0: read_frames(frames) for frames in every if len(frames) > 1}
    return dark_current(stacks, found.pooled.gain, found.sensor)


def read_frames(frames: Sequence[CalibrationFrame]) -> Floats:
    """Return the frames in DN, (frames, height, width).

    Raises:
        ImageError: a file cannot be read.
        RequestError: the frames differ in size.
    """
    first = frames[0].read()
    mosaics = np.empty((len(frames), *first.shape), np.float32)
    mosaics[0] = first
    for target, frame in zip(mosaics[1:], frames[1:], strict=True):
        mosaic = frame.read()
        if mosaic.shape != first.shape:
            raise _different_sizes(frame, mosaic, frames[0], first)
        target[...] = mosaic
    return mosaics


def _different_sizes(
    frame: CalibrationFrame, mosaic: Floats, other: CalibrationFrame, other_mosaic: Floats
) -> RequestError:
    """Return the error that two frames differ in size."""
    (height, width), (other_height, other_width) = mosaic.shape, other_mosaic.shape
    return RequestError(
        f"{frame.path}: this frame has {width}x{height} pixels, but {other.path} has "
        f"{other_width}x{other_height}; all frames must have one size"
    )
