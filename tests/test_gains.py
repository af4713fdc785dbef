"""The figure of the gains of denoisers on real pictures."""

import re

import numpy as np
import pytest

from tools.pages.gains import drawn, gains_of

pytestmark = pytest.mark.slow
SCORES = {
    "noisy": {"psnr": [[30.0, 34.0]]},
    "awgn": {"psnr": [[30.5, 33.0], [31.5, 34.0]]},
    "clpipe": {"psnr": [[33.0, 36.0], [33.0, 37.0]]},
}


def test_gains_are_over_the_noisy_picture_and_means_of_seeds():
    gains = gains_of(SCORES)
    assert list(gains) == ["awgn", "clpipe"]
    assert gains["awgn"].tolist() == [1.0, -0.5] and gains["clpipe"].tolist() == [3.0, 2.5]


def test_every_picture_has_its_dot():
    figure = drawn({"Nikon": gains_of(SCORES), "Canon": gains_of(SCORES)})
    dots = re.findall(r'<circle class="dot" cx="([\d.]+)"', figure)
    assert len(dots) == 2 * 2 * 2 and np.ptp(np.array(dots, float)) > 100
    texts = re.findall(r"<text[^>]*>([^<]*)<", figure)
    assert "+2.8" in texts and "Nikon" in texts
    assert sum("2 pictures" in text for text in texts) == 2
