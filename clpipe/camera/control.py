"""Control loops of a camera: auto exposure with auto ISO, and auto white balance, over time."""

import math
from collections import deque
from typing import Annotated, NamedTuple, Self

from pydantic import BaseModel, ConfigDict, Field, model_validator

ISO_STEPS = 3  # steps of auto ISO for each factor of two

TOLERANCE = 1e-9  # of a number of half periods of the mains

Iso = Annotated[float, Field(gt=0, le=10**9, allow_inf_nan=False)]
Ev = Annotated[float, Field(ge=0, le=100, allow_inf_nan=False)]


class Control(BaseModel):
    """How a camera's control loops follow what they meter: the ``[control]`` table.

    The loops follow ``exposure.method=auto`` and an estimated white balance. Gains of white balance
    are in stops as well, so all loops have the same parameters.

    Attributes:
        delay: the frames from metering to the frame that uses the result.
        smoothing: the time constant in frames, after which 1/e of a change is left. 0 is none.
        speed: the most that a loop changes, in EV per frame. 0 is no limit.
        hysteresis: the smallest change of the metered value that a loop follows, in EV.
        iso_max: the highest ISO of auto ISO; None is no auto ISO. Auto ISO multiplies the ISO that
            is set by the exposure's gain, in thirds of a stop, within the camera's range.
        iso_min: the lowest ISO of auto ISO; None is the ISO that is set.
        time_max: the longest exposure time in s, which is used before the ISO is raised. None is
            the time that is set, which auto exposure exceeds only at the highest ISO.
        mains: the frequency of the mains in Hz, whose lamps must not flicker; None is no lamps. It
            needs ``iso_max``, because the ISO supplies what the steps of the time lack.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    delay: Annotated[int, Field(ge=0, le=1000)] = 2
    smoothing: Ev = 4.0
    speed: Ev = 0.5
    hysteresis: Ev = 0.1
    iso_max: Iso | None = None
    iso_min: Iso | None = None
    time_max: Annotated[float, Field(gt=0, le=3600, allow_inf_nan=False)] | None = None
    mains: Annotated[float, Field(ge=10, le=1000, allow_inf_nan=False)] | None = None

    @model_validator(mode="after")
    def _mains_needs_auto_iso(self) -> Self:
        if self.mains and self.iso_max is None:
            raise ValueError("mains needs iso_max, because the ISO supplies what the time lacks")
        return self


class ControlLoop:
    """Follows a metered value in EV. It starts at the first one, as if the scene had not changed.

    A value is followed once it differs from the last one that was followed by more than the
    hysteresis. The loop then approaches it exponentially, at its highest speed at most.

    >>> loop = ControlLoop(Control(delay=1, smoothing=0.0, speed=0.5, hysteresis=0.0))
    >>> [loop.next(metered) for metered in (0.0, 0.8, 0.8, 0.8, 0.8)]
    [0.0, 0.0, 0.5, 0.8, 0.8]
    """

    def __init__(self, control: Control) -> None:
        self._control = control
        self._metered: deque[float] = deque(maxlen=control.delay + 1)
        self._target = self._value = 0.0

    def next(self, metered: float | None, frames: float = 1.0) -> float:
        """Return the value of the next frame, after a time in frames.

        Args:
            metered: the metered value of the frame; None is that of the frame before. Without one,
                the value is 0.
            frames: the time since the frame before, in usual intervals. Less than one changes less.
        """
        control = self._control
        if metered is None:
            if not self._metered:
                return self._value
            metered = self._metered[-1]
        if not self._metered:
            self._target = self._value = metered
            self._metered.extend([metered] * control.delay)
        self._metered.append(metered)
        seen = self._metered[0]
        if abs(seen - self._target) > control.hysteresis:
            self._target = seen
        share = -math.expm1(-frames / control.smoothing) if control.smoothing else 1.0
        step = share * (self._target - self._value)
        if speed := control.speed * frames:
            step = min(max(step, -speed), speed)
        self._value += step
        return self._value

    def hold(self, frames: int) -> None:
        """Let frames pass as if each had the last metered value."""
        for _ in range(frames):
            before = self._value
            if self.next(None) == before and len({*self._metered}) < 2:
                break  # it has settled


class Program(NamedTuple):
    """The exposure of a frame.

    Args:
        ev: the gain over the stated exposure time and ISO, EV.
        time: the exposure time, s.
        iso: the ISO.
    """

    ev: float
    time: float
    iso: float


class AutoExposure:
    """Divides the exposure of each frame between exposure time and ISO.

    The time is changed first, up to the longest one, and then the ISO. The ISO is in thirds of a
    stop, and stays until the exposure asks for one that is more than a step away. The conversion
    gain of a camera therefore does not switch to and fro.

    Under lamps, a time of at least half a period of the mains is a multiple of it, so that all rows
    get the same light. The ISO then has no steps, because it supplies the rest.

    >>> auto = AutoExposure((50.0, 25600.0), Control(iso_max=800.0))
    >>> [round(auto.next(ev, 100.0, 0.01).iso) for ev in (0.0, 0.2, 1.0, 0.8, 5.0, -1.0)]
    [100, 100, 200, 200, 800, 100]
    >>> auto = AutoExposure((50.0, 25600.0), Control(iso_max=800.0, time_max=1 / 25, mains=50.0))
    >>> [tuple(round(v, 3) for v in auto.next(ev, 100.0, 0.01)) for ev in (-1.0, 0.5, 4.0, 9.0)]
    [(-1.0, 0.005, 100.0), (0.5, 0.01, 141.421), (4.0, 0.04, 400.0), (5.0, 0.04, 800.0)]

    Args:
        iso_range: the lowest and the highest ISO of the camera.
        control: the longest time, the ISOs and the mains.
    """

    def __init__(self, iso_range: tuple[float, float], control: Control) -> None:
        self._range, self._control = iso_range, control
        self._step: int | None = None

    def next(self, ev: float, iso: float, time: float) -> Program:
        """Return the exposure of the next frame.

        Args:
            ev: the gain that it needs over the stated time and ISO, EV.
            iso: the stated ISO.
            time: the stated exposure time, s.
        """
        control = self._control
        low = high = 0.0
        if control.iso_max is not None:
            ends = max(control.iso_min or iso, self._range[0]), min(control.iso_max, self._range[1])
            low, high = (math.log2(each / iso) for each in ends)
        longest = math.log2((control.time_max or time) / time)
        gain = min(max(ev - longest if control.mains else self._gain(ev - longest), low), high)
        time_ev = min(ev - gain, longest) if control.time_max else ev - gain
        if control.mains:
            half_period = 0.5 / control.mains
            halves = time * 2**time_ev / half_period
            if halves > 1 - TOLERANCE:
                time_ev = math.log2(int(halves + TOLERANCE) * half_period / time)
                if ev - time_ev > high and not control.time_max:  # only time supplies the rest
                    time_ev = math.log2(math.ceil(halves - TOLERANCE) * half_period / time)
                gain = min(ev - time_ev, high)
        return Program(min(ev, time_ev + gain), time * 2**time_ev, iso * 2**gain)

    def _gain(self, ev: float) -> float:
        """Return the gain of the ISO in EV, without its limits."""
        asked = ev * ISO_STEPS + (
            1 if self._control.time_max else 0
        )  # a step above the longest time
        if self._step is None or abs(asked - self._step) > 1:
            self._step = round(asked)
        return self._step / ISO_STEPS
