"""Image files: the correct picture or the correct error."""

import io

import numpy as np
import pytest
from PIL import Image, ImageCms

from clpipe.base.errors import ImageError
from clpipe.images.layers import picture_channels
from clpipe.images.pixels import display_window
from clpipe.images.read import read_finished, read_image
from clpipe.images.samples import holds_mosaic
from clpipe.images.tags import Tags, exif
from clpipe.images.write import write_display, write_exr
from tests.conftest import file_limit


def ramp(height=6, width=9, channels=3):
    count = height * width * channels
    return (np.arange(count, dtype=np.float32) / 64).reshape(height, width, channels)


@pytest.mark.parametrize("half", [True, False])
def test_half_stays_half(write_exr, half):
    source = read_image(write_exr("a.exr", ramp(), half=half))
    assert source.pixels.dtype == (np.float16 if half else np.float32)
    assert np.array_equal(source.pixels, ramp())


@pytest.mark.parametrize(
    ("channels", "layer", "order"),
    [
        ("B,G,R", "", (2, 1, 0)),
        ("A,B,G,R,Z", "", (3, 2, 1)),
        ("r,g,b", "", (0, 1, 2)),
        ("ViewLayer.Combined.A,ViewLayer.Combined.B,ViewLayer.Combined.G,ViewLayer.Combined.R",
         "ViewLayer.Combined", (3, 2, 1)),
        ("ViewLayer.Depth.Z,ViewLayer.DiffCol.R,ViewLayer.DiffCol.G,ViewLayer.DiffCol.B,"
         "ViewLayer.Combined.R,ViewLayer.Combined.G,ViewLayer.Combined.B",
         "ViewLayer.Combined", (4, 5, 6)),
    ],
)  # fmt: skip
def test_rgb_is_found_by_name(write_exr, channels, layer, order):
    pixels = ramp(channels=len(channels.split(",")))
    source = read_image(write_exr("layers.exr", pixels, channels))
    assert source.layer == layer
    assert np.array_equal(source.pixels, pixels[..., list(order)])
    names = channels.split(",")
    assert picture_channels(names) == (layer, order)


def test_infinity_becomes_bright_and_nan_black_and_both_are_counted(write_exr):
    pixels = ramp()
    pixels[0, 0, 0], pixels[1, 2, 1], pixels[3, 3, 2] = np.nan, np.inf, -np.inf
    for half in (True, False):
        source = read_image(write_exr("nan.exr", pixels, half=half))
        assert source.warnings == (
            "1 sample was infinite and was set to 65504, the largest half",
            "2 samples were NaN or -infinite and were set to 0",
        )
        assert np.isfinite(source.pixels).all()
        assert source.pixels[1, 2, 1] == 65504 and source.pixels[0, 0, 0] == 0
        assert source.pixels[5, 5, 1] == pixels[5, 5, 1]


def test_light_beyond_half_is_clipped(write_exr):
    pixels = ramp()
    pixels[0, 0, 0], pixels[1, 1, 1] = 3e38, -1e30
    source = read_image(write_exr("bright.exr", pixels, half=False))
    assert source.pixels[0, 0, 0] == 65504
    assert source.pixels[1, 1, 1] == -65504
    assert "2 samples beyond 65504" in source.warnings[0]


def test_the_display_window_is_the_picture(write_exr):
    pixels = ramp(4, 5)
    windows = {"x": 2, "y": 1, "full_width": 10, "full_height": 8}
    source = read_image(write_exr("small.exr", pixels, **windows))
    assert source.pixels.shape == (8, 10, 3)
    assert np.array_equal(source.pixels[1:5, 2:7], pixels)
    assert source.pixels.sum(dtype=np.float64) == pytest.approx(pixels.sum())
    windows = {"full_x": 1, "full_y": 2, "full_width": 3, "full_height": 2}
    source = read_image(write_exr("large.exr", pixels, **windows))
    assert np.array_equal(source.pixels, pixels[2:4, 1:4])
    assert display_window(pixels, 50, 0, 3, 3).sum() == 0


def test_not_an_image(tmp_path):
    for name, data in (("a.exr", b""), ("b.exr", b"hello" * 99), ("c.jpg", b"\xff\xd8\xff\xe0")):
        path = tmp_path / name
        path.write_bytes(data)
        reason = "empty" if not data else "cannot be read as an image"
        with pytest.raises(ImageError, match=f"{name}: .*{reason}"):
            read_image(path)
    with pytest.raises(ImageError, match="no such file"):
        read_image(tmp_path / "missing.exr")
    with pytest.raises(ImageError, match="cannot be read"):
        read_image(tmp_path)


