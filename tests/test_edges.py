"""Noise at edges: the choice of pixels, and the strength of noise there."""

import json

import numpy as np
import pytest
from PIL import Image

from clpipe.analysis.edges import slopes_of

SIZE = 128


def stripes():
    """A picture of wide stripes with soft borders, (SIZE, SIZE), 0 to 255."""
    x = np.arange(SIZE) / SIZE
    return np.broadcast_to(120 + 60 * np.tanh(12 * np.sin(2 * np.pi * 2 * x)), (SIZE, SIZE))


def noise(at_edges):
    """Return noise of sigma 2, with another sigma at the borders of the stripes."""
    normals = np.random.default_rng(1).normal(size=(SIZE, SIZE))
    steep = slopes_of(stripes(), np.ones((SIZE, SIZE), bool)).steep
    return normals * np.where(steep, at_edges, 2.0)


@pytest.mark.parametrize("at_edges", [1.0, 2.0, 5.0])
def test_a_known_ratio_comes_back(at_edges):
    slopes = slopes_of(stripes(), np.ones((SIZE, SIZE), bool))
    assert slopes.steep.mean() == pytest.approx(0.1, abs=0.03)
    assert slopes.flat.mean() == pytest.approx(0.25, abs=0.03)
    assert slopes.ratio(noise(at_edges)[None]) == pytest.approx(at_edges / 2, rel=0.05)


def test_what_is_left_out_does_not_count():
    whole = np.ones((SIZE, SIZE), bool)
    upper = whole & (np.arange(SIZE) < SIZE // 2)[:, None]
    strong = noise(2.0) + np.where(upper, 0, 50)
    assert slopes_of(stripes(), upper).ratio(strong[None]) == pytest.approx(1, rel=0.08)
    assert slopes_of(stripes(), whole).within(upper).ratio(strong[None]) == pytest.approx(
        1, rel=0.08
    )
    assert np.isnan(slopes_of(stripes(), ~whole).ratio(strong[None]))
    assert np.isnan(slopes_of(np.zeros((1, 9)), np.ones((1, 9), bool)).ratio(np.zeros((1, 1, 9))))


def test_measure_says_it(clpipe, tmp_path):
    clean = np.repeat(stripes()[..., None], 3, 2)
    for name, picture in {"clean": clean, "noisy": clean + noise(5.0)[..., None]}.items():
        Image.fromarray(picture.round().astype(np.uint8)).save(tmp_path / f"{name}.png")
    words = "measure", tmp_path / "noisy.png", "--truth", tmp_path / "clean.png"
    found = json.loads(clpipe(*words, "--json").stdout)
    assert found["edges_over_flat"] == pytest.approx(2.5, rel=0.1)
    stdout = clpipe(*words).stdout
    assert f"{found['edges_over_flat']:.2f} times as strong at edges" in stdout
