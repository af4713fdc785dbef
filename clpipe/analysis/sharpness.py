"""Sharpness of pictures, from their straight edges: the e-SFR of ISO 12233:2024.

An edge that is slanted against the pixel grid crosses each of its rows at another fraction of a
pixel. All pixels around it together sample its profile finely. The Fourier transform of the
profile's slope is the modulation transfer function (MTF). Frequencies are those across the edge.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, fields

import numpy as np

from clpipe.analysis.intensity import NOT_IN_JSON
from clpipe.base.types import Array, Doubles
from clpipe.reference.transfer import inverse_srgb_curve

SIDE = 28  # px, of the windows in which edges are sought
STEP = 7  # px between windows
MOST_WINDOWS = 50_000  # in large pictures, fewer are tried
REACH = 9  # px of the profile to each side of an edge that is sought
WIDE = (20, 40, 80)  # px, of an edge that fills its picture: wider if it is blurred
NARROW = 4  # rises of an edge that its profile must have to each side
MAX_EMPTY = 0.2  # share of distances that no pixel has: the edge has a slope such as 1:2
FLAT = 3  # px at each end of the profile that belong to the plateaus
BINS = 4  # of the profile in a pixel
MIN_CONTRAST = 0.03  # between the plateaus, in linear light, of an edge that is sought
DARKEST_CONTRAST = 1e-3  # of an edge that fills its picture
MAX_BEND = 0.35  # px; rms distance of an edge's points from its line
MAX_UNEVENNESS = 0.15  # rms of a plateau over the contrast
MIN_EDGES = 12
SMOOTHINGS = 3  # with a binomial of three values, before the line of an edge is fitted
RINGS = 16  # of frequencies, of noise
ROUNDING = 1 / 255**2 / 12  # the least power of noise, in a file of eight bits
LUMINANCE = np.array([0.2126, 0.7152, 0.0722])  # weights of BT.709, for linear light
FREQUENCIES = np.arange(257) / 256  # cycles/px, at which MTFs are computed
CURVES = ("luma", "red", "green", "blue")


@dataclass(frozen=True, eq=False)
class Edge:
    """A straight edge of a picture.

    Args:
        mtf50: the frequency at which contrast falls to a half, cycles/px.
        mtf10: the frequency at which it falls to a tenth; NaN above 1 cycle/px.
        nyquist: the MTF at 0.5 cycles/px.
        overshoot: how far the bright side exceeds its plateau near the edge, over the contrast.
        undershoot: the same of the dark side.
        red: the place of the edge in red minus that in green, px, towards the bright side.
        blue: the same of blue.
        contrast: the difference of luminance between the sides.
        capacity: Koren's information capacity of this contrast, bits/px.
        mtf: the MTF of each of :data:`CURVES` at :data:`FREQUENCIES`, (4, 257).
    """

    mtf50: float
    mtf10: float
    nyquist: float
    overshoot: float
    undershoot: float
    red: float
    blue: float
    contrast: float
    capacity: float
    mtf: Doubles = field(metadata=NOT_IN_JSON)


def edges_in(picture: Array) -> list[Edge]:
    """Return the straight, isolated edges of a picture.

    >>> from clpipe.analysis.quality.charts import slanted_edge
    >>> [edge] = edges_in(np.uint8(slanted_edge(4, 5, size=SIDE) * 255))
    >>> 0.3 < edge.mtf50 < 0.7
    True

    Args:
        picture: (height, width, 3) uint8, as written to a file: sRGB.
    """
    light = inverse_srgb_curve(picture / 255)
    luma = light @ LUMINANCE
    slopes = np.stack(np.gradient(luma))
    height, width = luma.shape
    step = max(STEP, int((luma.size / MOST_WINDOWS) ** 0.5))
    found = []
    for y in range(0, height - SIDE + 1, step):
        for x in range(0, width - SIDE + 1, step):
            window = np.s_[y : y + SIDE, x : x + SIDE]
            levels = picture[window]
            if np.ptp(luma[window]) >= MIN_CONTRAST and levels.max() < 253 and levels.min() > 1:
                distance = _distance(slopes[:, *window])
                edge = None if distance is None else _edge(light[window], distance, REACH, True)
                found += [edge] if edge else []
    return found


def edge_of(light: Doubles, strict: bool = False) -> Edge | None:
    """Return the edge that fills a picture, or None if it has no straight edge.

    The edge may be curved by distortion, like a polynomial of the third degree.

    >>> from clpipe.analysis.quality.charts import slanted_edge
    >>> edge = edge_of(slanted_edge(4, 5).astype(float))
    >>> round(edge.mtf50 / 0.603, 2), round(edge.contrast, 2)  # a square pixel, along its side
    (1.0, 0.27)

    Args:
        light: linear RGB, (height, width, 3). It should have 40 px to both sides of the edge.
        strict: whether both sides must be even, so that a photograph is not taken for an edge.
    """
    luma = light @ LUMINANCE
    smooth = luma
    for _ in range(2 * SMOOTHINGS):  # along each axis, against noise
        wide = np.pad(smooth, ((1, 1), (0, 0)), "edge")
        smooth = ((wide[:-2] + 2 * wide[1:-1] + wide[2:]) / 4).T
    distance = _distance(np.stack(np.gradient(smooth)), fills=True)
    if distance is None:
        return None
    room = int(np.abs(np.percentile(distance, [3, 97])).min())
    edge = None
    for reach in sorted({min(each, room) for each in WIDE if room > 2 * FLAT}):
        edge, profile = _edge(light, distance, reach, strict), _profile(distance, luma, reach)
        if edge is None or profile is None or NARROW * _rise(profile) < reach:
            break
    return edge


def _rise(profile: Doubles) -> float:
    """Return the distance in which a profile rises from 10 to 90 %, px."""
    ends = profile[: FLAT * BINS].mean(), profile[-FLAT * BINS :].mean()
    levels = np.maximum.accumulate((profile - ends[0]) / (ends[1] - ends[0]))
    return float(np.diff(np.searchsorted(levels, [0.1, 0.9]))[0] / BINS)


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
    values = {each.name: [getattr(edge, each.name) for edge in edges] for each in fields(Edge)}
    medians = {name: np.median(np.abs(each), axis=0) for name, each in values.items()}
    mtf = medians.pop("mtf")
    return Edge(**{name: float(each) for name, each in medians.items()}, mtf=mtf)


def frequency_at(level: float, mtf: Doubles) -> float:
    """Return the lowest frequency at which an MTF falls to a level, cycles/px; NaN without one.

    >>> round(frequency_at(0.5, np.sinc(FREQUENCIES)), 3)
    0.603
    """
    below = int(np.argmax(mtf < level))
    if not below:
        return float("nan")
    return float(np.interp(level, mtf[[below, below - 1]], FREQUENCIES[[below, below - 1]]))


def _edge(light: Doubles, distance: Doubles, reach: int, strict: bool) -> Edge | None:
    """Return the edge of a window, from the distance of its pixels; None if it is not isolated."""
    luma = light @ LUMINANCE
    planes = (luma, *np.moveaxis(light, -1, 0))
    profiles = [p for each in planes if (p := _profile(distance, each, reach)) is not None]
    if len(profiles) < len(planes):
        return None
    ends = np.s_[: FLAT * BINS], np.s_[-FLAT * BINS :]
    spans = [[p[end] for end in ends] for p in profiles]
    contrasts = [bright.mean() - dark.mean() for dark, bright in spans]
    contrast, uneven = contrasts[0], max(each.std() for each in spans[0])
    least = MIN_CONTRAST if strict else DARKEST_CONTRAST
    if min(contrasts[1:]) < least / 2 or contrast < least:
        return None
    if strict and uneven > MAX_UNEVENNESS * contrast:
        return None
    scaled = [
        (p - dark.mean()) / size
        for p, (dark, _), size in zip(profiles, spans, contrasts, strict=True)
    ]
    mtf = np.stack([_transfer(profile) for profile in scaled])
    mtf50 = frequency_at(0.5, mtf[0])
    if np.isnan(mtf50):
        return None
    halves = scaled[0].reshape(-1, BINS // 2).mean(1)
    plateau, near = FLAT * 2, halves[FLAT * 2 : -FLAT * 2]
    # The largest of many values exceeds the plateau by about two sigmas of their noise.
    noise = 0.0 if reach <= REACH else 2 * max(halves[:plateau].std(), halves[-plateau:].std())
    red, green, blue = (_centre(profile, reach) for profile in scaled[1:])
    plateaus = (abs(distance) > reach - FLAT) & (abs(distance) < reach + 2 * FLAT)
    smooth = np.interp(distance, (np.arange(2 * reach * BINS) + 0.5) / BINS - reach, profiles[0])
    grain = np.where(plateaus, luma - smooth, 0.0)
    return Edge(
        mtf50,
        frequency_at(0.1, mtf[0]),
        float(mtf[0, len(FREQUENCIES) // 2]),
        max(float(near.max()) - 1 - noise, 0.0),
        max(float(-near.min()) - noise, 0.0),
        red - green,
        blue - green,
        float(contrast),
        _capacity(contrast, mtf[0], grain, int(plateaus.sum())),
        mtf,
    )


def _capacity(contrast: float, mtf: Doubles, noise: Doubles, count: int) -> float:
    """Return the information capacity, bits/px (Koren, "Image information metrics", EI 2023).

    It is the integral of log2(1 + S/N) over all frequencies below 0.5 cycles/px. The signal is
    spread evenly over the contrast, so its power is that of the contrast times the MTF over 12.

    Args:
        contrast: between the plateaus.
        mtf: at :data:`FREQUENCIES`.
        noise: luminance minus the edge in plateaus, (height, width), and 0 elsewhere.
        count: the number of pixels in plateaus.
    """
    height, width = noise.shape
    power = np.abs(np.fft.fft2(noise)) ** 2 / count
    frequency = np.hypot(np.fft.fftfreq(width), np.fft.fftfreq(height)[:, None])
    rings = (frequency * RINGS / 0.5).astype(int).ravel()
    radial = np.bincount(rings, power.ravel())[:RINGS] / np.bincount(rings)[:RINGS]
    at = (np.arange(RINGS) + 0.5) * 0.5 / RINGS
    signal = (contrast * np.interp(at, FREQUENCIES, mtf)) ** 2 / 12
    bits = np.log2(1 + signal / np.maximum(radial, ROUNDING))
    return float(2 * np.pi * (bits * at).sum() * 0.5 / RINGS)


def _distance(slopes: Doubles, fills: bool = False) -> Doubles | None:
    """Return each pixel's distance from a window's edge, px, or None if there is no straight edge.

    It is above 0 on the bright side.

    Args:
        slopes: the slopes down and across, (2, height, width).
        fills: whether an edge is known to fill the window. It may then be curved, noisy, and off
            the centre.
    """
    down, across = slopes
    steep = np.hypot(across, down)
    weights = np.where(steep > 0.3 * steep.max(), steep, 0) ** 2
    xx, yy, xy = ((weights * p).sum() for p in (across**2, down**2, across * down))
    if np.hypot(xx - yy, 2 * xy) < (0.5 if fills else 0.9) * (xx + yy):
        return None
    angle = 0.5 * np.arctan2(2 * xy, xx - yy)  # of the normal: the structure tensor's main axis
    if (weights * (across * np.cos(angle) + down * np.sin(angle))).sum() < 0:
        angle += np.pi
    y, x = (np.arange(size) - (size - 1) / 2 for size in down.shape)
    distance = x * np.cos(angle) + y[:, None] * np.sin(angle)
    place = y[:, None] * np.cos(angle) - x * np.sin(angle)
    line, bend = _line(place, distance, weights, 1)
    if fills:
        rising = np.maximum(across * np.cos(angle) + down * np.sin(angle), 0)
        for _ in range(2):
            near = np.clip(1 - abs(distance - line(place)) / REACH, 0, 1)
            line, bend = _line(place, distance, rising * near, 3)
    elif bend > MAX_BEND or abs(line(0)) > STEP:
        return None
    distance = (distance - line(place)) / np.hypot(1, line.deriv()(place))
    length = abs(place[abs(distance) < 1]).max(initial=0)
    counts = np.histogram(distance, np.arange(-30, 31) / 10)[0]
    uneven = fills and (counts < 0.25 * counts.mean()).mean() > MAX_EMPTY
    return distance if length >= min(down.shape) / 4 and not uneven else None


def _line(
    place: Doubles, distance: Doubles, weights: Doubles, degree: int
) -> tuple[np.poly1d, float]:
    """Return the polynomial of an edge's points, and their rms distance from it, px."""
    rows = np.floor(place - place.min()).astype(int)
    total = np.bincount(rows.ravel(), weights.ravel())
    used = total > 0.2 * total.max()
    if used.sum() <= max(degree, min(place.shape) / 2):
        return np.poly1d([0]), np.inf
    points = np.bincount(rows.ravel(), (weights * distance).ravel())[used] / total[used]
    at = (np.arange(len(total)) + 0.5 + place.min())[used]
    line = np.poly1d(np.polyfit(at, points, degree))
    return line, float(np.sqrt(np.mean((points - line(at)) ** 2)))


