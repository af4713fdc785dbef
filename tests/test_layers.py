"""The choice of a render's picture layer: by known names, never by the alphabet."""

import json
import re

import numpy as np
import OpenEXR
import pytest

from clpipe.base.errors import ImageError, NoPictureError
from clpipe.chain.carry import AovSpec
from clpipe.images.kinds import is_aov
from clpipe.images.layers import PICTURE_LAYERS
from clpipe.images.read import ReadOptions, read_image, read_source
from clpipe.inputs.companions import LayerFinder
from clpipe.stage import Kind
from tests.conftest import run_cli

PICTURE, OTHER = (0.125, 0.25, 0.5), (4.0, 4.0, 4.0)


def write_layers(path, *names, letters="RGB", picture=0):
    """An OpenEXR file whose layers of these names hold OTHER, but for one that holds PICTURE."""
    channels = {}
    for number, name in enumerate(names):
        for letter, value in zip(letters, PICTURE if number == picture else OTHER, strict=True):
            channel = f"{name}.{letter}" if name else letter
            channels[channel] = np.full((6, 8), value, np.float32)
    OpenEXR.File({}, channels).write(str(path))
    return path


@pytest.mark.parametrize(
    "names",
    [
        ("RGB_IMAGEPIPELINE", "ALBEDO", "RGB", "MATERIAL_ID", "AVG_SHADING_NORMAL"),  # LuxCore
        ("Ci", "Albedo", "directDiffuse", "normal_var", "albedo_mse"),  # RenderMan
        ("Composite.Combined", "Another.Combined", "ViewLayer.Combined"),  # Blender
        ("ViewLayer.Combined", "ViewLayer.AO", "ViewLayer.DiffCol", "ViewLayer.Noisy Image"),
        ("Background.Combined", "Background.Albedo", "Background.CryptoObject00"),
        ("Beauty", "AO", "Denoising Albedo"),
        ("C", "albedo", "directdiffuse", "beautyunshadowed", "N"),  # Houdini
        ("FinalImage", "FinalImageMovieRenderQueue_WorldDepth", "FinalImageWorldNormal"),  # Unreal
        ("", "Ci", "beauty", "Albedo"),  # Nuke, Mitsuba, Arnold, V-Ray
        ("effectsResult", "VRayDiffuseFilter", "VRayReflection", "VRayMtlID"),  # V-Ray
        ("RGBA", "diffuse_albedo", "crypto_asset00", "shadow_matte", "sss"),  # Arnold
        ("my_image", "albedo", "sh_normal"),  # Mitsuba; unknown, but alone
        ("comp_v2", "zz_depth"),
    ],
)
def test_the_finished_picture_is_read(tmp_path, names):
    for order in (names, names[::-1]):  # whatever the order in the file, which is alphabetical
        path = write_layers(tmp_path / "a.exr", *order, picture=order.index(names[0]))
        source = read_image(path)
        assert source.layer == names[0]
        assert source.pixels[0, 0].tolist() == list(PICTURE)


@pytest.mark.parametrize("letters", [("red", "green", "blue"), ("r", "g", "b")])
def test_channels_may_be_called_by_their_colours(tmp_path, letters):
    path = write_layers(tmp_path / "a.exr", "beauty", "albedo", letters=letters)
    assert read_image(path).pixels[0, 0].tolist() == list(PICTURE)


@pytest.mark.parametrize(
    "names", [("Background.Combined", "ViewLayer.Combined"), ("fog", "sky"), ("key", "Fill")]
)
def test_of_several_candidates_none_is_taken(tmp_path, names):
    path = write_layers(tmp_path / "a.exr", *names, "normals")
    with pytest.raises(ImageError, match=r"2 layers may be the picture: .*--layer") as error:
        read_source(path, Kind.RGB, ReadOptions())
    assert all(name in str(error.value) for name in names)
    assert "normals" not in str(error.value)
    assert read_image(path, layer=names[0].lower()).layer == names[0]


@pytest.mark.parametrize("name", ["albedo", "ViewLayer.Normal", "AO", "crypto_object", "Depth"])
def test_an_aov_alone_is_no_picture_unless_it_is_named(tmp_path, name):
    path = write_layers(tmp_path / "a.exr", name)
    with pytest.raises(NoPictureError, match=f"AOVs by their names: {name}. .*--layer {name}"):
        read_source(path, Kind.RGB, ReadOptions())
    assert read_image(path, layer=name).pixels[0, 0].tolist() == list(PICTURE)


def test_names_that_only_look_like_aovs():
    names = (
        "composition",
        "normalized",
        "vinyl",
        "plaid",
        "Environment",
        "zoom",
        "beauty_denoised",
    )
    assert not [name for name in names if is_aov(name)]


