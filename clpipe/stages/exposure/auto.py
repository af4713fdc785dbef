"""Exposure by metering: the gain follows from the luminance of the image."""

from typing import ClassVar, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import model_validator

from clpipe.base.types import Floats, Mask
from clpipe.reference.math import negative_log, power_of_two
from clpipe.stage import (
    Arguments,
    CompileTime,
    Context,
    Pass,
    Reduction,
    ReferenceContext,
    parameter,
)
from clpipe.stages.exposure.gain import Exposing

STEPS = 4096  # steps per factor of two; the base-2 logarithm is stored as an integer
_PER_NEPER = np.float32(-STEPS * 1.4426950408889634)

OCTAVES = 36  # octaves of the histogram, from 2^-18 on; each has 256 bins
BINS = OCTAVES * 256
_LOWEST = np.float32(2.0**-18)
_FIRST = int(_LOWEST.view(np.int32))

# The image's shorter side, divided by the diameter of the metered circle. 0 means no circle.
CIRCLES = {"average": 0, "centre_weighted": 2, "spot": 6}
# Weights of a pixel inside and outside the circle.
WEIGHTS = {"average": (1, 0), "centre_weighted": (20, 1), "spot": (1, 0)}
TARGETS = {"log_average": 0.18, "percentile": 1.0}


def luminance(image: Floats) -> Floats:
    """Return the luminance of linear sRGB (BT.709); (height, width, 3) to (height, width).

    >>> luminance(np.float32([[[1, 1, 1], [0, 1, 0]]])).round(4).tolist()
    [[1.0, 0.7152000069618225]]
    """
    red, green, blue = np.moveaxis(image, -1, 0)
    return np.float32(0.2126) * red + np.float32(0.7152) * green + np.float32(0.0722) * blue


def in_circle(height: int, width: int, share: int) -> Mask:
    """Return the mask of the pixels in the circle around an image's centre, (height, width).

    ``share`` is the shorter side over the circle's diameter, which is at least 2 px. With 0, all
    pixels are inside.

    >>> in_circle(4, 5, 2).astype(int).tolist()
    [[0, 0, 0, 0, 0], [0, 0, 1, 0, 0], [0, 0, 1, 0, 0], [0, 0, 0, 0, 0]]
    """
    dx = (2 * np.arange(width) + 1 - width).astype(np.float32)
    dy = (2 * np.arange(height) + 1 - height).astype(np.float32)[:, None]
    diameter = np.float32(max(min(width, height), 2 * share))
    inside = (dx * dx + dy * dy) * np.float32(share * share) <= diameter * diameter
    return np.asarray(inside)


def steps_of(level: Floats) -> NDArray[np.int64]:
    """Return log2 of levels above 0, in whole steps of 1/4096; int64."""
    return np.rint(negative_log(level) * _PER_NEPER).astype(np.int64)


