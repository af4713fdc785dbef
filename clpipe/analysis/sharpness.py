"""Sharpness of pictures, from their straight edges, like the e-SFR of ISO 12233:2017.

An edge that is slanted against the pixel grid crosses each of its rows at another fraction of a
pixel. All pixels around it together sample its profile finely. The Fourier transform of the
profile's slope is the modulation transfer function (MTF).
"""

from collections.abc import Iterator, Sequence
from dataclasses import astuple, dataclass

import numpy as np

from clpipe.base.types import Array, Doubles, Floats
from clpipe.reference.transfer import inverse_srgb_curve

SIDE = 28  # px, of the windows in which edges are sought
STEP = 7  # px between windows
REACH = 9  # px of the profile to each side of an edge
FLAT = 3  # px at each end of the profile that belong to the plateaus
BINS = 4  # of the profile in a pixel
MIN_CONTRAST = 0.03  # between the plateaus, in linear light
MAX_BEND = 0.35  # px; rms distance of an edge's points from its line
MAX_UNEVENNESS = 0.15  # rms of a plateau over the contrast
MIN_EDGES = 12
LUMINANCE = np.array([0.2126, 0.7152, 0.0722])  # weights of BT.709, for linear light


@dataclass(frozen=True)
class Edge:
    """A straight edge of a picture.

    Args:
        mtf50: the frequency at which contrast falls to a half, cycles/px.
        nyquist: the MTF at 0.5 cycles/px.
        overshoot: how far the bright side exceeds its plateau near the edge, over the contrast.
        undershoot: the same of the dark side.
        red: the place of the edge in red minus that in green, px, towards the bright side.
        blue: the same of blue.
    """

    mtf50: float
    nyquist: float
    overshoot: float
    undershoot: float
    red: float
    blue: float


def slanted_edge(contrast: float, angle: float, size: int = 120, middle: float = 0.18) -> Floats:
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
    samples = 8
    at = (np.arange(size * samples) + 0.5) / samples - size / 2
    normal = np.radians(angle)
    distance = at * np.cos(normal) + at[:, None] * np.sin(normal)
    share = (distance > 0).reshape(size, samples, size, samples).mean((1, 3))
    dark, bright = middle / np.sqrt(contrast), middle * np.sqrt(contrast)
    light = np.asarray(dark + (bright - dark) * share, np.float32)
    return light[..., None].repeat(3, 2)


def edges_in(picture: Array) -> list[Edge]:
    """Return the straight, isolated edges of a picture.

    >>> [edge] = edges_in(np.uint8(slanted_edge(4, 5, size=SIDE) * 255))
    >>> 0.3 < edge.mtf50 < 0.7
    True

    Args:
        picture: (height, width, 3) uint8, as written to a file: sRGB.
    """
    light = inverse_srgb_curve(picture / 255)
    luma = light @ LUMINANCE
    down, across = np.gradient(luma)
    height, width = luma.shape
    found: list[Edge] = []
    for y in range(0, height - SIDE + 1, STEP):
        for x in range(0, width - SIDE + 1, STEP):
            window = np.s_[y : y + SIDE, x : x + SIDE]
            levels = picture[window]
            if np.ptp(luma[window]) >= MIN_CONTRAST and levels.max() < 253 and levels.min() > 1:
                found += _edge_of(light[window], luma[window], across[window], down[window])
    return found


