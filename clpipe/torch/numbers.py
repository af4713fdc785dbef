"""Random numbers and short polynomials on tensors, bit for bit equal to :mod:`clpipe.reference`.

PyTorch cannot multiply unsigned 32-bit words, so words are stored in ``int64``, where a product
keeps its low 64 bits. Images are (sample, height, width), and each sample has its own key. Apart
from :func:`square_root` and :func:`inverse_root`, the arguments of all functions do not depend on
an image, so they have no derivatives.
"""

from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
import torch
from torch import Tensor

from clpipe.reference.math import LOG_COEFFICIENTS, POWER_COEFFICIENTS
from clpipe.reference.random import COSINE_COEFFICIENTS, NORMAL_COEFFICIENTS, SINE_COEFFICIENTS

WORD = 0xFFFFFFFF
LOW, SIGN = 0x7FFFFFFF, -0x80000000  # the low 31 bits and the sign bit of an int32

Words: TypeAlias = Tensor | int


@dataclass(frozen=True)
class Streams:
    """The counterpart of :class:`clpipe.reference.random.Stream`, for each sample.

    Args:
        keys: (2, sample), int64 from 0 to 2^32 - 1.
        stage: the stage's number.
    """

    keys: Tensor
    stage: int


def f32(value: float | np.float32) -> float:
    """Convert a float32 to a Python number, so that an operation on a tensor does not round it."""
    return float(np.float32(value))


def estrin(coefficients: Any, x: Tensor) -> Tensor:
    """The counterpart of :func:`clpipe.reference.math.estrin`."""
    values = [float(c) for c in coefficients]
    x2 = x * x
    x4 = x2 * x2
    total, power = x, x
    for i in range(0, len(values), 4):
        c = values[i : i + 4]
        group = (x * c[1]).add_(c[0]) if len(c) > 1 else torch.full_like(x, c[0])
        if len(c) == 3:
            group += x2 * c[2]
        elif len(c) == 4:
            group += (x * c[3]).add_(c[2]).mul_(x2)
        total = group if i == 0 else total.add_(group.mul_(power))
        power = x4 if i == 0 else power * x4
    return total


def negative_log(t: Tensor) -> Tensor:
    """The counterpart of :func:`clpipe.reference.math.negative_log`."""
    bits = t.view(torch.int32)
    exponent = (bits - 0x3F3504F3) >> 23
    y = (bits - (exponent << 23)).view(torch.float32).sub_(1)
    polynomial = estrin(LOG_COEFFICIENTS, y)
    return exponent.float().mul_(f32(-0.6931472)).sub_(polynomial.mul_(y))


def exponential_minus_1(x: Tensor) -> Tensor:
    """The counterpart of :func:`clpipe.reference.math.exponential_minus_1`."""
    s, e = _power_of_two(x * f32(1.442695))
    return s * e + (s - 1)


def exponential(x: Tensor) -> Tensor:
    """The counterpart of :func:`clpipe.reference.math.exponential`."""
    s, e = _power_of_two(x * f32(1.442695))
    return s + s * e


def _power_of_two(x: Tensor) -> tuple[Tensor, Tensor]:
    whole = (x + 12582912.0) - 12582912.0
    f = x - whole
    s = ((whole.to(torch.int32) + 127) << 23).view(torch.float32)
    return s, f * estrin(POWER_COEFFICIENTS, f)


def raw_inverse_root(x: Tensor) -> Tensor:
    """The counterpart of :func:`clpipe.reference.math.inverse_root`, without a derivative."""
    half = x * 0.5
    r = (0x5F375A86 - (x.view(torch.int32) >> 1)).view(torch.float32)
    for _ in range(2):
        # The product is (half * r) * r, in the same order as in the reference.
        r = r * (half * r).mul_(r).neg_().add_(1.5)
    return r


class _InverseRoot(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: Tensor) -> Tensor:
        r = raw_inverse_root(x)
        ctx.save_for_backward(r)
        return r

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> Tensor:
        (r,) = ctx.saved_tensors
        return gradient * (r * r * r * -0.5)


def inverse_root(x: Tensor) -> Tensor:
    """The counterpart of :func:`clpipe.reference.math.inverse_root`, with its derivative."""
    result: Tensor = _InverseRoot.apply(x)
    return result


def square_root(x: Tensor) -> Tensor:
    """The counterpart of :func:`clpipe.reference.math.square_root`, with a finite derivative."""
    return x * inverse_root(x)


def _round(word: Words, factor: int, other: Words, key: Tensor) -> tuple[Words, Words]:
    """Return half a round of Philox: the upper and lower word of a product, the upper mixed."""
    product = word * factor
    if isinstance(product, int):
        return (key ^ (product >> 32) ^ other), product & WORD
    low = product & WORD
    if not isinstance(other, int) and other.shape != product.shape:
        return (product >> 32 ^ other ^ key) & WORD, low
    # Operations are in place, because memory bandwidth limits the speed.
    high = product.bitwise_right_shift_(32).bitwise_xor_(other)
    if key.dim() and key.numel() > 1 and len(high) == 1:
        return (high ^ key).bitwise_and_(WORD), low
    return high.bitwise_xor_(key).bitwise_and_(WORD), low


