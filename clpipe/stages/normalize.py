"""Levels: from DN to signal, the first step of a raw converter."""

from typing import ClassVar

import numpy as np
from pydantic import model_validator

from clpipe.base.errors import RequestError
from clpipe.base.types import Floats
from clpipe.reference.companding import apply_pieces, parse_knots, pieces_of
from clpipe.stage import (
    Arguments,
    Backend,
    CompileTime,
    Context,
    Kind,
    Method,
    Numbers,
    Pass,
    ReferenceContext,
    Signal,
    SignalMethod,
    Stage,
    StageRole,
    parameter,
)
from clpipe.stages.quantize import MAX_DN


class Linear(SignalMethod):
    """(DN - black) / (white - black); values below black stay negative.

    >>> from clpipe.stage import run_reference
    >>> linear = Linear(black_level=100, white_level=1124)
    >>> run_reference(linear, np.float32([[36, 100, 612]])).tolist()
    [[-0.0625, 0.0, 0.5]]
    """

    method: ClassVar = "linear"
    kernel: ClassVar = "normalize"
    summary: ClassVar = "subtract the black level and scale the white level to 1"

    black_level: float | None = parameter(
        None,
        "DN that becomes 0.",
        "DN",
        "the black level of quantize, else from the camera",
        ge=0,
        le=MAX_DN,
    )
    white_level: float | None = parameter(
        None,
        "DN that becomes 1.",
        "DN",
        "the white level of quantize, or of the first of several readouts; else from the camera",
        gt=0,
        le=MAX_DN,
    )

    @model_validator(mode="after")
    def _check_levels(self) -> "Linear":
        black, white = self.black_level, self.white_level
        if black is not None and white is not None and white <= black:
            raise ValueError(
                f"white_level must be above black_level; found white_level {self.white_level} "
                f"and black_level {self.black_level}"
            )
        return self

    def resolve(self, context: Context) -> "Linear":
        """Return the method with its levels.

        Raises:
            RequestError: quantize compressed the DN with a curve.
        """
        if context.knots:
            raise RequestError(
                "normalize.method=linear does not undo the curve of quantize.method=pwl; set "
                "normalize.method=pwl, or quantize.method=linear"
            )
        return self._with_levels(context)

    def _with_levels(self, context: Context) -> "Linear":
        camera = context.camera
        black = camera.black_level if context.black_level is None else context.black_level
        white = camera.white_level if context.white_level is None else context.white_level
        first = black + (white - black) / context.full_scale
        resolved = self.with_defaults(black_level=black, white_level=first)
        return type(self).model_validate(dict(resolved))

    def next_context(self, context: Context) -> Context:
        if context.full_scale == 1 or context.white_level is None or context.black_level is None:
            return context
        full_range = context.white_level - context.black_level
        return context.replace(full_scale=full_range / self._range)

    @property
    def _range(self) -> float:
        assert self.black_level is not None and self.white_level is not None
        return self.white_level - self.black_level

    @property
    def scale(self) -> float:
        """The signal of one DN."""
        return 1 / self._range

    def passes(self) -> tuple[Pass, ...]:
        return (Pass("normalize_levels", arguments=("black_level", "scale")),)

    def variance(self, input_variance: Floats, signal: Floats, context: Context) -> Floats:
        return input_variance * np.float32(self._range**-2)

    @classmethod
    def apply(cls, y: Signal, n: Numbers, backend: Backend) -> Signal:
        return (y - n["black_level"]) * n["scale"]


class Pwl(Linear):
    """The inverse of the curve of ``quantize.method=pwl``, then the levels.

    >>> from clpipe.stage import run_reference
    >>> knots = [[0.0, 0.0], [1023.0, 511.0], [4095.0, 1023.0]]
    >>> back = Pwl(black_level=0, white_level=4095, knots=knots)
    >>> run_reference(back, np.float32([[0, 511, 1023]])).round(3).tolist()
    [[0.0, 0.25, 1.0]]
    """

    method: ClassVar = "pwl"
    kernel: ClassVar = "companding"
    summary: ClassVar = "undo the curve of quantize.method=pwl, then apply the levels"
    example: ClassVar = {"knots": [[0.0, 0.0], [4096.0, 512.0], [16383.0, 1023.0]]}

    knots: list[list[float]] | None = parameter(
        None, "The knots of quantize.", auto="those of quantize"
    )

    @model_validator(mode="after")
    def _check_knots(self) -> "Pwl":
        if self.knots is not None:
            parse_knots(self.knots)
        return self

    def resolve(self, context: Context) -> "Linear":
        """Return the method with its levels and knots.

        Raises:
            RequestError: no knots are known, or the knots of quantize differ.
        """
        resolved = self._with_levels(context)
        if self.knots is None and not context.knots:
            raise RequestError(
                "normalize.method=pwl: no knots are known; set normalize.knots, or use "
                "quantize.method=pwl"
            )
        if self.knots and context.knots and parse_knots(self.knots) != context.knots:
            raise RequestError(
                f"normalize.knots: {self.knots} differ from those of quantize, "
                f"{[list(pair) for pair in context.knots]}; remove normalize.knots"
            )
        return resolved.with_defaults(knots=[list(pair) for pair in context.knots])

    @property
    def _pieces(self) -> Floats:
        assert self.knots is not None
        return pieces_of(parse_knots(self.knots), inverse=True)

    def next_context(self, context: Context) -> Context:
        return super().next_context(context).replace(knots=())

    def passes(self) -> tuple[Pass, ...]:
        return (Pass("expand", arguments=("black_level", "scale", "pieces", "count")),)

    def arguments(self, context: Context) -> Arguments:
        count = CompileTime(str(len(self._pieces)))
        return {**super().arguments(context), "pieces": self._pieces, "count": count}

    def reference(self, image: Floats, inputs: ReferenceContext) -> Floats:
        return super().reference(apply_pieces(image, self._pieces), inputs)


def _curve_default(context: Context) -> Method | None:
    return Pwl() if context.knots else None


STAGE = Stage(
    "normalize",
    "Apply black and white level: DN to signal.",
    Kind.RAW,
    Kind.MOSAIC,
    (Linear, Pwl),
    role=StageRole.LEVELS,
    default_method=_curve_default,
)
