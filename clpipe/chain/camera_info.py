"""The camera of a picture as other programs name it: OpenCV's K and D, ROS's CameraInfo."""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from clpipe.chain.chain import Chain, cached_by_structure
from clpipe.chain.photometry import Estimates, exposure_of
from clpipe.reference.filter_array import FilterArray
from clpipe.reference.intrinsics import COEFFICIENTS, OPENCV_FISHEYE, THIN_PRISM, Intrinsics
from clpipe.stage import Kind, StageRole

# ROS's distortion models (sensor_msgs/distortion_models.hpp), and the order of OpenCV's D.
PLUMB_BOB, RATIONAL, EQUIDISTANT = "plumb_bob", "rational_polynomial", "equidistant"
NO_LENS = (0.0,) * 12
ORDER = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4")
Row = tuple[float, ...]


@dataclass(frozen=True)
class CameraInfo:
    """The camera that made a picture.

    The names and conventions are those of OpenCV and of ROS's ``sensor_msgs/CameraInfo``: the
    centre of the first pixel is (0, 0).

    >>> import numpy as np
    >>> import clpipe
    >>> lens = {"method": "brown_conrady", "fx": 30, "k1": 0.1}
    >>> camera = clpipe.Pipeline(device="numpy", iso=800, distortion=lens)
    >>> info = camera(np.full((24, 32, 3), 0.2, np.float32)).camera
    >>> info.k[0], info.distortion_model, info.d[:2], info.encoding, info.raw_encoding
    ((30.0, 0.0, 15.5), 'plumb_bob', (0.1, 0.0), 'rgb8', 'bayer_rggb16')

    Attributes:
        width, height: the size of the picture, px.
        k: the camera matrix, three rows; None if the focal length is unknown.
        d: the coefficients of distortion in OpenCV's order; () without a focal length.
        distortion_model: ROS's name of the model; "" without a focal length.
        encoding: ROS's encoding of the picture.
        raw_encoding: ROS's encoding of the raw, such as bayer_rggb16. An array that ROS has no name
            for is 16UC1, and a chain without a raw has "".
        black_level, white_level: of the raw, DN.
        exposure_time: s; None if it is unknown.
        iso: the ISO.
        gain: DN per electron; None without a raw.
        white_balance: the gains of red, green and blue that were applied.
        color_matrix: from white-balanced camera RGB to linear sRGB, three rows; None if the chain
            has none.
        row_time: the time from the start of a row to the start of the next, s; 0 is a global
            shutter. Rows start at the top.
        time: the time of the picture, s; None if it was not stated.
    """

    width: int
    height: int
    k: tuple[Row, Row, Row] | None
    d: Row
    distortion_model: str
    encoding: str
    raw_encoding: str
    black_level: float
    white_level: float
    exposure_time: float | None
    iso: float
    gain: float | None
    white_balance: Row
    color_matrix: tuple[Row, Row, Row] | None
    row_time: float
    time: float | None = None

    @cached_property
    def p(self) -> tuple[Row, Row, Row] | None:
        """The projection matrix of the undistorted picture, 3x4: K, and zeros."""
        return self.k and tuple((*row, 0.0) for row in self.k)  # type: ignore[return-value]

    def record(self) -> dict[str, Any]:
        """Return the camera as JSON values, with the projection matrix."""
        return {**vars(self), "p": self.p}

    def arrays(self) -> dict[str, Any]:
        """Return what a sample has of it. Numbers that are unknown are NaN, and D has 12."""
        unknown = np.full((3, 3), np.nan)
        return {
            "k": np.array(self.k) if self.k else unknown,
            "d": np.array(self.d + NO_LENS[len(self.d) :]),
            "distortion_model": self.distortion_model,
            "exposure_time": math.nan if self.exposure_time is None else self.exposure_time,
            "row_time": self.row_time,
            "color_matrix": np.array(self.color_matrix) if self.color_matrix else unknown,
        }


