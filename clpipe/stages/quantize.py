"""The analogue-to-digital converter."""

from dataclasses import replace
from typing import ClassVar

import numpy as np
from pydantic import model_validator

from clpipe.base.types import Floats
from clpipe.stage import Arguments, Context, Kind, Method, Pass, ReferenceContext, Stage, parameter


class Linear(Method):
    """Signal to DN: black + y * (white - black), rounded to nearest and clipped to 0..white.

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
        "Bit depth of the raw; the camera's levels are scaled to it.",
        "",
        "from the levels",
        ge=8,
        le=16,
    )
    black_level: float | None = parameter(
        None, "DN without light.", "DN", "from the camera", ge=0, le=65535
    )
    white_level: float | None = parameter(
        None, "DN at full scale; more light clips.", "DN", "from the camera", gt=0, le=65535
    )

    @model_validator(mode="after")
    def _ordered(self) -> "Linear":
        if None not in (self.black_level, self.white_level) and self._range <= 0:
            raise ValueError(
                f"white_level must be above black_level; "
                f"found {self.white_level} and {self.black_level}"
            )
        if self.bits and self.white_level and self.white_level >= 2**self.bits:
            raise ValueError(
                f"white_level must be below {2**self.bits}, which {self.bits} bits hold; "
                f"found {self.white_level}"
            )
        return self

    @property
    def _range(self) -> float:
        assert self.black_level is not None and self.white_level is not None
        return self.white_level - self.black_level

    def resolve(self, context: Context) -> "Linear":
        camera = context.camera
        black, white = camera.black_level, camera.white_level
        if self.bits and self.bits != camera.bits:
            scale = (2**self.bits - 1) / (2**camera.bits - 1)
            black, white = float(round(black * scale)), float(round(white * scale))
        filled = self.with_defaults(black_level=black, white_level=white)
        assert filled.white_level is not None
        filled = filled.with_defaults(bits=max(int(filled.white_level).bit_length(), 8))
        return type(self).model_validate(filled.model_dump())

    def next_context(self, context: Context) -> Context:
        return replace(context, black_level=self.black_level, white_level=self.white_level)

    def passes(self) -> tuple[Pass, ...]:
        return (Pass("quantize", arguments=("range", "black_level", "white_level")),)

    def arguments(self, context: Context) -> Arguments:
        return {
            "range": np.float32(self._range),
            "black_level": np.float32(self.black_level),
            "white_level": np.float32(self.white_level),
        }

    def variance(self, before: Floats, signal: Floats, context: Context) -> Floats:
        """In DN^2; rounding adds 1/12, and clipping, which reduces variance, is not modelled."""
        return before * np.float32(self._range**2) + np.float32(1 / 12)

    def reference(self, image: Floats, given: ReferenceContext) -> Floats:
        dn = np.rint(image * np.float32(self._range) + np.float32(self.black_level))
        return np.minimum(np.maximum(dn, np.float32(0)), np.float32(self.white_level))


STAGE = Stage("quantize", "Digitise: signal to DN.", Kind.MOSAIC, Kind.RAW, (Linear,))
