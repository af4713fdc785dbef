"""A rational tone curve that keeps hues, and its inverse."""

from typing import ClassVar

import numpy as np

from clpipe.base.types import Floats
from clpipe.stage import Arguments, Context, Method, Pass, ReferenceContext
from clpipe.stages.tone_curve.hue import keep_hue

# y = x (a x + b) / (x (c x + d) + 1), with a + b = c + d + 1, so that 1 stays 1. The curve was
# fitted in roots of y. The target is three fifths of Camera Raw's default curve and two fifths of
# the render's own light. The render's light is 2 x up to 0.25 and rolls off above 0.25. An input of
# 0.09, which is 18 % grey with a stop of headroom, becomes 0.173. A render's 1.0 becomes 0.8.
A, B, C, D = (np.float32(value) for value in (13.5, 1.27, 11.6, 2.17))


def neutral(x: Floats) -> Floats:
    """Apply the curve to values 0..1 of any shape.

    >>> neutral(np.float32([0, 0.09, 0.5, 1])).astype(float).round(3).tolist()
    [0.0, 0.173, 0.804, 1.0]
    """
    one = np.float32(1)
    return np.asarray(x * (A * x + B) / (x * (C * x + D) + one))


def inverse_neutral(y: Floats) -> Floats:
    """Invert :func:`neutral`: the root of (a - c y) x^2 + (b - d y) x - y = 0 in 0..1.

    >>> inverse_neutral(neutral(np.float32([0, 0.09, 0.5, 1]))).round(5).tolist()
    [0.0, 0.09000000357627869, 0.5, 1.0]
    """
    quadratic, linear = A - C * y, B - D * y
    root = np.sqrt(np.maximum(linear * linear + np.float32(4) * quadratic * y, np.float32(0)))
    return (root - linear) / (np.float32(2) * quadratic)


class Neutral(Method):
    """A curve of low contrast: as bright as the render in sRGB, with highlights rolled off.

    It expects a raw image with one stop of headroom, the default of ``exposure``. Hues do not
    change: the curve is applied to the largest and the smallest colour, and the third keeps its
    relative position between them.
    """

    method: ClassVar = "neutral"
    kernel: ClassVar = "tone_curve_neutral"
    summary: ClassVar = "low contrast; keeps hues, and the brightness of the render"
    tolerance: ClassVar = 1e-5  # sums may be contracted

    def passes(self) -> tuple[Pass, ...]:
        return (Pass("neutral", arguments=("a", "b", "c", "d", "twist")),)

    def arguments(self, context: Context) -> Arguments:
        return {"a": A, "b": B, "c": C, "d": D, "twist": A * D - B * C}

    def reference(self, image: Floats, inputs: ReferenceContext) -> Floats:
        return keep_hue(image, neutral)
