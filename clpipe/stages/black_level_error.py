"""Errors of the black level, different in each colour and each frame."""

from typing import Annotated, ClassVar

import numpy as np
from pydantic import Field

from clpipe.base.types import Floats
from clpipe.stage import (
    Arguments,
    Backend,
    CompileTime,
    Context,
    LineTable,
    NoiseScope,
    Numbers,
    Pass,
    Signal,
    SignalMethod,
    camera_parameter,
    parameter,
    sensor_stage,
)

Bias = tuple[float, float, float, float]


class Offsets(SignalMethod):
    """y + bias + offset + sigma * n: one offset per position in the filter array and frame.

    The bias is fixed for a camera and ISO: one number for R, for G in the rows of R, for G in the
    rows of B, and for B. It is the colour bias of Wei et al., TPAMI 2021, sec. 3.3. n is a standard
    normal of that colour, new in each frame. ``offset`` is the same for all colours; let it drift
    through a sequence for a black level that moves with temperature. All are in signal units.

    >>> from clpipe.stage import run_reference
    >>> black = np.zeros((4, 4), np.float32)
    >>> biased = run_reference(Offsets(sigma=0.0, bias=(0.1, 0.2, 0.3, 0.4)), black)
    >>> biased[:2, :2].round(1).tolist()
    [[0.10000000149011612, 0.20000000298023224], [0.30000001192092896, 0.4000000059604645]]
    """

    method: ClassVar = "offsets"
    kernel: ClassVar = "black_level_error"
    summary: ClassVar = (
        "add an offset to each colour: a fixed part and a part that changes with each image"
    )
    example: ClassVar = {"sigma": 0.01, "bias": [0.004, -0.002, 0.001, 0.003]}

    sigma: float | None = camera_parameter(
        "Standard deviation of the offsets that change with each image.",
        "signal",
        more=" and ISO",
        ge=0,
        le=1,
    )
    bias: Annotated[Bias, Field(strict=False)] | None = camera_parameter(
        "Fixed offsets of R, of G in the rows of R, of G in the rows of B, and of B.",
        "signal",
        more=" and ISO",
    )

    offset: float = parameter(0.0, "Offset of all colours.", "signal", ge=-1, le=1)

    def resolve(self, context: Context) -> "Offsets":
        camera, iso = context.camera, context.iso
        return self.with_defaults(sigma=camera.black_level_error(iso), bias=camera.color_bias(iso))

    def passes(self) -> tuple[Pass, ...]:
        if not (self.sigma or self.offset or any(self.bias or ())):
            return ()
        rows, image = LineTable("rows"), NoiseScope.IMAGE
        even = ("column_0", "bias_00", "bias_01", "sigma")
        odd = ("column_1", "bias_10", "bias_11", "sigma")
        return (
            Pass("errors_of_lines", rows, even, writes="in_even", random=image),
            Pass("errors_of_lines", rows, odd, writes="in_odd", random=image),
            Pass("black_level_error", arguments=("in_even", "in_odd")),
        )

    def _bias_by_site(self, pattern: str) -> dict[tuple[int, int], float]:
        """Return the fixed offset at a column and row of the filter array."""
        offsets = (bias + self.offset for bias in self.bias or (0.0,) * 4)
        red, with_red, with_blue, blue = offsets
        green = with_red if "R" in pattern[:2] else with_blue
        other_green = with_blue if "R" in pattern[:2] else with_red
        by_colour = {"R": (red, red), "B": (blue, blue), "G": (green, other_green)}
        return {(k % 2, k // 2): by_colour[colour][k // 2] for k, colour in enumerate(pattern)}

    def arguments(self, context: Context) -> Arguments:
        biases = self._bias_by_site(context.pattern)
        return {
            "column_0": CompileTime("0u"),
            "column_1": CompileTime("1u"),
            **{f"bias_{column}{row}": bias for (column, row), bias in biases.items()},
            "sigma": self.sigma,
        }

    def variance(self, input_variance: Floats, signal: Floats, context: Context) -> Floats:
        return input_variance + np.float32(self.sigma) ** 2

    @classmethod
    def apply(cls, y: Signal, n: Numbers, backend: Backend) -> Signal:
        normals = backend.lines(4)[..., None] * n["sigma"]
        cell = [
            [n[f"bias_{c}{r}"] + normals[..., r + 2 * c, :, None] for c in (0, 1)] for r in (0, 1)
        ]
        return y + backend.tiled(cell)


STAGE = sensor_stage(
    "black_level_error", "Add an error of the black level to each colour.", (Offsets,)
)
