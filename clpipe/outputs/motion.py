"""The motion of a camera while its shutter is open, for sidecars and transforms.json."""

from typing import Any

import numpy as np

from clpipe.base.types import Doubles
from clpipe.chain.chain import Chain
from clpipe.chain.exposures import exposures_of
from clpipe.images.read import SourceImage
from clpipe.reference.pose import from_quaternion, to_quaternion
from clpipe.stage import StageRole
from clpipe.stages.shutter import Rows

Moved = tuple[Doubles, Doubles]  # a quaternion, and the camera's position in the world


def motion_records(chain: Chain, source: SourceImage) -> dict[str, Any]:
    """Return the poses of an exposure's files and of its first and last row, as JSON values.

    Times are in seconds from the start of the first row's exposure. The files divide the time until
    the last row's last exposure ends into equal parts, and the pose of a file is that of the middle
    of its part. The pose of a row is that of the middle of its first exposure, interpolated
    between files (shortest arc, Shoemake 1985). The result is empty if the camera does not move, or
    the chain has no shutter.
    """
    poses, step = chain.settings.render.motion, chain.step_in(StageRole.SHUTTER)
    if poses is None or step is None or not isinstance(step.method, Rows):
        return {}
    exposures = exposures_of(chain)
    shutter = step.method.for_exposure(exposures.spans, 0) if exposures else step.method
    _, rows = source.margins.frame_size(*source.pixels.shape[1::-1])
    readout = float(shutter.times(rows)[-1])
    span = shutter.duration(rows)
    times = (np.arange(len(poses)) + 0.5) * span / len(poses)
    moved = [(to_quaternion(r), -np.array(r).T @ np.array(t)) for r, t in poses]
    seen = {"first_row": shutter.time / 2, "last_row": readout + shutter.time / 2}
    return {
        "motion": {
            "exposure_time": shutter.time,
            "readout_time": readout,
            **{name: _record(time, *_between(moved, times, time)) for name, time in seen.items()},
            "files": [_record(time, *own) for time, own in zip(times, moved, strict=True)],
        }
    }


def _between(moved: list[Moved], times: Doubles, time: float) -> Moved:
    """Return the pose at a time, interpolated or extrapolated from the nearest two."""
    after = int(np.clip(np.searchsorted(times, time), 1, len(times) - 1))
    (q, place), (p, there) = moved[after - 1], moved[after]
    share = (time - times[after - 1]) / (times[after] - times[after - 1])
    p = p if q @ p >= 0 else -p
    angle = float(np.arccos(np.clip(q @ p, -1, 1)))
    if angle < 1e-9:
        turned = q
    else:
        turned = (np.sin((1 - share) * angle) * q + np.sin(share * angle) * p) / np.sin(angle)
    return turned, place + share * (there - place)


def _record(time: float, q: Doubles, place: Doubles) -> dict[str, Any]:
    """Return a pose at a time, as JSON values."""
    r = from_quaternion(q.tolist())
    return {"time": float(time), "R": r.tolist(), "t": (-(r @ place) + 0.0).tolist()}
