"""The noise of finished pictures by luma and in saturated colours, next to that of real cameras."""

from collections.abc import Mapping, Sequence

import numpy as np

from clpipe.analysis.matching.columns import (
    BY_LUMA,
    CHROMA_SIGMA,
    COLUMNS,
    LEVELS,
    RELATIVE_TO,
    SKEWS,
    WEAK,
    Figures,
    by_intensity,
    flat_places,
    noise_of_frames,
)
from clpipe.base.types import Floats

NAMES = (
    *SKEWS,
    *(f"{CHROMA_SIGMA}_{low}" for low in LEVELS[:-1] if low != RELATIVE_TO),
    WEAK,
)
# The ranges of the five camera sets of Nam et al. (CVPR 2016) and the five cameras of PolyU. One
# 5D Mark III (chroma in shadows: 0.43, 0.46) and one D600 (weak over strong: 0.65) lie outside.
REAL = {
    "skew_80": (-0.05, 0.05),
    "skew_112": (-0.20, 0.06),
    "skew_160": (-0.12, -0.01),
    "chroma_sigma_12": (0.54, 0.78),
    "chroma_sigma_24": (0.65, 0.92),
    "chroma_sigma_96": (0.87, 1.17),
    "chroma_sigma_128": (0.83, 1.11),
    WEAK: (0.80, 1.15),
}


def relative(figures: Figures) -> Figures:
    """Return figures in which noise by luma is a share of that at 64-95, for comparing cameras.

    >>> relative({"rms": 3.0, "sigma_64": 4.0, "sigma_96": 2.0})
    {'rms': 3.0, 'sigma_64': 1.0, 'sigma_96': 0.5}
    """
    found = dict(figures)
    for name, value in figures.items():
        if (kind := name.rpartition("_")[0]) in BY_LUMA:
            found[name] = value / (figures[f"{kind}_{RELATIVE_TO}"] or np.nan)
    return found


def finished_figures(frames: Sequence[Floats], truth: Floats | None) -> Figures:
    """Return the skew of luma noise, chroma noise by luma, and weak over strong channels.

    The names are those of :data:`NAMES`, with NaN where there are too few flat pixels.

    Args:
        frames: pictures of one scene, (height, width, 3), 0 to 1.
        truth: the scene without noise; None uses the mean of the frames.
    """
    clean = np.mean(frames, axis=0) if truth is None else truth
    levels = [frame * np.float32(255) for frame in frames]
    noise = noise_of_frames(levels, None if truth is None else truth * np.float32(255))
    figures = relative(by_intensity(noise, flat_places(clean * 255)))
    return {name: figures.get(name, np.nan) for name in NAMES}


def finished_rows(figures: Mapping[str, float]) -> list[tuple[str, float, str]]:
    """Return the text of each figure that is known, the figure, and the range of real cameras."""
    return [
        (text_of(name), value, "{:.2f} to {:.2f}".format(*REAL[name]) if name in REAL else "")
        for name, value in figures.items()
        if not np.isnan(value)
    ]


def text_of(name: str) -> str:
    """Return the text of a figure; chroma noise is relative to that at 64-95.

    >>> text_of("chroma_sigma_12"), text_of("skew_24")
    ('chroma rms at 12-23 over that at 64-95', 'luma skew at 24-47')
    """
    text = COLUMNS[name].text
    end = LEVELS[LEVELS.index(RELATIVE_TO) + 1] - 1
    is_relative = name.rpartition("_")[0] in BY_LUMA
    return (
        f"{text.removesuffix(', levels')} over that at {RELATIVE_TO}-{end}" if is_relative else text
    )
