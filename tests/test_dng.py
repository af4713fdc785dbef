"""DNGs, read by independent programs: LibRaw, Pillow, ExifRead."""

import io
import json

import exifread
import numpy as np
import pytest
import rawpy
from PIL import Image
from PIL.TiffImagePlugin import ImageFileDirectory_v2
from scipy.interpolate import CubicSpline

from clpipe.base.errors import ImageError
from clpipe.camera.profile import SRGB_TO_XYZ, load_camera
from clpipe.chain.making import make_chain
from clpipe.chain.settings import settings_from
from clpipe.images.dng import write_dng
from clpipe.images.raw import read_raw, read_raw_info
from clpipe.images.read import read_image
from clpipe.images.tags import Tags
from clpipe.images.write import write_display
from clpipe.outputs.negative import negative_of
from clpipe.pipeline import Pipeline
from clpipe.reference.cfa import PATTERNS
from tests.conftest import STILL_LIFE, written
from tests.conftest import cli_output as clpipe
from tests.dng import write_dng as write_raw

LINEAR = ("--skip", "denoise", "--skip", "tone_curve", "--skip", "sharpen")
LINEAR += ("--set", "gamma.method=power", "--set", "gamma.exponent=1")


@pytest.fixture
def scene(write_exr):
    """A render of any size, with all kinds of colours and light beyond white."""

    def write(height, width, name="scene.exr"):
        random = np.random.default_rng(height * width)
        return write_exr(name, random.random((height, width, 3)).astype(np.float32) * 1.2)

    return write


def read_dn(path):
    with rawpy.imread(str(path)) as raw:
        return raw.raw_image.copy()


def directories(path):
    """The first directory of a DNG and the mosaic's, as Pillow reads them."""
    data = io.BytesIO(path.read_bytes())
    with Image.open(data) as image:
        first = dict(image.tag_v2)
        below = ImageFileDirectory_v2(b"II*\0\0\0\0\0")
        data.seek(first[330][0])
        below.load(data)
        return first, dict(below)


