"""Intrinsics in sidecars: scene points project as COLMAP's models state."""

import json
from pathlib import Path

import numpy as np
import pytest

from clpipe.chain.making import make_chain
from clpipe.chain.settings import settings_from
from clpipe.images.read import SourceImage
from clpipe.outputs.record import intrinsics_of
from clpipe.reference.geometry import destinations

WIDTH, HEIGHT = 640, 420
HALVED = {"stages": ["distortion", "exposure", "resize"], "resize": {"scale": 0.51}}
RENDER = {"fx": 600.0, "fy": 600.0, "cx": 330.0, "cy": 205.0}
PLACE = {"cx": 330.0, "cy": 205.0}
BROWN = {
    "method": "brown_conrady",
    **{"fx": 600.0, "k1": -0.12, "k2": 0.03, "k3": -0.004, "p1": 0.0011, "p2": -0.0007},
}


def projected(x, y, camera):
    """Places in px of directions x / z, y / z: OpenCV's formulas, written down once more."""
    k = camera["distortion"]
    r2 = x * x + y * y
    if camera["model"] in ("FULL_OPENCV", "OPENCV_THIN_PRISM"):
        above = 1 + k["k1"] * r2 + k["k2"] * r2**2 + k["k3"] * r2**3
        grown = above / (1 + k["k4"] * r2 + k["k5"] * r2**2 + k["k6"] * r2**3)
        dx = 2 * k["p1"] * x * y + k["p2"] * (r2 + 2 * x * x)
        dy = k["p1"] * (r2 + 2 * y * y) + 2 * k["p2"] * x * y
        if camera["model"] == "OPENCV_THIN_PRISM":
            dx, dy = dx + k["s1"] * r2 + k["s2"] * r2**2, dy + k["s3"] * r2 + k["s4"] * r2**2
        x, y = x * grown + dx, y * grown + dy
    elif camera["model"] == "OPENCV_FISHEYE":
        r = np.sqrt(r2)
        a = np.arctan(r)
        bent = a * (1 + k["k1"] * a**2 + k["k2"] * a**4 + k["k3"] * a**6 + k["k4"] * a**8)
        x, y = x * bent / r, y * bent / r
    return camera["fx"] * x + camera["cx"], camera["fy"] * y + camera["cy"]


@pytest.mark.parametrize(
    ("distortion", "model"),
    [
        (BROWN | PLACE, "FULL_OPENCV"),
        (BROWN | PLACE | {"fit": True, "k4": 0.05, "k5": 0.01}, "FULL_OPENCV"),
        (BROWN | PLACE | {"s1": 0.004, "s2": -0.01, "s3": -0.003, "s4": 0.02}, "OPENCV_THIN_PRISM"),
        ({"method": "fisheye", "fx": 600.0, "k1": 0.02, "k2": -0.01, **PLACE}, "OPENCV_FISHEYE"),
        ({"method": "poly3", "k1": -0.03, **PLACE}, "FULL_OPENCV"),
        ({"method": "poly5", "k1": -0.03, "k2": 0.004, "kr": 1.001, **PLACE}, "FULL_OPENCV"),
        ({"method": "ptlens", "a": 0.02, "b": -0.06, "c": 0.03, **PLACE}, "FULL_OPENCV"),
        ({"method": "ptlens", "b": 0.04, "c": -0.02, "fit": True, **PLACE}, "FULL_OPENCV"),
        ({"method": "none"}, "PINHOLE"),
    ],
)
def test_points_are_where_the_intrinsics_say(distortion, model):
    chain = make_chain(settings_from({**HALVED, "distortion": distortion}))
    camera = chain.intrinsics(WIDTH, HEIGHT, RENDER).record()
    assert (camera["model"], camera["width"], camera["height"]) == (model, 326, 214)
    x, y = (each.ravel() for each in np.meshgrid(np.linspace(-0.4, 0.4, 9), [-0.25, 0.01, 0.25]))
    rendered = 600 * x + 330, 600 * y + 205
    start = rendered[0] * 0.51, rendered[1] * 0.51
    seen = destinations(chain.geometry, rendered, start, WIDTH, HEIGHT)
    expected = projected(x, y, camera)
    off = np.hypot(seen[0] - expected[0], seen[1] - expected[1]).max()
    assert off < 0.01
    if distortion["method"] == "ptlens":  # whose powers are odd; what is fitted says how well
        assert 0.1 * camera["residual"] < off <= camera["residual"] + 2e-6 and off > 0
    else:
        assert camera["residual"] == 0


def test_unknown_intrinsics_are_not_written():
    def intrinsics_for(distortion, shot):
        chain = make_chain(settings_from({**HALVED, "distortion": distortion}))
        return chain.intrinsics(WIDTH, HEIGHT, shot)

    assert intrinsics_for({"method": "none"}, {}) is None
    assert intrinsics_for({"method": "poly3", "k1": -0.03}, {}) is None
    # An image that starts after the lens stages may already be distorted.
    entered = make_chain(settings_from({**HALVED, "distortion": BROWN}), start_at="exposure")
    image = SourceImage(np.zeros((HEIGHT, WIDTH, 3), np.float32), "", "", (), {}, RENDER)
    assert intrinsics_of(entered, image) is None
    assert intrinsics_for(BROWN, {}).fx == pytest.approx(600 * 326 / 640)  # the lens knows it


def test_the_sidecar_has_them(clpipe, write_exr, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_exr("a.exr", np.full((20, 30, 3), 0.2, np.float16))
    Path("list.csv").write_text("path,render.fx,render.cx\na.exr,45.0,14.0\n")
    clpipe("run", "list.csv", "-o", "o", "--device", "numpy")
    found = json.loads(Path("o/a.json").read_text())["intrinsics"]
    assert found == {
        **{"width": 30, "height": 20, "fx": 45.0, "fy": 45.0, "cx": 14.0, "cy": 10.0},
        **{"model": "PINHOLE", "distortion": {}, "residual": 0.0},
    }
    contradictory = [f"distortion.{k}={v}" for k, v in (BROWN | {"fx": 45.0, "cx": 15.0}).items()]
    sets = [x for each in contradictory for x in ("--set", each)]
    stderr = clpipe("run", "list.csv", "-o", "p", "--device", "numpy", *sets, status=2).stderr
    assert "distortion.cx: 15 contradicts render.cx: 14; set one" in stderr
