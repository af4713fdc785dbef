"""High dynamic range in one exposure: it is read several times, and the readouts are merged."""

from functools import lru_cache
from typing import ClassVar, NamedTuple, Self

import numpy as np
from pydantic import PrivateAttr

from clpipe.base.errors import RequestError
from clpipe.base.types import Floats
from clpipe.camera.profile import Camera
from clpipe.reference.math import square_root
from clpipe.reference.random import normal_at
from clpipe.stage import (
    Arguments,
    CompileTime,
    Context,
    Method,
    NoiseScope,
    Pass,
    ReferenceContext,
    camera_parameter,
    parameter,
    typed_arguments,
)
from clpipe.stages.sensor_noise.model import SensorNoise
from clpipe.stages.sensor_noise.no_noise import NEVER_FULL, NoNoise, or_default

DEFAULT_RATIO = 16.0  # for sensors whose profile does not state a ratio
MAX_READOUTS = 4
# Signal of a readout at which its weight becomes 0, and the slope below it. The transition
# therefore begins at 0.85.
HANDOVER_END, HANDOVER_SLOPE = np.float32(0.95), np.float32(10.0)


class Readout(NamedTuple):
    """One readout of an exposure.

    Args:
        photodiode: its number; readouts of one photodiode have the same charge.
        share: its light relative to the first readout's, which merging assumes.
        gain: its gain relative to the first readout's.
        leak: share of the first photodiode's light that leaks into it, which merging ignores.
    """

    photodiode: int
    share: float
    gain: float
    leak: float = 0.0

    @property
    def sensitivity(self) -> float:
        """Its signal over the first readout's, which merging assumes."""
        return self.share * self.gain


