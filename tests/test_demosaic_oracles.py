"""Linear demosaicing against independent references: published filters, and OpenCV."""

import numpy as np
import pytest
from scipy.ndimage import convolve

from clpipe.chain.making import make_chain
from clpipe.chain.settings import settings_from
from clpipe.engine.runner import Runner
from clpipe.reference.cfa import PATTERNS

INSIDE = np.s_[2:-2, 2:-2]  # where no filter reaches over the border
WHITE = 1023

# Malvar, He and Cutler (ICASSP 2004), figure 2, over 8: green at red and blue; red at green where
# red is in the row; red at blue. Where red is in the column, the second is transposed.
GREEN = [[0, 0, -1, 0, 0], [0, 0, 2, 0, 0], [-1, 2, 4, 2, -1], [0, 0, 2, 0, 0], [0, 0, -1, 0, 0]]
IN_ROW = [
    *([0, 0, 0.5, 0, 0], [0, -1, 0, -1, 0]),
    [-1, 4, 5, 4, -1],
    *([0, -1, 0, -1, 0], [0, 0, 0.5, 0, 0]),
]
ACROSS = [
    *([0, 0, -1.5, 0, 0], [0, 2, 0, 2, 0]),
    [-1.5, 0, 6, 0, -1.5],
    *([0, 2, 0, 2, 0], [0, 0, -1.5, 0, 0]),
]
# The names of OpenCV are those of the 2x2 pixels from the second row and column on.
OPENCV = {"RGGB": "BayerBG", "GRBG": "BayerGB", "GBRG": "BayerGR", "BGGR": "BayerRG"}


def demosaiced(mosaic, pattern, method, device):
    settings = {"stages": ["mosaic", "demosaic"], "mosaic": {"pattern": pattern}}
    chain = make_chain(settings_from({**settings, "demosaic": {"method": method}}))
    grey = np.repeat(mosaic[..., None], 3, 2)
    return Runner(chain, device, encode=False, final=True).run(grey, "k").final


def colours_of(pattern, shape):
    """Where red, green and blue are, (3, height, width)."""
    cell = np.array(list(pattern)).reshape(2, 2)
    sites = np.tile(cell, (shape[0] // 2 + 1, shape[1] // 2 + 1))[: shape[0], : shape[1]]
    return np.stack([sites == colour for colour in "RGB"])


@pytest.fixture
def mosaic():
    return np.random.default_rng(0).random((31, 44), np.float32)


@pytest.mark.parametrize("pattern", PATTERNS)
def test_bilinear_is_a_convolution_of_each_colour(mosaic, pattern, device):
    sites = colours_of(pattern, mosaic.shape)
    plus = np.array([[0, 1, 0], [1, 4, 1], [0, 1, 0]]) / 4
    square = np.array([[1, 2, 1], [2, 4, 2], [1, 2, 1]]) / 4
    planes = [
        convolve(np.where(site, mosaic, 0).astype(float), plus if i == 1 else square)
        for i, site in enumerate(sites)
    ]
    found = demosaiced(mosaic, pattern, "bilinear", device)
    np.testing.assert_allclose(found[INSIDE], np.stack(planes, -1)[INSIDE], atol=1e-6)


@pytest.mark.parametrize("pattern", PATTERNS)
def test_malvar_2004_is_the_published_filters(mosaic, pattern):
    red, green, blue = colours_of(pattern, mosaic.shape)
    filters = (GREEN, IN_ROW, np.transpose(IN_ROW), ACROSS)
    at_other, row, column, across = (
        convolve(mosaic.astype(float), np.array(f) / 8) for f in filters
    )
    expected = np.empty((*mosaic.shape, 3))
    expected[..., 1] = np.where(green, mosaic, at_other)
    for i, own, other in ((0, red, blue), (2, blue, red)):
        in_row = own.any(1)[:, None]
        at_green = np.where(in_row, row, column)
        expected[..., i] = np.where(own, mosaic, np.where(other, across, at_green))
    # In NumPy, with which test_kernels.py compares the kernel.
    found = demosaiced(mosaic, pattern, "malvar2004", None)
    np.testing.assert_allclose(found[INSIDE], expected[INSIDE], atol=1e-6)


@pytest.mark.parametrize("pattern", PATTERNS)
def test_bilinear_is_that_of_opencv(mosaic, pattern):
    cv2 = pytest.importorskip("cv2", reason="needs OpenCV, in the extra compare")
    raw = np.rint(mosaic * WHITE).astype(np.uint16)
    expected = cv2.cvtColor(raw, getattr(cv2, f"COLOR_{OPENCV[pattern]}2RGB"))
    found = demosaiced(raw.astype(np.float32), pattern, "bilinear", None)
    assert np.abs(found[INSIDE] - expected[INSIDE]).max() <= 0.5  # which OpenCV rounds