def lens_of(intrinsics: Intrinsics) -> tuple[str, Row]:
    """Return ROS's name of a distortion model, and OpenCV's coefficients.

    OpenCV's model of a thin prism has no name in ROS. It is called thin_prism here.

    >>> lens_of(Intrinsics(4, 3, 5, 5, 2, 1.5, "FULL_OPENCV", {"k1": 0.1, "k4": 0.2}))
    ('rational_polynomial', (0.1, 0.0, 0.0, 0.0, 0.0, 0.2, 0.0, 0.0))
    """
    known = intrinsics.distortion
    if intrinsics.model == OPENCV_FISHEYE:
        return EQUIDISTANT, tuple(known.get(name, 0.0) for name in COEFFICIENTS[OPENCV_FISHEYE])
    values = tuple(float(known.get(name, 0.0)) for name in ORDER)
    if intrinsics.model == THIN_PRISM:
        return "thin_prism", values
    return (RATIONAL, values[:8]) if any(values[5:8]) else (PLUMB_BOB, values[:5])


def encoding_of(array: FilterArray) -> str:
    """Return ROS's encoding of a raw of 16 bits.

    >>> from clpipe.reference.filter_array import parse_array
    >>> [encoding_of(parse_array(name)) for name in ("GBRG", "mono", "x-trans")]
    ['bayer_gbrg16', 'mono16', '16UC1']
    """
    if array.bayer:
        return f"bayer_{array.bayer.lower()}16"
    return "mono16" if array.is_gray else "16UC1"


@cached_by_structure
def _steps(chain: Chain) -> tuple[int | None, ...]:
    """Return the places of the steps that balance, expose rows and convert colours."""
    roles = [step.stage.role for step in chain.steps]
    wanted = StageRole.BALANCE, StageRole.SHUTTER, StageRole.COLOURS
    return tuple(roles.index(role) if role in roles else None for role in wanted)


def camera_info(
    chain: Chain, estimates: Estimates, size: tuple[int, int], intrinsics: Intrinsics | None
) -> CameraInfo:
    """Return the camera of a picture.

    Args:
        chain: the chain of the picture.
        estimates: the values that steps estimated from the image, by step name.
        size: the width and height of the input, px.
        intrinsics: those of the picture; None if they are unknown.
    """
    width, height = chain.size(*size)
    if intrinsics:  # a photograph's picture is upright
        width, height = intrinsics.width, intrinsics.height
    k, (model, d) = None, lens_of(intrinsics) if intrinsics else ("", ())
    if intrinsics:
        cx, cy = intrinsics.cx - 0.5, intrinsics.cy - 0.5
        k = (intrinsics.fx, 0.0, cx), (0.0, intrinsics.fy, cy), (0.0, 0.0, 1.0)
    raw, camera = chain.raw_context, chain.camera
    noise = raw.noise or camera.noise(chain.iso)
    has_raw = chain.raw_step_name is not None or chain.source is Kind.RAW
    raw_encoding = encoding_of(chain.filter_array) if has_raw else ""
    encodings = {Kind.DISPLAY: "rgb8", Kind.RAW: raw_encoding, Kind.MOSAIC: "32FC1"}
    exposure, (balance, shutter, colours) = exposure_of(chain, estimates), _steps(chain)
    red, blue = chain.context_after.applied_gains
    found = estimates.get(chain.steps[balance].name, {}) if balance is not None else {}
    matrix = None if colours is None else getattr(chain.steps[colours].method, "matrix", None)
    rows = None if shutter is None else chain.steps[shutter].method
    return CameraInfo(
        width,
        height,
        k,
        d,
        model,
        encodings.get(chain.result, "32FC3"),
        raw_encoding,
        camera.black_level if raw.black_level is None else raw.black_level,
        camera.white_level if raw.white_level is None else raw.white_level,
        (exposure and exposure.time) or chain.optics.exposure_time,
        chain.iso,
        noise.a * noise.signal_range if has_raw else None,
        (found.get("red_gain", red), 1.0, found.get("blue_gain", blue)),
        matrix,
        getattr(rows, "line_time", 0.0),
    )
