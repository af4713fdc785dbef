"""Short polynomials for log, exp and roots, bit for bit equal to ``kernels/lib/math.h``.

They use only multiplication, addition and operations on bits, which round equally on every device.
The coefficients are our own least-squares minimax fits. ``tests/test_noise.py`` checks the errors
that are stated here.
"""

import numpy as np

from clpipe.base.types import Floats

# Coefficients of ln(1 + y) / y for 1 + y in [sqrt(1/2), sqrt(2)), and of (2^f - 1) / f for f in
# [-1/2, 1/2]; lowest power first.
LOG_COEFFICIENTS = np.array(
    [1.0000032, -0.50001967, 0.33303297, -0.24881342, 0.20604694, -0.18901953, 0.118273675],
    np.float32,
)
POWER_COEFFICIENTS = np.array(
    [0.69314719, 0.24022651, 0.055503571, 0.0096180567, 0.0013390867, 0.00015461448], np.float32
)


def negative_log(t: Floats) -> Floats:
    """Return -ln(t) for t > 0, float32; error 4e-7, relative if |ln(t)| > 1, else absolute."""
    bits = t.view(np.int32)
    exponent = (bits - np.int32(0x3F3504F3)) >> np.int32(23)
    y = (bits - (exponent << np.int32(23))).view(np.float32) - np.float32(1)
    return exponent.astype(np.float32) * np.float32(-0.6931472) - y * estrin(LOG_COEFFICIENTS, y)


def square_root(x: Floats) -> Floats:
    """Return sqrt(x) for x >= 0, float32, relative error 5e-6.

    >>> square_root(np.float32([0, 1, 4])).round(4).tolist()
    [0.0, 1.0, 2.0]
    """
    return x * inverse_root(x)


def inverse_root(x: Floats) -> Floats:
    """Return 1/sqrt(x) for x > 0, float32, relative error 5e-6.

    It takes two Newton steps from an estimate on the float's bits (Lomont, "Fast inverse square
    root", 2003).
    """
    half_x = x * np.float32(0.5)
    r = (np.int32(0x5F375A86) - (x.view(np.int32) >> np.int32(1))).view(np.float32)
    for _ in range(2):
        r = r * (np.float32(1.5) - half_x * r * r)
    return r


def power_of_two(x: Floats) -> tuple[Floats, Floats]:
    """Return (s, e) with 2^x = s * (1 + e), for |x| < 126.

    s is an integer power of two; e keeps its relative accuracy near x = 0, where it is small.
    """
    whole = (x + np.float32(12582912)) - np.float32(12582912)
    f = x - whole
    s = ((whole.astype(np.int32) + np.int32(127)) << np.int32(23)).view(np.float32)
    return s, f * estrin(POWER_COEFFICIENTS, f)


def exponential(x: Floats) -> Floats:
    """Return e^x for |x| < 87, float32, relative error 1e-6 for |x| < 20, otherwise 4e-6.

    >>> exponential(np.float32([-2.3025851, 0, 1])).round(4).tolist()
    [0.10000000149011612, 1.0, 2.7183001041412354]
    """
    s, e = power_of_two(x * np.float32(1.442695))
    return s + s * e


def exponential_minus_1(x: Floats) -> Floats:
    """Return e^x - 1 for |x| < 87, float32; relative error of :func:`exponential`, also near 0.

    >>> exponential_minus_1(np.float32([1e-6, 1])).tolist()
    [1.0000005659094313e-06, 1.7182817459106445]
    """
    s, e = power_of_two(x * np.float32(1.442695))
    return s * e + (s - np.float32(1))


def estrin(coefficients: Floats, x: Floats) -> Floats:
    """Return the value at x of a polynomial, float32; coefficients from the lowest power up.

    Estrin's scheme, in the kernels' order: pairs, then pairs of pairs, then their sum from the
    lowest power up.

    >>> estrin(np.float32([1, 2, 3, 4, 5]), np.float32([2])).tolist()
    [129.0]
    """
    x2 = x * x
    x4 = x2 * x2
    total, power = x, x
    for i in range(0, len(coefficients), 4):
        c = coefficients[i : i + 4]
        group = x * c[1] + c[0] if len(c) > 1 else np.full_like(x, c[0])
        if len(c) == 3:
            group = group + x2 * c[2]
        elif len(c) == 4:
            group = group + (x * c[3] + c[2]) * x2
        total = group if i == 0 else total + group * power
        power = x4 if i == 0 else power * x4
    return total
