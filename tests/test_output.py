"""Output formats and the table [output]."""

import hashlib
import json
import re

import numpy as np
import OpenImageIO as oiio
import pytest
from PIL import Image

from clpipe.chain.files import load_settings
from clpipe.chain.settings import overlay, settings_from
from clpipe.images.read import read_image
from tests.conftest import STILL_LIFE
from tests.conftest import cli_output as clpipe

FORMATS = ("jpg", "png", "png16", "tif", "tif16", "tif32", "exr", "exr16")


@pytest.fixture
def scene(write_exr):
    return write_exr("scene.exr", np.random.default_rng(0).random((21, 33, 3)).astype(np.float32))


def pixels(path, kind):
    file = oiio.ImageInput.open(str(path))
    return file.spec().format.basetype, file.read_image(kind)


def test_every_format_holds_the_same_picture(scene, tmp_path):
    for name in FORMATS:
        clpipe("run", scene, "-o", tmp_path / name, "--format", name)
    made = {name: tmp_path / name / f"scene.{re.sub('[0-9]', '', name)}" for name in FORMATS}
    kind, exact = pixels(made["exr"], oiio.FLOAT)
    assert kind == oiio.FLOAT
    for name in ("png", "tif"):
        kind, found = pixels(made[name], oiio.UINT8)
        assert kind == oiio.UINT8
        assert np.array_equal(found, np.rint(exact * np.float32(255)))
    for name in ("png16", "tif16"):
        kind, found = pixels(made[name], oiio.UINT16)
        assert kind == oiio.UINT16
        assert np.array_equal(found, np.rint(exact * np.float32(65535)))
        assert len(np.unique(found)) > 1000  # not eight bits made wide
    kind, found = pixels(made["tif32"], oiio.FLOAT)
    assert kind == oiio.FLOAT
    assert np.array_equal(found, exact)
    kind, found = pixels(made["exr16"], oiio.FLOAT)
    assert kind == oiio.HALF
    assert np.array_equal(found, exact.astype(np.float16))


def test_npy_holds_the_same_values(scene, tmp_path):
    options = ("--keep", "quantize", "--keep", "demosaic", "--truth", "mosaic")
    for name in ("exr", "npy"):
        clpipe("run", scene, "-o", tmp_path / name, "--format", name, *options)
    kinds = {
        "scene": np.float16,
        "scene.quantize": np.uint16,
        "scene.demosaic": np.float32,
        "scene.truth_mosaic": np.float32,
    }
    for name, kind in kinds.items():
        found = np.load(tmp_path / "npy" / f"{name}.npy", allow_pickle=False)
        _, exact = pixels(tmp_path / "exr" / f"{name}.exr", oiio.FLOAT)
        assert found.dtype == kind
        assert np.array_equal(found, np.squeeze(exact).astype(kind))
    made = tmp_path / "npy" / "scene.npy"
    whole = made.read_bytes()
    (tmp_path / "npy" / "scene.json").unlink()  # as a kill may leave it
    clpipe("run", scene, "-o", tmp_path / "npy", "--format", "npy", *options)
    assert made.read_bytes() == whole


def test_how_well_a_png_is_compressed(scene, tmp_path):
    sizes = []
    for level in (0, 9):
        folder = tmp_path / str(level)
        options = ("--format", "png", "--set", f"output.png_compression={level}")
        clpipe("run", scene, "-o", folder, *options)
        sizes.append((folder / "scene.png").stat().st_size)
    assert sizes[0] > sizes[1]
    assert np.array_equal(*(pixels(tmp_path / n / "scene.png", oiio.UINT8)[1] for n in ("0", "9")))


def test_several_at_once_are_the_same_as_one_by_one(scene, tmp_path):
    several = ("jpg", "png16", "tif", "exr")
    options = [o for name in several for o in ("--format", name)]
    clpipe("run", scene, "-o", tmp_path / "all", *options)
    for name in several:
        clpipe("run", scene, "-o", tmp_path / name, "--format", name)
        file = f"scene.{name.removesuffix('16')}"
        assert (tmp_path / "all" / file).read_bytes() == (tmp_path / name / file).read_bytes()
    outputs = json.loads((tmp_path / "all" / "scene.json").read_text())["outputs"]
    assert [each["name"] for each in outputs] == [
        "scene.jpg",
        "scene.png",
        "scene.tif",
        "scene.exr",
    ]
    for each in outputs:
        data = (tmp_path / "all" / each["name"]).read_bytes()
        assert (each["size"], each["sha256"]) == (len(data), hashlib.sha256(data).hexdigest())


def test_light_beyond_half_is_clipped_in_half(write_exr, tmp_path):
    bright = write_exr("bright.exr", np.full((4, 4, 3), 60000, np.float32))
    options = ("--set", "exposure.ev=4", "--until", "exposure", "--format", "exr16")
    clpipe("run", bright, "-o", tmp_path / "o", *options)
    assert read_image(tmp_path / "o" / "bright.exr").pixels.max() == 65504


