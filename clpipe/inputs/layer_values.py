"""Checks the values of layers: labels are whole, hashes exact, normals vectors of length 1."""

import numpy as np

from clpipe.base.errors import ImageError
from clpipe.base.types import Array
from clpipe.reference.carried import LayerKind

CRYPTOMATTE = "crypto"  # part of the names of Cryptomatte's layers, in any case
LENGTH = (0.9, 1.1)  # of normals; compression and antialiasing change them little


def value_warnings(name: str, kind: LayerKind, pixels: Array) -> list[str]:
    """Return sentences about values of a layer that cannot mean what its kind says.

    >>> value_warnings("IndexOB", "label", np.float32([[[1.0], [1.5]]]))[0][:56]
    '1 of 2 values of its layer IndexOB are not whole, the fi'

    Args:
        name: the name of the layer.
        kind: the kind of its values.
        pixels: the values, (row, column, channel), as stored.

    Raises:
        ImageError: it is a Cryptomatte whose hashes are rounded.
    """
    if CRYPTOMATTE in name.lower() and pixels.dtype == np.float16:
        raise ImageError(
            f"its layer {name} has half floats, which round the hashes of a Cryptomatte; render "
            "this layer with 32-bit floats"
        )
    if pixels.dtype.kind != "f" or not pixels.size:
        return []
    check = {"label": _of_labels, "normal": _of_normals, "depth": _of_depth}.get(kind)
    return check(name, pixels) if check else []


def _of_labels(name: str, pixels: Array) -> list[str]:
    if CRYPTOMATTE in name.lower():
        return []
    wrong = np.argwhere(np.isfinite(pixels) & (pixels != np.rint(pixels)))
    if not len(wrong):
        return []
    row, column, channel = wrong[0].tolist()
    return [
        f"{len(wrong)} of {pixels.size} values of its layer {name} are not whole, the first at "
        f"column {column}, row {row}: {pixels[row, column, channel]:g}. Labels mix at antialiased "
        "edges; render this layer without antialiasing"
    ]


def _of_normals(name: str, pixels: Array) -> list[str]:
    if pixels.shape[2] < 3:
        return []
    vectors = pixels[..., :3].astype(np.float32)
    squares = np.square(vectors).sum(-1)
    vectors = vectors[np.isfinite(squares) & (squares > 0)]
    if not len(vectors):
        return []
    length, decoded = (
        float(np.median(np.sqrt(np.square(each).sum(-1)))) for each in (vectors, 2 * vectors - 1)
    )
    if float(vectors.min()) >= 0 and LENGTH[0] <= decoded <= LENGTH[1]:
        return [f"normals of its layer {name} are stored as 0 to 1; write them as -1 to 1"]
    if LENGTH[0] <= length <= LENGTH[1]:
        return []
    return [f"normals of its layer {name} have a length of {length:.2g} instead of 1"]


def _of_depth(name: str, pixels: Array) -> list[str]:
    if (np.nan_to_num(pixels, nan=0) > 0).any():
        return []
    return [
        f"no depth of its layer {name} is above 0, so no pixel is valid; write distances from the "
        "camera"
    ]
