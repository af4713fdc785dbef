"""Calibration from files: choice of frames, rejected inputs, and a usable profile."""

import json
import shutil

import numpy as np
import OpenImageIO as oiio
import pytest
import rawpy
from PIL import Image

from clpipe.analysis.calibration.frames import FrameOverrides, find_frames, read_frame
from clpipe.camera.profile import load_camera
from clpipe.images.raw import read_raw, read_raw_info
from tests.conftest import DATA, WRITTEN
from tests.conftest import run_cli as call
from tests.test_calibrate import frames, scene

LEVELS = ("--black-level", 512, "--white-level", 16383, "--pattern", "RGGB", "--iso", 400)


def write(path, pixels, kind=oiio.FLOAT):
    pixels = np.ascontiguousarray(np.atleast_3d(pixels))
    spec = oiio.ImageSpec(pixels.shape[1], pixels.shape[0], pixels.shape[2], kind)
    spec.attribute("DateTime", WRITTEN)
    file = oiio.ImageOutput.create(str(path))
    assert file.open(str(path), spec) and file.write_image(pixels) and file.close()


@pytest.fixture(scope="module")
def shots(tmp_path_factory):
    """Four frames of a scene and of the dark at two ISOs, as clpipe run writes them."""
    folder = tmp_path_factory.mktemp("shots")
    light = np.repeat(scene(96, 128)[..., None], 3, axis=2).astype(np.float32)
    write(folder / "scene.exr", light)
    write(folder / "dark.exr", light * 0)
    for name in ("scene", "dark"):
        for iso in (500, 640):
            for seed in range(4):
                options = ("--iso", iso, "--seed", seed, "--device", "numpy", "--until", "quantize")
                extra = ("--set", "row_noise.sigma=1e-4", "--set", "column_noise.sigma=5e-5")
                call("run", folder / f"{name}.exr", "-o", folder / "one", *options, *extra)
                (folder / name).mkdir(exist_ok=True)
                shutil.move(folder / "one" / f"{name}.exr", folder / name / f"{iso}_{seed}.exr")
    return folder


@pytest.mark.slow
def test_a_profile_that_loads_and_runs(shots, tmp_path):
    profile = tmp_path / "mine.toml"
    dark = ("--dark", f"{shots}/dark/*.exr")
    text = call("calibrate", shots / "scene", *dark, "-o", profile).output
    assert "4 + 4 dark" in text and "wrote" in text
    camera, original = load_camera(str(profile)), load_camera("sony-a7r2")
    assert (camera.name, camera.make, camera.model) == ("mine", "Sony", "ILCE-7RM2")
    assert camera.white_balance_gains == original.white_balance_gains
    assert camera.xyz_to_camera == original.xyz_to_camera
    assert camera.iso_range == (500, 640)
    assert [stage.iso for stage in camera.gain_stages] == [(500,), (640,)]
    for iso in (500, 640):
        assert camera.noise(iso).a == pytest.approx(original.noise(iso).a, rel=0.03)
        assert camera.noise(iso).b == pytest.approx(original.noise(iso).b, rel=0.04)
        assert camera.row_noise(iso) == pytest.approx(1e-4, rel=0.2)
        assert camera.column_noise(iso) == pytest.approx(5e-5, rel=0.3)
    assert camera.hot_pixel_share == 0
    assert "4 frames and 4 dark" in camera.sources["gain_stages"]
    assert "+-" in camera.sources["row_noise"]
    with Image.open(tmp_path / "mine.png") as picture:
        assert picture.width == 1600 and picture.format == "PNG"
    call("run", shots / "scene.exr", "-o", tmp_path / "out", "--camera", profile, "--iso", 600)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["mine.png", "mine.toml", "out"]


@pytest.mark.slow
def test_hot_and_dead_pixels_come_back(shots, tmp_path):
    light = np.full((128, 128, 3), 0.3, np.float32)
    write(tmp_path / "scene.exr", light * np.linspace(0.1, 1, 128, dtype=np.float32)[None, :, None])
    write(tmp_path / "dark.exr", light * 0)
    level = 200 * load_camera("sony-a7r2").noise(800).a  # 200 e-
    given = {"hot_share": 5e-3, "hot_level": level, "dead_share": 3e-3}
    options = [x for key, v in given.items() for x in ("--set", f"defect_pixels.{key}={v}")]
    for name in ("scene", "dark"):
        for seed in range(3):
            call("run", tmp_path / f"{name}.exr", "-o", tmp_path / name / str(seed), "--iso", 800,
                 "--seed", seed, "--until", "quantize", "--device", "numpy", *options)  # fmt: skip
    call("calibrate", f"{tmp_path}/scene/*/*.exr", "--dark", f"{tmp_path}/dark/*/*.exr", "-o",
         tmp_path / "p.toml")  # fmt: skip
    camera = load_camera(str(tmp_path / "p.toml"))
    assert camera.hot_pixel_share == pytest.approx(5e-3, rel=0.3)
    assert camera.hot_pixel_level == pytest.approx(200, rel=0.2)
    assert camera.dead_pixel_share == pytest.approx(3e-3, rel=0.4)