def strip(path):
    """The mosaic of a DNG, by its directory."""
    _, raw = directories(path)
    data = np.frombuffer(path.read_bytes(), "<u2", raw[279][0] // 2, raw[273][0])
    return data.reshape(raw[257], raw[256])


@pytest.mark.parametrize("pattern", PATTERNS)
@pytest.mark.parametrize("size", [(24, 30), (37, 51)])
def test_libraw_reads_the_very_dn(scene, tmp_path, pattern, size):
    options = ("--iso", 3200, "--set", f"mosaic.pattern={pattern}", "--keep", "quantize")
    options += ("--set", "exposure.ev=1.5", "--device", "numpy")  # so that some samples are white
    clpipe("run", scene(*size), "-o", tmp_path / "o", *options, "--format", "dng")
    kept = read_image(tmp_path / "o" / "scene.quantize.exr", mosaic=True).pixels
    path = tmp_path / "o" / "scene.dng"
    assert np.array_equal(read_dn(path), kept)
    assert kept.max() == 16383
    facts = read_raw_info(path)
    assert facts.pattern == pattern
    assert facts.black_levels == (512,) * 4
    assert facts.white_level == 16383
    assert facts.gains == pytest.approx((2.77, 1.36), rel=1e-6)
    assert (facts.make, facts.model, facts.iso) == ("Sony", "ILCE-7RM2", 3200)
    real = load_camera("sony-a7r2").xyz_to_camera
    assert np.array(facts.xyz_to_camera) == pytest.approx(np.array(real), abs=3e-3)
    assert np.array_equal(read_raw(path, facts), kept)
    with rawpy.imread(str(path)) as raw:
        assert raw.color_desc == b"RGBG"
        thumb = raw.extract_thumb()
    assert thumb.data.shape == (size[0] // 2, size[1] // 2, 3)


def test_what_it_says_of_itself(tmp_path):
    shot = {"focal_length": 24, "sensor_width": 18, "exposure_time": 0.008}
    options = [o for k, v in shot.items() for o in ("--set", f"render.{k}={v}")]
    # The picture's own balance does not reach the raw.
    options += ("--set", "white_balance.method=gains", "--set", "white_balance.red_gain=2")
    clpipe("run", STILL_LIFE, "-o", tmp_path, "--iso", 1600, "--format", "dng", *options)
    path = tmp_path / "still_life.dng"
    first, raw = directories(path)
    noise = load_camera("sony-a7r2").noise(1600)
    assert first[50706] == b"\1\4\0\0"
    assert first[50778] == 21
    assert first[50708] == "clpipe Sony ILCE-7RM2"
    assert first[51041] == raw[51041] == (noise.a, noise.b) * 3
    assert [float(x) for x in first[50728]] == pytest.approx([1 / 2.77, 1, 1 / 1.36])
    assert (raw[254], raw[262], raw[258]) == (0, 32803, (16,))
    with path.open("rb") as file:
        exif = exifread.process_file(file, details=False)
    found = {name: exif[f"EXIF {name}"].values[0] for name in ("ExposureTime", "FocalLength")}
    assert {name: float(value) for name, value in found.items()} == {
        "ExposureTime": 1 / 125,
        "FocalLength": 24,
    }
    assert exif["EXIF FocalLengthIn35mmFilm"].values == [48]
    assert exif["EXIF ISOSpeedRatings"].values == [1600]
    assert float(exif["EXIF FocalPlaneXResolution"].values[0]) == pytest.approx(960 / 1.8)
    assert str(exif["Image Software"]).startswith("clpipe ")


def test_it_has_every_tag_of_a_jpeg(tmp_path):
    mosaic = np.arange(4096, dtype=np.float32).reshape(64, 64)
    shot = {"exposure": 0.01, "aperture": 2.8, "focal_length": 24.0, "sensor_width": 18.0}
    tags = Tags("Sony", "A", 100, **shot, taken="2024:05:06 07:08:09")
    write_dng(tmp_path / "a.dng", mosaic, negative_of(make_chain(settings_from({}))), tags)
    write_display(tmp_path / "a.jpg", np.zeros((64, 64, 3), np.uint8), tags)

    def read(name):
        with (tmp_path / name).open("rb") as file:
            return exifread.process_file(file, details=False)

    of_pictures = {"ColorSpace", "ComponentsConfiguration", "FlashPixVersion"}
    jpeg, dng = read("a.jpg"), read("a.dng")
    names = {k for k in jpeg if k.split()[-1] not in of_pictures | {"JPEGThumbnail"}}
    differing = {"Image Model", "Image ExifOffset"}
    for name in names - differing:
        one, other = jpeg[name].values, dng[name].values
        assert one == other or float(one[0]) == pytest.approx(float(other[0])), name
    assert names >= {"EXIF FNumber", "EXIF DateTimeOriginal", "Image DateTime"}
    assert differing <= names
    facts = read_raw_info(tmp_path / "a.dng")
    assert (facts.aperture, facts.taken) == (2.8, tags.taken)


@pytest.mark.parametrize("method", ["none", "camera"])
def test_its_matrix_is_read_as_that_of_a_camera(tmp_path, method):
    values = {"inverse_color_matrix": {"method": method}}
    negative = negative_of(make_chain(settings_from(values)))
    mosaic = np.arange(4096, dtype=np.float32).reshape(64, 64)
    write_dng(tmp_path / "a.dng", mosaic, negative, Tags("Sony", "A", 100))
    matrix = read_raw_info(tmp_path / "a.dng").xyz_to_camera
    assert np.array(matrix) == pytest.approx(negative.xyz_to_camera, abs=1e-6)
    if method == "camera":
        camera = load_camera("sony-a7r2")
        assert np.array(matrix) == pytest.approx(np.array(camera.xyz_to_camera), abs=1e-3)


def blocks(picture):
    """The means of 10 times 15 blocks of a picture of any size, (10, 15, 3)."""
    height, width = picture.shape[:2]
    return picture.reshape(10, height // 10, 15, width // 15, 3).mean((1, 3))


@pytest.mark.parametrize(
    "options",
    [
        (),
        ("--skip", "inverse_white_balance"),
        ("--set", "inverse_white_balance.red_gain=1.4", "--set", "mosaic.pattern=GBRG"),
        ("-c", "canon-5d2-jpeg", "--iso", 100),
    ],
)
def test_a_converter_gives_the_colours_of_our_own_picture(tmp_path, write_exr, options):
    half = read_image(STILL_LIFE).pixels.astype(np.float32).reshape(320, 2, 480, 2, 3)
    render = write_exr("half.exr", half.mean((1, 3)))
    formats = ("--format", "dng", "--format", "exr", "--device", "numpy")
    clpipe("run", render, "-o", tmp_path / "o", *LINEAR, *formats, *options)
    ours = read_image(tmp_path / "o" / "half.exr").pixels
    with rawpy.imread(str(tmp_path / "o" / "half.dng")) as raw:
        theirs = raw.postprocess(
            gamma=(1, 1), no_auto_bright=True, output_bps=16, use_camera_wb=True
        ) / np.float32(65535)
    means = [blocks(x) for x in (ours, theirs)]
    usable = (means[0].max(-1) < 0.9) & (means[0].min(-1) > 0.03)
    assert usable.sum() > 100
    ratio = means[1][usable] / means[0][usable]
    assert np.abs(np.median(ratio, axis=0) - 1).max() < 0.002
    assert np.abs(np.percentile(ratio, [5, 95], axis=0) - 1).max() < 0.03


@pytest.mark.slow
def test_the_preview_is_our_neutral_picture(tmp_path):
    formats = ("--format", "dng", "--format", "png", "--truth", "clean")
    plain = ("--skip", "denoise", "--skip", "sharpen", "--set", "tone_curve.method=neutral")
    clpipe("run", STILL_LIFE, "-o", tmp_path, *formats, *plain)
    with rawpy.imread(str(tmp_path / "still_life.truth_clean.dng")) as raw:
        preview = raw.extract_thumb().data
    with Image.open(tmp_path / "still_life.truth_clean.png") as picture:
        ours = np.asarray(picture)
    off = np.abs(blocks(preview) - blocks(ours)).max(-1)
    assert np.median(off) < 1.5
    assert np.percentile(off, 95) < 8  # of edges: one averages light there, the other levels


def test_adobes_software_is_told_of_our_tone_curve(tmp_path, scene):
    """The tone curve includes all gains: there is no BaselineExposure."""
    render = scene(8, 8)
    clpipe("run", render, "-o", tmp_path, "--format", "dng", "--device", "numpy")
    first, raw = directories(tmp_path / "scene.dng")
    light, tone = np.reshape(first[50940], (-1, 2)).T  # ProfileToneCurve
    assert (light[0], tone[0], light[-1], tone[-1]) == pytest.approx((0, 0, 1, 1))
    assert (np.diff(light) > 0).all()
    x = np.linspace(0, 1, 256, dtype=np.float32)
    greys = x[None, :, None].repeat(3, 2)
    ours = (
        Pipeline(device="numpy", stages=["tone_curve"], tone_curve={"method": "neutral"})
        .process(greys, "greys")
        .image
    )
    spline = CubicSpline(light, tone, bc_type="natural")  # as Adobe's software has it
    assert np.abs(spline(x) - ours[0, :, 0]).max() < 2e-3
    assert first[51110] == 1  # DefaultBlackRender: none
    assert 50730 not in {*first, *raw}  # BaselineExposure


def test_the_colour_matrix_is_of_what_the_mosaic_holds():
    camera = load_camera("sony-a7r2")
    plain = {"inverse_color_matrix": {"method": "none"}}
    rendered = negative_of(make_chain(settings_from(plain)))
    white = rendered.xyz_to_camera @ SRGB_TO_XYZ @ np.ones(3)
    assert white / white[1] == pytest.approx([1 / 2.77, 1, 1 / 1.36])  # AsShotNeutral is D65's
    red = rendered.xyz_to_camera @ SRGB_TO_XYZ @ [1, 0, 0]
    assert red / red[0] == pytest.approx([1, 0, 0], abs=1e-6)
    filtered = negative_of(make_chain(settings_from({})))
    assert filtered.xyz_to_camera == pytest.approx(np.array(camera.xyz_to_camera), abs=3e-3)


@pytest.mark.parametrize("size", [(1, 1), (1, 9), (9, 1), (2, 3), (3, 1100)])
def test_any_size_is_written(scene, tmp_path, size):
    clpipe(
        *("run", scene(*size), "-o", tmp_path / "o", "--keep", "quantize", "--format", "dng"),
        *("--device", "numpy"),
    )
    kept = read_image(tmp_path / "o" / "scene.quantize.exr", mosaic=True).pixels
    assert np.array_equal(strip(tmp_path / "o" / "scene.dng"), kept)
    first, _ = directories(tmp_path / "o" / "scene.dng")
    assert 1 <= first[256] <= 512


def test_the_same_file_whatever_else_is_written(scene, tmp_path):
    render = scene(30, 40)
    others = ("jpg", "png16", "tif", "exr")
    every = [o for name in others for o in ("--format", name)]
    clpipe("run", render, "-o", tmp_path / "a", "--format", "dng")
    clpipe("run", render, "-o", tmp_path / "b", "--format", "dng", *every, "--keep", "all")
    clpipe("run", render, "-o", tmp_path / "c", "--format", "dng", "--device", "numpy")
    clpipe("run", render, "-o", tmp_path / "d", "--format", "dng", "--until", "quantize")
    clpipe("run", render, "-o", tmp_path / "e", "--format", "dng", "--until", "normalize")
    alone = (tmp_path / "a" / "scene.dng").read_bytes()
    assert written(tmp_path / "a") == ["scene.dng", "scene.json"]
    for folder in "bcde":
        assert (tmp_path / folder / "scene.dng").read_bytes() == alone
    for name in ("jpg", "png", "tif", "exr"):
        assert (tmp_path / "b" / f"scene.{name}").is_file()
    record = json.loads((tmp_path / "b" / "scene.json").read_text())
    assert {"scene.dng", "scene.jpg", "scene.png"} <= {each["name"] for each in record["outputs"]}


def test_only_what_it_takes_is_run():
    launches = json.loads(clpipe("plan", "--format", "dng", "--json"))["launches"]
    assert launches[-1]["stages"].endswith("quantize")
    whole = json.loads(clpipe("plan", "--format", "dng", "--format", "jpg", "--json"))["launches"]
    assert len(whole) > len(launches)


def test_a_burst_has_a_dng_of_each_frame_and_of_the_truth(scene, tmp_path):
    clpipe("run", scene(24, 30), "-o", tmp_path / "o", "--frames", 2, "--format", "dng")
    names = {name: tmp_path / "o" / f"scene.{name}.dng" for name in ("truth", "frame0", "frame1")}
    assert set((tmp_path / "o").glob("*.dng")) == set(names.values())
    truth, *frames = (read_dn(path).astype(float) for path in names.values())
    assert 51041 in directories(names["frame0"])[1]
    assert 51041 not in directories(names["truth"])[1]
    assert (frames[0] != frames[1]).mean() > 0.5
    assert np.abs(np.mean(frames, axis=0) - truth).mean() < 100


@pytest.mark.slow
def test_a_kept_raw_as_a_dng_loses_nothing(scene, tmp_path):
    options = ("--iso", 800, "--set", "mosaic.pattern=GRBG", "--keep", "quantize")
    clpipe("run", scene(24, 30), "-o", tmp_path / "a", *options, "--format", "dng")
    kept = tmp_path / "a" / "scene.quantize.exr"
    again = ("--start-at", "normalize", "--format", "dng")
    clpipe("run", kept, "-o", tmp_path / "b", *again)
    one, two = (tmp_path / "a" / "scene.dng", tmp_path / "b" / "scene.quantize.dng")
    assert one.read_bytes() == two.read_bytes()


@pytest.mark.slow
def test_a_mosaic_from_elsewhere_as_a_dng(write_exr, tmp_path):
    dn = np.random.default_rng(0).integers(0, 4096, (25, 31, 1)).astype(np.float32)
    mosaic = write_exr("m.exr", dn, "Y", half=False)
    matrix = "[[1.8, -0.6, -0.2], [-0.2, 1.5, -0.3], [0, -0.5, 1.5]]"
    values = ("mosaic.pattern=BGGR", "normalize.black_level=0", "normalize.white_level=4000")
    values += ("color_matrix.method=given", f"color_matrix.matrix={matrix}")
    values += (
        "white_balance.method=gains",
        "white_balance.red_gain=2",
        "white_balance.blue_gain=3",
    )
    options = [o for value in values for o in ("--set", value)]
    clpipe(
        "run", mosaic, "-o", tmp_path / "o", "--start-at", "normalize", "--format", "dng", *options
    )
    path = tmp_path / "o" / "m.dng"
    facts = read_raw_info(path)
    assert np.array_equal(read_dn(path), dn[..., 0])
    assert (facts.pattern, facts.black_levels, facts.white_level) == ("BGGR", (0,) * 4, 4000)
    assert facts.gains == pytest.approx((2, 3))
    with rawpy.imread(str(path)) as raw:
        to_srgb = raw.color_matrix[:, :3]
    given = np.array(json.loads(matrix))
    inverse = np.linalg.inv(given)
    balanced = np.linalg.inv(inverse / inverse.sum(1, keepdims=True))
    assert to_srgb == pytest.approx(balanced, abs=0.02)


@pytest.mark.parametrize("value", [0.5, -1, 65536, np.inf])
def test_samples_that_are_no_dn_are_refused(tmp_path, value):
    chain = make_chain(settings_from({}))
    mosaic = np.full((4, 4), 600, np.float32)
    mosaic[2, 1] = value
    with pytest.raises(ImageError, match=r"a\.dng: this raw has samples that are not whole DN"):
        write_dng(tmp_path / "a.dng", mosaic, negative_of(chain), Tags("a", "b", 100))
    assert not list(tmp_path.iterdir())


def test_one_that_cannot_be_written_leaves_nothing(scene, tmp_path):
    (tmp_path / "o" / "scene.dng" / "in the way").mkdir(parents=True)
    output = clpipe("run", scene(8, 8), "-o", tmp_path / "o", "--format", "dng", status=1)
    assert "scene.dng: clpipe did not write this file" in output
    assert not written(tmp_path / "o")


@pytest.mark.parametrize("pattern", PATTERNS)
def test_a_cameras_raw_as_a_dng_loses_nothing(tmp_path, pattern):
    dn = np.random.default_rng(4).integers(400, 16384, (46, 62)).astype(np.uint16)
    write_raw(tmp_path / "shot.dng", dn, pattern, orientation=6)
    to_dng = ("--format", "dng", "--device", "numpy")
    clpipe("run", tmp_path / "shot.dng", "-o", tmp_path / "out", *to_dng)
    again = tmp_path / "out" / "shot.dng"
    assert np.array_equal(read_dn(again), dn)
    with rawpy.imread(str(tmp_path / "shot.dng")) as one, rawpy.imread(str(again)) as other:
        assert np.array_equal(one.raw_colors_visible, other.raw_colors_visible)
        assert one.black_level_per_channel == other.black_level_per_channel
        assert one.white_level == other.white_level
        assert one.sizes.flip == other.sizes.flip == 6
        ours, its = np.array(other.camera_whitebalance[:3]), np.array(one.camera_whitebalance[:3])
        assert ours / ours[1] == pytest.approx(its / its[1], rel=1e-4)
        assert np.abs(other.color_matrix - one.color_matrix).max() < 0.01


def test_of_a_raw_alone_the_clipped_pixels_are_counted(tmp_path, write_exr):
    pixels = np.full((8, 8, 3), 0.1, np.float32)
    pixels[:2] = 100
    path = write_exr("bright.exr", pixels)
    sharp = ("--skip", "optical_blur")
    result = clpipe("run", path, "-o", tmp_path, "--format", "dng", "--device", "numpy", *sharp)
    assert json.loads((tmp_path / "bright.json").read_text())["clipped"] == 0.25
    assert "25 % of its pixels are clipped" in result
