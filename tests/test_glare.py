"""Veiling glare, and the lenses without a name that contain it."""

import json
from pathlib import Path

import numpy as np
import pytest

from clpipe.base.errors import KeyedError
from clpipe.chain.making import make_chain
from clpipe.chain.settings import Settings, overlay, settings_from
from clpipe.engine.runner import Runner
from clpipe.stage import run_reference
from clpipe.stages.glare import Veil
from clpipe.stages.optical_blur import Lens

STEPS = ("distortion", "vignetting", "glare", "optical_blur")


@pytest.mark.parametrize("share", [0.003, 0.03, 0.3])
def test_a_black_spot_on_white_has_the_set_flare(device, share):
    """The figure of ISO 18844: the level of a small black spot over that of the white around it."""
    chart = np.ones((220, 300, 3), np.float32)
    chart[100:120, 140:160] = 0
    settings = {"stages": ["glare"], "glare": {"method": "veil", "share": share}}
    runner = Runner(make_chain(settings_from(settings)), device, encode=False, final=True)
    spot, white = (runner.run(chart, "k").final[place] for place in (np.s_[105:115, 145:155], 0))
    assert spot.mean() / white.mean() == pytest.approx(share, rel=0.01)


def test_light_is_spread_and_none_is_lost():
    image = np.random.default_rng(0).random((64, 90, 3), np.float32) * [1, 2, 0.5]
    spread = run_reference(Veil(share=0.2), image.astype(np.float32))
    assert spread.mean((0, 1)) == pytest.approx(image.mean((0, 1)), rel=0.02)
    assert spread.min() > 0.2 * 0.2


def test_corners_are_blurred_and_the_centre_is_not(device):
    dots = np.zeros((201, 301, 3), np.float32)
    dots[2:-2:28, 10::28] = 1
    dots[100, 150] = 1
    blurred = run_reference(Lens(sigma=0.0, corner=1.0), dots)
    assert blurred[100, 150, 1] == pytest.approx(1, abs=1e-4)
    edge = blurred[2, 10, 1]
    assert 0.2 < edge < 0.4  # nearly that of a Gaussian of 1 px: 0.15
    settings = {"stages": ["optical_blur"], "optical_blur": {"sigma": 0.0, "corner": 1.0}}
    runner = Runner(make_chain(settings_from(settings)), device, encode=False, final=True)
    assert np.abs(runner.run(dots, "k").final - blurred).max() < 1e-6


def test_the_faults_of_a_typical_lens_are_drawn_for_each_image():
    settings = settings_from({"lens": "typical", "optical_blur": {"sigma": 0.8}})
    one, two, again = (settings.drawn(name).parameters for name in ("a", "b", "a"))
    assert one == again != two
    assert 0.003 <= one["glare"]["share"] <= 0.03
    assert 0 <= one["optical_blur"]["corner"] <= 0.7 and one["optical_blur"]["sigma"] == 0.8
    assert abs(one["distortion"]["kr"] - 1) < 0.01 and one["vignetting"]["k1"] < 0


def test_no_lens_leaves_the_render_as_it_is():
    image = np.random.default_rng(0).random((24, 32, 3), np.float32)
    chain = make_chain(settings_from({"lens": "none"}))
    kept = Runner(chain, None, ["optical_blur"], encode=False).run(image, "k").kept
    quiet = make_chain(settings_from({"skip": list(STEPS)}))
    same = Runner(quiet, None, ["inverse_color_matrix"], encode=False).run(image, "k").kept
    assert np.array_equal(kept["optical_blur"], same["inverse_color_matrix"])


def test_another_lens_replaces_a_typical_one():
    typical = overlay(Settings(), {"lens": "typical"})
    none = overlay(typical, {"lens": "none"})
    assert not none.draws
    assert [none.method(step).method for step in STEPS] == ["none"] * 4
    named = overlay(typical, {"lens": "Canon EF 50mm f/1.8"})
    assert not named.draws
    assert [named.method(step).method for step in STEPS] == ["lens", "lens", "none", "lens"]
    own = overlay(typical, {"glare": {"method": "none"}})
    assert own.method("glare").method == "none" and "vignetting.k1" in own.draws
    with pytest.raises(KeyedError, match="'typical' is no lens of lensfun's database"):
        overlay(Settings(), {"lens": {"choice": ["typical", "Canon EF 50mm f/1.8"]}})


def test_a_run_records_the_drawn_lens(clpipe, write_exr):
    write_exr("a.exr", np.random.default_rng(0).random((24, 32, 3)))
    clpipe("run", "a.exr", "-o", "out", "--lens", "typical", "--device", "numpy")
    record = json.loads(Path("out/a.json").read_text())
    methods = {step["name"]: step["method"] for step in record["stages"]}
    assert [methods[step] for step in STEPS[1:]] == ["pa", "veil", "lens"]
    clpipe("replay", "out/a.json", "-o", "again", "--device", "numpy")
    assert Path("again/a.jpg").read_bytes() == Path("out/a.jpg").read_bytes()
