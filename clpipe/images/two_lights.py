"""The colours of a raw in its own light, from a DNG's matrices for two lights.

A sensor's filters differ from the eye's, so the best matrix depends on the light. A DNG states
matrices for two lights, usually a lamp and daylight. The matrix for a light between them is
interpolated by its inverse temperature (Adobe, Digital Negative Specification 1.7, chapter 6).
"""

from typing import NamedTuple

import numpy as np

from clpipe.base.types import Doubles
from clpipe.camera.colorimetry import adaptation
from clpipe.camera.profile import SRGB_TO_XYZ

# Temperatures in K of EXIF's light sources.
TEMPERATURES = {1: 5500, 2: 4230, 3: 2856, 4: 5500, 9: 5500, 10: 6504, 11: 7504, 12: 6430, 13: 5000}
TEMPERATURES |= {14: 4230, 15: 3450, 17: 2856, 18: 4874, 19: 6774, 20: 5503, 21: 6504, 22: 7504}
TEMPERATURES |= {23: 5003, 24: 3200}
ROUNDS = 12  # until the temperature no longer changes


class Light(NamedTuple):
    """The matrix of a camera for a light, from CIE XYZ to camera RGB, and its temperature in K."""

    temperature: float
    matrix: Doubles


def temperature_of(white: Doubles) -> float:
    """Return the correlated colour temperature of a white in CIE XYZ, K (McCamy 1992).

    >>> round(temperature_of(np.array([0.95047, 1.0, 1.08883])), -1)
    6500.0
    """
    x, y = white[:2] / white.sum()
    n = (x - 0.3320) / (0.1858 - y)
    return float(((449 * n + 3525) * n + 6823.3) * n + 5520.33)


def matrix_between(one: Light, two: Light, temperature: float) -> Doubles:
    """Return the matrix for a temperature, (3, 3): that of the nearer light outside of both.

    >>> lamp, day = Light(2856, np.zeros((3, 3))), Light(6504, np.ones((3, 3)))
    >>> [matrix_between(lamp, day, t)[0, 0].round(2).item() for t in (2000, 4000, 9000)]
    [0.0, 0.51, 1.0]
    """
    first, second = 1 / one.temperature, 1 / two.temperature
    share = np.clip((1 / temperature - first) / (second - first), 0, 1)
    return np.asarray(one.matrix + share * (two.matrix - one.matrix))


def camera_to_srgb(one: Light, two: Light, neutral: Doubles) -> tuple[Doubles, float]:
    """Return the matrix from white-balanced camera RGB to linear sRGB, and the temperature in K.

    The light is the one in which grey has the camera RGB of ``neutral``. Its white becomes D65's.

    >>> camera = np.linalg.inv(SRGB_TO_XYZ)  # a camera that sees sRGB
    >>> light = Light(2856, camera), Light(6504, camera)
    >>> camera_to_srgb(*light, np.ones(3))[0].round(3).diagonal().tolist()
    [1.0, 1.0, 1.0]

    Args:
        one: the matrix for a light.
        two: the matrix for another light.
        neutral: grey in camera RGB, before white balance, (3,).
    """
    temperature = (one.temperature + two.temperature) / 2
    for _ in range(ROUNDS):
        to_xyz = np.linalg.inv(matrix_between(one, two, temperature))
        white = to_xyz @ neutral
        temperature = float(np.clip(temperature_of(white), 1000, 40000))
    adapted = adaptation(white / white[1], SRGB_TO_XYZ.sum(1)) @ to_xyz
    matrix = np.linalg.inv(SRGB_TO_XYZ) @ adapted @ np.diag(neutral) / white[1]
    return np.asarray(matrix), temperature
