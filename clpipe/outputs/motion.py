"""The rows and the motion of a camera while its shutter is open, for sidecars and cameras."""

from typing import Any

import numpy as np

from clpipe.base.types import Doubles
from clpipe.chain.chain import Chain
from clpipe.chain.exposures import exposures_of, shutter_in
from clpipe.images.read import SourceImage
from clpipe.reference.pose import from_quaternion, to_quaternion
from clpipe.stage import Span, StageRole
from clpipe.stages.shutter import Rows

Pose = tuple[Doubles, Doubles]  # a quaternion, and the camera's position in the world


def motion_records(chain: Chain, source: SourceImage) -> dict[str, Any]:
    """Return the poses of an exposure's files and of its first and last row, as JSON values.

    Times are in seconds from the start of the first row's exposure. The files divide the time until
    the end of the last row's last exposure into equal parts. The pose of a file applies at the
    middle of its part. The pose of a row applies at the middle of the row's first exposure, and is
    interpolated between files (shortest arc, Shoemake 1985). The result is empty if the camera does
    not move, or the chain has no shutter.
    """
    poses = chain.settings.render.motion
    shutter = shutter_in(chain) if poses else None
    if poses is None or shutter is None:
        return {}
    _, rows = source.margins.frame_size(*source.pixels.shape[1::-1])
    readout = float(shutter.times(rows)[-1])
    span = shutter.duration(rows)
    times = (np.arange(len(poses)) + 0.5) * span / len(poses)
    camera_poses = [(to_quaternion(r), -np.array(r).T @ np.array(t)) for r, t in poses]
    row_times = {"first_row": shutter.time / 2, "last_row": readout + shutter.time / 2}
    return {
        "motion": {
            "exposure_time": shutter.time,
            "readout_time": readout,
            **{
                name: _record(time, *_interpolated(camera_poses, times, time))
                for name, time in row_times.items()
            },
            "files": [_record(time, *pose) for time, pose in zip(times, camera_poses, strict=True)],
        }
    }


def row_times(chain: Chain, source: SourceImage) -> dict[str, Any]:
    """Return when the rows of a rolling shutter are exposed, as JSON values; {} for a global one.

    Row y of the render, of ``rows``, is exposed from START + y * ``step`` until END + y * ``step``,
    for each (START, END) of ``exposures``. Times are in s from the start of the first row's
    exposure.
    """
    step = chain.step_in(StageRole.SHUTTER)
    if step is None or not isinstance(step.method, Rows) or not step.method.line_time:
        return {}
    shutter = step.method
    exposures = exposures_of(chain)
    spans = exposures.spans if exposures else (Span(),)
    shutters = [shutter.for_exposure(spans, number) for number in range(len(spans))]
    _, rows = source.margins.frame_size(*source.pixels.shape[1::-1])
    times = [[float(each.times(1)[0]), float(each.times(1)[0]) + each.time] for each in shutters]
    return {"row_times": {"rows": rows, "step": shutter.line_time, "exposures": times}}


def _interpolated(camera_poses: list[Pose], times: Doubles, time: float) -> Pose:
    """Return the pose at a time, interpolated or extrapolated from the nearest two."""
    after = int(np.clip(np.searchsorted(times, time), 1, len(times) - 1))
    (q, position), (p, next_position) = camera_poses[after - 1], camera_poses[after]
    fraction = (time - times[after - 1]) / (times[after] - times[after - 1])
    p = p if q @ p >= 0 else -p
    angle = float(np.arccos(np.clip(q @ p, -1, 1)))
    if angle < 1e-9:
        rotation = q
    else:
        rotation = (np.sin((1 - fraction) * angle) * q + np.sin(fraction * angle) * p) / np.sin(
            angle
        )
    return rotation, position + fraction * (next_position - position)


def _record(time: float, q: Doubles, position: Doubles) -> dict[str, Any]:
    """Return a pose at a time, as JSON values."""
    r = from_quaternion(q.tolist())
    return {"time": float(time), "R": r.tolist(), "t": (-(r @ position) + 0.0).tolist()}
