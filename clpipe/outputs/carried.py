"""Writes the layers that go along with a picture: one EXR of all, and depth in millimetres."""

from pathlib import Path

import numpy as np

from clpipe.base.files import Stored
from clpipe.base.types import Array
from clpipe.chain.carry import VALID
from clpipe.images.attributes import PREFIX
from clpipe.images.write import write_grey_png, write_planes
from clpipe.inputs.carry import CARRIED, Aovs

MM = 1000  # in a metre


def write_carried(path: Path, carried: Aovs, depth: str = "") -> Stored:
    """Write all carried layers as an EXR, or one of them, a depth in metres, as a PNG.

    The EXR has the layers' own channels, in their own types, and the channel :data:`VALID`.

    Args:
        path: the file.
        carried: the layers.
        depth: the name of the depth for a PNG.

    Raises:
        ImageError: the file cannot be written.
    """
    if depth:
        return write_grey_png(path, millimetres(carried.arrays()[depth][..., 0]))
    planes = {
        name: layer.pixels[..., i]
        for layer in carried.layers
        for i, name in enumerate(layer.channels)
    }
    own = {f"{PREFIX}{CARRIED}": ",".join(carried.arrays())}
    return write_planes(path, {**planes, VALID: carried.valid}, {**own, **carried.attributes})


def millimetres(depth: Array) -> Array:
    """Depth in metres as whole millimetres, uint16: 0 where it is unknown, or beyond 65.535 m.

    >>> millimetres(np.array([1.5, 65.535, 70, 1e10, -1, np.nan, np.inf])).tolist()
    [1500, 65535, 0, 0, 0, 0, 0]
    """
    whole = np.rint(depth.astype(np.float64) * MM)
    return np.where((whole > 0) & (whole <= 65535), whole, 0).astype(np.uint16)
