"""Poisson numbers by inverse CDF, bit for bit equal to ``kernels/lib/poisson.h``.

After M. Giles, "Algorithm 955: Approximation of the inverse Poisson cumulative distribution
function", ACM TOMS 42(1), 2016.
"""

import numpy as np

from clpipe.base.types import Floats
from clpipe.reference.math import estrin, exponential, inverse_root
from clpipe.reference.random import Words, in_upper_half, normal_of, tail_probability

LARGE = np.float32(10)  # the expansion is used for this mean and above
TERMS = 36  # a Poisson number of mean 10 exceeds this with a probability of 1e-10

# The polynomials of the expansion, lowest power first: our own weighted least-squares fits.
A = np.array(
    [
        0.16666667,
        -0.01394692063331604,
        0.003954051993787289,
        -0.001212189788930118,
        0.00014181389997247607,
        -0.0003447002964094281,
        0.0004576310748234391,
        -0.00013785895134788007,
    ],
    np.float32,
)
B = np.array(
    [
        0.33333334,
        -0.027716415002942085,
        0.007524685002863407,
        -0.002561307279393077,
        -0.00019453179265838116,
    ],
    np.float32,
)
C = np.array([-0.0197614673525095, 0.016855543479323387], np.float32)


def poisson_of(mean: Floats, words: Words) -> Floats:
    """Return a Poisson number per random word, as whole float32; ``mean`` is float32, >= 0.

    Below a mean of 10, the CDF is summed. From 10 on, the quantile is expanded, with an error of
    3e-4 within 3 sigma.

    >>> poisson_of(np.float32([0, 3, 50]), np.uint32([1 << 30] * 3)).tolist()
    [0.0, 4.0, 55.0]
    """
    large = poisson_large(np.maximum(mean, LARGE), words)
    small = poisson_small(np.minimum(mean, LARGE), words)
    return np.where(mean < LARGE, small, large)


def poisson_small(mean: Floats, words: Words) -> Floats:
    """Return Poisson numbers for means up to 10.

    The number is the count of k with a CDF below u. For u above 1/2, it is the count of k with P(X
    >= k) above 1 - u. Both sums begin with their smallest terms, which keeps the tails exact.
    """
    p = tail_probability(words)
    one = np.float32(1)
    terms = [exponential(-mean)]
    cdf, lower = terms[0], np.zeros_like(mean)
    for k in range(1, TERMS + 1):
        terms.append(terms[-1] * (mean * (one / np.float32(k))))
        if k <= 11:
            lower = np.where(cdf < p, lower + one, lower)
            cdf = cdf + terms[-1]
    rest, upper = np.zeros_like(mean), np.zeros_like(mean)
    for term in terms[:0:-1]:
        rest = rest + term
        upper = np.where(rest > p, upper + one, upper)
    return np.where(in_upper_half(words), upper, lower)


def poisson_large(mean: Floats, words: Words) -> Floats:
    """Return Poisson numbers for means from 10 on: the integer part of a continuous quantile.

    The quantile is mean + sqrt(mean) w + w^2 A(s) + B(s) + C(s) / mean, with w the normal quantile
    and s = w / sqrt(mean).
    """
    w = normal_of(words)
    r = inverse_root(mean)
    s = np.maximum(w * r, np.float32(-1.3))
    whole = np.where(mean < np.float32(1 << 22), nearest(mean), mean)
    terms = (w * w) * estrin(A, s) + (estrin(B, s) + estrin(C, s) * (r * r))
    v = ((mean * r) * w + terms) + (mean - whole)
    rounded = nearest(v)
    below = np.where(rounded > v, rounded - np.float32(1), rounded)
    return np.maximum(whole + below, np.float32(0))


def nearest(v: Floats) -> Floats:
    """Return the nearest whole number, ties to even, for |v| < 2^22."""
    magic = np.float32(12582912)
    return (v + magic) - magic
