"""The analogue-to-digital converter."""

from math import ceil, log2
from typing import ClassVar

import numpy as np
from pydantic import model_validator

from clpipe.base.types import Floats
from clpipe.reference.companding import Knots, apply_pieces, default_knots, parse_knots, pieces_of
from clpipe.stage import (
    Arguments,
    Backend,
    CompileTime,
    Context,
    Kind,
    Numbers,
    Pass,
    ReferenceContext,
    Signal,
    SignalMethod,
    Stage,
    StageRole,
    camera_parameter,
    parameter,
)

MAX_BITS = 24  # largest whole DN that a float32 represents
MAX_DN = 2**MAX_BITS - 1


class Linear(SignalMethod):
    """Signal to DN: black + y * (white - black), rounded to nearest and clipped to 0..white.

    After several readouts, the last one defines white, and the raw image has correspondingly
    more bits.

    >>> from clpipe.stage import run_reference
    >>> signal = np.float32([[-1, 0, 0.1, 0.5, 7]])
    >>> run_reference(Linear(black_level=100, white_level=1124), signal).tolist()
    [[0.0, 100.0, 202.0, 612.0, 1124.0]]
    """

    method: ClassVar = "linear"
    kernel: ClassVar = "quantize"
    summary: ClassVar = "round to whole DN and clip to 0..white_level"

    bits: int | None = parameter(
        None,
        "Bit depth of the raw image; the camera's levels are scaled to it.",
        "",
        "from the levels",
        ge=8,
        le=MAX_BITS,
    )
    black_level: float | None = camera_parameter("DN without light.", "DN", ge=0, le=MAX_DN)
    white_level: float | None = camera_parameter(
        "DN at full scale; more light clips.", "DN", gt=0, le=MAX_DN
    )

    @model_validator(mode="after")
    def _check_levels(self) -> "Linear":
        if None not in (self.black_level, self.white_level) and self._range <= 0:
            raise ValueError(
                f"white_level must be above black_level; found white_level {self.white_level} "
                f"and black_level {self.black_level}"
            )
        if self.bits and self.white_level and self.white_level >= 2**self.bits:
            raise ValueError(
                f"white_level must be below {2**self.bits}, because the raw image has "
                f"{self.bits} bits; it is {self.white_level}"
            )
        return self

    @property
    def _range(self) -> float:
        assert self.black_level is not None and self.white_level is not None
        return self.white_level - self.black_level

    def resolve(self, context: Context) -> "Linear":
        camera = context.camera
        black, white = camera.black_level, camera.white_level
        bits = self.bits
        # More bits, because the size of a DN stays that of the first readout.
        if bits is None and context.full_scale > 1:
            bits = min(camera.bits + ceil(log2(context.full_scale)), MAX_BITS)
        if bits and bits != camera.bits:
            scale = (2**bits - 1) / (2**camera.bits - 1)
            black, white = float(round(black * scale)), float(round(white * scale))
        resolved = self.with_defaults(black_level=black, white_level=white)
        assert resolved.white_level is not None
        resolved = resolved.with_defaults(bits=max(int(resolved.white_level).bit_length(), 8))
        return type(self).model_validate(dict(resolved))

    def next_context(self, context: Context) -> Context:
        return context.replace(black_level=self.black_level, white_level=self.white_level)

    def passes(self) -> tuple[Pass, ...]:
        return (Pass("quantize", arguments=("range", "black_level", "white_level")),)

    def arguments(self, context: Context) -> Arguments:
        return {
            "range": self._range / context.full_scale,
            "black_level": self.black_level,
            "white_level": self.white_level,
        }

    def variance(self, input_variance: Floats, signal: Floats, context: Context) -> Floats | None:
        """The variance in DN^2: rounding adds 1/12. Clipping reduces it, which is not modelled."""
        scale = self._range / context.full_scale
        return input_variance * np.float32(scale**2) + np.float32(1 / 12)

    @classmethod
    def apply(cls, y: Signal, n: Numbers, backend: Backend) -> Signal:
        dn = backend.rounded(y * n["range"] + n["black_level"])
        return backend.minimum(dn.clip(min=0), n["white_level"])


class Pwl(Linear):
    """Signal to DN, then fewer DN by a piecewise linear curve, which HDR sensors apply.

    ``normalize`` inverts the curve by default.

    >>> from clpipe.stage import run_reference
    >>> knots = [[0.0, 0.0], [1023.0, 511.0], [4095.0, 1023.0]]
    >>> few = Pwl(black_level=0, white_level=4095, knots=knots)
    >>> run_reference(few, np.float32([[0, 0.125, 0.5, 1]])).tolist()
    [[0.0, 256.0, 682.0, 1023.0]]
    """

    method: ClassVar = "pwl"
    kernel: ClassVar = "companding"
    summary: ClassVar = "round and clip, then reduce the bits by a piecewise linear curve"
    example: ClassVar = {"result_bits": 10}

    result_bits: int = parameter(12, "Bit depth after the curve.", ge=8, le=16)
    knots: list[list[float]] | None = parameter(
        None,
        "Knots of the curve: DN before and after, from [0, 0] to the white level.",
        auto="close to a square root",
    )

    @model_validator(mode="after")
    def _check_knots(self) -> "Pwl":
        if self.knots is None:
            return self
        last = parse_knots(self.knots)[-1]
        if last[1] >= 2**self.result_bits:
            raise ValueError(
                f"knots: the last output is {last[1]:g}, which does not fit in "
                f"{self.result_bits} bits"
            )
        if self.white_level is not None and last[0] != self.white_level:
            raise ValueError(
                f"knots: the last input is {last[0]:g}, but it must be the white level, "
                f"{self.white_level:g}"
            )
        return self

    def resolve(self, context: Context) -> "Linear":
        resolved = super().resolve(context)
        assert isinstance(resolved, Pwl)
        assert resolved.white_level is not None
        default = default_knots(resolved.white_level, 2**self.result_bits - 1)
        resolved = resolved.with_defaults(knots=[list(pair) for pair in default])
        return type(self).model_validate(dict(resolved))

    @property
    def _knots(self) -> Knots:
        assert self.knots is not None
        return parse_knots(self.knots)

    def next_context(self, context: Context) -> Context:
        return super().next_context(context).replace(knots=self._knots)

    def passes(self) -> tuple[Pass, ...]:
        names = ("range", "black_level", "white_level", "pieces", "count")
        return (Pass("compand", arguments=names),)

    def arguments(self, context: Context) -> Arguments:
        pieces = pieces_of(self._knots)
        count = CompileTime(str(len(pieces)))
        return {**super().arguments(context), "pieces": pieces, "count": count}

    def variance(self, input_variance: Floats, signal: Floats, context: Context) -> Floats | None:
        return None

    def reference(self, image: Floats, inputs: ReferenceContext) -> Floats:
        return np.rint(apply_pieces(super().reference(image, inputs), pieces_of(self._knots)))


STAGE = Stage(
    "quantize",
    "Digitise with the ADC: signal to DN.",
    Kind.MOSAIC,
    Kind.RAW,
    (Linear, Pwl),
    role=StageRole.RAW,
)
