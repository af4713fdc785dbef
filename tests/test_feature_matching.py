"""tools/compare/matching.py: keypoints that noise hides, moves and adds."""

import json
import sys

import numpy as np
import pytest
from PIL import Image
from scipy import ndimage

from clpipe.analysis.matching.scenes import load_scenes
from tools.compare import matching

pytestmark = pytest.mark.slow
pytest.importorskip("cv2", reason="needs OpenCV, in the extra compare")


@pytest.fixture(scope="module")
def scene():
    """A grey picture with rectangles on its right half, (256, 320, 3), 0 to 255."""
    random = np.random.default_rng(0)
    luma = np.repeat(np.linspace(60, 150, 320)[None], 256, 0)
    for _ in range(150):
        y, x = random.integers(0, 240), random.integers(160, 305)
        height, width = random.integers(4, 16, 2)
        luma[y : y + height, x : x + width] = random.integers(50, 200)
    return np.repeat(ndimage.gaussian_filter(luma, 0.7)[..., None], 3, 2)


@pytest.mark.parametrize("detector", matching.DETECTORS)
def test_noise_hides_keypoints(detector, scene):
    clean = matching.grey(scene)
    assert matching.compared(detector, clean, clean) == (1, 1)
    normals = np.random.default_rng(1).normal(size=scene.shape)
    weak, strong = (
        matching.compared(detector, clean, matching.grey(scene + sigma * normals))
        for sigma in (3, 30)
    )
    assert 1 > weak.repeated > strong.repeated + 0.1
    assert 1 > weak.matched > strong.matched + 0.1
    moved = matching.compared(detector, clean, np.roll(clean, 5, 0))
    assert moved.matched < 0.1 and moved.repeated < weak.repeated
    near = matching.compared(detector, clean, np.roll(clean, 1, 0))
    assert near.matched > 0.8 and near.repeated > 0.8
    half = clean.copy()
    half[:128] = 90
    assert 0.3 < matching.compared(detector, clean, half).repeated < 0.7
    assert matching.compared(detector, half, clean).repeated > 0.8
    assert matching.compared(detector, clean, np.full_like(clean, 90)) == (0, 0)
    with pytest.raises(SystemExit, match=f"{detector} detects nothing"):
        matching.compared(detector, np.full_like(clean, 90), clean)


def test_noise_models_are_compared_with_a_camera(scene, tmp_path, monkeypatch, capsys):
    random = np.random.default_rng(0)
    for number in (1, 2):
        noise = ndimage.gaussian_filter(random.normal(0, 40, scene.shape), (1.2, 1.2, 0.5))
        for name, pixels in (("mean", scene), ("real", scene + noise)):
            file = tmp_path / f"camera_{number}_{name}.png"
            Image.fromarray(np.rint(pixels).clip(0, 255).astype(np.uint8)).save(file)
    monkeypatch.setattr(matching, "STEPS", 2)
    words = ["matching", str(tmp_path), "--config", "default", "--json"]
    monkeypatch.setattr(sys, "argv", words)
    matching.main()
    found = json.loads(capsys.readouterr().out)
    assert found["pictures"] == ["camera_1_real", "camera_2_real"]
    models = found["models"]
    assert list(models) == ["real", "default", "iid", "intensity-dependent"]
    real = models["real"]
    for model in models.values():
        assert model["luma_rms"] == pytest.approx(real["luma_rms"], rel=0.1)
        for detector in matching.DETECTORS:
            for name, figure in model[detector].items():
                expected = np.abs(np.subtract(figure["each"], real[detector][name]["each"])).mean()
                assert figure["error"] == pytest.approx(expected)
                assert figure["mean"] == pytest.approx(np.mean(figure["each"]))
    # Detectors smooth. Independent noise therefore hides less than correlated noise.
    independent, correlated = (
        models[source]["SIFT"]["matched"]["mean"] for source in ("iid", "real")
    )
    assert independent > correlated + 0.03
    table = matching.table(found).splitlines()
    assert len(table) == 3 + len(models) and table[-1].startswith("intensity-dependent")


def test_models_are_as_strong_as_the_picture(scene, tmp_path):
    random = np.random.default_rng(0)
    files = [str(tmp_path / f"{name}.png") for name in ("real", "mean")]
    grey_noise = np.repeat(random.normal(0, 8, (*scene.shape[:2], 1)), 3, 2)
    for file, pixels in zip(files, (scene + grey_noise, scene), strict=True):
        Image.fromarray(np.rint(pixels).clip(0, 255).astype(np.uint8)).save(file)
    own = load_scenes(files[:1], files[1:]).each[0]
    real = matching.strength(own.noise, own)
    assert matching.strength(matching.iid(own), own) < 0.8 * real  # its channels are independent
    for source in (matching.iid, matching.intensity_dependent):
        scaled = matching.as_strong(source)(own)
        assert matching.strength(scaled, own) == pytest.approx(real)
