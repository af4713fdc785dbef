"""Photometry in EXIF and sidecars matches the processing."""

import json
import math
from io import BytesIO
from itertools import pairwise
from pathlib import Path

import exifread
import numpy as np
import pytest
from PIL import Image

from clpipe.images.exif_block import with_lens_model
from clpipe.images.tags import Tags
from clpipe.images.write import write_display
from tests.conftest import values_of

RUN = ("--device", "numpy", "--skip", "noise", "--format", "png", "--format", "exr")
PHOTOMETRIC = ("--set", "exposure.method=photometric", "--set", "exposure.scale=400")
SHOT = ("--set", "render.exposure_time=0.02")
PLAIN = ("--skip", "sharpen", "--skip", "denoise", "--skip", "optical_blur")


@pytest.fixture
def grey(write_exr):
    """A render of a grey, and one of twice its light."""
    write_exr("in/a.exr", np.full((24, 36, 3), 0.15, np.float32))
    write_exr("in/b.exr", np.full((24, 36, 3), 0.3, np.float32))


def exif(path):
    with Image.open(path) as image:
        return image.getexif().get_ifd(0x8769)


def photometry_of(path):
    return values_of(path)["photometry"]


def light(folder, name):
    """The light of a picture's middle, by the inverse of its response."""
    with Image.open(folder / f"{name}.png") as image:
        codes = np.asarray(image, np.float64)[8:16, 12:24].mean((0, 1)) / 255
    inverse = photometry_of(folder / f"{name}.json")["response"]["inverse"]
    return np.interp(codes, np.arange(256) / 255, inverse)[1]


def exposure(tags):
    """t S / N^2, as trainers of radiance fields take it of EXIF."""
    return float(tags[0x829A]) * tags[0x8827] / float(tags[0x829D]) ** 2


def test_exif_alone_has_the_factor_between_pictures(clpipe, grey):
    table = "iso,exposure.exposure_time,aperture,exposure.ev"
    rows = [(100, 0.01, 4, 0), (800, 0.004, 5.6, 0), (1600, 0.01, 11, -0.5), (100, 0.02, 4, 1)]
    text = "".join(f"in/a.exr,{i},{','.join(map(str, row))}\n" for i, row in enumerate(rows))
    Path("m.csv").write_text(f"path,name,{table}\n{text}")
    clpipe("run", "m.csv", "-o", "o", *RUN, *PHOTOMETRIC)
    found = [(exposure(exif(f"o/{i}.png")), light(Path("o"), str(i))) for i in range(4)]
    for (one, seen), (other, also_seen) in pairwise(found):
        assert seen / also_seen == pytest.approx(one / other, rel=0.02)


def test_a_bracket_is_one_of_the_shutter(clpipe, grey):
    clpipe("run", "in/a.exr", "-o", "o", *RUN, *SHOT, "--bracket", "-1,0,2")
    tags = {ev: exif(f"o/a.ev{ev:+d}.png") for ev in (-1, 0, 2)}
    assert {ev: float(each[0x9204]) for ev, each in tags.items()} == {-1: -1, 0: 0, 2: 2}
    assert [float(each[0x829A]) for each in tags.values()] == pytest.approx([0.01, 0.02, 0.08])
    seen = light(Path("o"), "a.ev+0")
    assert light(Path("o"), "a.ev-1") == pytest.approx(seen / 2, rel=0.02)
    assert light(Path("o"), "a.ev+2") == pytest.approx(4 * seen, rel=0.02)


def test_what_is_metered_is_said(clpipe, grey):
    clpipe("run", "in", "-o", "o", *RUN, *SHOT, "--set", "exposure.method=auto")
    one, other = exif("o/a.png"), exif("o/b.png")
    assert float(one[0x829A]) == pytest.approx(2 * float(other[0x829A]), rel=0.01)
    assert float(one[0x9204]) - float(other[0x9204]) == pytest.approx(1, abs=0.01)
    assert photometry_of("o/a.json")["ev"] == pytest.approx(math.log2(0.18 / 0.15), abs=0.01)


def test_a_picture_made_of_a_kept_image_says_the_same(clpipe, grey):
    given = (*SHOT, "--set", "exposure.ev=1.5", "--keep", "quantize", "--skip", "noise")
    clpipe("run", "in/a.exr", "-o", "o", "--device", "numpy", *given)
    clpipe("run", "o/a.quantize.exr", "-o", "p", "--device", "numpy", "--start-at", "normalize")
    assert Path("o/a.jpg").read_bytes() == Path("p/a.quantize.jpg").read_bytes()
    assert float(exif("o/a.jpg")[0x9204]) == 1.5


