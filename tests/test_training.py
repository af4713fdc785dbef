"""tools/training: denoisers trained on clpipe's pictures, and their scores."""

import json

import numpy as np
import pytest
from PIL import Image

from tests.conftest import STILL_LIFE, run_python

pytestmark = pytest.mark.slow
torch = pytest.importorskip("torch", reason="needs PyTorch, in the extra train")


@pytest.fixture
def tool(tmp_path):
    """Return a function that runs a tool in a folder with a render, and returns its output."""
    (tmp_path / "renders").mkdir()
    (tmp_path / "renders/a.exr").write_bytes(STILL_LIFE.read_bytes())

    def run(name, *words, status=0):
        done = run_python("-m", f"tools.training.{name}", *words, cwd=tmp_path, status=status)
        return done.stdout + done.stderr

    return run


@pytest.fixture
def real(clpipe, tmp_path):
    """A folder of simulated camera pairs: a development, and the same without noise."""
    made = tmp_path / "made"
    clpipe(
        "run", STILL_LIFE, "-o", made, "--iso", 3200, "--truth", "development", "--format", "png"
    )
    folder = tmp_path / "real"
    folder.mkdir()
    for number, top in ((1, 100), (2, 300)):
        for kind, name in (("real", "still_life.png"), ("mean", "still_life.truth.png")):
            with Image.open(made / name) as picture:
                picture.crop((200, top, 360, top + 161)).save(folder / f"cam_{number}_{kind}.png")
    return folder


def test_denoisers_are_compared_on_real_pictures(tool, real, tmp_path):
    words = ("renders/a.exr", "--real", real, "--steps", 150, "--seeds", 1, "-o", "out")
    printed = tool(
        "train_on_real", *words, "--regimes", "clpipe", "awgn", "real", "--pairs", _other(real)
    )
    assert "6 pictures to train on, 2 real ones to test on" in printed
    found = json.loads((tmp_path / "out/scores.json").read_text())
    assert list(found["regimes"]) == ["noisy", "clpipe", "awgn", "real"]
    table = (tmp_path / "out/table.md").read_text()
    assert table.splitlines()[0].startswith("| trained on | PSNR, dB |") and "cam (2)" in table
    for regime, row in zip(found["regimes"], table.splitlines()[2:], strict=True):
        mean = np.mean(found["regimes"][regime]["psnr"])
        assert row.startswith(f"| {regime} | {mean:.2f} |")
    with Image.open(tmp_path / "out/crops.png") as crops:
        assert crops.size[0] > 5 * 320 and np.ptp(np.asarray(crops)) > 100
    assert list((tmp_path / "out").iterdir()) and not list((tmp_path / "out").glob("tmp*"))
    scores = found["regimes"]
    assert np.mean(scores["clpipe"]["psnr"]) > np.mean(scores["noisy"]["psnr"])


def test_networks_share_a_table(tool, real, tmp_path):
    words = ("--steps", 2, "--seeds", 1, "--regimes", "clpipe", "awgn", "-o", "out")
    networks = ("--network", "unet", "resnet")
    tool("train_on_real", "renders/a.exr", "--real", real, *words, *networks)
    heading, _, *rows = (tmp_path / "out/table.md").read_text().splitlines()
    assert heading.startswith("| network | trained on | PSNR, dB |")
    regimes = ["noisy", "clpipe", "awgn"]
    expected = [[network, regime] for network in networks[1:] for regime in regimes]
    assert [row.split(" | ")[:2] for row in (row[2:] for row in rows)] == expected
    assert len({row.count("|") for row in (heading, *rows)}) == 1
    files = [json.loads((tmp_path / f"out/scores_{n}.json").read_text()) for n in networks[1:]]
    assert [list(each["regimes"]) for each in files] == [regimes, regimes]
    assert files[0]["regimes"]["noisy"] == files[1]["regimes"]["noisy"]
    assert files[0]["regimes"]["clpipe"] != files[1]["regimes"]["clpipe"]
    with Image.open(tmp_path / "out/crops.png") as crops:
        assert crops.size[0] > 6 * 320


