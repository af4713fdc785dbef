"""Edges of the default chain and of its ground truth, on slanted edges."""

import numpy as np
import pytest

from clpipe.analysis.quality.charts import slanted_edge
from clpipe.analysis.sharpness import edges_in, median_edge, sharpest
from clpipe.chain.making import make_chain
from clpipe.chain.settings import settings_from
from clpipe.chain.truth import picture_without_noise
from clpipe.engine.runner import Runner
from clpipe.stages.optical_blur import line_spread

ANGLES = (5, 20, 70, 85)
CONTRASTS = (10, 4, 1.5)


def developed(chain, device, contrast, frames=1, angles=ANGLES):
    """Return the median of developed slanted edges, from the means of frames."""
    runner, edges = Runner(chain, device), []
    for angle in angles:
        render = slanted_edge(contrast, angle)
        pictures = [runner.run(render, f"{angle}:{n}").encoded for n in range(frames)]
        edges += edges_in(np.mean(pictures, axis=0).round().astype(np.uint8))
    assert len(edges) > 5 * len(angles)
    return median_edge(edges)


@pytest.mark.parametrize("sigma", [0.4, 0.65, 1.0])
def test_the_mtf_is_that_of_the_blur(sigma, device):
    stages = {"stages": ["optical_blur", "gamma"], "optical_blur": {"sigma": sigma}}
    light, frequency = line_spread(sigma, 0, 0), np.linspace(0, 0.5, 501)
    places = np.arange(len(light)) - len(light) // 2
    for angle in ANGLES:
        edge = developed(make_chain(settings_from(stages)), device, 4, angles=[angle])
        # The render's edge was sampled by the area of pixels.
        mtf = 1.0
        for part in (np.cos(np.radians(angle)), np.sin(np.radians(angle))):
            blurred = np.cos(2 * np.pi * frequency[:, None] * part * places) @ light
            mtf = mtf * blurred * np.sinc(frequency * part)
        assert edge.mtf50 == pytest.approx(frequency[np.argmax(mtf < 0.5)], rel=0.015)
        assert edge.nyquist == pytest.approx(mtf[-1], abs=0.02)
        assert max(edge.overshoot, edge.undershoot) < 0.01
        assert max(edge.red, edge.blue) < 0.02


def test_edges_at_the_base_iso_are_those_of_cameras(device):
    for contrast in CONTRASTS:
        edge = developed(make_chain(settings_from({"iso": 100})), device, contrast)
        assert 0.3 <= edge.mtf50 <= 0.4
        assert 0.1 <= edge.nyquist <= 0.32
        assert 0.04 <= edge.overshoot <= 0.11


@pytest.mark.slow
@pytest.mark.parametrize("denoise", ["biweight", "bilateral"])
@pytest.mark.parametrize("contrast", CONTRASTS)
def test_edges_do_not_become_sharper_with_noise(contrast, denoise, device):
    settings = {"denoise": {"method": denoise}}
    clean = developed(make_chain(settings_from({"iso": 100, **settings})), device, contrast)
    for iso in (1600, 6400):
        chain = make_chain(settings_from({"iso": iso, **settings}))
        noisy = developed(chain, device, contrast, frames=24)
        assert noisy.mtf50 <= clean.mtf50 * 1.02
        if contrast > 2 and denoise == "biweight":
            for truth in ("clean", "development"):
                edge = developed(picture_without_noise(truth, chain), device, contrast)
                assert edge.mtf50 == pytest.approx(noisy.mtf50, rel=0.08)  # angles differ by 6 %


def test_lateral_colour_is_measured(device):
    lens = {"stages": ["distortion", "gamma"], "distortion": {"method": "poly3", "kr": 1.01}}
    runner = Runner(make_chain(settings_from(lens)), device)
    picture = runner.run(np.roll(slanted_edge(4, 5), 30, axis=1), "k").encoded
    edges = edges_in(picture[:, 60:])
    assert median_edge(edges).red == pytest.approx(0.3, abs=0.1)
    assert median_edge(edges).blue < 0.05


def test_few_edges_say_nothing():
    assert sharpest(edges_in(np.full((200, 200, 3), 90, np.uint8))) is None
