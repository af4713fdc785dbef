"""An image's camera pose: world to camera in OpenCV's axes.

x_cam = R X + t, where x_cam points to the right, y_cam down and z_cam into the scene. File formats
differ. COLMAP uses the same with R as a quaternion. NeRF's poses map the camera to the world in
OpenGL's axes, where y points up and z out of the scene.
"""

from collections.abc import Sequence
from typing import TypeAlias

import numpy as np

from clpipe.base.types import Array

Vector: TypeAlias = tuple[float, float, float]
Matrix: TypeAlias = tuple[Vector, Vector, Vector]

OPENGL = np.diag([1.0, -1.0, -1.0])  # converts between OpenCV's axes and OpenGL's

TOLERANCE = 1e-3  # largest element of R R^T - 1; text files may be rounded to four digits


def rotation(rows: Matrix) -> Matrix:
    """Return a matrix that is checked to be a rotation.

    Raises:
        ValueError: it is not a rotation; the message states why.
    """
    r = np.array(rows, np.float64)
    with np.errstate(all="ignore"):
        off = float(np.abs(r @ r.T - np.eye(3)).max())
        determinant = float(np.linalg.det(r)) if np.isfinite(r).all() else np.nan
    if not off <= TOLERANCE:
        lengths = ", ".join(f"{length:.4g}" for length in np.sqrt((r * r).sum(1)))
        raise ValueError(
            f"not a rotation: its rows have the lengths {lengths}, and R R^T differs from 1 by "
            f"{off:.2g}; remove scale and shear from it"
        )
    if determinant < 0:
        raise ValueError("not a rotation but a reflection: its determinant is -1; flip one axis")
    return rows


def from_opengl(matrix: Array) -> tuple[Array, Array]:
    """Return R and t of a pose from camera to world in OpenGL's axes, (3 or 4, 4) float64.

    >>> r, t = from_opengl(np.array([[1.0, 0, 0, 5], [0, 1, 0, 6], [0, 0, 1, 7]]))
    >>> r.diagonal().tolist(), t.tolist()
    ([1.0, -1.0, -1.0], [-5.0, 6.0, 7.0])
    """
    r = OPENGL @ matrix[:3, :3].T
    return r + 0.0, -(r @ matrix[:3, 3]) + 0.0  # adding 0.0 turns -0.0 into 0.0


def to_opengl(rows: Matrix, t: Vector) -> Array:
    """Invert :func:`from_opengl`, (4, 4) float64."""
    r = np.array(rows, np.float64)
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = r.T @ OPENGL, -(r.T @ np.array(t, np.float64))
    return matrix + 0.0


def from_quaternion(q: Sequence[float]) -> Array:
    """Return the rotation of a quaternion w, x, y, z of any length but 0, (3, 3) float64.

    >>> from_quaternion([2.0, 0, 0, 2.0]).round(12).tolist()
    [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]
    """
    w, x, y, z = np.array(q, np.float64) / np.linalg.norm(q)
    half = [
        [0.5 - y * y - z * z, x * y - w * z, x * z + w * y],
        [x * y + w * z, 0.5 - x * x - z * z, y * z - w * x],
        [x * z - w * y, y * z + w * x, 0.5 - x * x - y * y],
    ]
    return 2 * np.array(half)


def to_quaternion(rows: Matrix) -> Array:
    """Return the unit quaternion w, x, y, z of a rotation, with w not negative.

    It starts from its largest element, so that no division is by a small one (Shepperd 1978).

    >>> to_quaternion(((1.0, 0, 0), (0, -1.0, 0), (0, 0, -1.0))).tolist()
    [0.0, 1.0, 0.0, 0.0]
    """
    (a, b, c), (d, e, f), (g, h, i) = rows
    columns = np.array(
        [
            [1 + a + e + i, h - f, c - g, d - b],
            [h - f, 1 + a - e - i, b + d, c + g],
            [c - g, b + d, 1 - a + e - i, f + h],
            [d - b, c + g, f + h, 1 - a - e + i],
        ]
    )
    q = columns[int(np.argmax(columns.diagonal()))]
    return q / np.linalg.norm(q) * (-1.0 if q[0] < 0 else 1.0) + 0.0
