"""A camera's standard picture style: an S-curve that keeps hues and grey, and its inverse."""

from dataclasses import dataclass
from typing import ClassVar, Self

import numpy as np

from clpipe.base.tracing import float32
from clpipe.base.types import Floats
from clpipe.stage import Arguments, Context, Method, Pass, ReferenceContext, parameter
from clpipe.stages.tone_curve.hue import clip_to_unit

# The level of 18 % grey with one stop of headroom. Its result is nearly as bright as in sRGB.
GREY, GREY_OUT = 0.09, 0.173
NAMES = ("grey", "a", "b", "c", "d", "bright_a", "bright_b", "bright_c", "bright_d")
HIGHLIGHT_DESATURATION = (
    0.5  # loss of colourfulness towards the brightest highlights, which turn white
)


@dataclass(frozen=True)
class Piece:
    """The curve v (a v + b) / (v (c v + d) + 1), which rises from (0, 0)."""

    a: float
    b: float
    c: float
    d: float

    @classmethod
    def between(cls, width: float, height: float, first: float, last: float) -> Self:
        """Return the monotone curve from (0, 0) to (width, height) with these slopes at its ends.

        It is the rational quadratic of Gregory and Delbourgo (IMA J. Numer. Anal. 1982, eq. 2.3).
        """
        chord = height / width
        bend = (first + last - 2 * chord) / height
        return cls((chord - first) / width, first, -bend / width, bend)

    def at(self, v: Floats) -> Floats:
        """Apply the curve."""
        a, b, c, d = (np.float32(each) for each in (self.a, self.b, self.c, self.d))
        return np.asarray(v * (a * v + b) / (v * (c * v + d) + np.float32(1)))

    def inverse(self, y: Floats) -> Floats:
        """Return the nonnegative root of (a - c y) v^2 + (b - d y) v - y = 0."""
        a, b, c, d = (np.float32(each) for each in (self.a, self.b, self.c, self.d))
        quadratic, linear = a - c * y, b - d * y
        root = np.sqrt(np.maximum(linear * linear + np.float32(4) * quadratic * y, np.float32(0)))
        two = np.float32(2)
        above = np.where(linear > 0, two * y, root - linear)
        below = np.where(linear > 0, linear + root, two * quadratic)
        return np.asarray(above / np.maximum(below, np.float32(1e-12)))


class Standard(Method):
    """An S-curve like cameras' standard picture styles, which keeps grey and hues.

    It expects a raw image with one stop of headroom, the default of ``exposure``. There, 18 % grey
    is 0.09, and it becomes 0.173. One rational quadratic leads from black to grey and another from
    grey to white (Gregory and Delbourgo, IMA J. Numer. Anal. 1982). The parameters set their
    slopes. The toe reduces noise in shadows, and the shoulder reduces it in highlights, like in a
    camera.

    The largest of the three colours takes the curve's value, and the others keep their ratio to it.
    Hue and saturation therefore do not change, in CIELAB either. Then all colours move away from
    the grey of the largest, or towards it. ``saturation`` sets how far, and the brightest
    highlights turn whiter.

    >>> from clpipe.stage import run_reference
    >>> greys = np.float32([0, 0.01, 0.09, 0.5, 1])[:, None, None].repeat(3, 2)
    >>> run_reference(Standard(), greys)[:, 0, 0].astype(float).round(3).tolist()
    [0.0, 0.005, 0.173, 0.844, 1.0]
    """

    method: ClassVar = "standard"
    kernel: ClassVar = "tone_curve_standard"
    summary: ClassVar = "a camera's S-curve with toe and shoulder; keeps grey and hues"
    tolerance: ClassVar = 1e-5  # sums may be contracted
    example: ClassVar = {"contrast": 1.3, "toe": 1.0, "shoulder": 0.4}

    contrast: float = parameter(
        2.2,
        "Slope at grey: stops of output per stop of light.",
        ge=0.1,
        le=10,
    )
    toe: float = parameter(
        0.85,
        "Darkening of shadows. 0 starts with the slope of the line from black to grey, and 1 "
        "starts flat.",
        ge=0,
        le=1,
    )
    shoulder: float = parameter(
        0.95,
        "Softness of highlights. 0 ends with the slope of the line from grey to white, and 1 "
        "ends flat.",
        ge=0,
        le=1,
    )

    saturation: float = parameter(1.0, "Saturation relative to the scene's.", ge=0.5, le=3)

    @property
    def pieces(self) -> tuple[Piece, Piece]:
        """The curves from black to grey, and from white back to grey."""
        dark, bright = GREY_OUT / GREY, (1 - GREY_OUT) / (1 - GREY)
        slope = self.contrast * dark
        return (
            Piece.between(GREY, GREY_OUT, (1 - self.toe) * dark, slope),
            Piece.between(1 - GREY, 1 - GREY_OUT, (1 - self.shoulder) * bright, slope),
        )

    def passes(self) -> tuple[Pass, ...]:
        return (Pass("standard", arguments=(*NAMES, "saturation")),)

    def numbers(self, grey: float) -> Arguments:
        """Return the kernel's arguments; ``grey`` is where the pieces meet, before or after it."""
        numbers = (grey, *(x for p in self.pieces for x in (p.a, p.b, p.c, p.d)))
        named = dict(zip(NAMES, map(float32, numbers), strict=True))
        return {**named, "saturation": float32(self.saturation)}

    def arguments(self, context: Context) -> Arguments:
        return self.numbers(GREY)

    def curve(self, x: Floats) -> Floats:
        """Apply the curve to values 0..1 of any shape."""
        dark, bright = self.pieces
        one = np.float32(1)
        return np.asarray(np.where(x < np.float32(GREY), dark.at(x), one - bright.at(one - x)))

    def inverse(self, y: Floats) -> Floats:
        """Apply the inverse of :meth:`curve`.

        >>> style = Standard(toe=1.0)
        >>> style.inverse(style.curve(np.float32([0, 0.02, 0.09, 0.5, 1]))).round(3).tolist()
        [0.0, 0.019999999552965164, 0.09000000357627869, 0.5, 1.0]
        """
        dark, bright = self.pieces
        one, is_dark = np.float32(1), y < np.float32(GREY_OUT)
        return np.asarray(np.where(is_dark, dark.inverse(y), one - bright.inverse(one - y)))

    def colourfulness(self, high: Floats) -> Floats:
        """Return the share of the distance from grey that remains, by the largest colour."""
        return np.asarray(
            np.float32(self.saturation)
            - np.float32(HIGHLIGHT_DESATURATION) * np.square(high * high)
        )

    def reference(self, image: Floats, inputs: ReferenceContext) -> Floats:
        inside = clip_to_unit(image)
        high = inside.max(-1, keepdims=True)
        to_high = self.curve(high)
        part = self.colourfulness(high) * (to_high / np.maximum(high, np.float32(1e-9)))
        return np.asarray(to_high - (high - inside) * part)
