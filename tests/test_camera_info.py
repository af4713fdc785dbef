"""The camera of a picture in the words of OpenCV and ROS."""

import json
import math
import pickle

import numpy as np
import pytest
from scipy.ndimage import map_coordinates

import clpipe
from clpipe.base.errors import RequestError
from clpipe.camera.profile import load_camera

FRAME = np.full((96, 128, 3), 0.2, np.float32)
LENS = {"method": "brown_conrady", "fx": 110.0, "fy": 112.0, "cx": 60.0, "cy": 50.0, "k1": 0.2}
LENS |= {"k2": 0.05, "p1": 0.003, "p2": -0.002, "k3": 0.01}


def develop(**settings):
    return clpipe.Pipeline(device="numpy", **settings)(FRAME, "a")


def undistorted(image, k, d):
    """Return OpenCV's ``undistort(image, k, d)``, by its documentation (calib3d, 4.x)."""
    v, u = np.mgrid[: image.shape[0], : image.shape[1]]
    x, y = (u - k[0, 2]) / k[0, 0], (v - k[1, 2]) / k[1, 1]
    k1, k2, p1, p2, k3 = d
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    bent_x = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    bent_y = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    places = bent_y * k[1, 1] + k[1, 2], bent_x * k[0, 0] + k[0, 2]
    return map_coordinates(image, places, order=3)


def dots(places):
    """Return a render with dots, 96x128."""
    rows, columns = np.mgrid[:96, :128]
    frame = np.full((96, 128, 3), 0.02, np.float32)
    for x, y in places:
        spot = np.exp(-((columns - x) ** 2 + (rows - y) ** 2) / 8)
        frame += np.float32(0.5) * spot[..., None].astype(np.float32)
    return frame


def test_k_and_d_undistort_a_picture():
    """Dots of a render, bent by clpipe, are where K and D put them, within 0.05 px."""
    places = [(x, y) for x in range(16, 128, 24) for y in range(12, 96, 24)]
    shot = clpipe.Pipeline(device="numpy", until="distortion", distortion=LENS)(dots(places), "a")
    info = shot.camera
    assert info.distortion_model == "plumb_bob" and len(info.d) == 5
    straight = undistorted(shot.image[..., 1], np.array(info.k), info.d)
    errors = []
    for x, y in places:
        window = straight[y - 5 : y + 6, x - 5 : x + 6] - 0.02
        v, u = np.mgrid[-5:6, -5:6]
        errors.append(math.hypot((window * u).sum(), (window * v).sum()) / window.sum())
    assert max(errors) < 0.05


@pytest.mark.filterwarnings("ignore:.*is black")
def test_fisheye_and_rational_models():
    lens = {"method": "fisheye", "fx": 60.0, "k1": 0.02, "k4": -0.001}
    info = develop(distortion=lens).camera
    assert info.distortion_model == "equidistant"
    assert info.d == (0.02, 0.0, 0.0, -0.001) and info.k[0] == (60.0, 0.0, 63.5)
    info = develop(distortion={**LENS, "k4": 0.1}).camera
    assert info.distortion_model == "rational_polynomial" and len(info.d) == 8
    assert info.d[5] == 0.1


def test_resizing_changes_k():
    stages = ["distortion", "resize", "exposure", "mosaic", "sensor_noise", "quantize"]
    info = develop(stages=stages, distortion=LENS, resize={"scale": 0.5}).camera
    assert (info.width, info.height) == (64, 48)
    assert info.k[0] == pytest.approx((55.0, 0.0, 29.5)) and info.k[1][2] == pytest.approx(24.5)
    assert info.encoding == info.raw_encoding == "bayer_rggb16"
    assert info.p == tuple((*row, 0.0) for row in info.k)
    assert info.color_matrix is None


