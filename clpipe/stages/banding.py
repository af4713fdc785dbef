"""Banding: a periodic disturbance of the readout, for example from a power supply."""

from collections.abc import Callable
from typing import ClassVar

import numpy as np

from clpipe.base.types import Floats
from clpipe.stage import (
    Backend,
    Context,
    LineTable,
    NoiseScope,
    Numbers,
    Pass,
    Signal,
    SignalMethod,
    camera_parameter,
    sensor_stage,
)

SINE = tuple(map(np.float32, (42.058693, -76.705859, 81.605249, -41.341702, 6.2831853)))


def sine_of_turns(turns: Signal, where: Callable[..., Signal] = np.where) -> Signal:
    """Return the sine of an angle in turns, to within 4e-6, using only * and +.

    >>> sine_of_turns(np.float32([0, 0.125, 0.25, 0.5, 7.75])).round(3).tolist()
    [0.0, 0.7070000171661377, 1.0, 0.0, -1.0]
    """
    whole = 12582912.0
    part = turns - ((turns + whole) - whole)
    z = 0.25 - abs(abs(part) - 0.25)
    z2 = z * z
    first, *others, last = map(float, SINE)
    total = z2 * first
    for coefficient in others:
        total = (total + coefficient) * z2
    sine = (total + last) * z
    return where(part < 0, -sine, sine)


class Sine(SignalMethod):
    """y + amplitude * sin(2 pi (row / period + phase)): a wave with a new phase in each frame.

    Rows are read one after the other, so a disturbance in time becomes a wave over the rows. EMVA
    1288, release 4.0 (2021), finds it as a peak in the spectrogram of rows.

    >>> from clpipe.stage import run_reference
    >>> wave = run_reference(Sine(amplitude=0.1, period=4.0), np.zeros((400, 2), np.float32))
    >>> round(float(wave.std() * 2**0.5), 3), bool((wave[:, 0] == wave[:, 1]).all())
    (0.1, True)
    """

    method: ClassVar = "sine"
    kernel: ClassVar = "banding"
    summary: ClassVar = "add a sine wave over the rows, with a new phase in each image"
    example: ClassVar = {"amplitude": 0.01, "period": 9.7}

    amplitude: float | None = camera_parameter(
        "Amplitude of the wave.", "signal", more=" and ISO", ge=0, le=1
    )
    period: float | None = camera_parameter(
        "Period of the wave.", "rows", more="; else 16", ge=2, le=1e5
    )

    def resolve(self, context: Context) -> "Sine":
        camera = context.camera
        amplitude = camera.signal_of(camera.banding_amplitude, context.iso)
        return self.with_defaults(amplitude=amplitude, period=camera.banding_period or 16.0)

    def passes(self) -> tuple[Pass, ...]:
        if not self.amplitude:
            return ()
        names = ("frequency", "amplitude")
        return (
            Pass("wave_of_lines", LineTable("rows"), names, writes="wave", random=NoiseScope.IMAGE),
            Pass("banding", arguments=("wave",)),
        )

    @property
    def frequency(self) -> float:
        """The frequency of the wave, in turns per row."""
        assert self.period is not None
        return 1 / self.period

    def variance(self, input_variance: Floats, signal: Floats, context: Context) -> Floats:
        return input_variance + np.float32(self.amplitude) ** 2 / np.float32(2)

    @classmethod
    def apply(cls, y: Signal, n: Numbers, backend: Backend) -> Signal:
        turns = backend.rows() * n["frequency"] + backend.uniform()
        return y + sine_of_turns(turns, backend.where) * n["amplitude"]


STAGE = sensor_stage("banding", "Add a periodic wave over the rows.", (Sine,))
