"""Dark current: thermal charge that accumulates during the exposure."""

from collections.abc import Mapping
from typing import ClassVar

import numpy as np

from clpipe.base.types import Floats
from clpipe.reference.random import Stream, exponential_of
from clpipe.stage import (
    Arguments,
    Backend,
    Context,
    Kind,
    NoiseScope,
    Numbers,
    Pass,
    Signal,
    SignalMethod,
    camera_parameter,
    optics_parameter,
    parameter,
    sensor_bits,
    sensor_stage,
)


class Thermal(SignalMethod):
    """Shot noise and fixed pattern of the dark current. Black level subtraction removes its mean.

    On average a pixel accumulates D = current * 2^((temperature - reference) / doubling) * time
    electrons (EMVA 1288, release 4.0, 2021: dark current). Pixels differ: their charge has a
    shifted exponential distribution with the standard deviation spread * D, because hot pixels make
    its tail long. This pattern is fixed for a camera. The shot noise is new in each frame, and its
    variance is the pixel's charge.

    >>> from clpipe.stage import run_reference
    >>> hot = Thermal(exposure_time=10.0, current=2.0, spread=0.0, per_electron=1e-3)
    >>> round(float(run_reference(hot, np.zeros((300, 300), np.float32)).std()), 4)
    0.0045
    """

    method: ClassVar = "thermal"
    kernel: ClassVar = "dark_current"
    summary: ClassVar = "add the shot noise and the fixed pattern of dark current"
    example: ClassVar = {"exposure_time": 30.0, "current": 3.0, "spread": 0.4, "per_electron": 4e-4}

    exposure_time: float | None = optics_parameter(
        "Exposure time. 0 disables dark current.",
        "s",
        more=", from the exposure's EV; else 0",
        ge=0,
        le=86400,
    )
    temperature: float | None = parameter(
        None,
        "Temperature of the sensor.",
        "deg C",
        "the reference temperature",
        ge=-150,
        le=150,
    )
    current: float | None = camera_parameter(
        "Dark current at the reference temperature.", "e-/s", ge=0, le=1e6
    )
    reference_temperature: float | None = camera_parameter(
        "Reference temperature, at which the current was measured.", "deg C", ge=-150, le=150
    )
    doubling: float | None = camera_parameter(
        "Temperature difference that doubles the current. With 0 it does not depend on "
        "temperature.",
        "K",
        more="; else 0",
        ge=0,
        le=1000,
    )
    spread: float | None = camera_parameter(
        "Variation between pixels: standard deviation over mean.", ge=0, le=1
    )
    per_electron: float | None = camera_parameter(
        "Signal of one electron.", "signal/e-", more=" and ISO", gt=0, le=1
    )

    def optics(self) -> Mapping[str, float]:
        return super().optics() if self.exposure_time else {}  # 0 disables the stage

    def resolve(self, context: Context) -> "Thermal":
        camera = context.camera
        resolved = self.with_defaults(
            exposure_time=context.exposure_time or 0.0,
            reference_temperature=camera.dark_current_temperature,
            current=camera.dark_current,
            doubling=camera.dark_current_doubling or 0.0,
            spread=camera.dark_current_spread,
            per_electron=camera.signal_of(1.0, context.iso),
        )
        return resolved.with_defaults(temperature=resolved.reference_temperature)

    @property
    def electrons(self) -> float:
        """The mean charge of a pixel, e-."""
        if not self.current or not self.exposure_time:
            return 0.0
        warmer = (self.temperature or 0.0) - (self.reference_temperature or 0.0)
        factor = 2.0 ** (warmer / self.doubling) if self.doubling else 1.0
        return self.current * factor * self.exposure_time

    def passes(self) -> tuple[Pass, ...]:
        if not self.electrons:
            return ()
        return (
            Pass(
                "dark_charge",
                arguments=("mean", "spread"),
                writes="charge",
                kind=Kind.PAIR,
                random=NoiseScope.CAMERA,
            ),
            Pass(
                "dark_shot_noise",
                arguments=("per_electron",),
                reads=("charge",),
                random=NoiseScope.IMAGE,
            ),
        )

    @property
    def _charge(self) -> tuple[float, float, float]:
        """Return the mean charge, its deviation over pixels, and the signal of an electron."""
        assert self.spread is not None and self.per_electron is not None
        mean = self.electrons * self.per_electron
        return mean, mean * self.spread, self.per_electron

    def arguments(self, context: Context) -> Arguments:
        mean, spread, electron = self._charge
        return {"mean": mean, "spread": spread, "per_electron": electron}

    def variance(self, input_variance: Floats, signal: Floats, context: Context) -> Floats:
        if not self.electrons:
            return input_variance
        mean, spread, electron = map(np.float32, self._charge)
        return input_variance + (mean * electron + spread * spread)

    @classmethod
    def apply(cls, y: Signal, n: Numbers, backend: Backend) -> Signal:
        offset = backend.fixed(charge_of_sensor) * n["spread"]
        shot = backend.square_root((offset + n["mean"]).clip(min=0) * n["per_electron"])
        return y + offset + backend.normals(1) * shot


def charge_of_sensor(height: int, width: int, stream: Stream) -> Floats:
    """Return exponential numbers of mean 1, minus 1."""
    return exponential_of(sensor_bits(height, width, stream)) - np.float32(1)


STAGE = sensor_stage(
    "dark_current", "Add the shot noise and fixed pattern of thermal charge.", (Thermal,)
)
