"""CIE colorimetry: chromatic adaptation and CIELAB."""

import numpy as np

from clpipe.base.types import Array, Doubles
from clpipe.camera.profile import SRGB_TO_XYZ

# Cone response of the Bradford transform (Lam 1985), after B. Lindbloom, "Chromatic Adaptation".
BRADFORD = np.array(
    [[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]]
)


def adaptation(source_white: Array, target_white: Array) -> Array:
    """The 3x3 matrix on CIE XYZ that maps one white to another (linear Bradford transform).

    Args:
        source_white: X, Y and Z.
        target_white: X, Y and Z.
    """
    gains = (BRADFORD @ target_white) / (BRADFORD @ source_white)
    return np.linalg.inv(BRADFORD) @ (gains[:, None] * BRADFORD)


def lab_of(light: Doubles) -> Doubles:
    """Convert linear sRGB to CIELAB under D65, (..., 3)."""
    ratio = light @ (SRGB_TO_XYZ / SRGB_TO_XYZ.sum(1, keepdims=True)).T
    cubes = ratio > (6 / 29) ** 3
    x, y, z = np.moveaxis(
        np.where(cubes, np.cbrt(ratio), ratio * (29 / 6) ** 2 / 3 + 4 / 29), -1, 0
    )
    return np.stack([116 * y - 16, 500 * (x - y), 200 * (y - z)], axis=-1)