class Auto(Exposing):
    """A gain that brings the luminance of the image to a target, times 2^(ev - headroom).

    log_average brings ``exp(mean(log(delta + L)))`` to a key of 0.18, like SyB3R (Reinhard et al.,
    SIGGRAPH 2002, eq. 1 and 2). percentile brings a percentile of L to white. Both use integers:
    sums of log2 in steps of 1/4096, or a histogram of 256 bins per octave. The gain is therefore
    the same on every device and in tiles. An image without light does not change.

    With average, metering weights all pixels equally. With spot, it only meters a circle, whose
    diameter is a sixth of the image's shorter side. With centre_weighted, a circle of half the
    shorter side gets three quarters of the weight in a 3:2 image, like 12 mm on 35 mm film.

    >>> from clpipe.stage import run_reference
    >>> grey = np.full((2, 3, 3), 0.045, np.float32)
    >>> run_reference(Auto(headroom=0.0), grey).round(3).max().item()
    0.18000000715255737
    """

    method: ClassVar = "auto"
    kernel: ClassVar = "exposure_auto"
    overscan: ClassVar = False  # the finished image is metered
    summary: ClassVar = "meter the image and scale its luminance to a target"
    example: ClassVar = {"metering": "centre_weighted"}

    rule: Literal["log_average", "percentile"] = parameter(
        "log_average", "How the metered luminance is computed.", structural=True
    )
    target: float | None = parameter(
        None,
        "Level to which the metered luminance is scaled, before ev and headroom.",
        "1 = white",
        "0.18 for log_average, 1 for percentile",
        ge=1e-6,
        le=1e6,
    )
    metering: Literal["average", "centre_weighted", "spot"] = parameter(
        "average", "Metered area of the image."
    )
    percentile: float = parameter(
        99.0,
        "For percentile: share of the pixels that are darker than the metered level.",
        "%",
        gt=0,
        le=100,
    )
    delta: float = parameter(
        1e-4,
        "For log_average: added to each pixel's luminance to limit the effect of black pixels.",
        "1 = white",
        ge=1e-9,
        le=1,
    )
    min_ev: float = parameter(-20.0, "Lowest result of metering, before ev.", "EV", ge=-20, le=20)
    max_ev: float = parameter(20.0, "Highest result of metering, before ev.", "EV", ge=-20, le=20)

    @model_validator(mode="after")
    def _check_order(self) -> Self:
        if self.min_ev > self.max_ev:
            raise ValueError(
                f"max_ev must not be below min_ev; found {self.max_ev:g} and {self.min_ev:g}"
            )
        return self

    def resolve(self, context: Context) -> Self:
        return self.with_defaults(target=TARGETS[self.rule])

    def passes(self) -> tuple[Pass, ...]:
        limits, estimates = ("target", "lowest", "highest", "offset"), ("metered_ev", "gain")
        circle = ("share", "inside", "outside")
        if self.rule == "percentile":
            metering = Pass(
                "metered_bin",
                Reduction(
                    "meter_percentile",
                    estimates,
                    ("inside", "outside", "millionths", *limits),
                    bins=2 * BINS,
                ),
                ("share", "outside"),
            )
        else:
            metering = Pass(
                "metered_log",
                Reduction("meter_log_average", estimates, (*circle, "delta", *limits)),
                ("extent", *circle, "delta"),
            )
        return metering, Pass("exposure", arguments=("gain",))

    def arguments(self, context: Context) -> Arguments:
        assert self.target is not None
        inside, outside = WEIGHTS[self.metering]
        return {
            "extent": CompileTime("e"),
            "share": np.uint32(CIRCLES[self.metering]),
            "inside": np.uint32(inside),
            "outside": np.uint32(outside),
            "delta": self.delta,
            "millionths": np.uint32(self._millionths),
            "target": round(np.log2(self.target) * STEPS),
            "lowest": round(self.min_ev * STEPS),
            "highest": round(self.max_ev * STEPS),
            "offset": self.gain,
        }

    @property
    def _millionths(self) -> int:
        return max(1, round(self.percentile * 10_000))

    def reference(self, image: Floats, inputs: ReferenceContext) -> Floats:
        level = self._percentile(image) if self.rule == "percentile" else self._log_average(image)
        ev = 0
        if level is not None:
            assert self.target is not None
            ev = round(np.log2(self.target) * STEPS) - level
            ev = min(max(ev, round(self.min_ev * STEPS)), round(self.max_ev * STEPS))
        stops = np.array([ev / STEPS], np.float32)
        whole, rest = power_of_two(stops)
        (gain,) = (whole + whole * rest) * np.float32(self.gain)
        inputs.estimates["metered_ev"], inputs.estimates["gain"] = float(stops[0]), float(gain)
        return image * gain

    def _circle(self, image: Floats) -> Mask:
        return in_circle(image.shape[0], image.shape[1], CIRCLES[self.metering])

    def _log_average(self, image: Floats) -> int | None:
        """Return log2 of the image's log-average luminance, in steps; None without light."""
        inside, outside = WEIGHTS[self.metering]
        circle = self._circle(image)
        delta = np.float32(self.delta)
        steps = steps_of(np.maximum(luminance(image), np.float32(0)) + delta)
        weights = np.where(circle, inside, outside)
        total, weight = int((steps * weights).sum()), int(weights.sum())
        black = int(steps_of(np.array([delta]))[0])
        return None if total == black * weight else (2 * total + weight) // (2 * weight)

    def _percentile(self, image: Floats) -> int | None:
        """Return log2 of a percentile of the image's luminance, in steps; None without light."""
        inside, outside = WEIGHTS[self.metering]
        circle = self._circle(image)
        level = np.maximum(luminance(image), _LOWEST)
        bins = np.minimum((level.view(np.int32) - _FIRST) >> 15, BINS - 1)
        counts = [np.bincount(bins[where], minlength=BINS) for where in (circle, ~circle)]
        below = np.cumsum(inside * counts[0] + outside * counts[1])
        rank = -(-int(below[-1]) * self._millionths // 1_000_000)
        bin_ = int(np.argmax(below >= rank))
        middle = np.array([_FIRST + (bin_ << 15) + (1 << 14)], np.int32).view(np.float32)
        return int(steps_of(middle)[0]) if bin_ else None
