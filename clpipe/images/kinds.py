"""Finds the kind of a render's layer from its name."""

import re

from clpipe.reference.carried import LayerKind, Vector

# Kinds of layers by their names in Blender, Mitsuba and others, in lower-case letters.
KIND_NAMES: dict[LayerKind, tuple[str, ...]] = {
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

BLENDER_VECTORS: tuple[Vector, ...] = ((0, 1), (1, -1)), ((2, -1), (3, 1))

MIN_CHANNELS: dict[LayerKind, int] = {"flow": 2, "normal": 3}  # smallest number of channels

# Layers that renderers write next to the picture, as their manuals name them, without spaces.
AOVS = {
    "Blender": "Position UV DenoisingAlbedo Freestyle GreasePencil NoisyImage DebugSampleCount "
    "DebugRenderTime GuidingColor VolumeScatter VolumeTransmit VolumeMajorant",
    "Blender's light": "DiffDir DiffInd DiffCol GlossDir GlossInd GlossCol TransDir TransInd "
    "TransCol VolumeDir VolumeInd SubsurfaceDir SubsurfaceInd SubsurfaceCol Emit Env Shadow AO "
    "ShadowCatcher Transp",
    "Arnold": "AA_inv_density N P Pref background coat coat_direct coat_indirect cputime diffuse "
    "diffuse_direct direct emission highlight indirect opacity raycount shadow_matte sheen "
    "sheen_direct specular sss transmission volume volume_direct volume_opacity volume_Z",
    "V-Ray": "alpha bumpNormals extraTex MultiMatteElement matteShadow nodeID noiseLevel renderID "
    "objectSelect sampleRate worldPositions denoiser wireColor coatFilter diffuseFilter "
    "sheenFilter",
    "V-Ray's light": "atmosphere caustics GI lighting lightSelect rawGI rawLight rawReflection "
    "rawRefraction rawShadow reflection refraction selfIllumination SSS2 toon totalLight",
    "RenderMan": "curvature dPcameradtime dPdtime dPdu dPdv dPdw mse motionBack motionFore Nn Ngn "
    "Non outsideIOR PRadius rawId rayId sampleCount st Tn variance Vn VLen zfiltered Nworld Pworld",
    "RenderMan's light": "directDiffuse directSpecular emissive indirectDiffuse indirectSpecular "
    "occluded unoccluded subsurface transmissive",
    "Karma": "beautyunshadowed combineddiffuse combinedemission combinedglossyreflection "
    "combinedvolume directdiffuse directemission directvolume glossyreflection glossytransmission "
    "rayorigin raytime visiblelights Pz primid deviceoverflow element",
    "LuxCore": "GEOMETRY_NORMAL SHADING_NORMAL AVG_SHADING_NORMAL DIRECT_DIFFUSE DIRECT_GLOSSY "
    "INDIRECT_GLOSSY DIRECT_SHADOW_MASK RADIANCE_GROUP CONVERGENCE BY_MATERIAL_ID IRRADIANCE NOISE",
    "Mitsuba": "dp_du dp_dv duv_dx duv_dy prim_index shape_index",
    "Unreal": "LightingOnly DetailLighting ReflectionsOnly Unlit WorldNormal WorldDepth SceneDepth "
    "ObjectMaterialHashes AmbientOcclusion CustomStencil Roughness Metallic",
}
_AOV_NAMES = {
    re.sub(r"[^a-z0-9]", "", each.lower()) for all_ in AOVS.values() for each in all_.split()
}
# Parts of their names, also for layers that are not listed, in lower case, with _ between and
# around words.
AOV_PATTERN = re.compile(
    "albedo|base_?colou?r|depth|normal(?!i[sz])|crypto|occlusion|noisy|denoising|(?<!com)position"
    "|velocity|motion_?vec|optical_?flow|tangent|shadow|diffuse|gloss[yi]|specular|reflect|refract"
    "|transmi[st]|subsurface|emissi(on|ve)|illuminat|irradiance|caustic|indirect"
    "|light_?(select|group)|lighting|wire_?colou?r|(sample|ray)_?(rate|count)|matte|mask|opacity"
    "|convergence|variance|roughness|metallic|curvature|cpu_?time"
    "|(material|object|instance|render|shape|prim)_?id"
    "|_(diff|gloss|trans|volume|subsurface)_?(dir|ind|col)_"
    "|_(ids?|index_?(ob|ma)|ao|nn?|p|pref|pworld|z|st|uvw?|sss|gi|mse|var)_"
    "|_(emit|env|mist|alpha|mtlid|unlit|freestyle)_"
)


def kind_from_name(name: str) -> LayerKind | None:
    """Return the kind of a layer with this name; None if the name does not tell.

    >>> kind_from_name("ViewLayer.CryptoObject00"), kind_from_name("sh_normal")
    ('label', 'normal')
    >>> kind_from_name("DiffCol")
    """
    plain = re.sub(r"[^a-z]", "", name.rpartition(".")[2].lower())
    return next((kind for kind, names in KIND_NAMES.items() if plain in names), None)


def is_aov(name: str) -> bool:
    """Return whether a layer is an AOV by its name, and so not the finished picture.

    Args:
        name: the name, without those of parts and view layers before it.

    >>> [is_aov(name) for name in ("ALBEDO", "MaterialID", "crypto_asset00", "Noisy Image", "N")]
    [True, True, True, True, True]
    >>> [is_aov(name) for name in ("Combined", "composition", "RGB_IMAGEPIPELINE", "video", "")]
    [False, False, False, False, False]
    """
    if re.sub(r"[^a-z0-9]", "", name.lower()) in _AOV_NAMES:
        return True
    words = re.findall(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+", name)
    return bool(kind_from_name(name) or AOV_PATTERN.search(f"_{'_'.join(words)}_".lower()))


def flow_vectors(name: str, channels: tuple[str, ...]) -> tuple[Vector, ...]:
    """Return the vectors of a flow layer: for each, the channels of x and y, and their signs.

    Vectors point right and down, to the place of the surface in the other frame. Blender's Vector
    differs: Y and W point up, X and Y lead to the previous frame, Z and W come from the next.

    Args:
        name: the name of the layer.
        channels: the names of its channels.

    >>> flow_vectors("Vector", ("X", "Y", "Z", "W"))
    (((0, 1), (1, -1)), ((2, -1), (3, 1)))
    >>> flow_vectors("flow", ("R", "G", "B"))
    (((0, 1), (1, 1)),)
    """
    if name.rpartition(".")[2].lower() == "vector" and len(channels) == 4:
        return BLENDER_VECTORS
    return tuple(((i, 1), (i + 1, 1)) for i in range(0, len(channels) - 1, 2))


def flow_directions(names: str, channels: tuple[str, ...]) -> tuple[int, ...]:
    """Return for each vector of a flow layer whether it leads forward (1) or back (-1) in time.

    The first vector of Blender's Vector leads back. Other layers lead back if a name says so.

    Args:
        names: the names of the layer, in its file and in ``--carry``.
        channels: the names of its channels.

    >>> flow_directions("Vector", ("X", "Y", "Z", "W")), flow_directions("flow_to_prev", ("X", "Y"))
    ((-1, 1), (-1,))
    """
    vectors = flow_vectors(names, channels)
    if vectors == BLENDER_VECTORS:
        return -1, 1
    return (-1 if re.search("back|bwd|prev", names.lower()) else 1,) * len(vectors)
