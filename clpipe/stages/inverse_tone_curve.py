"""Inverse tone curve: from a photograph's contrast back to the scene's contrast."""

from functools import lru_cache
from typing import ClassVar

import numpy as np

from clpipe.base.types import Floats
from clpipe.reference.curve import tabulate
from clpipe.stage import (
    Arguments,
    Context,
    Curve,
    Method,
    Pass,
    ReferenceContext,
    Unchanged,
    rgb_stage,
)
from clpipe.stages import tone_curve
from clpipe.stages.tone_curve import standard
from clpipe.stages.tone_curve.hue import clip_to_unit, keep_hue
from clpipe.stages.tone_curve.neutral import A, B, C, D, inverse_neutral
from clpipe.stages.tone_curve.table import load_table


@lru_cache(maxsize=16)
def inverse_table(path: str) -> Floats:
    """Return the table of the inverse of a file's curve; level parts give the darkest input.

    Raises:
        ValueError: the file contains no curve, or the curve falls somewhere, or it never rises.
    """
    table = load_table(path).astype(np.float64)
    if np.any(np.diff(table) < 0) or table[-1] <= table[0]:
        raise ValueError(
            f"{path}: this curve falls or is flat, so it cannot be inverted; use a rising curve"
        )
    linear = tabulate(lambda x: x).astype(np.float64)
    value, first = np.unique(table, return_index=True)
    return tabulate(lambda y: np.interp(y, value, linear[first]))


class Standard(standard.Standard):
    """The inverse of the curve standard: the light of the raw image, with one stop of headroom."""

    kernel: ClassVar = "inverse_tone_curve_standard"
    summary: ClassVar = "undo the curve standard"
    tolerance: ClassVar = 2e-3  # near black the kernel's root is a short iteration
    example: ClassVar = {"toe": 0.5, "shoulder": 0.4, "saturation": 1.2}

    def passes(self) -> tuple[Pass, ...]:
        return (Pass("inverse_standard", arguments=("a", "b", "c", "d", "saturation")),)

    def reference(self, image: Floats, inputs: ReferenceContext) -> Floats:
        inside = clip_to_unit(image)
        one, two, smallest = np.float32(1), np.float32(2), np.float32(1e-12)
        gain = one / np.float32(self.saturation)
        lost = one - gain
        total, squares = standard.sums_of(inside * gain)
        # The mean of the scene's colours over their own mean is 1: a quadratic equation in 1 / t,
        # where t is the curve at the mean.
        middle = (one - two * lost) * total
        inner = middle * middle - np.float32(12) * lost * (lost - one) * squares
        below = middle + np.sqrt(np.maximum(inner, np.float32(0)))
        to_mean = clip_to_unit(two * squares / np.maximum(below, smallest))
        # White stays white, where the curve is nearly flat.
        mean = np.where(to_mean > np.float32(0.9999), one, self.inverse(to_mean))
        factor = gain * (mean / np.maximum(to_mean, smallest))
        return np.maximum(inside * factor + lost * mean, np.float32(0))


class Neutral(Method):
    """The inverse of the curve neutral: the light of the raw image, with one stop of headroom."""

    method: ClassVar = "neutral"
    kernel: ClassVar = "inverse_tone_curve_neutral"
    summary: ClassVar = "undo the curve neutral"
    tolerance: ClassVar = 5e-5  # the kernel's root is a short iteration

    def passes(self) -> tuple[Pass, ...]:
        return (Pass("inverse_neutral", arguments=("a", "b", "c", "d")),)

    def arguments(self, context: Context) -> Arguments:
        return {"a": A, "b": B, "c": C, "d": D}

    def reference(self, image: Floats, inputs: ReferenceContext) -> Floats:
        return keep_hue(image, inverse_neutral)


class CameraRaw(Curve):
    """The inverse of the default curve of Adobe Camera Raw, on each channel.

    >>> from clpipe.reference.curve import curve_index
    >>> from clpipe.stages.tone_curve import CameraRaw as Forward
    >>> x = np.float32([0.01, 0.1, 0.5, 1.0])
    >>> there = Forward().table()[curve_index(x)]
    >>> CameraRaw().table()[curve_index(there)].round(3).tolist()
    [0.009999999776482582, 0.10000000149011612, 0.5, 1.0]
    """

    method: ClassVar = "camera_raw"
    summary: ClassVar = "undo the default curve of Adobe Camera Raw (DNG SDK)"

    def table(self) -> Floats:
        return inverse_table(tone_curve.CAMERA_RAW)


class Linear(Unchanged):
    """No curve to undo: the image does not change."""

    method: ClassVar = "linear"
    summary: ClassVar = "no curve to undo"


class File(tone_curve.File):
    """The inverse of a curve from a file, on each channel."""

    summary: ClassVar = "undo a curve from a .csv or one-dimensional .cube file"
    read: ClassVar = staticmethod(inverse_table)


STAGE = rgb_stage(
    "inverse_tone_curve",
    "Undo the tone curve of a photograph.",
    (Standard, Neutral, CameraRaw, Linear, File),
)
