"""Calibrates a camera from files, and writes a profile and a picture of the fit."""

import os
from collections.abc import Sequence
from pathlib import Path

from clpipe.analysis.calibration.frames import (
    CalibrationFrame,
    FrameOverrides,
    find_frames,
    read_frame,
)
from clpipe.analysis.calibration.groups import calibrate_group, group_frames
from clpipe.analysis.calibration.profile import calibrated_profile
from clpipe.analysis.calibration.result import Calibration
from clpipe.base.errors import ImageError, RequestError
from clpipe.base.extras import require
from clpipe.base.files import atomic_file, write_new
from clpipe.camera.profile import load_camera


def calibrate_files(
    inputs: Sequence[str], dark: Sequence[str], overrides: FrameOverrides
) -> tuple[CalibrationFrame, list[Calibration]]:
    """Estimate the noise at each ISO of the frames.

    Args:
        inputs: files, folders and globs of frames of a scene; files in ``dark`` are skipped.
        dark: files, folders and globs of frames without light.
        overrides: values that replace those in the files.

    Returns:
        The first frame, for its metadata, and the calibrations in ascending order of ISO.

    Raises:
        RequestError: the frames do not belong together, needed metadata is missing, or SciPy or
            matplotlib is not installed.
        ImageError: a file cannot be read, or the frames do not allow an estimate.
    """
    require("clpipe calibrate", "calibrate")
    overrides.check()
    dark_paths = find_frames(dark)
    without_light = {os.path.realpath(path) for path in dark_paths}
    scene_paths = [p for p in find_frames(inputs) if os.path.realpath(p) not in without_light]
    if not scene_paths:
        raise RequestError("all frames are dark frames; add frames of a scene")
    scene = [read_frame(path, overrides) for path in scene_paths]
    groups = group_frames(scene, [read_frame(path, overrides) for path in dark_paths])
    return scene[0], [calibrate_group(group) for group in groups]


def write_profile(path: Path, frame: CalibrationFrame, calibrations: Sequence[Calibration]) -> Path:
    """Write the profile, and the picture of the fit next to it.

    Args:
        path: the path of the profile.
        frame: one of the frames, for its metadata.
        calibrations: one for each ISO.

    Returns:
        The path of the picture.

    Raises:
        ImageError: a file cannot be written, or the estimates do not form a valid profile.
    """
    from clpipe.analysis.calibration.plot import calibration_png  # imports Matplotlib

    text = calibrated_profile(
        path.stem, frame.make, frame.model, calibrations, frame.gains, frame.xyz_to_camera
    )
    return write_with_picture(
        path, text, calibration_png(calibrations, f"{frame.make} {frame.model}")
    )


def write_with_picture(path: Path, text: str, png: bytes) -> Path:
    """Write a profile, and the picture of the measurement next to it; return the picture's path.

    Raises:
        ImageError: a file cannot be written, or the text is not a valid profile.
    """
    picture = path.with_suffix(".png")
    write_new(picture, png)
    try:
        with atomic_file(path) as file:
            file.write(text.encode())
            file.flush()
            load_camera(file.name)  # raises RequestError for an invalid profile
    except RequestError as error:
        raise ImageError(f"the estimates do not form a valid profile: {error}") from None
    return picture
