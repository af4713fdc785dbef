"""Lights under which pictures are taken, and the white balance gains that a camera needs for them.

Their colours are those of incandescent lamps, 2500 to 4000 K, and of daylight, 4000 to 12000 K. An
estimate of gains far away from all of them was misled by the colours of the scene.
"""

from functools import lru_cache

import numpy as np

from clpipe.base.types import Doubles, Floats
from clpipe.camera.profile import SRGB_TO_XYZ, Camera, Matrix, srgb_to_camera

COOLEST, JUNCTION, WARMEST = 12000.0, 4000.0, 2500.0  # K
COUNT = 48  # lights, in equal steps of the inverse temperature
TOLERANCE = 0.08  # relative distance of a plausible gain from that of the nearest light


def chromaticity(temperature: float) -> tuple[float, float]:
    """Return CIE 1931 x and y of a light.

    Below 4000 K it is a black body (Kim et al., US patent 7024034, 2002). Above, it is daylight
    (CIE 15:2004, eq. 3.1 to 3.4).

    >>> [round(each, 3) for each in chromaticity(6504)]
    [0.313, 0.329]

    Args:
        temperature: correlated colour temperature, from 2222 K.
    """
    t = 1e3 / temperature
    if temperature < JUNCTION:
        x = -0.2661239 * t**3 - 0.2343589 * t**2 + 0.8776956 * t + 0.179910
        return x, -0.9549476 * x**3 - 1.37418593 * x**2 + 2.09137015 * x - 0.16748867
    if temperature <= 7000:
        x = -4.6070 * t**3 + 2.9678 * t**2 + 0.09911 * t + 0.244063
    else:
        x = -2.0064 * t**3 + 1.9018 * t**2 + 0.24748 * t + 0.237040
    return x, -3.000 * x**2 + 2.870 * x - 0.275


def light_in_srgb(temperature: float) -> Doubles:
    """Return a light's linear sRGB, (3,), with green 1; D65 is white.

    >>> light_in_srgb(2856).round(2).tolist()
    [2.22, 1.0, 0.28]
    """
    x, y = chromaticity(temperature)
    rgb = np.linalg.inv(SRGB_TO_XYZ) @ np.array([x / y, 1, (1 - x - y) / y])
    return np.asarray(rgb / rgb[1])


def plausible_gains(camera: Camera, daylight: tuple[float, float]) -> Floats:
    """Return the gains of red and blue for 48 lights, from warm to cool, (48, 2).

    A camera without a matrix counts as one that sees sRGB.

    >>> from clpipe.camera.profile import load_camera
    >>> camera = load_camera("sony-a7r2")
    >>> plausible_gains(camera, camera.white_balance_gains)[[0, 47]].round(1).tolist()
    [[1.399999976158142, 3.200000047683716], [3.200000047683716, 1.100000023841858]]

    Args:
        camera: its colours.
        daylight: the gains for D65, the light in which a render's white is white.
    """
    return _gains(camera.xyz_to_camera, daylight)


@lru_cache(maxsize=64)
def _gains(xyz_to_camera: Matrix | None, gains: tuple[float, float]) -> Floats:
    matrix = np.eye(3) if xyz_to_camera is None else srgb_to_camera(xyz_to_camera)
    temperatures = 1 / np.linspace(1 / WARMEST, 1 / COOLEST, COUNT)
    seen = np.array([matrix @ light_in_srgb(t) for t in temperatures])
    ratios = (seen / seen[:, 1:2])[:, [0, 2]]
    return np.ascontiguousarray(np.array(gains) / ratios, np.float32)


def limited_to_lights(gains: Floats, lights: Floats, tolerance: np.float32) -> Floats:
    """Return gains of red and blue, moved to within a tolerance of the nearest light.

    >>> lights = np.float32([[1, 3], [2, 1]])
    >>> limited_to_lights(np.float32([4, 1]), lights, np.float32(0.25)).tolist()
    [2.5, 1.0]

    Args:
        gains: (2,). Gains of 1 do not change, because they mean that there was no light.
        lights: (light, 2); none changes nothing.
        tolerance: relative to the gains of the light.
    """
    if not len(lights) or (gains == 1).all():
        return gains
    one = np.float32(1)
    nearest = lights[abs(gains / lights - one).max(1).argmin()]
    return np.clip(gains, nearest * (one - tolerance), nearest * (one + tolerance))
