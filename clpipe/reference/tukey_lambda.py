"""The symmetric Tukey lambda distribution, like in ``kernels/lib/tukey_lambda.h``.

It models read noise with heavy tails (Wei et al., "A physics-based noise formation model for
extreme low-light raw denoising", CVPR 2020).
"""

from math import gamma

import numpy as np

from clpipe.base.pure import pure
from clpipe.base.types import Floats
from clpipe.reference.math import exponential_minus_1, negative_log
from clpipe.reference.random import Words, in_upper_half, tail_probability

# Replaces smaller lambdas, because 1 / lambda fails at 0 (the logistic distribution).
NEARLY_ZERO = 1e-4


@pure
def shape_and_scale(shape: float) -> tuple[np.float32, np.float32]:
    """Return the kernel's arguments for a shape lambda above -1/2: lambda and 1 / (lambda * sigma).

    The standard deviation of the distribution at scale 1 is sigma. It follows from ``sigma^2 = 2 /
    lambda^2 * (1 / (1 + 2 lambda) - G(lambda + 1)^2 / G(2 lambda + 2))``, with G the gamma function
    (Joiner and Rosenblatt, JASA 66, 1971).

    >>> shape, scale = shape_and_scale(1)  # uniform, of width sqrt(12) at a variance of 1
    >>> round(float(shape * scale * scale), 4)
    3.0
    """
    lam = shape if abs(shape) >= NEARLY_ZERO else NEARLY_ZERO
    spread = 1 / (1 + 2 * lam) - gamma(lam + 1) ** 2 / gamma(2 * lam + 2)
    return np.float32(lam), np.float32(np.sign(lam) / np.sqrt(2 * spread))


def tukey_lambda_of(words: Words, shape: np.float32, scale: np.float32) -> Floats:
    """Return a Tukey lambda number of mean 0 and variance 1 per random word, by inverse CDF.

    ``shape`` and ``scale`` come from :func:`shape_and_scale`.

    >>> words = np.uint32([0x7fffffff, 0x14514514, 0x94514514])
    >>> tukey_lambda_of(words, *shape_and_scale(0.14)).round(2).tolist()
    [0.0, 1.409999966621399, -1.409999966621399]
    """
    p = tail_probability(words)
    low = exponential_minus_1(negative_log(p) * -shape)
    high = exponential_minus_1(negative_log(np.float32(1) - p) * -shape)
    z = (high - low) * scale
    return np.where(in_upper_half(words), z, -z)
