"""The distributions of random draws, which a configuration declares in place of a value.

A drawn value depends only on the seed, the image key and the name of the value. It is rounded to
nine digits, enough for a float32, so that platforms whose ``log`` differs in the last bit agree.
"""

import math
from collections.abc import Mapping, Sequence
from statistics import NormalDist
from typing import Annotated, Any, Self

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from clpipe.base.text import unknown_name
from clpipe.base.validation import first_fault
from clpipe.chain.keys import setting_error
from clpipe.chain.limits import SMALLEST_FLOAT, Limits

MAX_SIGMAS = 9.0  # standard deviations; a uniform number of 52 bits gives a normal of at most 8.3


class Draw(BaseModel):
    """A distribution to draw values from. The fields of a subclass are its keys in a table."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)

    @property
    def follows(self) -> str:
        """The dotted name of the value that this one follows; "" if it follows none."""
        return ""

    def record(self) -> dict[str, Any]:
        """Return the draw as a configuration stores it."""
        values = self.model_dump()
        return {key: list(v) if isinstance(v, tuple) else v for key, v in values.items()}

    def extremes(self, limits: Limits | None, followed: Sequence[Any]) -> Sequence[Any]:
        """Return the extreme values. If they are allowed, every drawn value is.

        Args:
            limits: the limits of the drawn value; None if it is no number.
            followed: the extremes of the value that it follows.

        Raises:
            ValueError: the distribution does not fit such a value, or cannot follow such values.
        """
        raise NotImplementedError(type(self).__name__)

    def truncated(self, limits: Limits) -> "Draw | None":
        """Return the distribution truncated to limits, so that no values pile up at a limit.

        Returns None if the limits allow no value, or exclude the mean. A draw that follows another
        value is returned unchanged.
        """
        return self

    def value(self, uniform: float, limits: Limits | None, followed: Any) -> Any:
        """Return the value for a uniform number.

        Args:
            uniform: a number above 0 and below 1.
            limits: as for :meth:`extremes`.
            followed: the value that it follows; None if it follows none.
        """
        raise NotImplementedError(type(self).__name__)


Ends = Annotated[tuple[float, float], Field(strict=False)]


class Choice(Draw):
    """One of several values, all equally likely."""

    choice: Annotated[list[Any], Field(strict=False, min_length=1)]

    @model_validator(mode="after")
    def _check_plain(self) -> "Choice":
        for item in self.choice:
            if item is None or isinstance(item, Mapping):
                raise ValueError(
                    f"found {item!r} in the list, but null and tables are not allowed; list plain "
                    "values"
                )
        return self

    def extremes(self, limits: Limits | None, followed: Sequence[Any]) -> Sequence[Any]:
        return self.choice

    def truncated(self, limits: Limits) -> "Choice | None":
        left = [each for each in self.choice if limits.low <= each <= limits.high]
        return Choice(choice=left) if left else None

    def value(self, uniform: float, limits: Limits | None, followed: Any) -> Any:
        return self.choice[int(uniform * len(self.choice))]


class NumberDraw(Draw):
    """A distribution of numbers. Subclasses define its range and its inverse CDF."""

    def extremes(self, limits: Limits | None, followed: Sequence[Any]) -> Sequence[Any]:
        if limits is None:
            raise ValueError(
                "this draw needs a parameter with one number as its value; use choice or "
                "same_as instead"
            )
        return limits.validation_samples(*self.range_of(limits, followed))

    def value(self, uniform: float, limits: Limits | None, followed: Any) -> Any:
        assert limits
        return limits.nearest(self.number(uniform, limits, followed))

    def range_of(self, limits: Limits, followed: Sequence[Any]) -> tuple[float, float]:
        """Return the lowest and the highest value. Arguments and errors as :meth:`extremes`."""
        raise NotImplementedError(type(self).__name__)

    def number(self, uniform: float, limits: Limits, followed: Any) -> float:
        """Return the value before it is rounded. Arguments as :meth:`value`."""
        raise NotImplementedError(type(self).__name__)


class RangeDraw(NumberDraw):
    """Any number of a range, including both ends; a whole number if the value must be whole.

    The first field of a subclass contains the ends.
    """

    @property
    def _ends(self) -> Ends:
        return getattr(self, next(iter(type(self).model_fields)))

    @model_validator(mode="after")
    def _check_order(self) -> Self:
        low, high = self._ends
        if low > high:
            raise ValueError(f"found [{low:g}, {high:g}]; put the lower end first")
        return self

    def range_of(self, limits: Limits, followed: Sequence[Any]) -> tuple[float, float]:
        return self._ends

    def truncated(self, limits: Limits) -> Self | None:
        name = next(iter(type(self).model_fields))
        ends = limits.overlap(*self._ends)
        return self.model_copy(update={name: ends}) if ends else None

    def number(self, uniform: float, limits: Limits, followed: Any) -> float:
        low, high = self._ends
        if limits.whole:
            return min(math.floor(low + uniform * (high - low + 1)), high)
        return min(max(low * (1 - uniform) + high * uniform, low), high)


class Uniform(RangeDraw):
    """A number that is uniform in its range.

    >>> Uniform(uniform=(3, 5)).value(0.99, Limits(whole=True), None)
    5
    """

    uniform: Ends


class Drift(RangeDraw):
    """A number that drifts slowly through the frames of a sequence, uniform in its range.

    A standard Gaussian is drawn every ``frames`` frames. Between two of them, a frame has
    ``cos(pi t / 2) z0 + sin(pi t / 2) z1``, which is a standard Gaussian as well, and its CDF is a
    uniform number. Frames that are ``frames`` apart are therefore correlated by 0.32 on average,
    and those twice as far apart are independent. A single image has the value of the first frame.

    >>> drift = Drift(drift=(10, 20), frames=100)
    >>> drift.knots(250), drift.between(250, 0.5, 0.5)
    ((2, 3), 0.5)
    """

    drift: Ends
    frames: Annotated[float, Field(ge=1)] = 100.0

    def knots(self, frame: float) -> tuple[int, int]:
        """Return the numbers of the two draws that a frame is between."""
        first = math.floor(frame / self.frames)
        return first, first + 1

    def between(self, frame: float, first: float, second: float) -> float:
        """Return the uniform number of a frame from those of its two draws."""
        angle = (frame / self.frames % 1) * math.pi / 2
        normal = math.cos(angle) * _normal(first) + math.sin(angle) * _normal(second)
        return NormalDist().cdf(normal)


class LogUniform(RangeDraw):
    """A number whose logarithm is uniform: each octave of the range is as likely as the others.

    >>> round(LogUniform(log_uniform=(100, 6400)).value(0.5, Limits(), None))
    800
    """

    log_uniform: Ends

    @model_validator(mode="after")
    def _check_positive(self) -> Self:
        if self.log_uniform[0] <= 0:
            raise ValueError(f"found {list(self.log_uniform)}, but both ends must be above 0")
        return self

    def number(self, uniform: float, limits: Limits, followed: Any) -> float:
        low, high = self.log_uniform
        log = math.log(low) * (1 - uniform) + math.log(high) * uniform
        return min(max(_exp(log), low), high)


class Normal(NumberDraw):
    """A Gaussian with a mean and a standard deviation. Values outside the limits are clamped.

    >>> Normal(normal=(0.8, 0.1)).value(0.5, Limits(), None)
    0.8
    """

    normal: Ends

    @model_validator(mode="after")
    def _check_sigma(self) -> "Normal":
        if self.normal[1] < 0:
            raise ValueError(
                f"found {list(self.normal)}, but the standard deviation must be 0 or more"
            )
        return self

    def range_of(self, limits: Limits, followed: Sequence[Any]) -> tuple[float, float]:
        mean, sigma = self.normal
        if not limits.low <= mean <= limits.high:
            return mean, mean  # validation will reject it
        return limits.nearest(mean - MAX_SIGMAS * sigma), limits.nearest(mean + MAX_SIGMAS * sigma)

    def truncated(self, limits: Limits) -> "Truncated | None":
        if not limits.low <= self.normal[0] <= limits.high:
            return None
        return Truncated(normal=self.normal, ends=(limits.low, limits.high))

    def number(self, uniform: float, limits: Limits, followed: Any) -> float:
        mean, sigma = self.normal
        return mean + sigma * _normal(uniform)


class Truncated(Normal):
    """A Gaussian truncated to the range between two ends.

    >>> Truncated(normal=(0, 1), ends=(0, 8)).value(0.5, Limits(), None)
    0.67448975
    """

    ends: Ends

    def number(self, uniform: float, limits: Limits, followed: Any) -> float:
        mean, sigma = self.normal
        if not sigma:
            return mean
        low, high = (NormalDist(mean, sigma).cdf(end) for end in self.ends)
        return super().number(low + uniform * (high - low), limits, followed)


class SameAs(Draw):
    """The same value as another one."""

    same_as: str

    @property
    def follows(self) -> str:
        return self.same_as

    def extremes(self, limits: Limits | None, followed: Sequence[Any]) -> Sequence[Any]:
        return followed

    def value(self, uniform: float, limits: Limits | None, followed: Any) -> Any:
        return followed


class LogNormalOf(NumberDraw):
    """A number whose logarithm is Gaussian about a linear function of another number's logarithm.

    Read noise follows shot noise in this way: log b ~ N(2.18 log a + 1.2, 0.26) (Brooks et al.,
    "Unprocessing images for learned raw denoising", CVPR 2019, sec. 3.1). Values outside the limits
    are clamped.

    >>> read = LogNormalOf(log_normal_of="sensor_noise.a", slope=2.18, intercept=1.2, sigma=0.26)
    >>> read.value(0.5, Limits(), 1e-3)
    9.5753218e-07
    """

    log_normal_of: str
    slope: float
    intercept: float
    sigma: Annotated[float, Field(ge=0)]

    @property
    def follows(self) -> str:
        return self.log_normal_of

    def _value_at(self, normal: float, followed: float) -> float:
        log = self.slope * math.log(followed) + self.intercept + self.sigma * normal
        return max(_exp(log), SMALLEST_FLOAT)

    def range_of(self, limits: Limits, followed: Sequence[Any]) -> tuple[float, float]:
        for one in followed:
            if isinstance(one, bool) or not isinstance(one, int | float) or not one > 0:
                raise ValueError(
                    f"this draw follows {self.follows}, but {self.follows} can be {one!r}; "
                    f"keep {self.follows} above 0"
                )
        ends = [self._value_at(z, one) for z in (-MAX_SIGMAS, MAX_SIGMAS) for one in followed]
        return limits.nearest(min(ends)), limits.nearest(max(ends))

    def number(self, uniform: float, limits: Limits, followed: Any) -> float:
        return self._value_at(_normal(uniform), followed)


DISTRIBUTIONS: dict[str, type[Draw]] = {
    "choice": Choice,
    "uniform": Uniform,
    "drift": Drift,
    "log_uniform": LogUniform,
    "normal": Normal,
    "same_as": SameAs,
    "log_normal_of": LogNormalOf,
}


def parse_draw(key: str, table: Mapping[str, Any]) -> Draw:
    """Return the draw of a table such as ``{"uniform": [1, 2]}``.

    >>> parse_draw("iso", {"choice": [100, 400]})
    Choice(choice=[100, 400])

    Raises:
        KeyedError: the table is no draw. The message begins with ``key``, the name of the value.
    """
    names = [distribution for distribution in DISTRIBUTIONS if distribution in table]
    if len(names) != 1:
        problem = unknown_name("draw", next((str(k) for k in table), ""), DISTRIBUTIONS)
        if names:
            problem = f"a draw has one distribution, but these are {' and '.join(names)}; use one"
        raise setting_error(f"{key}: found {dict(table)!r}: {problem}")
    distribution = DISTRIBUTIONS[names[0]]
    try:
        return distribution.model_validate(dict(table))
    except ValidationError as error:
        fault = first_fault(error)
        field = str(fault.path[0]) if fault.path else names[0]
        reason = fault.text
        if fault.problem == "unknown":
            reason = unknown_name(f"key of {names[0]}", field, distribution.model_fields)
        elif fault.problem == "missing":
            reason = f"the draw {names[0]} needs this key; add it"
        raise setting_error(f"{key}: {field}: {reason}") from None


def _exp(log: float) -> float:
    return math.exp(min(log, 709.0))


def _normal(uniform: float) -> float:
    """Return the standard normal for a uniform number, by inverse CDF (Wichura 1988, AS241)."""
    return NormalDist().inv_cdf(uniform)
