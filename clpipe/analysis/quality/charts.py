"""Charts as linear renders, whose pixels are exact means of the scene over a square pixel.

Edges and discs therefore have no aliasing but that of the pixel grid, and the MTF of a square
pixel. Only where several of the dead leaves share a pixel is their order within it unknown.
"""

from functools import cache

import numpy as np

from clpipe.base.types import Array, Doubles, Floats
from clpipe.camera.profile import SRGB_TO_XYZ
from clpipe.reference.transfer import inverse_srgb_curve

GREY = 0.18  # the linear level of a middle grey
SIDE, BORDER, ROW = 128, 8, 6  # px of a patch, and of background around it; patches in a row

# EV of the grey patches, from a middle grey: in steps of 0.5, and finer where highlights clip.
STOPS = np.concatenate([np.arange(-21, 0) / 2, np.arange(44) / 10])
COVERAGE = 4  # times, by which the leaves cover the chart of dead leaves
SMALLEST = 0.6  # px, the radius of the smallest of the dead leaves
PITCH, DOT = 48, 8.0  # px between the dots of the chart of dots, and their radius

# sRGB levels of the 24 patches of a ColorChecker, row by row, after X-Rite, "Colorimetric values
# for ColorChecker family of targets" (charts made before November 2014).
CHECKER = (
    *((115, 82, 68), (194, 150, 130), (98, 122, 157), (87, 108, 67), (133, 128, 177)),
    *((103, 189, 170), (214, 126, 44), (80, 91, 166), (193, 90, 99), (94, 60, 108)),
    *((157, 188, 64), (224, 163, 46), (56, 61, 150), (70, 148, 73), (175, 54, 60)),
    *((231, 199, 31), (187, 86, 149), (8, 133, 161), (243, 243, 242), (200, 200, 200)),
    *((160, 160, 160), (122, 122, 121), (85, 85, 85), (52, 52, 52)),
)
GREYS = slice(18, 24)  # the grey patches of a ColorChecker

BRADFORD = np.array(
    [[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]]
)
LIGHT_A = np.array([1.09850, 1.0, 0.35585])  # XYZ of illuminant A (CIE 15:2018)


def covered(distance: Doubles, angle: float) -> Doubles:
    """Return the share of a square pixel on the positive side of a straight edge.

    >>> covered(np.array([-1.0, 0.0, 0.25]), 0.0).tolist()
    [0.0, 0.5, 0.75]

    Args:
        distance: that of the pixel's centre from the edge, px.
        angle: of the edge's normal against rows, degrees.
    """
    wide, narrow = sorted((abs(np.cos(np.radians(angle))), abs(np.sin(np.radians(angle)))))[::-1]
    if narrow < 1e-9:
        return np.clip(distance + 0.5, 0, 1)
    corners = ((1, wide + narrow), (-1, wide - narrow), (-1, narrow - wide), (1, -wide - narrow))
    areas = (sign * np.maximum(distance + at / 2, 0) ** 2 for sign, at in corners)
    return np.asarray(sum(areas) / (2 * wide * narrow))


def slanted_edge(contrast: float, angle: float, size: int = 120, middle: float = GREY) -> Floats:
    """Return a render of a grey slanted edge, (size, size, 3), in linear light.

    >>> edge = slanted_edge(4, 0, size=8)
    >>> edge[0, [0, -1], 0].astype(float).round(2).tolist()
    [0.09, 0.36]

    Args:
        contrast: of the bright side to the dark side.
        angle: of the edge's normal against rows, degrees.
        size: side, px.
        middle: the geometric mean of both sides.
    """
    at, normal = np.arange(size) + 0.5 - size / 2, np.radians(angle)
    share = covered(at * np.cos(normal) + at[:, None] * np.sin(normal), angle)
    dark, bright = middle / np.sqrt(contrast), middle * np.sqrt(contrast)
    return grey(dark + (bright - dark) * share)


def chroma_edge(size: int) -> Floats:
    """Return an upright edge between a warm and a cold colour of one luminance, (size, size, 3)."""
    warm, cold = np.array([0.25, 0.16, 0.12]), np.array([0.12, 0.2, 0.3])
    luminance = SRGB_TO_XYZ[1]
    row = np.where(
        np.arange(size)[:, None] < size // 2, warm, cold * (warm @ luminance) / (cold @ luminance)
    )
    return np.tile(row.astype(np.float32), (size, 1, 1))


def grey(light: Doubles) -> Floats:
    """Return a grey image, (height, width, 3), of its luminance."""
    return light.astype(np.float32)[..., None].repeat(3, 2)