def philox(c0: Words, c1: Words, draw: int, streams: Streams) -> tuple[Tensor, ...]:
    """The counterpart of :func:`clpipe.reference.random.philox`: four words.

    Args:
        c0: the first counter, int64, (1, height, width) or a shape that is broadcast to it.
        c1: the second counter, likewise, or a number.
        draw: the third counter.
        streams: keys and stage; the stage is the last counter.

    Returns:
        int32 of (sample, height, width), with the bits of the words.
    """
    key0, key1 = streams.keys[:, :, None, None]
    w0, w1, w2, w3 = c0, c1, draw, streams.stage  # the words grow to full size in the second round
    for _ in range(10):
        new0, new1 = _round(w2, 0xCD9E8D57, w1, key0)
        new2, new3 = _round(w0, 0xD2511F53, w3, key1)
        w0, w1, w2, w3 = new0, new1, new2, new3
        key0, key1 = (key0 + 0x9E3779B9) & WORD, (key1 + 0xBB67AE85) & WORD
    words = torch.broadcast_tensors(*(torch.as_tensor(w) for w in (w0, w1, w2, w3)))
    return tuple(word.to(torch.int32) for word in words)


def tail_probability(words: Tensor) -> Tensor:
    """The counterpart of :func:`clpipe.reference.random.tail_probability`."""
    return (words & LOW).float().add_(0.5).mul_(f32(2.3283064e-10))


def normal_of(words: Tensor) -> Tensor:
    """The counterpart of :func:`clpipe.reference.random.normal_of`."""
    p = tail_probability(words)
    w = negative_log(p * 4 * (1 - p))
    s = (w := w.clamp_(min=0)) * raw_inverse_root(w) - 2.25
    z = estrin(NORMAL_COEFFICIENTS, s) * (1 - p * 2)
    return (z.view(torch.int32) ^ (words & SIGN)).view(torch.float32)


def normals_of(distance: Tensor, direction: Tensor) -> tuple[Tensor, Tensor]:
    """The counterpart of :func:`clpipe.reference.random.normals_of`."""
    u = (distance & LOW).float().add_(0.5).mul_(f32(4.6566129e-10))
    squared = negative_log(u).clamp_(min=0)
    radius = raw_inverse_root(squared).mul_(squared)
    f = (direction << 2).float().mul_(f32(4.6566129e-10))
    f2 = f * f
    s0, s1, s2 = map(float, SINE_COEFFICIENTS)
    c0, c1, c2 = map(float, COSINE_COEFFICIENTS)
    sine = (f2 * s2).add_(s1).mul_(f2).add_(s0).mul_(f)
    cosine = (f2 * c2).add_(c1).mul_(f2).add_(c0)
    sign = (direction << 1) & SIGN
    signed = cosine.view(torch.int32).bitwise_xor_(sign).view(torch.float32)
    swapped = direction < 0
    first = torch.where(swapped, sine, signed).mul_(radius)
    return first, torch.where(swapped, signed, sine).mul_(radius)


def words_at(height: int, width: int, draw: int, streams: Streams) -> tuple[Tensor, ...]:
    """The counterpart of :func:`clpipe.reference.random.words_at`: (sample, height / 4, width)."""
    device = streams.keys.device
    quarter = torch.arange((height + 3) // 4, device=device)[None, :, None]
    return philox(torch.arange(width, device=device)[None, None], quarter, draw, streams)


def _rows(quarters: tuple[Tensor, ...], height: int) -> Tensor:
    """Interleave four tensors of every fourth row each into one of all rows."""
    stacked = torch.stack(quarters, 2)
    return stacked.reshape(len(stacked), -1, stacked.shape[-1])[:, :height]


def word_at(height: int, width: int, draw: int, streams: Streams) -> Tensor:
    """The counterpart of :func:`clpipe.reference.random.word_at`: (sample, height, width)."""
    return _rows(words_at(height, width, draw, streams), height)


def normal_at(height: int, width: int, draw: int, streams: Streams) -> Tensor:
    """The counterpart of :func:`clpipe.reference.random.normal_at`: (sample, height, width)."""
    word0, word1, word2, word3 = words_at(height, width, draw, streams)
    return _rows((*normals_of(word0, word1), *normals_of(word2, word3)), height)


def normal_of_line(count: int, streams: Streams) -> Tensor:
    """The counterpart of :func:`clpipe.reference.random.normal_of_line`: (sample, count)."""
    indices = torch.arange(count, device=streams.keys.device)[None, None]
    return normal_of(philox(indices, 0, 0, streams)[0])[:, 0]