def test_the_first_view_is_the_picture(tmp_path):
    parts = []
    for view, value in (("right", 0.25), ("left", 0.5)):
        planes = {letter: np.full((6, 8), value, np.float32) for letter in "RGB"}
        parts.append(OpenEXR.Part({"view": view}, planes, f"rgba_{view}"))
    OpenEXR.File(parts).write(str(tmp_path / "parts.exr"))
    source = read_image(tmp_path / "parts.exr")
    assert (source.layer, source.part, source.pixels[0, 0, 0]) == ("rgba_right", 0, 0.25)
    assert read_image(tmp_path / "parts.exr", layer="rgba_left").part == 1


def test_whole_numbers_are_ids(tmp_path):
    ids = {f"{letter}": np.full((6, 8), 7, np.uint32) for letter in "RGB"}
    OpenEXR.File({}, ids).write(str(tmp_path / "ids.exr"))
    with pytest.raises(ImageError, match=r"type uint\. Channels of type uint hold IDs or masks"):
        read_image(tmp_path / "ids.exr")
    mixed = {**ids, "R": np.zeros((6, 8), np.float32)}
    OpenEXR.File({}, mixed).write(str(tmp_path / "mixed.exr"))
    with pytest.raises(ImageError, match="type float and uint"):
        read_image(tmp_path / "mixed.exr")
    beside = {**ids, **{f"Image.{c}": np.full((6, 8), 0.5, np.float32) for c in "RGB"}}
    OpenEXR.File({}, beside).write(str(tmp_path / "beside.exr"))
    assert read_image(tmp_path / "beside.exr").layer == "Image"


def test_sidecar_and_log_record_layer_and_part(tmp_path):
    write_layers(tmp_path / "a.exr", "RGB_IMAGEPIPELINE", "ALBEDO")
    run_cli("run", tmp_path / "a.exr", "-o", tmp_path / "out", "--device", "numpy")
    sidecar = json.loads((tmp_path / "out" / "a.json").read_text())
    lines = map(json.loads, (tmp_path / "out" / "run.jsonl").read_text().splitlines())
    (line,) = [each for each in lines if each["event"] == "image"]
    for record in (sidecar, line):
        assert (record["layer"], record["part"]) == ("RGB_IMAGEPIPELINE", 0)


STEREO = {"R": 0.1, "G": 0.2, "B": 0.3, "Z": 3.0}
STEREO |= {"right.R": 0.4, "right.G": 0.5, "right.B": 0.6, "right.Z": 6.0}
VIEW_LAYERS = {f"{name}.Combined.{c}": 0.3 for name in ("beauty", "volume") for c in "RGB"}
VIEW_LAYERS |= {"beauty.Depth.Z": 3.0}


def planes_written(name, values, **header):
    planes = {c: np.full((6, 8), value, np.float32) for c, value in values.items()}
    OpenEXR.File(header, planes).write(name)


@pytest.mark.parametrize(
    ("layer", "name", "channel", "value"),
    [("right", "Z", "right.Z", 6), ("right", "Depth", "right.Z", 6), (None, "Z", "Z", 3)],
)
def test_layers_of_the_pictures_own_view_are_carried(clpipe, layer, name, channel, value):
    planes_written("a.exr", STEREO, multiView=["left", "right"])
    chosen = ("--layer", layer) if layer else ()
    clpipe("run", "a.exr", "-o", "o", "--carry", name, *chosen, "--device", "numpy")
    carried = OpenEXR.File("o/a.carried.exr", separate_channels=True).channels()
    assert set(carried) == {channel, "valid"}
    assert (carried[channel].pixels == value).all()


def test_layers_of_another_view_layer_need_their_full_name(clpipe):
    planes_written("a.exr", VIEW_LAYERS)
    run = ("run", "a.exr", "-o", "o", "--device", "numpy", "--layer", "volume.Combined")
    stderr = clpipe(*run, "--carry", "Depth", status=1).stderr
    assert "the picture is volume.Combined, and its view layer and view have no such" in stderr
    assert "The file has beauty.Depth; to carry one of these, give its full name" in stderr
    clpipe(*run, "--carry", "beauty.Depth")
    carried = OpenEXR.File("o/a.carried.exr", separate_channels=True).channels()
    assert (carried["beauty.Depth.Z"].pixels == 3).all()


@pytest.mark.parametrize(("picture", "found"), [("right", "right.Z"), ("", "Z")])
def test_a_step_finds_the_depth_of_the_pictures_own_view(tmp_path, picture, found):
    planes_written(str(tmp_path / "a.exr"), STEREO, multiView=["left", "right"])
    [source] = LayerFinder(tmp_path / "a.exr", (), picture).find(AovSpec("Depth", "depth"))
    assert source.location.name == found


