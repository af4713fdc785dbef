"""The exposure of each row of the sensor: a rolling shutter, and flickering lamps."""

from dataclasses import replace
from typing import ClassVar, Self

import numpy as np
from pydantic import PrivateAttr

from clpipe.base.types import Array, Doubles, Floats
from clpipe.camera.optics import DEFAULT_EXPOSURE_TIME
from clpipe.stage import (
    Arguments,
    Context,
    LineTable,
    Method,
    Pass,
    ReferenceContext,
    Span,
    StageRole,
    optics_parameter,
    parameter,
    rgb_stage,
    typed_arguments,
)


class Rows(Method):
    """Row y is exposed from y * line_time on, for exposure_time.

    On a sensor with staggered exposures, each row's further exposures follow one after the other.

    Light may flicker as ``1 + depth cos(2 pi f t + phase)``. Averaged over a row's exposure T, it
    is ``1 + depth sinc(f T) cos(2 pi f (y line_time + T / 2) + phase)``. With a duty, light is
    pulsed, like an LED. It is 1 - depth, plus depth / duty while the fraction of f t + phase / 2 pi
    is below the duty. A row then gets the share of its exposure in which the light is on. Both
    kinds of light have the mean 1.

    >>> from clpipe.stage import run_reference
    >>> banded = Rows(exposure_time=1e-3, line_time=1e-3, flicker_depth=0.5, flicker_frequency=250)
    >>> seen = run_reference(banded, np.ones((5, 1, 3), np.float32))
    >>> [round(float(y), 2) for y in seen[:, 0, 0]]
    [1.32, 0.68, 0.68, 1.32, 1.32]
    >>> pulsed = Rows(exposure_time=2e-3, line_time=2e-3, flicker_duty=0.25, flicker_frequency=100)
    >>> [round(float(y), 2) for y in run_reference(pulsed, np.ones((6, 1, 3), np.float32))[:, 0, 0]]
    [4.0, 1.0, 0.0, 0.0, 0.0, 4.0]
    """

    method: ClassVar = "rows"
    kernel: ClassVar = "shutter"
    overscan: ClassVar = True
    summary: ClassVar = (
        "rows one after the other (rolling shutter), or all at once (global shutter)"
    )
    tolerance: ClassVar = 1e-5
    example: ClassVar = {"flicker_depth": 0.4, "line_time": 1e-3, "exposure_time": 4e-3}
    other_examples: ClassVar = (
        {"flicker_duty": 0.3, "flicker_frequency": 93.0, "line_time": 1e-3},
        {"flicker_duty": 0.7, "flicker_frequency": 480.0, "line_time": 3e-4, "flicker_depth": 0.8},
    )

    subframes: int = parameter(
        1,
        "Number of consecutive files whose mean is one exposure. With a rolling shutter, each "
        "row averages the files within its own exposure.",
        ge=1,
        le=10_000,
    )
    exposure_time: float | None = optics_parameter(
        "Exposure time of each row.", "s", more=", else 0.01", gt=0, le=3600
    )
    line_time: float = parameter(
        0.0,
        "Time from the start of a row to the start of the next; 0 is a global shutter.",
        "s",
        ge=0,
        le=1,
    )
    frame_time: float = parameter(
        0.0,
        "Time from the start of a frame to the start of the next in its sequence, which only the "
        "optical flow of a rolling shutter needs; 0 is not known.",
        "s",
        ge=0,
        le=3600,
    )
    flicker_depth: float | None = parameter(
        None,
        "Amplitude of the flicker relative to the mean, or share of the light that is pulsed; 0 "
        "is steady.",
        auto="1 with a duty, else 0",
        ge=0,
        le=1,
    )
    flicker_frequency: float = parameter(
        100.0,
        "Frequency of the light, which for lamps is twice the mains frequency.",
        "Hz",
        gt=0,
        le=1e6,
    )
    flicker_phase: float = parameter(
        0.0,
        "Phase of the light when the exposure of the first row starts; a pulse begins at 0.",
        "degrees",
        ge=-360,
        le=360,
    )
    flicker_duty: float = parameter(
        0.0,
        "Share of a period in which a pulsed light, like an LED, is on; 0 flickers as a cosine.",
        ge=0,
        le=1,
    )
    flicker_layer: str = parameter(
        "",
        "Layer of the render with only the flickering light; without one, all light flickers.",
    )

    _span: Span = PrivateAttr(Span())  # the time span of this exposure
    _end: float = PrivateAttr(1.0)  # the end of the last exposure, in durations of the first

    def resolve(self, context: Context) -> Self:
        resolved = self.with_optics(context).with_defaults(exposure_time=DEFAULT_EXPOSURE_TIME)
        return resolved.with_defaults(flicker_depth=self.depth)

    def next_context(self, context: Context) -> Context:
        return replace(context, light_changes=self.changes_light)

    @property
    def changes_light(self) -> bool:
        """Whether the light changes during an exposure, by motion or by flicker."""
        return self.subframes > 1 or bool(self.depth)

    @property
    def depth(self) -> float:
        """Amplitude of the flicker, or share of the light that is pulsed."""
        default = 1.0 if self.flicker_duty else 0.0
        return default if self.flicker_depth is None else self.flicker_depth

    @property
    def light_layer(self) -> str:
        """The layer with the flickering light that the image's file must contain, or ""."""
        return self.flicker_layer if self.depth else ""

    def for_exposure(self, spans: tuple[Span, ...], number: int) -> Self:
        """Return the method for one of several exposures.

        Args:
            spans: the spans of all exposures.
            number: the number of this exposure.
        """
        return self.with_state(_span=spans[number], _end=spans[-1].end)

    @property
    def _first_exposure(self) -> float:
        return self.exposure_time or DEFAULT_EXPOSURE_TIME

    @property
    def time(self) -> float:
        """Exposure time of each row, s."""
        return self._first_exposure * self._span.length

    def times(self, rows: int) -> Doubles:
        """Return when the exposure of each row starts, in s: (row,)."""
        start = self._first_exposure * self._span.start
        return np.arange(rows, dtype=np.float64) * self.line_time + start

    def frames_at_middles(self, frames: int, rows: int) -> Array:
        """Return the number of the frame in the middle of each row's exposures: (row,).

        If the middle is between two frames, the earlier one is returned.

        >>> Rows(exposure_time=1.0, line_time=1.0).frames_at_middles(4, 3).tolist()
        [0, 1, 3]
        """
        middles = np.arange(rows) * self.line_time + self._first_exposure * self._end / 2
        ends = np.ceil(np.round(middles * frames / self.duration(rows), 9))
        return np.asarray(ends.astype(np.intp) - 1)

    def duration(self, rows: int) -> float:
        """Return the time from the start of the first row to the end of the last row, s."""
        return (rows - 1) * self.line_time + self._first_exposure * self._end

    def weights(self, frames: int, rows: int, weighted: bool = False) -> Doubles:
        """Return the share of each row's exposure in each of the frames: (frame, row).

        The frames follow each other without a gap, over all of :meth:`duration`.

        Args:
            frames: the number of frames.
            rows: the number of rows.
            weighted: weight by the flickering light over its mean; shares need not add up to 1
            then.
        """
        starts = self.times(rows)
        bounds = np.linspace(0, self.duration(rows), frames + 1)[:, None]
        bounds_seen = np.clip(bounds, starts, starts + self.time)
        shares = np.diff(self._light_until(bounds_seen) if weighted else bounds_seen, axis=0)
        return np.asarray(shares / self.time)

    def _light_until(self, time: Doubles) -> Doubles:
        """Return the integral of the light, over its mean, until some times, s."""
        cycles = self.flicker_frequency * time + self.flicker_phase / 360
        if not self.flicker_duty:
            light = self.depth * np.sin(2 * np.pi * cycles) / (2 * np.pi)
        else:
            on = np.floor(cycles) + np.minimum(cycles % 1 / self.flicker_duty, 1)
            light = self.depth * (on - cycles)
        return np.asarray(time + light / self.flicker_frequency)

    @property
    def cycles(self) -> float:
        """Periods of the light during a row's exposure."""
        return self.flicker_frequency * self.time

    @property
    def swing(self) -> float:
        """The amplitude of the flicker after averaging over a row's exposure."""
        if not self.flicker_duty:
            return self.depth * np.sinc(self.cycles)
        return self.depth * (1 - self.flicker_duty) * (self.cycles % 1) / self.cycles

    def passes(self) -> tuple[Pass, ...]:
        if not self.swing or self.light_layer:  # the light layer was applied when the file was read
            return ()
        table = Pass(
            "flicker_of_rows", LineTable("rows"), ("step", "start", "swing"), writes="rows"
        )
        if self.flicker_duty:
            names = ("step", "start", "rest", "duty", "steady", "scale")
            table = Pass("pulses_of_rows", LineTable("rows"), names, writes="rows")
        return (table, Pass("flicker", arguments=("rows",)))

    def arguments(self, context: Context) -> Arguments:
        step = self.flicker_frequency * self.line_time % 1
        start = self.flicker_frequency * self._first_exposure * self._span.start
        start += self.flicker_phase / 360 - self.margins.top * step  # the image's first row
        if not self.flicker_duty:
            middle = (start + self.cycles / 2) % 1
            return {"step": step, "start": middle, "swing": self.swing}
        whole = float(np.floor(self.cycles))
        return {
            "step": _phase_word(step),
            "start": _phase_word(start),
            "rest": self.cycles - whole,
            "duty": self.flicker_duty,
            "steady": 1 - self.depth + self.depth * whole / self.cycles,
            "scale": self.depth / self.flicker_duty / self.cycles,
        }

    def reference(self, image: Floats, inputs: ReferenceContext) -> Floats:
        if not self.passes():
            return image
        n = typed_arguments(self.arguments(inputs.context))
        rows = np.arange(image.shape[0], dtype=np.uint32)
        if not self.flicker_duty:
            turns = rows.astype(np.float32) * n["step"] + n["start"]
            gains = (1 + n["swing"] * np.cos(2 * np.pi * turns.astype(np.float64))).astype("f4")
        else:
            begins = ((rows * n["step"] + n["start"]) >> 8).astype(np.float32) * np.float32(2**-24)
            ends, zero, one = begins + n["rest"], np.float32(0), np.float32(1)
            first = np.minimum(ends, n["duty"]) - begins
            second = np.minimum(ends, one + n["duty"]) - one
            gains = n["steady"] + n["scale"] * (np.maximum(first, zero) + np.maximum(second, zero))
        return image * gains[:, None, None]


def _phase_word(cycles: float) -> np.uint32:
    """Return the fraction of a period, in units of 2^-32: its sums stay exact.

    >>> int(_phase_word(-2.75)) == 2**30
    True
    """
    return np.uint32(round(cycles % 1 * 2**32) % 2**32)


STAGE = rgb_stage(
    "shutter",
    "Expose with a rolling shutter and flickering light.",
    (Rows,),
    role=StageRole.SHUTTER,
)
