"""Training samples of chains with depth and overscan, and the margins of both."""

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import clpipe as api
from clpipe.images.read import read_image
from clpipe.images.tags import upright
from tests.test_overscan import AROUND, BARREL, HEIGHT, WIDTH, light, places, write_render

ISO = 3200
THIN = {"method": "thin_lens", "f_number": 0.5, "focus_distance": 0.5, "pixel_pitch": 1000.0}
DEFOCUS = {"defocus": {**THIN, "focal_length": BARREL["fx"], "max_radius": 6}}
BEND = {"distortion": BARREL}
MOVE = {"motion_blur": {"method": "linear", "length": 9.0, "angle": 30.0}}
DARK = {"exposure": {"ev": -2.0}}
STAGES = ("exposure", "mosaic", "sensor_noise", "quantize", "normalize", "demosaic", "gamma")
WHOLE = {
    "defocus": {"stages": ["defocus", *STAGES], **DEFOCUS, **DARK},
    "overscan": {"stages": ["motion_blur", "distortion", *STAGES], **MOVE, **BEND, **DARK},
    "both": {
        "stages": ["defocus", "motion_blur", "distortion", *STAGES],
        **DEFOCUS,
        **MOVE,
        **BEND,
        **DARK,
    },
}


def options_of(settings):
    """Options of ``clpipe run`` for settings."""
    given = ["--stages", ",".join(settings["stages"]), "--iso", ISO]
    for stage, values in settings.items():
        for name, value in values.items() if stage != "stages" else ():
            given += ["--set", f"{stage}.{name}={value}"]
    return given


@pytest.fixture
def depth_of(write_exr, tmp_path, monkeypatch):
    """Write a render with overscan, and give its depth, so much further away."""
    monkeypatch.chdir(tmp_path)

    def write(away=0.0):
        x, y = places(WIDTH, HEIGHT, AROUND)
        depth = np.float32(0.48 + 0.08 * np.sin((x + y) / 15) + away)
        write_render(write_exr, "in/a.exr", pixels=np.dstack([light(x, y), depth]))
        return depth

    return write


@pytest.mark.slow
@pytest.mark.parametrize(
    ("device", "kind"), [("numpy", "defocus"), ("numpy", "overscan"), (None, "both")]
)
@pytest.mark.filterwarnings("ignore:.*pixels are spread")
def test_samples_and_patches_are_what_a_run_and_a_pipeline_make(clpipe, depth_of, device, kind):
    depth, settings = depth_of(), WHOLE[kind]
    command = ("run", "in/a.exr", "-o", "o", "--frames", 2, "--format", "png")
    on = ("--device", "numpy") if device else ()
    clpipe(*command, *options_of(settings), "--truth", "clean", *on)
    given = {"device": device, "iso": ISO, "truth": "clean", "epochs": 2, **settings}
    whole = list(api.Dataset("in/a.exr", **given))
    for epoch, sample in enumerate(whole):
        assert sample["image"].shape == (HEIGHT, WIDTH, 3)
        for name, file in (("image", f"a.frame{epoch}"), ("truth", "a.truth_clean")):
            assert np.array_equal(sample[name], np.asarray(Image.open(f"o/{file}.png")))
    pipeline = api.Pipeline(iso=ISO, device=device, **settings)
    pixels = read_image(Path("in/a.exr"), overscan=True).pixels
    noise_key = json.loads(Path("o/a.frame0.json").read_text())["noise_key"]
    own = depth if "defocus" in settings else None
    shown = pipeline.process(pixels, "a", depth=own, overscan=AROUND, noise_key=noise_key)
    assert np.array_equal(shown.image, whole[0]["image"])
    patches = api.Dataset("in/a.exr", patch=api.Patches(16, 12, augment=True), **given)
    for patch in patches.__getitems__([*range(24), 3, 20]):
        left, top = patch["place"]
        for name in ("image", "truth"):
            part = whole[patch["epoch"]][name][top : top + 16, left : left + 16]
            assert np.array_equal(patch[name], upright(part, patch["turn"]))


@pytest.mark.filterwarnings("ignore:.*pixels are spread")
def test_a_depth_that_is_replaced_is_seen(depth_of):
    depth_of()
    given = {"device": "numpy", **WHOLE["both"]}
    made = api.Dataset("in/a.exr", patch=16, **given)
    before = made[0]["image"]
    assert np.array_equal(made[0]["image"], before)
    depth_of(away=3.0)
    after = made[0]["image"]
    assert not np.array_equal(after, before)
    assert np.array_equal(after, api.Dataset("in/a.exr", patch=16, **given)[0]["image"])