class Readouts(SensorNoise):
    """Several readouts of an exposure, each with its own noise, rounding and white level.

    The first readout is the camera's at its ISO, with its a and b. The last one has its white at
    the signal ``full_scale``, which ``quantize`` uses as the white level. After ``normalize``, 1 is
    the white of the first readout, and brighter light is above 1. The merged signal is that of the
    first readout that is below 0.85 of its white. From there to 0.95 it changes linearly to the
    next readout. The signal-to-noise ratio drops there, because the next readout has collected or
    amplified less.
    """

    kernel: ClassVar = "sensor_noise_readouts"

    ratio: float | None = camera_parameter(
        "Ratio of sensitivity between each readout and the next one.",
        more="; else 16",
        gt=1,
        le=1024,
    )
    later_noise: float | None = camera_parameter(
        "Read noise of the further readouts over that of the first, both in DN.",
        more="; else 1",
        ge=0,
        le=1000,
    )
    part: int | None = parameter(
        None,
        "Number of a single readout to return, from 0, instead of the merged signal.",
        auto="merged",
        structural=True,
        ge=0,
        le=MAX_READOUTS - 1,
    )

    _signal_range: float = PrivateAttr(1.0)  # the camera's white level minus its black level, DN
    _full_signal: float | None = PrivateAttr(None)  # the signal that fills the well, without noise
    _is_clean: bool = PrivateAttr(False)  # merges readouts that have no noise

    @property
    def readouts(self) -> tuple[Readout, ...]:
        """The (resolved) readouts, the most sensitive first, grouped by photodiode."""
        raise NotImplementedError(type(self).__name__)

    @property
    def full_scale(self) -> float:
        """The signal at which the last readout saturates."""
        return 1 / self.readouts[-1].sensitivity

    def with_camera(self, camera: Camera) -> Self:
        """Return a copy with the camera's values for everything that is not set."""
        filled = self.with_defaults(ratio=camera.readout_ratio, later_noise=camera.readout_noise)
        return filled.with_defaults(ratio=DEFAULT_RATIO, later_noise=1.0)

    def resolve(self, context: Context) -> Self:
        resolved = super().resolve(context).with_camera(context.camera)
        last = len(resolved.readouts) - 1
        if resolved.part is not None and resolved.part > last:
            raise RequestError(
                f"sensor_noise.part: readout {resolved.part} does not exist; choose 0 to {last}"
            )
        return resolved.with_state(_signal_range=context.camera.signal_range)

    def next_context(self, context: Context) -> Context:
        return super().next_context(context).replace(full_scale=self.full_scale)

    def passes(self) -> tuple[Pass, ...]:
        function, *further = self.function
        if self._is_clean:
            names = ("count", "part", "full_well", "table", *further)
            return (Pass(f"clean_{function}", arguments=names),)
        names = ("count", "part", "a", "full_well", "range", "unit", "table", *further)
        return (Pass(function, arguments=names, random=NoiseScope.IMAGE),)

    @property
    def function(self) -> tuple[str, ...]:
        """The kernel function, and its arguments besides the readouts."""
        return ("readouts",)

    def light_on(self, image: Floats, photodiode: int) -> Floats:
        """Return the light of one photodiode for an image, over the light of the first one."""
        return image

    @property
    def is_exact(self) -> bool:
        """Whether merged readouts without noise equal the light up to the last one's white."""
        return self.part is None and not any(each.leak for each in self.readouts)

    def without_noise(self) -> Method | None:
        if self._is_clean:
            return self
        if self.is_exact:
            return NoNoise(full_signal=self.full_scale)
        clean = self.model_copy(update={"a": 0.0, "b": 0.0, "tukey_lambda": None})
        return clean.with_state(_full_signal=self.full_signal, _is_clean=True)

    @property
    def full_signal(self) -> float | None:
        return self._full_signal if self._is_clean else super().full_signal

    @property
    def table(self) -> Floats:
        """The readouts in the layout of the kernel: (readout, 5)."""
        assert self.b is not None and self.later_noise is not None
        return _table(self.readouts, self.b, self.b * self.later_noise**2)

    def arguments(self, context: Context) -> Arguments:
        structure = {"count": len(self.readouts), "part": -1 if self.part is None else self.part}
        literals = {name: CompileTime(str(value)) for name, value in structure.items()}
        return {
            **literals,
            "a": self.a,
            "full_well": or_default(self.full_signal, NEVER_FULL),
            "range": self._signal_range,
            "unit": 1 / self._signal_range,
            "table": self.table,
        }

    def added_variance(self, signal: Floats) -> Floats:
        remaining, read = np.ones_like(signal), np.zeros_like(signal)
        by_photodiode: dict[int, tuple[Floats, Floats]] = {}  # weight and shot noise by photodiode
        readouts = self.readouts
        for i, (each, row) in enumerate(zip(readouts, self.table, strict=True)):
            if self.part is None:
                is_last = i == len(readouts) - 1
                weight_here = (
                    remaining if is_last else remaining * self._weight(signal * row[1] * row[2])
                )
                remaining = remaining - weight_here
            else:
                weight_here = np.full_like(signal, i == self.part)
            weight = (
                by_photodiode.get(each.photodiode, (np.zeros_like(signal), remaining))[0]
                + weight_here
            )
            light, scale = signal * row[1], row[2] * row[3]
            by_photodiode[each.photodiode] = weight, np.float32(self.a) * light * scale**2
            read = read + weight_here**2 * row[4] * row[3] ** 2
        shot = sum(weight**2 * variance for weight, variance in by_photodiode.values())
        return np.asarray(shot + read, np.float32)

    @staticmethod
    def _weight(read: Floats) -> Floats:
        """Return the weight of a readout in the merged signal, from its own signal."""
        return np.minimum(
            np.maximum((HANDOVER_END - read) * HANDOVER_SLOPE, np.float32(0)), np.float32(1)
        )

    def reference(self, image: Floats, inputs: ReferenceContext) -> Floats:
        def normals(draw: int) -> Floats:
            return normal_at(image.shape, draw, inputs.stream[NoiseScope.IMAGE])

        n = typed_arguments(self.arguments(inputs.context))
        values, weights = [], []
        photodiode, charge = -1, image
        for i, (number, share, gain, inverse, variance) in enumerate(self.table):
            if int(number) != photodiode:
                photodiode, light = int(number), self.light_on(image, int(number)) * share
                if not self._is_clean:
                    shot = square_root(np.maximum(n["a"] * light, np.float32(0)))
                    light = light + normals(photodiode) * shot
                charge = np.minimum(light, n["full_well"])
            read = charge * gain
            if not self._is_clean:
                sigma = square_root(np.full(image.shape, variance, np.float32))
                noise = normals(MAX_READOUTS + i) * sigma
                read = np.rint((read + noise) * n["range"]) * n["unit"]
            read = np.minimum(read, np.float32(1))
            values.append(read * inverse)
            weights.append(self._weight(read))
        if self.part is not None:
            return values[self.part]
        merged = values[-1]
        for value, weight in zip(values[-2::-1], weights[-2::-1], strict=True):
            merged = weight * value + (np.float32(1) - weight) * merged
        return merged


@lru_cache(maxsize=256)  # equal readouts share one object, so that it is uploaded once
def _table(readouts: tuple[Readout, ...], first: float, later: float) -> Floats:
    rows = [
        (
            each.photodiode,
            each.share + each.leak,
            each.gain,
            1 / each.sensitivity,
            later if number else first,
        )
        for number, each in enumerate(readouts)
    ]
    return np.array(rows, np.float32)


class DualGain(Readouts):
    """Dual conversion gain: one charge is read at a high and at a low gain, ``ratio`` apart.

    The shot noise of both readouts is the same. LOFIC sensors are similar, with a larger ratio: the
    second readout is that of a capacitor into which a full photodiode overflows.

    >>> from clpipe.stage import run_reference
    >>> noisy = run_reference(DualGain(a=1e-4, b=1e-6), np.full((200, 200), 8.0, np.float32))
    >>> round(float(noisy.mean()), 1), round(float(noisy.var()), 3)
    (8.0, 0.001)
    """

    method: ClassVar = "dual_gain"
    summary: ClassVar = "one charge, read at two gains and merged"
    other_examples: ClassVar = ({"part": 1},)

    @property
    def readouts(self) -> tuple[Readout, ...]:
        assert self.ratio is not None
        return Readout(0, 1, 1), Readout(0, 1, 1 / self.ratio)