# The passes and AOVs of the manuals; what is none of a picture, its data or its light is not here.
PASSES = {
    "Blender": """Combined; Depth; Mist; Position; Normal; Vector; UV; Denoising Normal;
    Denoising Albedo; Denoising Depth; IndexOB; IndexMA; DiffDir; DiffInd; DiffCol;
    GlossDir; GlossInd; GlossCol; TransDir; TransInd; TransCol; VolumeDir; VolumeInd;
    SubsurfaceDir; SubsurfaceInd; SubsurfaceCol; Emit; Env; Shadow; AO; CryptoObject00;
    CryptoMaterial00; CryptoAsset00; Noisy Image; Debug Sample Count;
    Debug Render Time; Shadow Catcher; Freestyle; Transp; Guiding Color; GreasePencil;
    Volume Scatter; Volume Transmit; Volume Majorant""",
    "Arnold": """RGBA; AA_inv_density; ID; N; Z; P; Pref; albedo; background; coat; coat_albedo;
    coat_direct; coat_indirect; cputime; diffuse; diffuse_albedo; diffuse_direct;
    diffuse_indirect; direct; emission; highlight; indirect; motionvector; opacity;
    raycount; shadow; shadow_diff; shadow_mask; shadow_matte; sheen; sheen_albedo;
    sheen_direct; sheen_indirect; specular; specular_albedo; specular_direct;
    specular_indirect; sss; sss_albedo; sss_direct; sss_indirect; transmission;
    transmission_albedo; transmission_direct; transmission_indirect; volume;
    volume_albedo; volume_direct; volume_indirect; volume_opacity; volume_Z;
    denoise_albedo; crypto_asset; crypto_material; crypto_object""",
    "V-Ray": """effectsResult; RGB color; alpha; atmosphere; background; bumpNormals; caustics;
    coatFilter; diffuse; diffuseFilter; extraTex; GI; lighting; lightSelect;
    materialID; matteShadow; MultiMatteElement; nodeID; normals; noiseLevel;
    objectSelect; rawGI; rawLight; rawReflection; rawRefraction; rawShadow; reflection;
    reflectionFilter; refraction; renderID; sampleRate; selfIllumination; shadow;
    sheenFilter; specular; SSS2; toon; totalLight; velocity; worldPositions; zDepth;
    denoiser; wireColor; lightingAnalysis""",
    "RenderMan": """Ci; albedo; beauty; cpuTime; curvature; dPcameradtime; dPdtime; dPdu; dPdv;
    dPdw;
    diffuse; diffuseU; directDiffuse; directDiffuseLobe; directSpecular; emissive; id;
    id2; indirectDiffuse; indirectSpecular; lighting; mse; motionBack; motionFore; Nn;
    Ngn; Non; normal; occluded; outsideIOR; PRadius; Pref; rawId; rayId; sampleCount;
    shadow; specular; st; subsurface; subsurfaceLobe; Tn; transmissive; unoccluded;
    variance; Vn; VLen; z; zfiltered; __depth; __Nworld; __Pworld; __st""",
    "Karma": """C; beauty; beautyunshadowed; combineddiffuse; combineddiffuseunshadowed;
    combinedemission; combinedglossyreflection; combinedvolume; coat; directdiffuse;
    directdiffuseunshadowed; directemission; directglossyreflection; directvolume;
    emission; glossyreflection; glossytransmission; indirectdiffuse; indirectemission;
    indirectglossyreflection; indirectvolume; rayorigin; raytime; sss; visiblelights;
    N; P; Pz; depth; albedo; primid; cputime; deviceoverflow; element""",
    "LuxCore": """RGB_IMAGEPIPELINE; RGBA_IMAGEPIPELINE; RGB; RGBA; ALPHA; DEPTH; POSITION;
    GEOMETRY_NORMAL; SHADING_NORMAL; AVG_SHADING_NORMAL; MATERIAL_ID; OBJECT_ID; UV;
    DIRECT_DIFFUSE; DIRECT_GLOSSY; EMISSION; INDIRECT_DIFFUSE; INDIRECT_GLOSSY;
    INDIRECT_SPECULAR; DIRECT_SHADOW_MASK; INDIRECT_SHADOW_MASK; RADIANCE_GROUP;
    SAMPLECOUNT; CONVERGENCE; RAYCOUNT; BY_MATERIAL_ID; IRRADIANCE; ALBEDO; NOISE;
    CAUSTIC""",
    "Mitsuba": """depth; position; uv; geo_normal; sh_normal; albedo; dp_du; dp_dv; duv_dx; duv_dy;
    prim_index; shape_index""",
    "Unreal": """FinalImage; LightingOnly; DetailLighting; ReflectionsOnly; Unlit; WorldNormal;
    WorldDepth; SceneDepth; MotionVectors; ObjectMaterialHashes; AmbientOcclusion;
    CustomStencil; BaseColor; Roughness; Metallic; Specular""",
}


@pytest.mark.parametrize("program", PASSES)
def test_each_published_pass_is_a_picture_or_an_aov(program):
    names = [" ".join(each.split()) for each in PASSES[program].split(";")]
    plain = {name: re.sub(r"[^a-z0-9]", "", name.lower()) for name in names}
    assert [n for n in names if not is_aov(n) and plain[n] not in PICTURE_LAYERS] == []
    assert len([n for n in names if not is_aov(n)]) <= 4  # its pictures
