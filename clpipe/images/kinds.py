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

# Layers that renderers write next to the picture: data, and single components of the light. The
# names are those in the manuals of Blender, LuxCore, RenderMan, Arnold, V-Ray, Houdini and Unreal;
# lower case, with _ between and around words.
AOV = re.compile(
    "|".join(
        (
            *(
                "albedo",
                "base_?colou?r",
                "depth",
                "normal(?!i[sz])",
                "crypto",
                "occlusion",
                "noisy",
            ),
            *(
                "denoising",
                "(?<!com)position",
                "velocity",
                "motion_?vec",
                "optical_?flow",
                "tangent",
            ),
            *("shadow", "diffuse", "gloss[yi]", "specular", "reflect", "refract", "transmi[st]"),
            *("subsurface", "emissi(on|ve)", "illuminat", "irradiance", "caustic", "indirect"),
            *("light_?(select|group)", "lighting", "wire_?colou?r", "(sample|ray)_?(rate|count)"),
            *("matte", "mask", "opacity", "convergence", "variance", "roughness", "metallic"),
            *("curvature", "cpu_?time", "(material|object|instance|render|shape|prim)_?id"),
            "_(diff|gloss|trans|volume|subsurface)_?(dir|ind|col)_",
            "_(ids?|index_?(ob|ma)|ao|nn?|p|pref|pworld|z|st|uvw?|sss|gi|mse|var)_",
            "_(emit|env|mist|alpha|mtlid|unlit|freestyle)_",
        )
    )
)


def kind_named(name: str) -> LayerKind | None:
    """What a layer holds, by its name; None where that does not say it.

    >>> kind_named("ViewLayer.CryptoObject00"), kind_named("sh_normal"), kind_named("DiffCol")
    ('label', 'normal', None)
    """
    plain = re.sub(r"[^a-z]", "", name.rpartition(".")[2].lower())
    return next((kind for kind, names in NAMES.items() if plain in names), None)


def is_aov(name: str) -> bool:
    """Whether a layer's name says that the layer is an AOV, so not the finished picture.

    Args:
        name: without the names of parts and view layers before it.

    >>> [is_aov(name) for name in ("ALBEDO", "MaterialID", "crypto_asset00", "Noisy Image", "N")]
    [True, True, True, True, True]
    >>> [is_aov(name) for name in ("Combined", "composition", "RGB_IMAGEPIPELINE", "video", "")]
    [False, False, False, False, False]
    """
    words = re.findall(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+", name)
    return bool(kind_named(name) or AOV.search(f"_{'_'.join(words)}_".lower()))


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
