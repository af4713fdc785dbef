"""From a finished picture back to a raw, and development with another camera."""

import json

import numpy as np
import pytest
from PIL import Image
from PIL.ExifTags import IFD, Base
from PIL.TiffImagePlugin import IFDRational

from clpipe import Pipeline
from clpipe.base.errors import RequestError
from clpipe.images.read import read_finished
from clpipe.images.tags import orientation_of
from clpipe.reference.curve import curve_index
from clpipe.stage import run_reference
from clpipe.stages.gamma import Power, Srgb
from clpipe.stages.inverse_gamma import Power as InversePower
from clpipe.stages.inverse_gamma import Srgb as InverseSrgb
from clpipe.stages.inverse_tone_curve import CameraRaw as InverseCameraRaw
from clpipe.stages.inverse_tone_curve import File as InverseFile
from clpipe.stages.inverse_tone_curve import Neutral as InverseNeutral
from clpipe.stages.tone_curve import CameraRaw, Neutral
from tests.conftest import run_cli, written

QUIET = ["sensor_noise", "row_noise", "denoise"]


def smooth(height: int = 96, width: int = 128) -> np.ndarray:
    """A smooth picture in sRGB, eight bits, with a white patch and a black one."""
    y, x = np.mgrid[0:height, 0:width]
    red = 40 + 180 * x / width
    green = 200 - 120 * y / height
    blue = 90 + 60 * np.sin(x / 20) * np.cos(y / 25)
    picture = np.stack([red, green, blue], axis=-1)
    picture[20:50, 20:50] = 255
    picture[60:90, 80:110] = 0
    return np.rint(picture).astype(np.uint8)


@pytest.mark.parametrize(
    ("there", "back"),
    [(Srgb(), InverseSrgb()), (Power(), InversePower()), (CameraRaw(), InverseCameraRaw())],
)
def test_what_is_undone_was_there(there, back):
    x = np.linspace(0, 1, 4001, dtype=np.float32)
    light = x if isinstance(there, CameraRaw) else x**2
    again = back.table()[curve_index(there.table()[curve_index(light)])]
    # Entries of both tables are 2^-13 apart, and where a curve is flat that is more light.
    assert np.abs(again - light).max() < 2e-3
    assert np.abs(again - light)[light > 0.01].mean() < 2e-4


def test_the_neutral_curve_is_undone_for_all_colours():
    light = np.random.default_rng(0).random((40, 50, 3), np.float32) ** 2
    light[:, 25:] *= 1 / 64  # the toe
    curved = run_reference(Neutral(), light)
    assert np.abs(curved - light).max() > 0.2
    assert np.abs(run_reference(InverseNeutral(), curved) - light).max() < 2e-6


def test_a_curve_that_falls_cannot_be_undone(tmp_path):
    (tmp_path / "falling.csv").write_text("0,0\n0.5,0.8\n1,0.6\n")
    with pytest.raises(ValueError, match="falls or is flat, so it cannot be inverted"):
        InverseFile(path=str(tmp_path / "falling.csv"))


@pytest.mark.slow
def test_a_picture_comes_back_as_it_was():
    picture = smooth()
    pipeline = Pipeline("unprocess", skip=QUIET)
    again = pipeline.process(picture, "p").image
    inside = np.zeros(picture.shape[:2], bool)
    inside[4:-4, 4:-4] = True
    for top, left in ((20, 20), (60, 80)):  # edges, where demosaicing has to guess
        inside[top - 6 : top + 36, left - 6 : left + 36] = False
        inside[top + 6 : top + 24, left + 6 : left + 24] = True
    assert np.abs(again[inside].astype(int) - picture[inside]).max() <= 3
    assert np.abs(again[inside].astype(int) - picture[inside]).mean() < 0.6


@pytest.mark.slow
def test_white_is_where_the_sensor_clips():
    raw = Pipeline("unprocess", skip=QUIET, until="quantize").process(smooth(), "p").image
    assert np.all(raw[22:48, 22:48] == 16383)
    tinted = Pipeline("unprocess", skip=[*QUIET, "restore_highlights"], until="quantize")
    assert tinted.process(smooth(), "p").image[22:48, 22:48].min() < 8000


def test_highlights_are_restored_for_the_light_that_is_taken_out():
    light = {"red_gain": 2.0, "blue_gain": 1.6}
    chain = Pipeline("unprocess", inverse_white_balance=light).chain
    assert chain.step_named("restore_highlights").method.gains == (2.0, 1.6)


@pytest.mark.slow
def test_another_camera_has_its_own_noise():
    noisy = Pipeline("unprocess", camera="canon-5d2", iso=3200, until="normalize")
    clean = Pipeline("unprocess", camera="canon-5d2", iso=3200, until="normalize", skip=QUIET[:2])
    noise = noisy.process(smooth(), "p").image - clean.process(smooth(), "p").image
    dark = noise[64:88, 84:108]
    known = clean.chain.steps[0].context.camera.noise(3200).b
    assert dark.var() == pytest.approx(known, rel=0.2)