def test_eight_bit_files_are_not_linear(tmp_path):
    path = tmp_path / "photo.png"
    Image.new("RGB", (4, 4)).save(path)
    with pytest.raises(ImageError, match=r"photo\.png: this PNG file has samples of type uint8"):
        read_image(path)


def test_finished_pictures_are_read_as_they_are_encoded(tmp_path, write_exr):
    pixels = np.random.default_rng(0).integers(0, 256, (40, 60, 3), np.uint8)
    for name in ("a.png", "a.tif", "a.jpg"):
        Image.fromarray(pixels).save(tmp_path / name, quality=100, subsampling=0)
        found = read_finished(tmp_path / name).pixels
        assert found.dtype == np.float32
        near = 5 if name == "a.jpg" else 1e-4
        assert np.abs(found * 255 - pixels).max() < near
    with_alpha = np.concatenate([pixels, np.full_like(pixels[..., :1], 255)], axis=-1)
    Image.fromarray(with_alpha).save(tmp_path / "alpha.png")
    assert np.abs(read_finished(tmp_path / "alpha.png").pixels * 255 - pixels).max() < 1e-4
    assert read_finished(write_exr("linear.exr", ramp())) is None
    Image.fromarray(pixels[..., 0]).save(tmp_path / "grey.png")
    assert read_finished(tmp_path / "grey.png") is None
    (tmp_path / "cut.png").write_bytes((tmp_path / "a.png").read_bytes()[:2000])
    with pytest.raises(ImageError, match=r"cut\.png: damaged"):
        read_finished(tmp_path / "cut.png")


def test_what_may_be_a_mosaic(write_exr):
    assert holds_mosaic(write_exr("y.exr", ramp(channels=1), "Y"))
    assert holds_mosaic(write_exr("ya.exr", ramp(channels=2), "Y,A"))
    assert not holds_mosaic(write_exr("rgb.exr", ramp()))
    assert not holds_mosaic(write_exr("xy.exr", ramp(channels=2), "x,y"))


def test_jpeg_is_as_a_camera_writes_it(tmp_path):
    pixels = np.random.default_rng(0).integers(0, 256, (40, 60, 3), np.uint8)
    write_display(tmp_path / "a.jpg", pixels, Tags("Sony", "ILCE-7RM2", 3200))
    with Image.open(tmp_path / "a.jpg") as image:
        assert [layer[1:3] for layer in image.layer] == [(2, 1), (1, 1), (1, 1)]  # 4:2:2
        assert image.quantization[0][0] == 1  # quality 97: 16 * 0.06, rounded
        exif = image.getexif()
        profile = ImageCms.ImageCmsProfile(io.BytesIO(image.info["icc_profile"]))
    assert (exif[0x010F], exif[0x0110]) == ("Sony", "ILCE-7RM2")
    assert exif.get_ifd(0x8769)[0x8827] == 3200
    assert "sRGB" in ImageCms.getProfileDescription(profile)


@pytest.mark.parametrize("name", ["a.jpg", "a.png", "a.tif", "a.exr"])
def test_a_picture_that_may_not_be_written_does_not_end_the_process(tmp_path, name):
    def write():
        if name == "a.exr":
            return write_exr(tmp_path / name, np.zeros((32, 32, 3), np.float32), "RGB", {})
        return write_display(tmp_path / name, np.zeros((32, 32, 3), np.uint8), Tags("", "", 100))

    for size in (1, 600):
        with file_limit(size), pytest.raises(ImageError, match=rf"{name}: cannot be written: File"):
            write()
        assert not list(tmp_path.iterdir())
    size = write().size
    assert [path.stat().st_size for path in tmp_path.iterdir()] == [size]


@pytest.mark.parametrize(
    "size", [(400, 400), (300, 400), (800, 1200), (1080, 1920), (400, 300), (1200, 800)]
)
def test_the_equivalent_focal_length_is_by_diagonals(size):
    values = exif(Tags("", "", 100, focal_length=50.0, sensor_width=23.0), *size)
    pixels = 50 / 23 * max(size)  # the focal length
    equivalent = pixels / np.hypot(*size) * 43.27  # 43.27 mm: the diagonal of 36 mm by 24 mm
    assert values["FocalLengthIn35mmFilm"] == pytest.approx(equivalent, abs=0.501)
    assert values["FocalPlaneXResolution"] / 10 * 50 == pytest.approx(pixels)
