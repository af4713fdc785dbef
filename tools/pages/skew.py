"""Draws how single changes to the development skew its luma noise: docs/skew.svg.

A chart of grey patches is developed at three ISOs. For each patch, the skew of luma noise is drawn
over the patch's luma. Each panel has one change.
"""

from collections.abc import Callable, Mapping
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

import clpipe
from clpipe.analysis.matching.columns import skewness
from clpipe.base.types import Doubles, Floats
from clpipe.reference.colour import luma
from clpipe.reference.transfer import inverse_srgb_curve, srgb_curve
from clpipe.stages.tone_curve import Standard
from tools.shared.plots import save
from tools.shared.tables import markdown

ISOS = (1600, 3200, 6400)
LEVELS = 24  # patches
PATCH, MARGIN = 96, 8  # px; the margin is not measured
FRAMES = 8
REAL = (-0.2, 0.08)  # the cameras' range in midtones
RANGES = ((80, 112), (112, 160), (160, 220))  # of luma

Curve = Callable[[Floats], Floats]  # linear RGB to linear RGB, 0..1


def two_pieces(x: Floats) -> Floats:
    """Apply the style of clpipe before: two rational pieces meet at grey, where the slope peaks."""
    grey, out, contrast, toe, shoulder = 0.09, 0.173, 2.2, 0.85, 0.95

    def piece(v: Floats, width: float, height: float, first: float, last: float) -> Floats:
        chord = height / width
        bend = (first + last - 2 * chord) / height
        return v * ((chord - first) / width * v + first) / (v * (bend - bend / width * v) + 1)

    slope = contrast * out / grey
    dark = piece(x, grey, out, (1 - toe) * out / grey, slope)
    end = (1 - shoulder) * (1 - out) / (1 - grey)
    bright = 1 - piece(1 - x, 1 - grey, 1 - out, end, slope)
    return np.where(x < grey, dark, bright)


def on_maximum(curve: Curve) -> Curve:
    """Return a function that scales all colours by a curve's factor at the largest of them."""

    def scaled(image: Floats) -> Floats:
        high = np.maximum(image.max(-1, keepdims=True), 1e-9)
        return image * (curve(high) / high)

    return scaled


DEFAULT: dict[str, Any] = {}
# Panels: settings, or a curve instead of the chain's.
CHANGES: Mapping[str, Mapping[str, Any] | Curve] = {
    "default": DEFAULT,
    "two curves that meet at grey, on the maximum": on_maximum(two_pieces),
    "the default's curve, on the maximum": on_maximum(Standard().curve),
    "shoulder=0.4": {"tone_curve": {"shoulder": 0.4}},
    "tone_curve=linear": {"tone_curve": {"method": "linear"}},
    "demosaic=malvar2004": {"demosaic": {"method": "malvar2004"}},
    "denoise=none": {"denoise": {"luma_strength": 0.0, "chroma_strength": 0.0}},
    "sharpen=none": {"sharpen": {"method": "none"}},
}


@cache
def chart() -> Floats:
    """Return the grey patches, linear RGB, whose display levels are evenly spaced."""

    levels = inverse_srgb_curve(np.linspace(24, 224, LEVELS) / 255)
    row = np.repeat(levels, PATCH)
    return np.repeat(np.repeat(row[None], PATCH, 0)[..., None], 3, 2).astype(np.float32)


def pictures(change: Mapping[str, Any] | Curve, iso: float) -> list[Doubles]:
    """Return luma, 0..255, of developments that differ in their noise."""
    if isinstance(change, Mapping):
        pipeline = clpipe.Pipeline(iso=iso, **change)
        found = [pipeline.process(chart(), f"frame{k}").image for k in range(FRAMES)]
        return [luma(np.asarray(each)) for each in found]
    pipeline = clpipe.Pipeline(iso=iso, keep="sharpen")
    kept = (pipeline.process(chart(), f"frame{k}").kept["sharpen"] for k in range(FRAMES))
    light = (change(np.clip(each, 0, 1)) for each in kept)
    return [luma(np.rint(255 * srgb_curve(np.clip(each, 0, 1)))) for each in light]


def skew_by_luma(change: Mapping[str, Any] | Curve, iso: float) -> tuple[Doubles, Doubles]:
    """Return the mean luma of each patch, and the skew of its noise."""
    developed = np.stack(pictures(change, iso))
    inner = developed.reshape(FRAMES, PATCH, LEVELS, PATCH)[:, MARGIN:-MARGIN, :, MARGIN:-MARGIN]
    patches = inner.transpose(2, 0, 1, 3).reshape(LEVELS, -1)
    return patches.mean(1), np.array([skewness(patch) for patch in patches])


def draw(path: Path) -> dict[str, list[float]]:
    """Draw the panels; return the mean skew by panel, in the ranges at each ISO."""
    figure = Figure(figsize=(12, 5.6), layout="constrained")
    panels = figure.subplots(2, len(CHANGES) // 2, sharex=True, sharey=True).ravel()
    means: dict[str, list[float]] = {}
    for panel, (name, change) in zip(panels, CHANGES.items(), strict=True):
        panel.axhspan(*REAL, color="0.9")
        for iso in ISOS:
            level, skew = skew_by_luma(change, iso)
            panel.plot(level, skew, label=f"ISO {iso}")
            inside = [(level >= low) & (level < high) for low, high in RANGES]
            means.setdefault(name, []).extend(float(skew[each].mean()) for each in inside)
        panel.set_title(name, fontsize=9)
        panel.grid(alpha=0.3)
    panels[0].set_ylim(-0.65, 0.45)
    panels[0].legend(fontsize=8)
    figure.supxlabel("luma without noise, levels")
    figure.supylabel("skew of luma noise")
    save(figure, path)
    return means


def section(path: Path) -> bool:
    """Draw the panels, print the table; return whether the default chain meets the target."""
    means = draw(path)
    heads = [f"{low} to {high}, ISO {iso}" for iso in ISOS for low, high in RANGES]
    rows = [[name, *(f"{value:+.2f}" for value in values)] for name, values in means.items()]
    print(markdown(["mean skew at luma", *heads], rows))
    return min(means["default"]) >= REAL[0] and max(means["default"]) <= REAL[1]