def test_pictures_from_the_command_line(tmp_path):
    folder = tmp_path / "photos"
    folder.mkdir()
    Image.fromarray(smooth()).save(folder / "one.jpg", quality=95)
    Image.fromarray(smooth()).save(folder / "two.png")
    (folder / "three.jpg").write_bytes(b"\xff\xd8\xff not a picture")
    out = tmp_path / "out"
    result = run_cli("run", folder, "-o", out, "-c", "unprocess", "--iso", 1600, status=1)
    assert "three.jpg" in result.output and "2 of 3 images done" in result.output
    assert written(out) == ["one.jpg", "one.json", "two.jpg", "two.json"]


def photograph(path, focal_length=35.0, equivalent=56, orientation=1) -> None:
    """A picture with the EXIF of a camera."""
    tags = Image.Exif()
    tags[Base.Make], tags[Base.Model], tags[Base.Orientation] = "Canon", "EOS 7D", orientation
    shot = tags.get_ifd(IFD.Exif)
    shot[Base.ExposureTime], shot[Base.FNumber] = IFDRational(1, 125), IFDRational(28, 5)
    shot[Base.FocalLength] = IFDRational(round(focal_length * 10), 10)
    shot[Base.FocalLengthIn35mmFilm], shot[Base.ISOSpeedRatings] = equivalent, 200
    shot[Base.DateTimeOriginal] = "2020:01:02 03:04:05"
    Image.fromarray(smooth()).save(path, exif=tags, quality=95)


@pytest.mark.parametrize("ending", ["jpg", "png"])
def test_what_a_photograph_says_of_its_shot_stays(tmp_path, ending):
    photograph(tmp_path / f"photo.{ending}", orientation=6)
    options = ("-o", tmp_path / "out", "-c", "unprocess", "--iso", 1600, "--format", "jpg")
    run_cli("run", tmp_path / f"photo.{ending}", *options)
    with Image.open(tmp_path / "out" / "photo.jpg") as picture:
        assert picture.size == (96, 128)  # upright
        top_right = np.asarray(picture)[20:50, -45:-25].mean()
        tags = picture.getexif()
        shot = tags.get_ifd(IFD.Exif)
    assert top_right > 230  # the white patch, top left before
    assert (tags[Base.Make], tags[Base.Model]) == ("Sony", "ILCE-7RM2")
    assert Base.Orientation not in tags or tags[Base.Orientation] == 1
    assert shot[Base.ISOSpeedRatings] == 1600
    assert shot[Base.FocalLength] == 35 and shot[Base.FocalLengthIn35mmFilm] == 56
    assert float(shot[Base.ExposureTime]) == pytest.approx(1 / 125)
    assert float(shot[Base.FNumber]) == pytest.approx(5.6)
    assert shot[Base.DateTimeOriginal] == "2020:01:02 03:04:05"
    sidecar = json.loads((tmp_path / "out" / "photo.json").read_text())
    intrinsics = sidecar["intrinsics"]
    assert (intrinsics["width"], intrinsics["height"]) == (96, 128)
    # On film, 56 mm and a diagonal of 43.27 mm; here a diagonal of 160 px.
    assert intrinsics["fx"] == pytest.approx(56 * 160 / np.hypot(36, 24), rel=1e-6)


def test_a_photograph_that_says_nonsense_of_its_shot_says_nothing(tmp_path):
    photograph(tmp_path / "photo.jpg", focal_length=0, equivalent=0, orientation=9)
    source = read_finished(tmp_path / "photo.jpg")
    assert "focal_length" not in source.shot and "sensor_width" not in source.shot
    assert source.shot["exposure_time"] == pytest.approx(1 / 125)
    assert orientation_of(source.attributes) == 1


def test_each_chain_wants_its_own_kind(tmp_path, write_exr):
    render = write_exr("render.exr", smooth() / 255)
    Image.fromarray(smooth()).save(tmp_path / "photo.png")
    for path, more, message in (
        (render, ["-c", "unprocess"], "contains linear light, but the chain starts on finished"),
        (tmp_path / "photo.png", [], "For a photograph, use -c unprocess"),
    ):
        assert message in run_cli("run", path, "-o", tmp_path / "out", *more, status=1).output


def test_a_camera_without_a_matrix_leaves_colours():
    chain = Pipeline("unprocess", camera="oppo-reno-10x").chain
    assert not [p for s in chain.steps if "color" in s.name for p in s.method.passes()]
    with pytest.raises(RequestError, match=r"no xyz_to_camera.*color_matrix\.method=as_shot"):
        Pipeline("unprocess", camera="oppo-reno-10x", color_matrix={"method": "camera"})


def test_a_chain_that_does_not_fit_a_picture():
    with pytest.raises(RequestError, match="mosaic"):
        Pipeline(stages=["inverse_gamma", "sensor_noise"])


def test_white_of_a_photograph_is_no_warning(tmp_path, recwarn):
    Image.fromarray(np.full((24, 32, 3), 255, np.uint8)).save(tmp_path / "white.png")
    command = ("run", tmp_path / "white.png", "-o", tmp_path / "out", "-c", "unprocess")
    assert "clipped" not in run_cli(*command, "--device", "numpy").stderr
    assert json.loads((tmp_path / "out/white.json").read_text())["clipped"] > 0.9
    Pipeline("unprocess", device="numpy").process(np.full((8, 8, 3), 255, np.uint8), "white")
    assert not [each for each in recwarn if "clipped" in str(each.message)]
