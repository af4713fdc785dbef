"""What the layers of a render hold, by their names."""

import re

from clpipe.reference.carried import LayerKind, Vector

# What layers hold, by their names in Blender, Mitsuba and elsewhere: lower case, letters alone.
NAMES: dict[LayerKind, tuple[str, ...]] = {
    "depth": ("depth", "z", "zdepth", "mist", "distance"),
    "label": (
        *("indexob", "indexma", "objectindex", "materialindex", "objectid", "materialid", "id"),
        *("index", "instance", "instanceid", "label", "labels", "segmentation", "seg", "semantic"),
        *("mask", "crypto", "cryptoobject", "cryptomaterial", "cryptoasset", "cryptomatte"),
        *("shapeindex", "primindex", "ids"),
    ),
    "normal": ("normal", "normals", "shnormal", "geonormal", "shadingnormal", "denoisingnormal"),
    "flow": (
        "vector",
        "flow",
        "opticalflow",
        "motion",
        "motionvector",
        "motionvectors",
        "velocity",
    ),
    "colour": ("albedo", "basecolor", "basecolour"),
}

CHANNELS: dict[LayerKind, int] = {"flow": 2, "normal": 3}  # at least


def kind_named(name: str) -> LayerKind | None:
    """What a layer holds, by its name; None where that does not say it.

    >>> kind_named("ViewLayer.CryptoObject00"), kind_named("sh_normal"), kind_named("DiffCol")
    ('label', 'normal', None)
    """
    plain = re.sub(r"[^a-z]", "", name.rpartition(".")[2].lower())
    return next((kind for kind, names in NAMES.items() if plain in names), None)


def vectors_of(name: str, channels: tuple[str, ...]) -> tuple[Vector, ...]:
    """The vectors of a flow: of each the channels to the right and down, and their signs.

    They point right and down, to where a surface is seen in the other frame, but in Blender's
    Vector, whose Y and W point up: X and Y go to the frame before, Z and W come from the next one.

    Args:
        name: of the layer.
        channels: the names of its channels; one alone is no vector.

    >>> vectors_of("Vector", ("X", "Y", "Z", "W"))
    (((0, 1), (1, -1)), ((2, -1), (3, 1)))
    >>> vectors_of("flow", ("R", "G", "B"))
    (((0, 1), (1, 1)),)
    """
    if name.rpartition(".")[2].lower() == "vector" and len(channels) == 4:
        return ((0, 1), (1, -1)), ((2, -1), (3, 1))
    return tuple(((i, 1), (i + 1, 1)) for i in range(0, len(channels) - 1, 2))