def sharpest(edges: Sequence[Edge]) -> Edge | None:
    """Return the medians of the sharpest quarter of edges, or None if there are fewer than 12.

    Only the sharpest edges of a picture are in focus, and sharp in the scene.
    """
    if len(edges) < MIN_EDGES:
        return None
    ranked = sorted(edges, key=lambda edge: -edge.mtf50)
    return median_edge(ranked[: len(ranked) // 4])


def median_edge(edges: Sequence[Edge]) -> Edge:
    """Return the medians of the edges' figures; of displacements, those of their sizes."""
    return Edge(*np.median(np.abs([astuple(edge) for edge in edges]), axis=0).tolist())


def _edge_of(light: Doubles, luma: Doubles, across: Doubles, down: Doubles) -> Iterator[Edge]:
    """Yield the edge through the middle of a window, if there is one."""
    distance = _distance(across, down)
    profile = None if distance is None else _profile(distance, luma)
    if distance is None or profile is None:
        return
    dark, bright = profile[: FLAT * BINS], profile[-FLAT * BINS :]
    contrast = bright.mean() - dark.mean()
    uneven = max(dark.std(), bright.std()) > MAX_UNEVENNESS * contrast
    places = [_centre(_profile(distance, light[..., c])) for c in range(3)]
    if contrast < MIN_CONTRAST or uneven or None in places:
        return
    profile = (profile - dark.mean()) / contrast
    frequency, mtf = _transfer(profile)
    below = int(np.argmax(mtf < 0.5))
    if below == 0:
        return
    near = profile[FLAT * BINS : -FLAT * BINS].reshape(-1, BINS // 2).mean(1)
    red, green, blue = (float(each or 0) for each in places)
    yield Edge(
        float(np.interp(0.5, mtf[[below, below - 1]], frequency[[below, below - 1]])),
        float(np.interp(0.5, frequency, mtf)),
        max(float(near.max()) - 1, 0.0),
        max(float(-near.min()), 0.0),
        red - green,
        blue - green,
    )


def _distance(across: Doubles, down: Doubles) -> Doubles | None:
    """Return each pixel's distance from a window's edge, px, or None if there is no straight edge.

    It is above 0 on the bright side.

    Args:
        across: the slope along rows, (SIDE, SIDE).
        down: the slope along columns, of that shape.
    """
    steep = np.hypot(across, down)
    weights = np.where(steep > 0.3 * steep.max(), steep, 0) ** 2
    xx, yy, xy = ((weights * p).sum() for p in (across**2, down**2, across * down))
    if np.hypot(xx - yy, 2 * xy) < 0.9 * (xx + yy):
        return None
    angle = 0.5 * np.arctan2(2 * xy, xx - yy)  # of the normal: the structure tensor's main axis
    at = np.arange(SIDE) - (SIDE - 1) / 2
    if (weights * (across * np.cos(angle) + down * np.sin(angle))).sum() < 0:
        angle += np.pi
    distance = at * np.cos(angle) + at[:, None] * np.sin(angle)
    place = at[:, None] * np.cos(angle) - at * np.sin(angle)
    line = _line(place, distance, weights)
    if line is None:
        return None
    offset, slope = line
    distance = (distance - offset - slope * place) / np.hypot(1, slope)
    length = abs(place[abs(distance) < 1]).max(initial=0)
    return distance if abs(offset) <= STEP and length >= SIDE / 4 else None


def _line(place: Doubles, distance: Doubles, weights: Doubles) -> tuple[float, float] | None:
    """Return offset and slope of the edge's points, or None if they are not on a line."""
    rows = np.clip((place + SIDE / 2).astype(int), 0, SIDE - 1)
    total = np.bincount(rows.ravel(), weights.ravel(), SIDE)
    used = total > 0.2 * total.max()
    if used.sum() < SIDE / 2:
        return None
    points = np.bincount(rows.ravel(), (weights * distance).ravel(), SIDE)[used] / total[used]
    at = (np.arange(SIDE) + 0.5 - SIDE / 2)[used]
    slope, offset = np.polyfit(at, points, 1)
    bend = np.sqrt(np.mean((points - offset - slope * at) ** 2))
    return (float(offset), float(slope)) if bend <= MAX_BEND else None


def _profile(distance: Doubles, values: Doubles) -> Doubles | None:
    """Return the means in bins of the distance, from -REACH to REACH, or None if one is empty."""
    bins = np.floor((distance + REACH) * BINS).astype(int)
    inside = (bins >= 0) & (bins < 2 * REACH * BINS)
    counts = np.bincount(bins[inside], minlength=2 * REACH * BINS)
    if not counts.all():
        filled = np.flatnonzero(counts)
        if len(filled) < 0.9 * len(counts):
            return None
        sums = np.bincount(bins[inside], values[inside], minlength=len(counts))
        return np.interp(np.arange(len(counts)), filled, sums[filled] / counts[filled])
    return np.asarray(np.bincount(bins[inside], values[inside], len(counts)) / counts)


def _transfer(profile: Doubles) -> tuple[Doubles, Doubles]:
    """Return frequencies, cycles/px, and the MTF of a profile."""
    spread = np.diff(profile)
    spread = spread * np.hanning(len(spread) + 2)[1:-1] ** 0.5
    mtf = np.abs(np.fft.rfft(spread, 1024))
    frequency = np.fft.rfftfreq(1024, 1 / BINS)
    used = frequency < 1
    # Bins and differences have a width of their own.
    width = np.sinc(frequency[used] / BINS) ** 2
    found = np.asarray(mtf[used] / mtf[0] / width, np.float64)
    return np.asarray(frequency[used], np.float64), found


def _centre(profile: Doubles | None) -> float | None:
    """Return the centre of an edge's slope, px."""
    if profile is None or abs(profile[-1] - profile[0]) < MIN_CONTRAST / 2:
        return None
    spread = np.diff(profile)[(REACH - 4) * BINS : -(REACH - 4) * BINS]
    return float((spread * np.arange(len(spread))).sum() / spread.sum() / BINS)