def test_no_exposure_time_is_made_up(clpipe, grey):
    clpipe("run", "in/a.exr", "-o", "o", *RUN)
    assert 0x829A not in exif("o/a.png") and float(exif("o/a.png")[0x9204]) == 0
    assert photometry_of("o/a.json")["exposure_time"] is None
    clpipe("run", "in/a.exr", "-o", "p", *RUN, *PHOTOMETRIC)
    tags = exif("p/a.png")  # what is used where nothing is set
    assert (float(tags[0x829A]), float(tags[0x829D])) == (pytest.approx(0.01), 8)


def test_focus_and_defaults_are_said_and_shared(clpipe, write_exr):
    write_exr("in/a.exr", np.full((24, 36, 3), 0.05, np.float32))
    write_exr("in/a_depth.exr", np.full((24, 36, 1), 1.5), "Z")
    thin = ("--set", "defocus.method=thin_lens", "--set", "render.sensor_width=36")
    clpipe("run", "in/a.exr", "-o", "o", *RUN, *PHOTOMETRIC, *thin)
    tags = exif("o/a.png")
    assert (float(tags[0x829D]), float(tags[0x9206])) == (pytest.approx(2.8), 3)
    stages = {s["name"]: s for s in json.loads(Path("o/a.json").read_text())["stages"]}
    assert stages["exposure"]["parameters"]["f_number"] == 2.8


def test_a_lens_and_a_raw_say_the_same(clpipe, grey):
    pytest.importorskip("lensfunpy", reason="needs lensfunpy, in the extra lens")
    lens = ("--lens", "Canon EF 24-70mm f/2.8L", "--focal-length", 24, "--aperture", 4)
    set_ = (*lens, "--focus-distance", 2, *SHOT, "--set", "exposure.ev=0.5")
    clpipe("run", "in/a.exr", "-o", "o", "--device", "numpy", "--format", "jpg", *set_)
    clpipe("run", "in/a.exr", "-o", "p", "--device", "numpy", "--format", "dng", *set_)
    tags = exif("o/a.jpg")
    assert tags[0xA434] == "Canon EF 24-70mm f/2.8L USM"
    raw = exif("p/a.dng")
    for number in (0x829A, 0x829D, 0x920A, 0x9206, 0x9204):
        assert float(raw[number]) == pytest.approx(float(tags[number]), rel=1e-4), hex(number)
    assert raw[0xA434] == tags[0xA434]


def test_the_equivalent_focal_length_follows_from_what_is_known(clpipe, grey):
    """From the focal length in px and mm, or of a lens by name from the camera's sensor."""
    pose = {"R": np.eye(3).tolist(), "t": [0, 0, 0], "K": [[24, 0, 18], [0, 24, 12], [0, 0, 1]]}
    Path("cameras.json").write_text(json.dumps({"views": [{"file": "a.exr", **pose}]}))
    run = ("run", "in/a.exr", *RUN)
    clpipe(*run, "-o", "o", "--poses", "cameras.json", "--focal-length", 16)
    assert exif("o/a.png")[0xA405] == 24  # 24 px of 36 are as 16 mm of 24, and 24 of 36
    clpipe(*run, "-o", "p", "--focal-length", 16)
    assert 0xA405 not in exif("p/a.png")
    pytest.importorskip("lensfunpy", reason="needs lensfunpy, in the extra lens")
    zoom = ("--lens", "Canon EF 24-70mm f/2.8L", "--focal-length", 35)
    clpipe(*run, "-o", "q", *zoom, "--camera", "sony-a7r2")
    assert exif("q/a.png")[0xA405] == 35


@pytest.mark.parametrize("style", ["standard", "neutral", "camera_raw", "linear"])
def test_a_picture_is_what_its_photometry_says(clpipe, write_exr, style):
    ramp = np.linspace(0.002, 1.6, 40 * 30, dtype=np.float32).reshape(30, 40, 1).repeat(3, 2)
    write_exr("in/a.exr", ramp)
    falloff = ("--set", "vignetting.method=pa", "--set", "vignetting.k1=-0.3")
    set_ = ("--set", f"tone_curve.method={style}", "--set", "exposure.ev=-0.5", *falloff)
    balance = ("--set", "white_balance.red_gain=2.2")
    clpipe("run", "in/a.exr", "-o", "o", *RUN, *PLAIN, *set_)
    facts = photometry_of("o/a.json")
    y, x = np.indices((30, 40))
    r2 = ((y - 14.5) ** 2 + (x - 19.5) ** 2) / (14.5**2 + 19.5**2)
    assert facts["falloff"]["parameters"]["k1"] == -0.3
    grey = facts["gain"] * ramp[..., 0] * (1 - 0.3 * r2)
    expected = 255 * np.interp(grey, np.arange(256) / 255, facts["response"]["table"])
    with Image.open("o/a.png") as image:
        seen = np.asarray(image, np.float64)
    middle = grey > 4 / 255  # below, a table of 256 is too coarse for gamma
    middle[[0, 1, -2, -1]] = middle[:, [0, 1, -2, -1]] = False  # where the ramp ends, for demosaic
    assert abs(seen.mean(-1) - expected)[middle].max() < 1.5
    again = np.interp(seen[..., 1] / 255, np.arange(256) / 255, facts["response"]["inverse"])
    kept = middle & (expected < 250)
    assert abs(again / grey - 1)[kept].max() < 0.06
    clpipe("run", "in/a.exr", "-o", "p", *RUN, *PLAIN, *set_, *balance)
    gains = photometry_of("p/a.json")["gains"]
    assert gains["applied"][0] == 2.2 and gains["light"][0] != 2.2


