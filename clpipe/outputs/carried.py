"""Writes carried layers: all of them to one EXR, and depth and labels to PNGs on request."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from clpipe.base.errors import ImageError
from clpipe.base.files import Stored
from clpipe.base.types import Array
from clpipe.chain.carry import VALID
from clpipe.images.attributes import PREFIX
from clpipe.images.write import write_planes, write_png
from clpipe.inputs.carry import CarriedLayers
from clpipe.inputs.companions import CARRIED
from clpipe.outputs.sidecar import output_entries

MILLIMETRES_PER_METRE = 1000


def write_carried(path: Path, carried: CarriedLayers, layer: str = "") -> Stored:
    """Write all carried layers as an EXR, or one layer (depth in metres, or labels) as a PNG.

    The EXR contains the channels of all layers in their types, and the channel :data:`VALID`.

    Args:
        path: the file.
        carried: the layers.
        layer: the name of the layer to write as a PNG; "" writes the EXR.

    Raises:
        ImageError: the file cannot be written, or a PNG cannot hold the labels.
    """
    if layer:
        pixels = carried.arrays()[layer][..., 0]
        kind = next(each.kind for each in carried.layers if each.name == layer)
        is_label = kind == "label"
        return write_png(
            path, to_label_samples(path, pixels) if is_label else to_millimetres(pixels)
        )
    planes = {
        name: layer.pixels[..., i]
        for layer in carried.layers
        for i, name in enumerate(layer.channels)
    }
    attributes = {f"{PREFIX}{CARRIED}": ",".join(carried.arrays())}
    return write_planes(
        path, {**planes, VALID: carried.valid}, {**attributes, **carried.attributes}
    )


def png_suffix(layer: str) -> str:
    """Return the suffix of the image's name for the PNG of a layer.

    >>> png_suffix("Object Index")
    'Object_Index.png'
    """
    return f"{layer.replace(' ', '_')}.png"


def carried_files(values: Mapping[str, Any]) -> dict[str, str]:
    """Return the files of layers that a sidecar lists: the EXR, "carried", and PNGs by layer.

    Raises:
        KeyError, TypeError: the values are damaged.
    """
    layers = [str(layer["layer"]) for layer in values.get("carried", ())]
    endings = {CARRIED: f"{CARRIED}.exr", **{layer: png_suffix(layer) for layer in layers}}
    stem, listed = Path(str(values["name"])).name, output_entries(values)
    return {key: name for key, each in endings.items() if (name := f"{stem}.{each}") in listed}


def to_label_samples(path: Path, labels: Array) -> Array:
    """Return labels as uint16.

    Raises:
        ImageError: the labels are not whole numbers from 0 to 65535.
    """
    with np.errstate(invalid="ignore"):
        whole = np.rint(labels).clip(0, 65535).astype(np.uint16)
    if not np.array_equal(whole, labels):
        raise ImageError(
            f"{path}: these labels are not whole numbers from 0 to 65535, which a PNG requires; "
            "remove :png from --carry, since the EXR contains them unchanged"
        )
    return whole


def to_millimetres(depth: Array) -> Array:
    """Return depth in metres as uint16 millimetres: 0 if it is unknown or above 65.535 m.

    >>> to_millimetres(np.array([1.5, 65.535, 70, 1e10, -1, np.nan, np.inf])).tolist()
    [1500, 65535, 0, 0, 0, 0, 0]
    """
    whole = np.rint(depth.astype(np.float64) * MILLIMETRES_PER_METRE)
    return np.where((whole > 0) & (whole <= 65535), whole, 0).astype(np.uint16)