def patch_image(colours: Doubles) -> Floats:
    """Return flat patches on grey as a linear render, (rows * 128, 768, 3).

    Args:
        colours: (patch, 3), linear RGB.
    """
    rows = -(-len(colours) // ROW)
    image = np.full((rows * SIDE, ROW * SIDE, 3), GREY, np.float32)
    for number, colour in enumerate(colours):
        y, x = (index * SIDE for index in divmod(number, ROW))
        image[y + BORDER : y + SIDE - BORDER, x + BORDER : x + SIDE - BORDER] = colour
    return image


def patches_of(frames: Array) -> Array:
    """Return the inner parts of an image's patches, (patch, frame, 96, 96, 3).

    Args:
        frames: (frame, rows * 128, 768, 3).
    """
    side = frames.shape[2] // ROW  # a chain may resize the picture
    number, rows, inner = len(frames), frames.shape[1] // side, slice(side // 8, side - side // 8)
    blocks = frames[:, : rows * side, : ROW * side].reshape(number, rows, side, ROW, side, 3)
    patches = blocks[:, :, inner, :, inner].transpose(1, 3, 0, 2, 4, 5)
    return patches.reshape(rows * ROW, number, *patches.shape[-3:])


def grey_steps() -> Doubles:
    """Return the linear levels of 66 grey patches: black, and -10.5 to 4.3 EV of a middle grey."""
    return np.concatenate([[0], GREY * 2**STOPS])


def checker(under_a: bool = False) -> Doubles:
    """Return the linear sRGB of the patches of a ColorChecker, (24, 3), under D65.

    >>> checker()[21].round(3).tolist()
    [0.195, 0.195, 0.191]

    Args:
        under_a: whether they are lit by illuminant A, by Bradford's transform (Lam, 1985).
    """
    light = inverse_srgb_curve(np.array(CHECKER) / 255)
    if not under_a:
        return light
    white = SRGB_TO_XYZ.sum(1)
    gains = (BRADFORD @ LIGHT_A) / (BRADFORD @ white)
    adapt = np.linalg.inv(BRADFORD) @ (gains[:, None] * BRADFORD)
    return np.asarray(light @ (np.linalg.inv(SRGB_TO_XYZ) @ adapt @ SRGB_TO_XYZ).T)


def disc(radius: float, down: Doubles, across: Doubles) -> Doubles:
    """Return the share of each square pixel that a disc covers, (row, column).

    >>> at = np.arange(-3.0, 4)
    >>> share = disc(2.0, at, at)
    >>> share[3].round(3).tolist(), round(float(share.sum() / 4 / np.pi), 6)
    ([0.0, 0.479, 1.0, 1.0, 1.0, 0.479, 0.0], 1.0)

    Args:
        radius: px.
        down: distances of the middles of rows from the centre, px; each is 1 more than the last.
        across: distances of the middles of columns from there.
    """
    # Borders of pixels, in radii.
    y, x = (np.append(at - 0.5, at[-1:] + 0.5) / radius for at in (down, across))
    wide, high = np.minimum(abs(x), 1), np.minimum(abs(y), 1)[:, None]
    chord = np.sqrt(1 - high**2)  # half of it, at each row's border

    def under(at: Doubles) -> Doubles:  # the integral of the circle's height from 0
        return (at * np.sqrt(1 - at**2) + np.arcsin(at)) / 2

    # The area of the disc between its centre and each corner of a pixel.
    beyond = np.where(wide > chord, under(wide) - under(chord), 0)
    area = high * np.minimum(wide, chord) + beyond
    signed = area * np.sign(x) * np.sign(y[:, None])
    return np.asarray(np.diff(np.diff(signed, axis=0), axis=1) * radius**2)


@cache
def dead_leaves(size: int = 512, seed: int = 0) -> Floats:
    """Return overlapping grey discs as a linear render, (size, size, 3) (ISO/TS 19567-2).

    The density of radii falls with their third power, so contrast is the same at all scales.
    """
    rng = np.random.default_rng(seed)
    low, high = SMALLEST**-2, (size / 4) ** -2.0
    count = int(COVERAGE * size**2 / (2 * np.pi * SMALLEST**2 * np.log(size / 4 / SMALLEST)))
    radii = np.sort((low + rng.random(count) * (high - low)) ** -0.5)[::-1]
    radii = radii[rng.permutation(count)]
    centres = rng.uniform(-size / 8, size * 9 / 8, (count, 2))
    levels = rng.uniform(0.3, 1.0, count) * GREY / 0.65
    light = np.full((size, size), GREY)
    for (y, x), radius, level in zip(centres, radii, levels, strict=True):
        top, left = (max(int(c - radius - 1), 0) for c in (y, x))
        part = light[top : int(max(y + radius + 2, 0)), left : int(max(x + radius + 2, 0))]
        rows, columns = map(np.arange, part.shape)
        part += disc(radius, rows + (top - y), columns + (left - x)) * (level - part)
    return grey(light)


def dots(width: int, height: int) -> Floats:
    """Return black dots in a square grid on white, (height, width, 3), one in the centre."""
    sides = (height, width)
    # The middles of a tile's pixels; the dot is between two of them if the side is even.
    down, across = (np.linspace(-PITCH, PITCH - 2, PITCH) / 2 + (n + 1) % 2 / 2 for n in sides)
    places = ((np.arange(n) - n // 2 + PITCH // 2) % PITCH for n in sides)
    return grey(0.5 - 0.48 * disc(DOT, down, across)[np.ix_(*places)])


def glare_spot(width: int, height: int) -> Floats:
    """Return a black spot in the centre of white, (height, width, 3), for veiling glare."""
    down, across = (np.linspace(1 - n, n - 1, n) / 2 for n in (height, width))
    return grey(0.5 - 0.5 * disc(min(width, height) / 20, down, across))
