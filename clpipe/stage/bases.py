"""What several methods have in common: bases to derive from, and a check of window sizes."""

from collections.abc import Mapping
from typing import ClassVar

import numpy as np

from clpipe.base.types import Floats
from clpipe.reference.curve import curve_index
from clpipe.stage.context import Context, ReferenceContext
from clpipe.stage.method import Method, parameter
from clpipe.stage.passes import Argument, Pass, TableLookup


class Unchanged(Method):
    """Leaves the image as it is, at no cost. A subclass gives the method's name."""

    kernel: ClassVar = ""

    def passes(self) -> tuple[Pass, ...]:
        return ()

    def reference(self, image: Floats, given: ReferenceContext) -> Floats:
        return image


class Noiseless(Unchanged):
    """A stage that only adds noise, or only takes it away, where there is none."""

    method: ClassVar = "none"
    summary: ClassVar = "no noise"


class Curve(Method):
    """A curve on each channel. A subclass gives its table, see :mod:`clpipe.reference.curve`."""

    kernel: ClassVar = "curve"

    def table(self) -> Floats:
        """The table; the same object for the same parameters, so that it is uploaded once."""
        raise NotImplementedError(type(self).__name__)

    def passes(self) -> tuple[Pass, ...]:
        return (Pass("curve", TableLookup(), ("table",)),)

    def arguments(self, context: Context) -> Mapping[str, Argument]:
        return {"table": self.table()}

    def reference(self, image: Floats, given: ReferenceContext) -> Floats:
        return np.asarray(self.table()[curve_index(image)])


class GaussianNoise(Method):
    """Gaussian noise of one sigma; at sigma 0 the image stays as it is, at no cost.

    A subclass gives the default of sigma, the passes and the reference; and the variance, if the
    noise is not an offset.
    """

    method: ClassVar = "gaussian"
    example: ClassVar = {"sigma": 0.01}

    sigma: float | None = parameter(
        None,
        "Standard deviation of the offsets.",
        "signal",
        "from the camera and ISO",
        ge=0,
        le=1,
    )

    def draw(self) -> tuple[Pass, ...]:
        """The kernel functions for a sigma above 0."""
        raise NotImplementedError(type(self).__name__)

    def passes(self) -> tuple[Pass, ...]:
        return self.draw() if self.sigma else ()

    def variance(self, before: Floats, signal: Floats, context: Context) -> Floats:
        return before + np.float32(self.sigma) ** 2

    def arguments(self, context: Context) -> Mapping[str, Argument]:
        return {"sigma": np.float32(self.sigma)}


def odd_size(size: int, largest: int) -> int:
    """The width of a window, checked.

    >>> odd_size(5, 15)
    5

    Raises:
        ValueError: it is even, below 1 or above ``largest``.
    """
    if size % 2 == 0 or not 1 <= size <= largest:
        raise ValueError(f"it must be odd, 1 to {largest}")
    return size