def _profile(distance: Doubles, values: Doubles, reach: int) -> Doubles | None:
    """Return the values in bins of the distance, from -reach to reach, or None if many are empty.

    Samples are not even in a bin, so each mean is moved along its slope to the bin's centre.
    """
    bins = np.floor((distance + reach) * BINS).astype(int)
    size = 2 * reach * BINS
    inside = (bins >= 0) & (bins < size)
    counts = np.bincount(bins[inside], minlength=size)
    filled = np.flatnonzero(counts)
    if len(filled) < 0.9 * size:
        return None
    sums = (np.bincount(bins[inside], each[inside], size)[filled] for each in (distance, values))
    at, mean = (each / counts[filled] for each in sums)
    moved = mean + np.gradient(mean, at) * ((filled + 0.5) / BINS - reach - at)
    return np.interp(np.arange(size), filled, moved)


def _transfer(profile: Doubles) -> Doubles:
    """Return the MTF of a profile at :data:`FREQUENCIES`."""
    spread = np.diff(profile)
    spread = spread * np.hanning(len(spread) + 2)[1:-1] ** 0.5
    mtf = np.abs(np.fft.rfft(spread, 256 * BINS))[: len(FREQUENCIES)]
    # Bins and differences have a width of their own.
    return np.asarray(mtf / mtf[0] / np.sinc(FREQUENCIES / BINS) ** 2)


def _centre(profile: Doubles, reach: int) -> float:
    """Return the centre of an edge's slope, px."""
    middle = np.diff(profile)[(reach - 4) * BINS : -(reach - 4) * BINS]
    return float((middle * np.arange(len(middle))).sum() / middle.sum() / BINS)