@pytest.mark.slow
def test_json_has_every_figure_with_its_error(shots, tmp_path):
    scene_frames = (f"{shots}/scene/*.exr", "-o", tmp_path / "p.toml", "--json")
    record = json.loads(call("calibrate", *scene_frames, "--dark", shots / "dark").output)
    low = record["isos"][0]
    assert (low["iso"], low["scene_frames"], low["dark_frames"]) == (500, 4, 4)
    assert set(low["channels"]) == {"R", "G1", "G2", "B"}
    for key in ("a", "b", "system_gain", "read_noise"):
        assert set(low["pooled"][key]) == {"value", "error"}
    assert low["hot_pixels"]["positions"] == []
    assert low["row_noise_dn"]["value"] == pytest.approx(1.5871, rel=0.2)
    without = json.loads(call("calibrate", *scene_frames).output)["isos"][0]
    assert without["column_noise_dn"] is None and without["dsnu_e"] is None
    sources = load_camera(str(tmp_path / "p.toml")).sources
    assert "without dark frames" in sources["column_noise"]


@pytest.mark.slow
def test_dark_frames_among_the_frames_are_dark_frames(shots, tmp_path):
    both = (shots / "scene", shots / "dark", "--dark", f"{shots}/dark/*")
    text = call("calibrate", *both, "-o", tmp_path / "p.toml").output
    assert "4 + 4 dark" in text
    only = (shots / "dark", "--dark", shots / "dark")
    assert (
        "all frames are dark"
        in call("calibrate", *only, "-o", tmp_path / "q.toml", status=2).stderr
    )


def test_signal_and_dn_say_the_same(shots, tmp_path):
    call("run", f"{shots}/scene/640_0.exr", "-o", tmp_path, "--start-at", "normalize", "--until",
         "normalize", "--device", "numpy")  # fmt: skip
    dn = read_frame(shots / "scene" / "640_0.exr", FrameOverrides())
    signal = read_frame(tmp_path / "640_0.exr", FrameOverrides())
    assert signal.signal and not dn.signal
    assert np.array_equal(dn.read(), signal.read())


@pytest.mark.slow
@pytest.mark.parametrize("ending", ["tif", "png", "exr"])
def test_mosaics_from_elsewhere(tmp_path, ending):
    for k, frame in enumerate(frames(scene(96, 128), 3)):
        kind = oiio.FLOAT if ending == "exr" else oiio.UINT16
        write(
            tmp_path / f"{k}.{ending}", frame if ending == "exr" else frame.astype(np.uint16), kind
        )
    given = (tmp_path, "-o", tmp_path / "p.toml")
    message = call("calibrate", *given, status=2).stderr
    assert "add --black-level, --white-level, --pattern, --iso" in message
    call("calibrate", *given, *LEVELS)
    camera = load_camera(str(tmp_path / "p.toml"))
    assert camera.gain_stages[0].system_gain[0] == pytest.approx(2, rel=0.03)
    assert camera.white_balance_gains == (1, 1)
    assert camera.sources["white_balance_gains"] == "not known; assumed to be 1"


@pytest.mark.slow
def test_headerless_dumps(tmp_path):
    for k, frame in enumerate(frames(scene(96, 128), 3)):
        (tmp_path / f"{k}.raw").write_bytes(frame.astype("<u2").tobytes())
    given = (tmp_path, "-o", tmp_path / "p.toml")
    assert "--dump" in call("calibrate", *given, *LEVELS, status=1).stderr
    message = call("calibrate", *given, "--dump", "128x96:uint16le", status=2).stderr
    assert "add --black-level, --white-level, --pattern, --iso" in message
    message = call("calibrate", *given, *LEVELS, "--dump", "128x48:uint16le", status=1).stderr
    assert "it would fit 128x96 uint16le" in message
    call("calibrate", *given, *LEVELS, "--dump", "128x96:uint16le")
    camera = load_camera(str(tmp_path / "p.toml"))
    assert camera.gain_stages[0].system_gain[0] == pytest.approx(2, rel=0.03)


@pytest.mark.slow
def test_a_single_frame_is_judged_alone(tmp_path):
    write(tmp_path / "a.exr", frames(scene(384, 512), 1)[0])
    text = call("calibrate", tmp_path / "a.exr", "-o", tmp_path / "p.toml", *LEVELS).output
    assert "a single frame" in text
    camera = load_camera(str(tmp_path / "p.toml"))
    assert "single image (Foi et al. 2008)" in camera.sources["gain_stages"]
    assert "without two frames" in camera.sources["row_noise"]


