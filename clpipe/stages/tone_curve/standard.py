"""A camera's standard picture style: an S-curve that keeps hues and grey, and its inverse."""

from typing import ClassVar

import numpy as np

from clpipe.base.types import Floats
from clpipe.stage import Arguments, Context, Method, Pass, ReferenceContext, parameter
from clpipe.stages.tone_curve.hue import clip_to_unit

# The level of 18 % grey with one stop of headroom. Its result is nearly as bright as in sRGB.
GREY, GREY_OUT = 0.09, 0.173
# The slope at white of the curve that has the shoulder 0. With a higher one, no curve of this form
# rises everywhere and keeps grey.
STEEPEST_END = GREY / GREY_OUT * (1 - GREY_OUT) / (1 - GREY)
SMALLEST = np.float32(1e-24)  # avoids a division by 0 where all colours are black


class Standard(Method):
    """An S-curve like cameras' standard picture styles, which keeps grey and hues.

    It expects a raw image with one stop of headroom, the default of ``exposure``. There, 18 % grey
    is 0.09, and it becomes 0.173. The curve is x (a x + b) / (x (c x + d) + 1). Its slopes at black
    and white are set by ``toe`` and ``shoulder``, and its contrast at grey follows from them: 1.46
    stops per stop by default. Like in a camera, noise is weaker in shadows and highlights than in
    midtones. In roots of the light, where shot noise has the same size at all levels, the slope
    changes slowly, so the noise stays symmetric (docs/validation.md).

    All three colours are scaled by one factor, so hue and saturation do not change, in CIELAB
    either. The factor is the curve's at the contraharmonic mean of the colours, the sum of their
    squares over their sum. For pure colours, this mean is the largest colour, which stays in range.
    For greys, it weighs the noise of the three colours equally. The maximum would instead select
    noise. Then all colours move away from the grey of that mean, or towards it, by ``saturation``.

    >>> from clpipe.stage import run_reference
    >>> greys = np.float32([0, 0.01, 0.09, 0.5, 1])[:, None, None].repeat(3, 2)
    >>> run_reference(Standard(), greys)[:, 0, 0].astype(float).round(3).tolist()
    [0.0, 0.006, 0.173, 0.854, 1.0]
    """

    method: ClassVar = "standard"
    kernel: ClassVar = "tone_curve_standard"
    summary: ClassVar = "a camera's S-curve with toe and shoulder; keeps grey and hues"
    tolerance: ClassVar = 1e-5  # sums may be contracted
    example: ClassVar = {"toe": 1.0, "shoulder": 0.4, "saturation": 1.2}

    toe: float = parameter(
        0.78,
        "Darkening of shadows. 0 starts with the slope of the line from black to grey, and 1 "
        "starts flat.",
        ge=0,
        le=1,
    )
    shoulder: float = parameter(
        0.72,
        "Brightening of highlights before they level off. 0.05 ends with a slope of 0.45, and 1 "
        "ends flat.",
        ge=0.05,
        le=1,
    )
    saturation: float = parameter(1.0, "Saturation relative to the scene's.", ge=0.5, le=3)

    @property
    def coefficients(self) -> tuple[float, float, float, float]:
        """The curve's a, b, c and d: it has the slopes of both ends, and keeps grey and white.

        The Bernstein form is (b x (1-x) + w x^2) / ((1-x)^2 + p x (1-x) + w x^2). Its numbers are
        positive and its ordinates rise, so the curve rises too.
        """
        first = (1 - self.toe) * GREY_OUT / GREY
        last = (1 - self.shoulder) * STEEPEST_END
        above = (1 - GREY) * (GREY_OUT * (1 - GREY) - first * (1 - GREY_OUT) * GREY)
        below = GREY * (GREY * (1 - GREY_OUT) - GREY_OUT * last * (1 - GREY))
        w = above / below
        p = first + last * w
        return w - first, first, 1 - p + w, p - 2

    def passes(self) -> tuple[Pass, ...]:
        return (Pass("standard", arguments=("a", "b", "c", "d", "saturation")),)

    def arguments(self, context: Context) -> Arguments:
        named = dict(zip("abcd", self.coefficients, strict=True))
        return {**named, "saturation": self.saturation}

    def curve(self, x: Floats) -> Floats:
        """Apply the curve to values 0..1 of any shape."""
        a, b, c, d = map(np.float32, self.coefficients)
        return np.asarray(x * (a * x + b) / (x * (c * x + d) + np.float32(1)))

    def inverse(self, y: Floats) -> Floats:
        """Apply the inverse of :meth:`curve`, the root of (a - c y) x^2 + (b - d y) x - y = 0.

        >>> style = Standard(toe=1.0)
        >>> style.inverse(style.curve(np.float32([0, 0.02, 0.09, 0.5, 1]))).round(3).tolist()
        [0.0, 0.019999999552965164, 0.09000000357627869, 0.5, 1.0]
        """
        a, b, c, d = map(np.float32, self.coefficients)
        quadratic, linear = a - c * y, b - d * y
        root = np.sqrt(np.maximum(linear * linear + np.float32(4) * quadratic * y, np.float32(0)))
        two = np.float32(2)
        above = np.where(linear > 0, two * y, root - linear)
        below = np.where(linear > 0, linear + root, two * quadratic)
        return np.asarray(above / np.maximum(below, np.float32(1e-12)))

    def reference(self, image: Floats, inputs: ReferenceContext) -> Floats:
        inside = clip_to_unit(image)
        a, b, c, d = map(np.float32, self.coefficients)
        total, squares = sums_of(inside)
        above = a * squares + b * total
        below = squares * (c * squares + d * total) + total * total
        share = above / np.maximum(below, SMALLEST)
        kept = np.float32(self.saturation)
        return np.asarray(share * (total * inside * kept + squares * (np.float32(1) - kept)))


def sums_of(image: Floats) -> tuple[Floats, Floats]:
    """Return the sums of the three colours and of their squares, (height, width, 1) each.

    >>> [each.ravel().tolist() for each in sums_of(np.float32([[[1, 2, 3]]]))]
    [[6.0], [14.0]]
    """
    total = image.sum(-1, keepdims=True, dtype=np.float32)
    return total, np.square(image).sum(-1, keepdims=True, dtype=np.float32)
