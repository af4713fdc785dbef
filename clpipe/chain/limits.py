"""The limits of numbers that a configuration sets or draws."""

import math
from dataclasses import dataclass
from functools import cache

from pydantic import BaseModel

SMALLEST_FLOAT = math.ulp(0.0)  # the smallest number above 0

MAX_VALIDATED = 64  # the most whole numbers of a range that are validated


@dataclass(frozen=True)
class Limits:
    """The range of a number, including both ends; ``whole`` if it must be a whole number."""

    low: float = -math.inf
    high: float = math.inf
    whole: bool = False

    def nearest(self, value: float) -> float:
        """Return the allowed number nearest to a value, to nine digits unless it is a limit.

        >>> Limits(0, 1).nearest(-0.5), Limits().nearest(1 / 3), Limits(whole=True).nearest(2.7)
        (0.0, 0.333333333, 3)
        """
        inside = min(max(value, self.low), self.high)
        rounded = round(inside) if self.whole else float(f"{inside:.9g}")
        return min(max(rounded, self.low), self.high)

    def overlap(self, low: float, high: float) -> tuple[float, float] | None:
        """Return the part of a range that is allowed; None if there is none.

        >>> Limits(100, 6400).overlap(800, 12800), Limits(100, 400).overlap(800, 1600)
        ((800, 6400), None)
        """
        ends = max(low, self.low), min(high, self.high)
        return ends if ends[0] <= ends[1] else None

    def validation_samples(self, low: float, high: float) -> list[float]:
        """Return numbers of a range to validate: its ends, and whole numbers between them.

        >>> Limits().validation_samples(1, 3), Limits(whole=True).validation_samples(1, 3)
        ([1, 3], [1, 2, 3, 3])
        """
        if not (self.whole and float(low).is_integer() and float(high).is_integer()):
            return [low, high]
        return [*range(int(low), int(high) + 1)[:MAX_VALIDATED], int(high)]


@cache
def field_limits(model: type[BaseModel], name: str) -> Limits | None:
    """Return the limits of a field of a model; None if the field holds no number.

    >>> from clpipe.images.encoding import Encoding
    >>> field_limits(Encoding, "jpeg_quality"), field_limits(Encoding, "jpeg_subsampling")
    (Limits(low=1, high=100, whole=True), None)
    """
    schema = model.model_json_schema()["properties"][name]
    for part in schema.get("anyOf", [schema]):
        if part.get("type") in ("number", "integer"):
            above, below = part.get("exclusiveMinimum"), part.get("exclusiveMaximum")
            low = part.get(
                "minimum", -math.inf if above is None else math.nextafter(above, math.inf)
            )
            high = part.get(
                "maximum", math.inf if below is None else math.nextafter(below, -math.inf)
            )
            return Limits(low, high, part["type"] == "integer")
    return None
