"""tools/compare/judge.py: it separates different noise, not equal noise, and reads pairs."""

import json
import sys

import numpy as np
import pytest
from PIL import Image
from scipy import ndimage

from tools.compare import judge
from tools.compare.classifier import PATCH, auc, distance, held_out_auc, statistics

pytestmark = pytest.mark.slow


def patches(seed, count=60, blur=0.8, skew=0.0):
    """Return the statistics of patches of blurred noise, (patch, statistic)."""
    random = np.random.default_rng(seed)
    level = np.add.outer(np.arange(PATCH), np.arange(PATCH)) + 60.0
    found = []
    for _ in range(count):
        noise = ndimage.gaussian_filter(random.normal(size=(PATCH, PATCH, 3)), (blur, blur, 0))
        noise /= noise.std()
        noise += skew * noise**2
        found.append(list(statistics(noise, level).values()))
    return np.array(found)


def test_only_different_noise_can_be_separated():
    real = {"a": patches(1), "b": patches(2)}
    alike = {"a": patches(3), "b": patches(4)}
    assert 0.3 < held_out_auc(real, alike, "a") < 0.7
    for other in ({"blur": 1.0}, {"skew": 0.15}):
        different = {"a": patches(3, **other), "b": patches(4, **other)}
        assert held_out_auc(real, different, "a") > 0.95
        assert held_out_auc(real, different, "b") > 0.95


def test_the_distance_grows_with_the_difference():
    kept = range(60)
    real = patches(1)
    gaps = [distance(real, patches(2, blur=blur), kept) for blur in (0.8, 0.9, 1.1)]
    assert gaps[0] < 2 < gaps[1] < gaps[2]


def test_the_statistics_do_not_depend_on_the_strength_of_the_noise():
    random = np.random.default_rng(0)
    noise = random.normal(size=(PATCH, PATCH, 3))
    noise -= noise.mean((0, 1))
    level = np.full((PATCH, PATCH), 90.0)
    one, two = (statistics(noise * strength, level) for strength in (1.0, 7.0))
    assert len(one) >= 75
    assert list(one.values()) == pytest.approx(list(two.values()), abs=1e-4)


def test_auc_is_the_chance_of_the_larger_score():
    assert auc(np.array([2.0, 3]), np.array([0.0, 1])) == 1
    assert auc(np.array([0.0, 1]), np.array([2.0, 3])) == 0
    assert auc(np.array([0.0, 2]), np.array([1.0, 3])) == 0.25


def test_pairs_of_two_cameras_are_judged(tmp_path, monkeypatch, capsys):
    random = np.random.default_rng(0)
    ramp = np.repeat(np.linspace(35, 170, 320)[None, :, None], 3, 2).repeat(256, 0)
    ramp[:, 192:] += 25 * np.sin(np.arange(128) / 3)[:, None]  # only the rest is flat
    for camera, blur in (("one", 0.6), ("two", 0.9)):
        for number in (1, 2):
            noise = ndimage.gaussian_filter(random.normal(0, 9, ramp.shape), (blur, blur, 0.5))
            for name, pixels in (("mean", ramp), ("real", ramp + noise)):
                file = tmp_path / f"{camera}_iso800_{number}_{name}.png"
                Image.fromarray(np.rint(pixels).clip(0, 255).astype(np.uint8)).save(file)
    monkeypatch.setattr(judge, "STEPS", 2)
    monkeypatch.setattr(sys, "argv", ["judge", str(tmp_path), "--config", "default", "--json"])
    judge.main()
    found = json.loads(capsys.readouterr().out)
    assert found["pictures"] == {"one_iso800": 2, "two_iso800": 2}
    assert set(found["judged"]) == {"default", "iid", "intensity-dependent"}
    for camera in ("one_iso800", "two_iso800"):
        for scores in found["judged"].values():
            assert 0 <= scores[camera]["auc"] <= 1 and scores[camera]["distance"] > 0
        # Independent noise is farther from correlated noise than a camera's noise is.
        far, near = (found["judged"][source][camera]["distance"] for source in ("iid", "default"))
        assert far > near
    white = found["figures"]["iid, as one_iso800"]
    assert abs(white[judge.CB_RIGHT]) < 0.1 and 0.3 < white[judge.CR_COARSE] < 3
    assert found["figures"]["iid, as one_iso800"]["half"] == pytest.approx(0.25, abs=0.03)
    assert white["chroma_sigma_96"] == pytest.approx(1, abs=0.05)
    assert abs(white["skew_80"]) < 0.1 and np.isnan(white["weak_over_strong"])
    print(judge.table(found))
    printed = capsys.readouterr().out
    assert "one_iso800 and two_iso800: " in printed and "most different" in printed
    assert "\nchroma rms at 96-127 over that at 64-95\n    real one_iso800 " in printed
    assert "\nluma skew at 160-219\n" in printed and "\nsaturated colours, weak over" in printed
    (tmp_path / "one_iso800_1_mean.png").unlink()
    with pytest.raises(SystemExit, match=r"has no one_iso800_1_mean\.png"):
        judge.read_pairs(tmp_path)
