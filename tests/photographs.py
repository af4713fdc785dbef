"""The photographs of tests/data, to measure demosaicing on."""

import numpy as np
from PIL import Image

from tests.conftest import DATA


def photographs() -> list[np.ndarray]:
    """Four photographs of 256x256 pixels, (height, width, 3) uint8, without visible noise."""
    return [np.asarray(Image.open(path)) for path in sorted((DATA / "photographs").glob("*.png"))]
