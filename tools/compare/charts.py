"""Charts of known colours as linear renders: square patches on grey, six in a row."""

import numpy as np
from numpy.typing import NDArray

from clpipe.base.types import Doubles, Floats, Mask
from clpipe.reference.transfer import inverse_srgb_curve

SIDE = 64  # px, of a patch
EDGE = SIDE // 8  # px of background around each
INNER = SIDE // 4  # px from the border of a patch to its measured part
ROW = 6  # patches
BACKGROUND = 0.18  # linear

GREY = 21  # the number of the grey patch in CHART, which is 19.5 % of white

# sRGB levels of the 24 patches of a ColorChecker, row by row, after X-Rite, "Colorimetric values
# for ColorChecker family of targets" (charts made before November 2014).
CHART = (
    *((115, 82, 68), (194, 150, 130), (98, 122, 157), (87, 108, 67), (133, 128, 177)),
    *((103, 189, 170), (214, 126, 44), (80, 91, 166), (193, 90, 99), (94, 60, 108)),
    *((157, 188, 64), (224, 163, 46), (56, 61, 150), (70, 148, 73), (175, 54, 60)),
    *((231, 199, 31), (187, 86, 149), (8, 133, 161), (243, 243, 242), (200, 200, 200)),
    *((160, 160, 160), (122, 122, 121), (85, 85, 85), (52, 52, 52)),
)

# Linear light of the saturated chart. Each hue is bright and dim, with its darkest channel near
# black, where noise that leaks through colour differences is most visible.
BRIGHT = (0.7, 0.2)
DARK = (0.03, 0.004)
HUES = ((1, 0, 0), (1, 0.4, 0), (1, 1, 0), (0, 1, 0), (0, 0, 1), (1, 0, 1))


def chart_patches() -> Doubles:
    """Return the 24 patches of a ColorChecker, (24, 3) in sRGB levels, 0 to 255, row by row.

    >>> chart_patches()[GREY].tolist()
    [122.0, 122.0, 121.0]
    """
    return np.array(CHART, np.float64)


def linear(levels: NDArray[np.number]) -> Doubles:
    """Convert sRGB levels, 0 to 255, to linear light, 0 to 1.

    >>> linear(np.array([0, 122, 255])).round(3).tolist()
    [0.0, 0.195, 1.0]
    """
    return inverse_srgb_curve(np.asarray(levels / 255, np.float64))


def saturated_patches() -> Doubles:
    """Return 24 saturated colours, (24, 3) linear: six hues, two bright levels, two dark levels.

    >>> saturated_patches()[0].tolist()
    [0.7, 0.03, 0.03]
    """
    hues = np.array(HUES, np.float64)
    return np.concatenate([d + (b - d) * hues for b in BRIGHT for d in DARK])


def patch_image(colours: Doubles) -> Floats:
    """Return flat patches on grey as a linear render, (rows * 64, 384, 3).

    Args:
        colours: (patch, 3), linear RGB.
    """
    rows = -(-len(colours) // ROW)
    image = np.full((rows * SIDE, ROW * SIDE, 3), BACKGROUND, np.float32)
    for number, colour in enumerate(colours):
        y, x = (index * SIDE for index in divmod(number, ROW))
        image[y + EDGE : y + SIDE - EDGE, x + EDGE : x + SIDE - EDGE] = colour
    return image


def chart_image() -> Floats:
    """Return the 24 patches of :func:`chart_patches` as a linear render, (256, 384, 3)."""
    return patch_image(linear(chart_patches()))


def patch_places(height: int, patches: int = 24) -> Mask:
    """Return the mask, (height, 384), of the inner halves of an image's patches.

    >>> int(patch_places(256).sum()) == 24 * 32 * 32
    True
    """
    y, x = np.mgrid[0:height, 0 : ROW * SIDE]
    inner = [(axis % SIDE >= INNER) & (axis % SIDE < SIDE - INNER) for axis in (y, x)]
    return np.asarray(inner[0] & inner[1] & (y // SIDE * ROW + x // SIDE < patches))


def patch_means(picture: NDArray[np.number], patches: int = 24) -> Doubles:
    """Return the means of the inner halves of an image's patches, (patch, 3).

    Args:
        picture: (height, 384, 3), in any unit.
        patches: the number of patches.

    >>> bool(np.allclose(patch_means(chart_image()), linear(chart_patches())))
    True
    """
    rows = -(-patches // ROW)
    blocks = picture[: rows * SIDE].reshape(rows, SIDE, ROW, SIDE, -1)
    inner = blocks[:, INNER:-INNER, :, INNER:-INNER].mean((1, 3), dtype=np.float64)
    return np.asarray(inner.reshape(rows * ROW, -1)[:patches])