def test_frames_that_do_not_belong_together(shots, tmp_path):
    one = shots / "scene" / "500_0.exr"
    out = ("-o", tmp_path / "p.toml")
    dark = ("--dark", f"{shots}/dark/640*")
    message = call("calibrate", f"{shots}/scene/500*", *dark, *out, status=2).stderr
    assert "ISO 640 has only dark frames" in message
    options = ("--until", "quantize", "--device", "numpy", "--iso", 500)
    for name, more, expected in (
        ("camera", ("--camera", "sony-a7s2"), "has the camera Sony ILCE-7SM2"),
        ("pattern", ("--set", "mosaic.pattern=GRBG"), "has the pattern GRBG"),
        ("levels", ("--set", "quantize.black_level=500"), "has the levels black 500"),
        ("exposure", ("--set", "exposure.ev=1"), "is +1 EV, but the exposure of"),
    ):
        call("run", shots / "scene.exr", "-o", tmp_path / name, *options, *more)
        message = call("calibrate", one, tmp_path / name / "scene.exr", *out, status=2).stderr
        assert expected in message and "500_0.exr" in message
    small = tmp_path / "small.exr"
    write(small, np.zeros((32, 32, 3), np.float32))
    call("run", small, "-o", tmp_path / "size", *options)
    message = call("calibrate", one, tmp_path / "size" / "small.exr", *out, status=2).stderr
    assert "32x32 pixels, but" in message and "128x96" in message
    assert not (tmp_path / "p.toml").exists() and not (tmp_path / "p.png").exists()


def test_what_is_no_frame(shots, tmp_path):
    out = ("-o", tmp_path / "p.toml")
    assert "add --black-level" in call("calibrate", shots / "scene.exr", *out, status=2).stderr
    assert "no such file" in call("calibrate", tmp_path / "x.nef", *out, status=2).stderr
    assert "no mosaic or raw" in call("calibrate", "nothing*.dng", *out, status=2).stderr
    assert "must end in .toml" in call("calibrate", shots, "-o", "p.png", status=2).stderr
    (tmp_path / "bad.cr2").write_bytes(b"not a raw" * 100)
    assert (
        "LibRaw does not support it"
        in call("calibrate", tmp_path / "bad.cr2", *out, status=1).stderr
    )
    call("run", shots / "scene.exr", "-o", tmp_path, "--until", "demosaic", "--device", "numpy")
    message = call("calibrate", tmp_path / "scene.exr", *out, status=1).stderr
    assert "contains rgb, kept after demosaic" in message
    same = shots / "scene" / "500_0.exr"
    shutil.copy(same, tmp_path / "copy.exr")
    message = call("calibrate", same, tmp_path / "copy.exr", *out, status=1).stderr
    assert "ISO 500: frames 1 and 2 are identical" in message
    assert find_frames([str(same), str(same)]) == [same]


def test_signal_that_is_taken_for_dn_is_told(tmp_path):
    for k in range(2):
        write(tmp_path / f"{k}.exr", np.random.default_rng(k).random((32, 32), np.float32))
    message = call("calibrate", tmp_path, "-o", tmp_path / "p.toml", *LEVELS, status=1).stderr
    assert "not above the black level of 512 DN" in message


def test_options_win_over_what_the_file_says(shots):
    frame = read_frame(shots / "scene" / "500_0.exr", FrameOverrides(500, 16000, "BGGR", 1234))
    assert (frame.iso, frame.sensor.black_level, frame.sensor.pattern) == (1234, 500, "BGGR")


@pytest.mark.slow
def test_a_real_raw(tmp_path):
    path = DATA / "raw" / "colorchart.dng"
    facts = read_raw_info(path)
    assert (facts.make, facts.model) == ("Canon", "Canon EOS Kiss X4")
    assert (facts.pattern, facts.black_level, facts.white_level) == ("RGGB", 2056, 15000)
    assert facts.iso is None and facts.gains == pytest.approx((2.477, 1.694), abs=1e-3)
    mosaic = read_raw(path, facts)
    with rawpy.imread(str(path)) as raw:
        assert np.array_equal(mosaic, raw.raw_image_visible)  # without the masked pixels
    assert mosaic.shape == (190, 288) and mosaic.min() == 2004  # below the black level
    assert (
        "this file does not state its ISO; add --iso"
        in call("calibrate", path, "-o", tmp_path / "p.toml", status=2).stderr
    )
    call("calibrate", path, "-o", tmp_path / "p.toml", "--iso", 400)
    assert 1 < load_camera(str(tmp_path / "p.toml")).gain_stages[0].system_gain[0] < 3
