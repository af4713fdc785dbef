"""Baselines: independent noise of the noisy picture's strength on the clean picture."""

import json

import numpy as np
import pytest
from PIL import Image

from clpipe.outputs.noise_areas import select_flat

ENDS = ("", ".truth", ".truth_clean", ".iid")
NUMPY = ("--device", "numpy", "-c", "paper", "--iso", 3200)


@pytest.fixture
def render(write_exr):
    """Flat, textured, black and blown out places, and edges between them."""
    random = np.random.default_rng(4)
    pixels = random.random((96, 128, 3)) * 0.3 * (np.arange(128) % 2)[:, None]
    pixels[:40] = np.linspace(0, 1.4, 128)[:, None]
    pixels[40:56, 64:] = 0
    write_exr("view.exr", pixels.astype(np.float32))
    return "view.exr"


def picture(path):
    with Image.open(path) as image:
        return np.asarray(image).astype(float)


def test_it_is_as_strong_as_the_pictures_noise_and_independent(clpipe, render, tmp_path):
    both = ("--truth", "iid", "--truth", "intensity")
    clpipe("run", render, "-o", "out", *NUMPY, "--format", "png", *both)
    out = {
        name: picture(tmp_path / f"out/view{name}.png")
        for name in ("", ".truth", ".truth_clean", ".iid", ".intensity")
    }
    expected = (out[""] - out[".truth"]).var((0, 1))
    assert (expected > 1).all()
    for baseline in (".iid", ".intensity"):
        noise = out[baseline] - out[".truth_clean"]
        assert noise.var((0, 1)) == pytest.approx(expected, rel=0.04)
        flat = noise[2:38, 40:80]
        assert abs(np.corrcoef(flat[:, 1:].ravel(), flat[:, :-1].ravel())[0, 1]) < 0.05
    # The one is the same everywhere, the other as large at each intensity as the picture's own.
    camera, ratios = out[""] - out[".truth"], []
    for noise, place in (
        (camera, ".truth"),
        (out[".intensity"] - out[".truth_clean"], ".truth_clean"),
    ):
        dark, bright = (noise[w] for w in (out[place] < 60, out[place] > 120))
        ratios.append(bright.std() / dark.std())
    assert ratios[1] == pytest.approx(ratios[0], rel=0.15)
    assert ratios[0] < 0.7
    record = json.loads((tmp_path / "out/view.iid.json").read_text())
    (noise,) = (stage for stage in record["stages"] if stage["name"] == "picture_noise")
    assert noise["method"] == "iid_gaussian"
    assert 0 < noise["parameters"]["sigma"][1] < 0.2


def halved(noise):
    return noise.reshape(48, 2, 64, 2, 3).mean((1, 3))


def test_where_it_is_matched_and_how_channels_go_together(clpipe, write_exr, tmp_path):
    pixels = np.full((96, 128, 3), 0.2)
    pixels[40:] += np.random.default_rng(4).random((56, 128, 1)) * 0.3
    render = write_exr("view.exr", pixels.astype(np.float32))
    command = ("run", render, *NUMPY, "--format", "png", "--truth", "iid")
    how = {"halved": ["match=halved", "correlated=true"], "flat": ["match=flat"]}
    noise = {}
    for name, values in how.items():
        sets = [x for value in values for x in ("--set", f"picture_noise.{value}")]
        clpipe(*command, "-o", name, *sets)
        out = {end: picture(tmp_path / f"{name}/view{end}.png") for end in ENDS}
        noise[name] = out[".iid"] - out[".truth_clean"]
    camera = out[""] - out[".truth"]
    ratio = halved(noise["halved"]).var((0, 1)) / halved(camera).var((0, 1))
    assert ratio == pytest.approx([1] * 3, rel=0.08)  # of 3,072 samples each
    truth, found = (np.float32(each / 255) for each in (out[".truth"], camera))
    flat = select_flat(truth, found[None], np.ones((96, 128), bool))
    assert 0.2 < flat.mean() < 0.8
    ratio = noise["flat"][flat].var(0) / camera[flat].var(0)
    assert ratio == pytest.approx([1] * 3, rel=0.15)
    assert (noise["flat"].var((0, 1)) < 0.8 * camera.var((0, 1))).all()
    tables = [
        np.corrcoef(each.reshape(-1, 3).T)[[0, 0, 1], [1, 2, 2]]
        for each in (halved(camera), halved(noise["halved"]), noise["flat"])
    ]
    assert (np.abs(tables[0]) > 0.2).all()
    assert tables[1] == pytest.approx(tables[0], abs=0.08)
    assert tables[2] == pytest.approx([0] * 3, abs=0.04)
    record = json.loads((tmp_path / "halved/view.iid.json").read_text())
    used = record["stages"][-1]["parameters"]
    assert (used["match"], used["correlated"]) == ("halved", True)


@pytest.mark.parametrize("subsampling", ["4:2:0", "4:4:4"])
def test_it_is_as_strong_in_jpegs_on_request(clpipe, render, tmp_path, subsampling):
    jpeg = ("--set", f"output.jpeg_subsampling={subsampling}", "--format", "jpg")
    for name, value in (("as_ever", "false"), ("matched", "true")):
        clpipe("run", render, "-o", name, *NUMPY, *jpeg, "--truth", "iid",
               "--set", f"picture_noise.jpeg={value}")  # fmt: skip
        out = {end: picture(tmp_path / f"{name}/view{end}.jpg") for end in ENDS}
        noise, camera = out[".iid"] - out[".truth_clean"], out[""] - out[".truth"]
        ratio = noise.var((0, 1)) / camera.var((0, 1))
        if value == "false":
            assert np.abs(ratio - 1).max() > 0.07
    assert ratio == pytest.approx([1] * 3, rel=0.05)
    record = json.loads((tmp_path / "matched/view.iid.json").read_text())
    reached = record["stages"][-1]["estimates"]
    assert list(reached) == [f"variance_ratio_{channel}" for channel in "rgb"]
    assert list(reached.values()) == pytest.approx([1] * 3, abs=0.03)


@pytest.mark.slow
def test_it_is_made_again_alone_the_same(clpipe, render, tmp_path):
    command = ("run", render, "-o", "out", *NUMPY, "--truth", "iid", "--bracket=-1,0")
    clpipe(*command, "--format", "png", "--format", "dng")
    path = tmp_path / "out/view.ev-1.iid.png"
    made = path.read_bytes()
    assert not path.with_suffix(".dng").exists()
    path.unlink()
    clpipe(*command, "--format", "png", "--format", "dng")
    assert path.read_bytes() == made
    clpipe("replay", "out/view.ev-1.iid.json", "-o", "again", "--device", "numpy")
    assert (tmp_path / "again/view.ev-1.iid.png").read_bytes() == made
