"""A gain stage: measurements of a sensor at the ISOs that share one conversion gain."""

import math
from bisect import bisect_right
from collections.abc import Sequence
from functools import cached_property, lru_cache
from typing import Annotated

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, model_validator

from clpipe.base.pure import pure

MAX_VALUE = 1e9  # the largest value of a sensor, so that its square is finite as well
Positive = Annotated[float, Field(gt=0, le=MAX_VALUE, allow_inf_nan=False)]
NotNegative = Annotated[float, Field(ge=0, le=MAX_VALUE, allow_inf_nan=False)]
Offset = Annotated[float, Field(ge=-65535, le=65535, allow_inf_nan=False)]
TukeyLambda = Annotated[float, Field(gt=-0.5, le=1)]
Offsets = tuple[Offset, Offset, Offset, Offset]


class GainStage(BaseModel):
    """The measurements at ISOs that share one conversion gain, in ascending order of ISO.

    Each table is as long as ``iso``; None is unknown.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    iso: Annotated[tuple[Positive, ...], Field(min_length=1)]
    system_gain: tuple[Positive, ...]  # DN/e-
    read_noise: tuple[Positive, ...]  # DN; noise of a pixel before rounding to whole DN
    tukey_lambda: tuple[TukeyLambda, ...] | None = None  # shape of the read noise
    row_noise: tuple[NotNegative, ...] | None = None  # DN; it differs in each frame
    column_noise: tuple[NotNegative, ...] | None = None  # DN; it is the same in each frame
    # DN; fixed offsets of R, G in rows with R, G in rows with B, and B.
    color_bias: tuple[Offsets, ...] | None = None
    # DN; sigma of each channel's level, drawn in each frame.
    black_level_error: tuple[NotNegative, ...] | None = None

    @model_validator(mode="after")
    def _check_lengths(self) -> "GainStage":
        for name in type(self).model_fields:
            values = getattr(self, name)
            if values is not None and len(values) != len(self.iso):
                raise ValueError(
                    f"{name} must be as long as iso; found {len(values)} and {len(self.iso)}"
                )
        if list(self.iso) != sorted(set(self.iso)):
            raise ValueError("iso must ascend")
        return self

    def at(self, iso: float, values: tuple[float, ...]) -> float:
        """Return the value in DN of one of this stage's tables at an ISO.

        The table is converted to electrons and interpolated linearly in log ISO. Outside the table,
        the nearest value in electrons is used.
        """
        electrons = self.interpolate(iso, _ratios(values, self.system_gain))
        return electrons * self.gain_at(iso)

    def interpolate(self, iso: float, values: Sequence[float]) -> float:
        """Return the value of a unitless table at an ISO: linear in log ISO, level outside.

        >>> stage = GainStage(iso=(100, 400), system_gain=(1, 4), read_noise=(2, 3))
        >>> round(stage.interpolate(200, (0.1, 0.2)), 6), stage.interpolate(800, (0.1, 0.2))
        (0.15, 0.2)
        """
        return _interpolate(iso, self.iso, self._logs, values)

    @cached_property
    def _logs(self) -> list[float]:
        return [math.log(iso) for iso in self.iso]

    def gain_at(self, iso: float) -> float:
        """Return the system gain in DN/e-, interpolated in proportion to the ISO."""
        return self.interpolate(iso, _ratios(self.system_gain, self.iso)) * iso

    @cached_property
    def adc_noise(self) -> float:
        """The part of the read noise that arises after the gain, in DN.

        It is a least-squares fit of read_noise^2 = gain^2 * before^2 + after^2 (EMVA 1288), with
        each ISO's residual relative to its read_noise^2. It is limited to the smallest read noise.
        With fewer than three ISOs, too few to fit, it is 0.
        """
        if len(self.iso) < 3:
            return 0.0
        read2 = np.square(self.read_noise)
        terms = np.stack([np.square(self.system_gain) / read2, 1 / read2], axis=1)
        _, after2 = np.linalg.lstsq(terms, np.ones(len(read2)))[0]
        return float(np.sqrt(np.clip(after2, 0, read2.min())))


@lru_cache(maxsize=1024)  # equal tables share one object, so that chains share it
def _ratios(values: tuple[float, ...], divisors: tuple[float, ...]) -> tuple[float, ...]:
    return tuple(value / divisor for value, divisor in zip(values, divisors, strict=True))


@pure
def _interpolate(
    iso: float, isos: Sequence[float], logs: Sequence[float], values: Sequence[float]
) -> float:
    """Return the value at an ISO of a table; see :meth:`GainStage.interpolate`."""
    after = bisect_right(isos, iso)
    if after in (0, len(isos)):
        return values[0 if after == 0 else -1]
    x, y = logs[after - 1], values[after - 1]
    slope = (values[after] - y) / (logs[after] - x)
    return slope * (math.log(iso) - x) + y