def test_the_raw_and_its_development():
    profile = load_camera("sony-a7r2")
    shot = develop(
        iso=800, exposure={"method": "photometric", "exposure_time": 0.004, "scale": 1e4}
    )
    info = shot.camera
    assert (info.black_level, info.white_level) == (512, 16383)
    assert (info.iso, info.exposure_time) == (800, 0.004)
    assert info.gain == pytest.approx(profile.noise(800).a * profile.signal_range)
    red, blue = profile.white_balance_gains
    assert info.white_balance == (red, 1.0, blue)
    matrix = np.linalg.inv(profile.srgb_to_camera())
    assert np.array(info.color_matrix) == pytest.approx(matrix)
    assert (info.k, info.d, info.distortion_model, info.p) == (None, (), "", None)
    assert info.row_time == 0 and info.encoding == "rgb8"
    for array, name in (("GBRG", "bayer_gbrg16"), ("x-trans", "16UC1"), ("mono", "mono16")):
        mosaic = {"pattern": array} if array == "GBRG" else {"method": "array", "array": array}
        assert develop(mosaic=mosaic, until="quantize").camera.encoding == name
    rolling = {"line_time": 2e-5, "exposure_time": 0.002, "flicker_depth": 0.1}
    info = develop(shutter=rolling).camera
    assert (info.row_time, info.exposure_time) == (2e-5, 0.002)


def test_estimated_gains_are_those_of_the_picture():
    shot = develop(white_balance={"method": "gray_world"})
    estimated = shot.estimates["white_balance"]
    assert shot.camera.white_balance == (estimated["red_gain"], 1.0, estimated["blue_gain"])


def test_a_stream_repeats_the_time():
    with clpipe.Stream(device="numpy", distortion=LENS, exposure={"method": "auto"}) as stream:
        shots = [stream(FRAME * light, time=time) for light, time in ((1, 0.5), (2, 0.75))]
        assert stream(FRAME).camera.time is None
    assert [shot.camera.time for shot in shots] == [0.5, 0.75]
    assert shots[0].camera.k[0] == (110.0, 0.0, 59.5)
    with clpipe.Stream(device="numpy") as stream:
        stream.put(FRAME, time=3.25)
        [shot] = stream.finish()
    assert shot.time == shot.camera.time == 3.25


def test_a_result_in_another_process_has_no_chain():
    shot = develop()
    assert "origin" not in repr(shot)
    with pytest.raises(RequestError, match="does not know its chain"):
        _ = pickle.loads(pickle.dumps(shot)).camera


def test_sidecars_and_samples(renders, clpipe, tmp_path):
    folder = renders(1)
    lens = ("--set", "distortion.method=brown_conrady", "--set", "distortion.fx=30")
    clpipe("run", folder, "-o", "out", *lens)
    record = json.loads((tmp_path / "out/r000.json").read_text())["camera_info"]
    direct = _camera(folder)
    assert record["k"][0] == [30.0, 0.0, 19.5] and record["distortion_model"] == "plumb_bob"
    assert record["raw_encoding"] == "bayer_rggb16" and record["p"][0] == [30.0, 0.0, 19.5, 0.0]
    assert direct["k"][0].tolist() == [30.0, 0.0, 19.5] and direct["d"].shape == (12,)
    assert np.array(record["color_matrix"]) == pytest.approx(direct["color_matrix"])
    assert math.isnan(direct["exposure_time"]) and direct["row_time"] == 0


def _camera(folder):
    lens = {"method": "brown_conrady", "fx": 30}
    [sample] = clpipe.Dataset(folder, device="numpy", distortion=lens)
    return sample


def test_auto_iso_changes_the_exposure_time_only_by_the_rest():
    options = {"shutter": {"exposure_time": 0.01, "flicker_depth": 0.1}, "iso": 100}
    frame = np.full((12, 16, 3), 0.012, np.float32)
    control = {"iso_max": 800.0}
    exposure = {"method": "auto"}
    with clpipe.Stream(device="numpy", exposure=exposure, control=control, **options) as stream:
        shot = stream(frame)
    ev = shot.settings["exposure"]["ev"]
    assert ev > 3.5 and shot.camera.iso == 800
    assert shot.camera.exposure_time == pytest.approx(0.01 * 2**ev / 8)
    with clpipe.Stream(device="numpy", exposure=exposure, **options) as stream:
        assert stream(frame).camera.exposure_time == pytest.approx(0.01 * 2**ev, rel=1e-6)