def test_a_configuration_says_how_files_are_written(scene, tmp_path):
    config = tmp_path / "c.toml"
    lines = ("jpeg_quality = 60", 'jpeg_subsampling = "4:2:0"', "jpeg_progressive = true")
    lines += ('date = "2026:05:04 10:30:00"',)
    config.write_text("\n".join(["iso = 400", "[output]", *lines, "[render]", "focal_length = 35"]))
    clpipe("run", scene, "-o", tmp_path / "o", "-c", config, "--set", "output.jpeg_quality=50")
    with Image.open(tmp_path / "o" / "scene.jpg") as image:
        assert image.quantization[0][0] == 16  # that of the standard's table, quality 50
        assert image.layer[0][1:3] == (2, 2)
        assert image.info["progressive"]
        assert image.getexif().get_ifd(0x8769)[0x920A] == 35
        assert image.getexif().get_ifd(0x8769)[0x9003] == "2026:05:04 10:30:00"
    record = json.loads((tmp_path / "o" / "scene.json").read_text())
    assert record["output"]["jpeg_quality"] == 50
    assert record["output"]["focal_length"] == 35
    text = clpipe("plan", "--toml", "-c", config)
    (tmp_path / "again.toml").write_text(text)
    again, first = load_settings(str(tmp_path / "again.toml")), load_settings(str(config))
    assert (again.output, again.render) == (first.output, first.render)


def test_a_render_without_a_date_gets_one_from_the_seed(scene, tmp_path):
    dates = []
    for run, seed in (("a", 5), ("b", 5), ("c", 6)):
        clpipe("run", scene, "-o", tmp_path / run, "--seed", seed)
        with Image.open(tmp_path / run / "scene.jpg") as image:
            dates.append(image.getexif().get_ifd(0x8769)[0x9003])
    assert dates == ["2020:01:06 12:00:00"] * 2 + ["2020:01:07 12:00:00"]


@pytest.mark.slow
def test_a_kept_image_knows_how_it_was_to_be_written(scene, tmp_path):
    set_ = ("--set", "output.jpeg_quality=50")
    clpipe("run", scene, "-o", tmp_path / "a", *set_, "--keep", "denoise")
    clpipe("run", tmp_path / "a" / "scene.denoise.exr", "-o", tmp_path / "b", "--start-at", "gamma")
    assert (
        json.loads((tmp_path / "b" / "scene.denoise.json").read_text())["output"]["jpeg_quality"]
        == 50
    )


def test_settings_of_a_render_are_overlaid_and_recorded():
    settings = overlay(
        settings_from({"render": {"focal_length": 24}}), {"render": {"sensor_width": 36}}
    )
    assert settings.record()["render"] == {"focal_length": 24, "sensor_width": 36}
    assert settings_from(settings.record()) == settings
    assert not {"output", "render"} & settings_from({}).record().keys()


@pytest.mark.parametrize(("text", "line"), [("output = 3", 1), ("[output]\nquality = 3", 2)])
def test_a_bad_output_table_is_named_with_its_line(tmp_path, text, line):
    (tmp_path / "c.toml").write_text(text)
    output = clpipe("run", STILL_LIFE, "-o", tmp_path, "-c", tmp_path / "c.toml", status=2)
    assert f"c.toml, line {line}: " in output


@pytest.mark.parametrize("name", ["jpg", "png", "tif"])
def test_exif_and_profile(scene, tmp_path, name):
    shot = {"focal_length": 50, "sensor_width": 24, "exposure_time": 0.01}
    options = [o for key, value in shot.items() for o in ("--set", f"render.{key}={value}")]
    clpipe("run", scene, "-o", tmp_path, "--iso", 25600, "--format", name, *options)
    with Image.open(tmp_path / f"scene.{name}") as image:
        exif = image.getexif()
        inner = exif.get_ifd(0x8769)
        assert "icc_profile" in image.info
    assert (exif[0x010F], exif[0x0110]) == ("Sony", "ILCE-7RM2")
    assert exif[0x0131].startswith("clpipe ")
    assert inner[0x829A] == pytest.approx(0.01)
    assert inner[0xA001] == 1
    assert (inner[0x920A], inner[0xA405]) == (50, 76)
    assert (inner[0xA20E], inner[0xA210]) == (pytest.approx(33 / 2.4), 3)
    if name != "tif":  # OpenImageIO has no way to put it there
        assert inner[0x8827] == 25600


def test_a_render_may_say_its_shot_and_a_request_wins(tmp_path):
    spec = oiio.ImageSpec(30, 20, 3, oiio.HALF)
    attributes = {"ExposureTime": 0.5, "effectiveFocalLength": 35.0, "isoSpeed": 50.0}
    for name, value in attributes.items():
        spec.attribute(name, value)
    spec.attribute("sensorOverallDimensions", oiio.TypeDesc("vector2"), (36.0, 24.0))
    path = tmp_path / "shot.exr"
    file = oiio.ImageOutput.create(str(path))
    assert file.open(str(path), spec) and file.write_image(np.ones((20, 30, 3), np.float32))
    assert file.close()
    assert dict(read_image(path).shot) == {
        "exposure_time": 0.5,
        "focal_length": 35.0,
        "sensor_width": 36.0,
    }
    clpipe("run", path, "-o", tmp_path / "o", "--set", "render.focal_length=70")
    with Image.open(tmp_path / "o" / "shot.jpg") as image:
        inner = image.getexif().get_ifd(0x8769)
    assert (inner[0x829A], inner[0x920A], inner[0xA405]) == (0.5, 70, 70)
    record = json.loads((tmp_path / "o" / "shot.json").read_text())
    assert record["output"]["exposure_time"] == 0.5


@pytest.mark.parametrize("value", [0.0, -1.0, float("inf"), float("nan")])
def test_a_shot_that_cannot_be_true_is_not_believed(tmp_path, value):
    spec = oiio.ImageSpec(8, 8, 3, oiio.HALF)
    spec.attribute("ExposureTime", value)
    spec.attribute("nominalFocalLength", value)
    path = tmp_path / "shot.exr"
    file = oiio.ImageOutput.create(str(path))
    assert file.open(str(path), spec) and file.write_image(np.ones((8, 8, 3), np.float32))
    assert file.close()
    assert not read_image(path).shot
