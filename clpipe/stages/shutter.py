"""When each row of the sensor sees the scene: a rolling shutter, and lamps that flicker."""

from dataclasses import replace
from typing import ClassVar, Self

import numpy as np
from pydantic import PrivateAttr

from clpipe.base.types import Doubles, Floats
from clpipe.camera.optics import USUAL_TIME
from clpipe.stage import (
    Arguments,
    Context,
    InTime,
    Kind,
    LineTable,
    Pass,
    ReferenceContext,
    Span,
    Stage,
    StageRole,
    parameter,
)


class Rows(InTime):
    """Row y is exposed from y * line_time on, for exposure_time.

    Further exposures of a sensor that staggers them follow in each row, one behind the other.

    Light that flickers as 1 + depth cos(2 pi f t + phase) comes, averaged over a row's exposure T,
    as 1 + depth sinc(f T) cos(2 pi f (y line_time + T / 2) + phase).

    >>> from clpipe.stage import run_reference
    >>> banded = Rows(exposure_time=1e-3, line_time=1e-3, flicker_depth=0.5, flicker_frequency=250)
    >>> seen = run_reference(banded, np.ones((5, 1, 3), np.float32))
    >>> [round(float(y), 2) for y in seen[:, 0, 0]]
    [1.32, 0.68, 0.68, 1.32, 1.32]
    """

    method: ClassVar = "rows"
    kernel: ClassVar = "shutter"
    overscan: ClassVar = True
    summary: ClassVar = "rows one after the other, or all at once"
    tolerance: ClassVar = 1e-5
    example: ClassVar = {"flicker_depth": 0.4, "line_time": 1e-3, "exposure_time": 4e-3}

    subframes: int = parameter(
        1,
        "How many files in a row are one exposure: their mean; rows take of each frame what "
        "falls into their time.",
        ge=1,
        le=10_000,
    )
    exposure_time: float | None = parameter(
        None,
        "How long each row is exposed.",
        "s",
        "the camera's, else 0.01",
        optics=True,
        gt=0,
        le=3600,
    )
    line_time: float = parameter(
        0.0,
        "From the start of a row to that of the next; 0 is a global shutter.",
        "s",
        ge=0,
        le=1,
    )
    flicker_depth: float = parameter(
        0.0, "How much the light swings about its mean; 0 is steady.", "", ge=0, le=1
    )
    flicker_frequency: float = parameter(
        100.0, "Frequency of the light, twice that of the mains.", "Hz", gt=0, le=1e6
    )
    flicker_phase: float = parameter(
        0.0, "Phase of the light when the first row's exposure starts.", "degrees", ge=-360, le=360
    )

    _span: Span = PrivateAttr(Span())  # of the exposure that it is for
    _end: float = PrivateAttr(1.0)  # of the last one, in exposures of the first

    def resolve(self, context: Context) -> Self:
        return self.with_optics(context).with_defaults(exposure_time=USUAL_TIME)

    def next_context(self, context: Context) -> Context:
        return replace(context, light_changes=self.subframes > 1 or bool(self.flicker_depth))

    def during(self, spans: tuple[Span, ...], number: int) -> Self:
        other = self.model_copy()
        other._span, other._end = spans[number], spans[-1].end
        return other

    @property
    def _longest(self) -> float:
        return self.exposure_time or USUAL_TIME

    @property
    def time(self) -> float:
        """How long each row is exposed, s."""
        return self._longest * self._span.length

    def times(self, rows: int) -> Doubles:
        """When the exposure of each row starts, in s: (row,)."""
        start = self._longest * self._span.start
        return np.arange(rows, dtype=np.float64) * self.line_time + start

    def duration(self, rows: int) -> float:
        """From the start of the first row's exposure to the end of the last row's last one, s."""
        return (rows - 1) * self.line_time + self._longest * self._end

    def weights(self, frames: int, rows: int) -> Doubles:
        """The share of each row's exposure that falls to each of some frames: (frame, row).

        The frames follow each other without a gap, over all of :meth:`duration`.
        """
        starts = self.times(rows)
        bounds = np.linspace(0, self.duration(rows), frames + 1)[:, None]
        seen = np.clip(bounds, starts, starts + self.time)
        return np.asarray(np.diff(seen, axis=0) / self.time)

    @property
    def swing(self) -> np.float32:
        """The flicker that is left after a row's exposure has averaged it."""
        return np.float32(self.flicker_depth * np.sinc(self.flicker_frequency * self.time))

    def passes(self) -> tuple[Pass, ...]:
        if not self.swing:
            return ()
        given = ("cycles", "start", "swing")
        return (
            Pass("flicker_of_rows", LineTable("rows"), given, writes="rows"),
            Pass("flicker", arguments=("rows",)),
        )

    @property
    def cycles(self) -> np.float32:
        """Periods of the light from a row to the next, less whole ones."""
        return np.float32(self.flicker_frequency * self.line_time % 1)

    @property
    def start(self) -> np.float32:
        """The light's phase in the middle of the first row's exposure, in periods."""
        middle = self.flicker_frequency * (self._longest * self._span.start + self.time / 2)
        before = self.margins.top * float(self.cycles)  # the picture's first row
        return np.float32((middle + self.flicker_phase / 360 - before) % 1)

    def arguments(self, context: Context) -> Arguments:
        return {"cycles": self.cycles, "start": self.start, "swing": self.swing}

    def reference(self, image: Floats, given: ReferenceContext) -> Floats:
        if not self.swing:
            return image
        turns = np.arange(image.shape[0], dtype=np.float32) * self.cycles + self.start
        gains = 1 + self.swing * np.cos(2 * np.pi * turns.astype(np.float64))
        return image * gains.astype(np.float32)[:, None, None]


STAGE = Stage(
    "shutter",
    "Expose rows one after the other, under lamps that flicker.",
    Kind.RGB,
    Kind.RGB,
    (Rows,),
    role=StageRole.SHUTTER,
)
