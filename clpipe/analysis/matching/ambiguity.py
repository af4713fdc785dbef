"""Finds parameters of a match that are poorly constrained, singly or in pairs.

Near the best match, residuals are about linear in the logarithms of its numbers. Residuals are in
units of their error and floor. The covariance of the numbers is the inverse of J'J, where J is
the Jacobian (Gauss and Newton; Seber and Wild, Nonlinear Regression, 1989, ch. 5).
"""

import itertools
import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from clpipe.analysis.matching.search import Candidate, Search, with_numbers
from clpipe.analysis.matching.space import Dimension
from clpipe.base.types import Doubles

NEAR = 0.1  # step of a logarithm to either side, to compute differences of residuals
TWICE = math.log(2)
CORRELATED = 0.95  # two numbers with a larger correlation cannot be distinguished
RIDGE = 1e-6  # makes the matrix invertible if two numbers have the same effect


@dataclass(frozen=True)
class Ambiguity:
    """A number that no residual constrains, or two that compensate each other.

    ``correlation`` is between the errors of two numbers; None for one number.
    """

    names: tuple[str, ...]
    correlation: float | None = None

    def __str__(self) -> str:
        if self.correlation is None:
            return (
                f"{self.names[0]} is poorly constrained: a factor of 2 changes no residual "
                "significantly"
            )
        return (
            f"{' and '.join(self.names)} cannot be distinguished: the correlation of their errors "
            f"is {self.correlation:+.2f}, so other values of both fit about as well"
        )


def ambiguities(search: Search, found: Candidate) -> tuple[Ambiguity, ...]:
    """Return the numbers that the search's pictures constrain poorly.

    Raises:
        StoppedError: the search's watch stopped it.
    """
    slopes = {
        dimension.name: slope(search, found, dimension)
        for dimension in search.dimensions(found.settings)
    }
    return ambiguous(slopes, len(search.targets))


def slope(search: Search, found: Candidate, dimension: Dimension) -> Doubles:
    """Return the change of residuals per logarithm of a number, from differences near the best."""
    best = found.numbers[dimension.name]
    values = [dimension.value(dimension.share(best * math.exp(step))) for step in (-NEAR, NEAR)]
    before, after = (
        search.residuals(with_numbers(found.settings, {dimension.name: value}), search.targets)
        for value in values
    )
    return np.asarray((after - before) / math.log(values[1] / values[0]))


def ambiguous(slopes: Mapping[str, Doubles], scenes: int = 1) -> tuple[Ambiguity, ...]:
    """Return the numbers that a Jacobian of residuals constrains poorly.

    Args:
        slopes: changes of residuals per logarithm of each number. A residual of 1 is its noise.
        scenes: the number of scenes; residuals are divided by its root.

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
