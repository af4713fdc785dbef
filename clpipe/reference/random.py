"""Philox4x32-10 and inverse-CDF normals, bit for bit as ``kernels/lib/random.h`` has them."""

import zlib
from dataclasses import dataclass
from hashlib import blake2b

import numpy as np
from numpy.typing import NDArray

from clpipe.types import Floats

Words = NDArray[np.uint32]

# Lowest power first.
LOG_COEFFICIENTS = np.array(
    [1.0000032, -0.50001967, 0.33303297, -0.24881342, 0.20604694, -0.18901953, 0.118273675],
    np.float32,
)
NORMAL_COEFFICIENTS = np.array(
    [
        2.9601128,
        1.3548409,
        0.09441337,
        -0.076602094,
        0.028542647,
        0.0062090177,
        -0.0069498117,
        -0.00031167656,
        0.0008937495,
        1.8514459e-06,
        -4.68934e-05,
    ],
    np.float32,
)


@dataclass(frozen=True)
class Stream:
    """Where the random numbers of one stage come from: a key, and the stage's own number."""

    key0: int
    key1: int
    stage: int


def stream_of(owner: str, stage: str) -> Stream:
    """The stream of a stage's noise for its owner.

    ``owner`` names what the noise belongs to (seed and image key, or the camera id); the key is
    its 64-bit BLAKE2b hash. ``stage`` is the stage's name in the chain.
    """
    digest = blake2b(owner.encode(), digest_size=8).digest()
    low, high = digest[:4], digest[4:]
    return Stream(
        int.from_bytes(low, "little"), int.from_bytes(high, "little"), zlib.crc32(stage.encode())
    )


def philox(c0: Words, c1: Words, c2: Words, c3: Words, stream: Stream) -> tuple[Words, ...]:
    """Philox4x32-10 (Salmon et al., SC 2011) of four broadcastable counters; four words.

    >>> zero = np.zeros(1, np.uint32)
    >>> [hex(int(w[0])) for w in philox(zero, zero, zero, zero, Stream(0, 0, 0))]
    ['0x6627e8d5', '0xe169c58d', '0xbc57ac4c', '0x9b00dbd8']
    """
    mask, half = np.uint64(0xFFFFFFFF), np.uint64(32)
    w0, w1, w2, w3 = (c.astype(np.uint64) for c in np.broadcast_arrays(c0, c1, c2, c3))
    key0, key1 = stream.key0, stream.key1
    for _ in range(10):
        product0 = w0 * np.uint64(0xD2511F53)
        product1 = w2 * np.uint64(0xCD9E8D57)
        w0, w1 = (product1 >> half) ^ w1 ^ np.uint64(key0), product1 & mask
        w2, w3 = (product0 >> half) ^ w3 ^ np.uint64(key1), product0 & mask
        key0, key1 = (key0 + 0x9E3779B9) & 0xFFFFFFFF, (key1 + 0xBB67AE85) & 0xFFFFFFFF
    return tuple(w.astype(np.uint32) for w in (w0, w1, w2, w3))


def negative_log(t: Floats) -> Floats:
    """-ln(t), t > 0, float32, relative error 3e-7, by multiplication and addition alone."""
    bits = t.view(np.int32)
    exponent = (bits - np.int32(0x3F3504F3)) >> np.int32(23)
    y = (bits - (exponent << np.int32(23))).view(np.float32) - np.float32(1)
    return exponent.astype(np.float32) * np.float32(-0.6931472) - y * estrin(LOG_COEFFICIENTS, y)


def square_root(x: Floats) -> Floats:
    """sqrt(x), x >= 0, float32, relative error 5e-6, by two Newton steps (Lomont 2003).

    >>> square_root(np.float32([0, 1, 4])).round(4).tolist()
    [0.0, 1.0, 2.0]
    """
    half_x = x * np.float32(0.5)
    r = (np.int32(0x5F375A86) - (x.view(np.int32) >> np.int32(1))).view(np.float32)
    for _ in range(2):
        r = r * (np.float32(1.5) - half_x * r * r)
    return x * r


def estrin(coefficients: Floats, x: Floats) -> Floats:
    """The polynomial with these coefficients, lowest power first, in float32, pair by pair.

    Estrin's scheme: pairs, then pairs of pairs, then sums of these from the lowest up.

    >>> estrin(np.float32([1, 2, 3, 4, 5]), np.float32([2])).tolist()
    [129.0]
    """
    x2 = x * x
    x4 = x2 * x2
    total = np.zeros_like(x)
    power = np.ones_like(x)
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


def normal_of(words: Words) -> Floats:
    """Standard normals from 32-bit words by inverse CDF, out to 6.2 sigma, relative error 4e-5.

    >>> normal_of(np.uint32([0x7fffffff, 0x14514514, 0x94514514])).round(3).tolist()
    [0.0, 1.409000039100647, -1.409000039100647]
    """
    bits = words.view(np.int32)
    p = ((bits & np.int32(0x7FFFFFFF)).astype(np.float32) + np.float32(0.5)) * np.float32(
        2.3283064e-10
    )
    w = negative_log(np.float32(4) * p * (np.float32(1) - p))
    s = square_root(np.maximum(w, np.float32(0))) - np.float32(2.25)
    z = estrin(NORMAL_COEFFICIENTS, s) * (np.float32(1) - np.float32(2) * p)
    return (z.view(np.int32) ^ (bits & np.int32(-0x80000000))).view(np.float32)


def normal_at(shape: tuple[int, ...], draw: int, stream: Stream) -> Floats:
    """One standard normal a pixel: counter (x, y // 4, draw, stage), word y % 4."""
    height, width = shape[:2]
    quarter = np.arange((height + 3) // 4, dtype=np.uint32)[:, None]
    words = philox(
        np.arange(width, dtype=np.uint32)[None, :],
        quarter,
        np.full((1, 1), draw, np.uint32),
        np.full((1, 1), stream.stage, np.uint32),
        stream,
    )
    return normal_of(np.stack(words, axis=1).reshape(-1, width)[:height])


def normal_of_line(count: int, stream: Stream) -> Floats:
    """One standard normal for each of the first ``count`` rows or columns."""
    zero = np.zeros(1, np.uint32)
    stage = np.full(1, stream.stage, np.uint32)
    return normal_of(philox(np.arange(count, dtype=np.uint32), zero, zero, stage, stream)[0])
