"""Control loops of a camera: auto exposure, auto ISO and auto white balance over time."""

import math
from collections import deque
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

ISO_STEPS = 3  # steps of auto ISO for each factor of two

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
    """

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    delay: Annotated[int, Field(ge=0, le=1000)] = 2
    smoothing: Ev = 4.0
    speed: Ev = 0.5
    hysteresis: Ev = 0.1
    iso_max: Iso | None = None
    iso_min: Iso | None = None


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


class AutoIso:
    """Chooses the ISO of each frame, in thirds of a stop.

    The ISO stays until the exposure asks for one that is more than a step away. The conversion gain
    of a camera therefore does not switch to and fro.

    >>> auto = AutoIso(100.0, (50.0, 25600.0), Control(iso_max=800.0))
    >>> [round(auto.next(ev)) for ev in (0.0, 0.2, 1.0, 0.8, 5.0, -1.0)]
    [100, 100, 200, 200, 800, 100]
    """

    def __init__(self, iso: float, iso_range: tuple[float, float], control: Control) -> None:
        assert control.iso_max is not None
        low, high = iso_range
        self._iso = self._last = iso
        self._ends = max(control.iso_min or iso, low), min(control.iso_max, high)
        self._step: int | None = None

    @property
    def gain(self) -> float:
        """The gain of the last ISO over the one that is set, EV."""
        return math.log2(self._last / self._iso)

    def next(self, ev: float) -> float:
        """Return the ISO of the next frame, whose exposure has a gain of ``ev`` EV."""
        asked = ev * ISO_STEPS
        if self._step is None or abs(asked - self._step) > 1:
            self._step = round(asked)
        low, high = self._ends
        self._last = min(max(self._iso * 2 ** (self._step / ISO_STEPS), low), high)
        return self._last