@pytest.mark.parametrize("kind", ["unet", "resnet"])
def test_a_network_begins_as_the_identity_and_learns(kind):
    from tools.training.figures import psnr
    from tools.training.networks import NETWORKS, denoised, train
    from tools.training.patches import BATCH

    assert sorted(NETWORKS) == ["resnet", "unet"]
    size = sum(weights.numel() for weights in NETWORKS[kind](3).parameters())
    assert 100_000 < size < 130_000
    image = torch.rand(3, 37, 50, generator=torch.Generator().manual_seed(3))
    assert torch.equal(denoised(NETWORKS[kind](3), image), image)

    def batch(generator, sides=(32, 32)):
        """Noisy and clean ramps of light."""
        slope = torch.linspace(0, 1, sides[1])
        ends = torch.rand(2, BATCH, 3, 1, 1, generator=generator)
        clean = (ends[0] + (ends[1] - ends[0]) * slope).expand(BATCH, 3, *sides)
        return clean + 0.05 * torch.randn(clean.shape, generator=generator), clean

    network = train(batch, 3, 80, 1, kind=kind)
    noisy, clean = (both[0] for both in batch(torch.Generator().manual_seed(9), (37, 50)))
    assert psnr(denoised(network, noisy), clean) > psnr(noisy.clamp(0, 1), clean) + 1


def _other(real):
    """A folder with the first pair under another name, so training does not use the test pair."""
    other = real.parent / "other"
    other.mkdir()
    for kind in ("real", "mean"):
        (other / f"b_1_{kind}.png").write_bytes((real / f"cam_1_{kind}.png").read_bytes())
    return other


def test_what_is_tested_is_not_trained_on(tool, real):
    printed = tool("train_on_real", real / "cam_1_mean.png", "--real", real, status=2)
    assert "is in the test set (cam_1); do not train on it" in printed
    printed = tool("train_on_real", "renders/a.exr", "--real", real, "--pairs", real, status=2)
    assert "the regime real needs --pairs FOLDER" in printed
    words = ("--regimes", "real", "--pairs", real)
    printed = tool("train_on_real", "renders/a.exr", "--real", real, *words, status=2)
    assert "is in the test set" in printed


def test_a_range_that_misses_the_pictures_is_said(tool, real):
    words = ("--iso", 100, 110, "--steps", 1, "--seeds", 1, "--regimes", "clpipe")
    printed = tool("train_on_real", "renders/a.exr", "--real", real, *words)
    assert "warning: 2 of 2 real pictures have less or more noise than the training" in printed


def test_noise_models_are_compared_on_raws(tool, tmp_path, write_exr):
    write_exr("b.exr", np.random.default_rng(0).random((96, 130, 3)).astype(np.float32) ** 2)
    words = ("renders/a.exr", "--test", "b.exr", "--steps", 2, "--seeds", 1, "-o", "raw.json")
    printed = tool("train_on_raw", *words)
    found = json.loads((tmp_path / "raw.json").read_text())
    assert list(found) == ["noisy", "full", "poisson-gaussian", "iid"]
    rows = [line for line in printed.splitlines() if line.startswith("| ")]
    kld = {row.split(" | ")[0][2:]: row.split(" | ")[-1][:-2] for row in rows[2:]}
    assert float(kld["full"]) < float(kld["poisson-gaussian"]) < float(kld["iid"])


def test_scores_are_what_they_are_called():
    from tools.training.figures import Score, psnr, ssim, table

    clean = torch.rand(3, 40, 50, generator=torch.Generator().manual_seed(1))
    assert psnr(clean + 0.01, clean) == pytest.approx(40, abs=1e-3)
    assert ssim(clean, clean) == pytest.approx(1)
    skimage = pytest.importorskip(
        "skimage.metrics", reason="needs scikit-image, in the extra compare"
    )
    noisy = clean + 0.1 * torch.randn(clean.shape, generator=torch.Generator().manual_seed(2))
    own = skimage.structural_similarity(
        clean.numpy(), noisy.numpy(), channel_axis=0, data_range=1, gaussian_weights=True
    )
    assert ssim(noisy, clean) == pytest.approx(own, abs=0.01)
    one, other = (Score(np.array([[30.0, x]]), np.array([[0.9, 0.8]])) for x in (32.0, 31.0))
    assert "| b | 30.50 | 30.50 | 0.8500 | 1 of 2 |" in table({"a": one, "b": other}, {})