def test_views_have_it_each_response_once(clpipe, grey):
    pose = {"R": np.eye(3).tolist(), "t": [0, 0, 0]}
    k = [[40, 0, 18], [0, 40, 12], [0, 0, 1]]
    views = [{"file": f"{name}.exr", "K": k, **pose} for name in "ab"]
    Path("cameras.json").write_text(json.dumps({"views": views}))
    given = ("--poses", "cameras.json", "--set", "exposure.method=auto")
    clpipe("run", "in", "-o", "o", *RUN, *given)
    for name, key in (("cameras.json", "views"), ("transforms.json", "frames")):
        values = json.loads(Path("o", name).read_text())
        own = [each["photometry"] for each in values[key]]
        assert own[0]["ev"] - own[1]["ev"] == pytest.approx(1, abs=0.01)
        assert [each["response"] for each in own] == [0, 0]
        assert [len(v) for v in values["responses"][0].values()] == [256, 256]


@pytest.mark.parametrize("ending", ["jpg", "png"])
def test_the_lens_is_put_into_a_file_that_stays_as_it_was(tmp_path, ending):
    path = tmp_path / f"a.{ending}"
    tags = Tags("Maker", "Model", 400, 0.02, 4.0, 0.5, 35.0, focus_distance=2.0, sensor_width=36.0)
    pixels = np.random.default_rng(1).integers(0, 256, (9, 14, 3), dtype=np.uint8)
    write_display(path, pixels, tags)
    before = path.read_bytes()
    after = with_lens_model(before, "Lens 35mm")
    path.with_stem("b").write_bytes(after)
    with Image.open(path) as one, Image.open(path.with_stem("b")) as other:
        assert np.array_equal(np.asarray(one), np.asarray(other))
        assert one.info["icc_profile"] == other.info["icc_profile"]
        assert dict(one.getexif()) | {0x8769: 0} == dict(other.getexif()) | {0x8769: 0}
        own, found = (dict(each.getexif().get_ifd(0x8769)) for each in (one, other))
        assert found == own | {0xA434: "Lens 35mm"}


@pytest.mark.parametrize(("shape", "lens"), [((700, 1100, 3), ""), ((1024, 40, 1), "Lens 35mm")])
def test_a_large_jpeg_has_a_thumbnail(tmp_path, monkeypatch, shape, lens):
    rows, columns = np.mgrid[: shape[0], : shape[1]]
    pixels = (127 + 100 * np.sin(columns / 90) * np.cos(rows / 70))[..., None]
    pixels = np.repeat(pixels, shape[2], axis=2).astype(np.uint8)
    pixels[..., 0] //= 2
    tags = Tags("Maker", "Model", 400, lens=lens)
    write_display(tmp_path / "a.jpg", pixels, tags)
    monkeypatch.setattr("clpipe.images.write.THUMBNAIL_FROM", 5000)
    write_display(tmp_path / "b.jpg", pixels, tags)
    with Image.open(tmp_path / "a.jpg") as one, Image.open(tmp_path / "b.jpg") as other:
        assert np.array_equal(np.asarray(one), np.asarray(other))
        assert dict(one.getexif()) == dict(other.getexif())
        assert not other.getexif().get_ifd(1)
    with (tmp_path / "a.jpg").open("rb") as file:
        small = exifread.process_file(file)["JPEGThumbnail"]
    with Image.open(BytesIO(small)) as found, Image.fromarray(pixels.squeeze()) as whole:
        assert found.width <= 160 and found.height <= 120 and max(found.size) >= 120
        difference = np.float32(found) - np.float32(whole.resize(found.size, Image.Resampling.BOX))
    assert abs(difference).mean() < 3


def test_small_jpegs_and_other_formats_have_no_thumbnail(tmp_path):
    for name, side in (("a.jpg", 512), ("b.png", 1200), ("c.tif", 1200)):
        write_display(tmp_path / name, np.zeros((side, 9, 3), np.uint8), Tags("M", "N", 100))
        with Image.open(tmp_path / name) as picture:
            assert not picture.getexif().get_ifd(1)
