"""The noise of clips: its correlation with later frames."""

import json
from pathlib import Path

import numpy as np
import pytest

from clpipe.analysis.temporal import load_frames, temporal_correlation
from clpipe.base.errors import RequestError
from clpipe.images.video import VideoOptions, VideoWriter

pytest.importorskip("av", reason="needs PyAV: pip install av")

SIGMA = 6.0


def recursive(alpha, count, shape):
    """Noise of a recursive filter, alpha * new + (1 - alpha) * last, with the variance 1."""
    rng = np.random.default_rng(0)
    state = rng.normal(size=shape)
    scale = ((2 - alpha) / alpha) ** 0.5
    for _ in range(40):  # until the first frame is forgotten
        state = alpha * rng.normal(size=shape) + (1 - alpha) * state
    for _ in range(count):
        state = alpha * rng.normal(size=shape) + (1 - alpha) * state
        yield state * scale


def clip(path, noise, drift=0):
    ramp = np.linspace(60, 180, 160)
    with VideoWriter(Path(path), VideoOptions("ffv1")) as video:
        for n, each in enumerate(noise):
            scene = np.roll(ramp, n * drift)[None, :, None]
            video.add(np.clip(np.rint(scene + SIGMA * each), 0, 255).astype(np.uint8))
    return path


@pytest.mark.parametrize("alpha", [1.0, 0.7, 0.4])
def test_a_recursive_filter_is_found(clpipe, alpha):
    clip("a.mkv", recursive(alpha, 24, (128, 160, 3)))
    record = json.loads(clpipe("measure", "a.mkv", "--json").stdout)
    assert record["frames"] == 24
    for name in ("R", "G", "B", "Y"):
        expected = [(1 - alpha) ** lag for lag in (1, 2, 3)]
        assert record["temporal_correlation"][name] == pytest.approx(expected, abs=0.02)
    if alpha == 1:
        assert record["channels"]["G"]["sigma"] * 255 == pytest.approx(SIGMA, rel=0.02)
    table = clpipe("measure", "a.mkv").stdout
    assert "correlation with later frames, flat areas (independent noise: 0)" in table


@pytest.mark.parametrize("count", [3, 5, 8, 30])
def test_the_removed_mean_does_not_bias_independent_noise(count):
    noise = np.random.default_rng(0).normal(size=(count, 200_000)).astype(np.float32)
    found = temporal_correlation(noise - noise.mean(0))
    assert len(found) == min((count - 1) // 2, 3)
    assert np.abs(found).max() < 0.01  # without the correction, it would be -1 / count


def test_two_frames_have_no_correlation(clpipe):
    clip("a.mkv", recursive(1.0, 2, (128, 160, 3)))
    record = json.loads(clpipe("measure", "a.mkv", "--json").stdout)
    assert record["temporal_correlation"]["Y"] == []


def test_a_scene_that_moves_is_rejected(clpipe):
    clip("a.mkv", recursive(1.0, 8, (128, 160, 3)), drift=3)
    result = clpipe("measure", "a.mkv", status=2)
    assert "a.mkv, frame" in result.output
    assert "is not aligned with the others" in result.output


def test_frames_with_less_noise_are_no_ground_truth(clpipe):
    noise = [each * (0.5 if n % 4 else 1) for n, each in enumerate(recursive(1, 8, (64, 160, 3)))]
    clip("a.mkv", noise)
    clpipe("measure", "a.mkv")


def test_large_clips_are_cropped(tmp_path, monkeypatch):
    monkeypatch.setattr("clpipe.analysis.temporal.MAX_PIXELS", 8 * 40 * 50)
    path = clip(tmp_path / "a.mkv", recursive(1.0, 8, (128, 160, 3)))
    shapes = {picture.pixels.shape for picture in load_frames(path)}
    assert shapes == {(40, 50, 3)}


def test_a_clip_is_measured_alone(clpipe):
    clip("a.mkv", recursive(1.0, 2, (8, 160, 3)))
    for arguments in (("a.mkv",), ("--truth", "a.mkv"), ("--snr",)):
        result = clpipe("measure", "a.mkv", *arguments, status=2)
        assert "name one clip, without --truth and --snr" in result.output
    with pytest.raises(RequestError, match="this clip has one frame"):
        load_frames(clip("b.mkv", recursive(1.0, 1, (8, 160, 3))))
