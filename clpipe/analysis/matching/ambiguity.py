"""What a match leaves open: numbers that the columns do not tell, alone or one from another.

Around the best, residuals change about linearly with the logarithms of its numbers. Their Jacobian
J gives the covariance of the numbers, the inverse of J'J, as residuals are in units of their error
and floor (Gauss and Newton's approximation; Seber and Wild, Nonlinear Regression, 1989, ch. 5).
"""

import itertools
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from clpipe.analysis.matching.search import Candidate, Search, with_numbers
from clpipe.analysis.matching.space import Dimension
from clpipe.base.types import Doubles

NEAR = 0.1  # of a logarithm: how far from the best residuals are looked at, on either side
TWICE = math.log(2)
CORRELATED = 0.95  # beyond it, two numbers are not told apart
RIDGE = 1e-6  # so that numbers that do exactly the same have an inverse, too


@dataclass(frozen=True)
class Ambiguity:
    """One number that no residual tells, or two that make up for each other.

    ``correlation`` is that of the errors of the two; None for one.
    """

    names: tuple[str, ...]
    correlation: float | None = None

    def __str__(self) -> str:
        if self.correlation is None:
            return f"{self.names[0]} is not told: a factor of 2 alters no residual beyond its noise"
        return (
            f"{' and '.join(self.names)} cannot be told apart: their errors have a correlation of "
            f"{self.correlation:+.2f}, so other values of both fit about as well"
        )

    def record(self) -> dict[str, Any]:
        """The ambiguity as JSON values."""
        return {"names": list(self.names), "correlation": self.correlation}


def ambiguities(search: Search, found: Candidate) -> tuple[Ambiguity, ...]:
    """What the search's pictures do not tell of the numbers that were found.

    Raises:
        StoppedError: the search's watch asked for it.
    """
    slopes = {
        dimension.name: slope(search, found, dimension)
        for dimension in search.dimensions(found.settings)
    }
    return ambiguous(slopes, len(search.targets))


def slope(search: Search, found: Candidate, dimension: Dimension) -> Doubles:
    """The change of residuals per logarithm of a number, by a difference around the best."""
    best = found.numbers[dimension.name]
    values = [dimension.value(dimension.share(best * math.exp(step))) for step in (-NEAR, NEAR)]
    before, after = (
        search.residuals(with_numbers(found.settings, {dimension.name: value}), search.targets)
        for value in values
    )
    return np.asarray((after - before) / math.log(values[1] / values[0]))


def ambiguous(slopes: Mapping[str, Doubles], scenes: int = 1) -> tuple[Ambiguity, ...]:
    """What a Jacobian of residuals leaves open.

    Args:
        slopes: of the residuals per logarithm of each number; a residual of 1 is its noise.
        scenes: by the root of whose count residuals are divided.

    >>> a, b, c = np.array([[3.0, 0, 0], [0, 2.0, 0], [3.0, 0, 0.3]])
    >>> [each.names for each in ambiguous({"a": a, "b": b, "c": c, "d": a / 9})]
    [('d',), ('a', 'c')]
    """
    unit = TWICE * scenes**0.5
    weak = [name for name, column in slopes.items() if np.abs(column).max() * unit < 1]
    told = [name for name in slopes if name not in weak]
    found = [Ambiguity((name,)) for name in weak]
    if len(told) > 1:
        jacobian = np.stack([slopes[name] / np.linalg.norm(slopes[name]) for name in told], axis=1)
        covariance = np.linalg.inv(jacobian.T @ jacobian + RIDGE * np.eye(len(told)))
        errors = np.sqrt(np.diag(covariance))
        for (i, first), (j, second) in itertools.combinations(enumerate(told), 2):
            correlation = float(covariance[i, j] / (errors[i] * errors[j]))
            if abs(correlation) > CORRELATED:
                found.append(Ambiguity((first, second), correlation))
    return tuple(found)
