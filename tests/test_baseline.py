"""Baselines: independent noise on the clean picture, as strong as what the noisy picture has."""

import json

import numpy as np
import pytest
from PIL import Image

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
    both = ("--baseline", "iid", "--baseline", "intensity")
    clpipe("run", render, "-o", "out", *NUMPY, "--format", "png", *both)
    out = {
        name: picture(tmp_path / f"out/view{name}.png")
        for name in ("", ".truth", ".truth_clean", ".iid", ".intensity")
    }
    wanted = (out[""] - out[".truth"]).var((0, 1))
    assert (wanted > 1).all()
    for baseline in (".iid", ".intensity"):
        noise = out[baseline] - out[".truth_clean"]
        assert noise.var((0, 1)) == pytest.approx(wanted, rel=0.04)
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


def test_it_is_made_again_alone_the_same(clpipe, render, tmp_path):
    command = ("run", render, "-o", "out", *NUMPY, "--baseline", "iid", "--bracket=-1,0")
    clpipe(*command, "--format", "png", "--format", "dng")
    path = tmp_path / "out/view.ev-1.iid.png"
    made = path.read_bytes()
    assert not path.with_suffix(".dng").exists()
    path.unlink()
    clpipe(*command, "--format", "png", "--format", "dng")
    assert path.read_bytes() == made
    clpipe("run", "--replay", "out/view.ev-1.iid.json", "-o", "again", "--device", "numpy")
    assert (tmp_path / "again/view.ev-1.iid.png").read_bytes() == made


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--skip", "picture_noise"], "that of picture_noise, and this chain has none"),
        (["--set", "picture_noise.method=iid_gaussian", "--set", "picture_noise.sigma=0.1"],
         "picture_noise adds noise already"),
        (["--until", "normalize"], "this chain has none"),
        (["--skip", "sensor_noise", "--skip", "row_noise"], "no stage of this chain adds noise"),
    ],
)  # fmt: skip
def test_what_is_refused(clpipe, render, options, message):
    command = ("run", render, "-o", "out", *NUMPY, "--baseline", "iid", *options)
    assert message in clpipe(*command, status=2).stderr
