"""Counter-based random numbers, bit for bit equal to ``kernels/lib/random.h``.

Words come from Philox4x32-10 (Salmon et al., "Parallel random numbers: as easy as 1, 2, 3", SC
2011), normals from them. A number depends only on the key and on the position of the pixel. It does
not depend on processing order, tiles or device.
"""

import zlib
from dataclasses import dataclass
from functools import lru_cache
from hashlib import blake2b
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from clpipe.base.types import Floats
from clpipe.reference.math import estrin, negative_log, square_root

Words = NDArray[np.uint32]

# Coefficients, lowest power first. Their form is after M. Giles, "Approximating the erfinv
# function", GPU Computing Gems 2011. The fit is our own, and tests/test_noise.py checks its error.
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


# Coefficients of sqrt(2) sin(f pi/4) / f and sqrt(2) cos(f pi/4) in powers of f^2, for f in [-1,
# 1]; our own minimax fits.
SINE_COEFFICIENTS = np.array([1.1107191, -0.11416271, 0.0034451601], np.float32)
COSINE_COEFFICIENTS = np.array([1.4141995, -0.43592441, 0.02173903], np.float32)


@dataclass(frozen=True)
class Stream:
    """The source of one stage's random numbers: a 64-bit key in two words, and its number."""

    key0: int
    key1: int
    stage: int


def stream_of(owner: str, stage: str) -> Stream:
    """Return the stream of one stage's noise.

    Args:
        owner: the scope of the noise (seed and image key, or the camera id); the key is its 64-bit
            BLAKE2b hash.
        stage: the stage's name in the chain; its number is the name's CRC-32.
    """
    return Stream(*_key_of(owner), zlib.crc32(stage.encode()))


@lru_cache(maxsize=64)
def _key_of(owner: str) -> tuple[int, int]:
    digest = blake2b(owner.encode("utf-8", "surrogatepass"), digest_size=8).digest()
    return int.from_bytes(digest[:4], "little"), int.from_bytes(digest[4:], "little")


Counter: TypeAlias = Words | int


def philox(c0: Counter, c1: Counter, c2: Counter, c3: Counter, stream: Stream) -> tuple[Words, ...]:
    """Apply Philox4x32-10 to four counters, which are broadcast against each other; four words.

    >>> [hex(int(w[0])) for w in philox(np.zeros(1, np.uint32), 0, 0, 0, Stream(0, 0, 0))]
    ['0x6627e8d5', '0xe169c58d', '0xbc57ac4c', '0x9b00dbd8']
    """
    w0, w1, w2, w3 = (c.astype(np.uint64) for c in np.broadcast_arrays(c0, c1, c2, c3))
    return tuple(w.astype(np.uint32) for w in philox_rounds(w0, w1, w2, w3, stream))


def philox_rounds(w0: Any, w1: Any, w2: Any, w3: Any, stream: Stream) -> tuple[Any, Any, Any, Any]:
    """Apply it to uint64 arrays or, for a few numbers, to Python integers, which is faster.

    >>> hex(philox_rounds(0, 0, 0, 0, Stream(0, 0, 0))[0])
    '0x6627e8d5'
    """
    key0, key1 = stream.key0, stream.key1
    for _ in range(10):
        product0, product1 = w0 * 0xD2511F53, w2 * 0xCD9E8D57
        w0, w1 = (product1 >> 32) ^ w1 ^ key0, product1 & 0xFFFFFFFF
        w2, w3 = (product0 >> 32) ^ w3 ^ key1, product0 & 0xFFFFFFFF
        key0, key1 = (key0 + 0x9E3779B9) & 0xFFFFFFFF, (key1 + 0xBB67AE85) & 0xFFFFFFFF
    return w0, w1, w2, w3


def tail_probability(words: Words) -> Floats:
    """Return the probability of the nearer tail, in (0, 1/2], from each word's lower 31 bits."""
    low = words.view(np.int32) & np.int32(0x7FFFFFFF)
    return (low.astype(np.float32) + np.float32(0.5)) * np.float32(2.3283064e-10)


def upper_bits(words: Words) -> NDArray[np.int32]:
    """Return the upper 31 bits of words."""
    return (words >> np.uint32(1)).view(np.int32)


def exponential_of(bits: NDArray[np.int32], limit: int = 1 << 31) -> Floats:
    """Return exponential numbers of mean 1 from whole numbers that are uniform below a limit."""
    u = (bits.astype(np.float32) + np.float32(0.5)) * np.float32(1 / max(limit, 1))
    return np.maximum(negative_log(u), np.float32(0))


def in_upper_half(words: Words) -> NDArray[np.bool_]:
    """Return whether the word is in the upper half of the distribution: its top bit is 0."""
    return words.view(np.int32) >= 0


def normal_of(words: Words) -> Floats:
    """Return standard normals from words by inverse CDF: up to 6.3 sigma, relative error 8e-5.

    >>> normal_of(np.uint32([0x7fffffff, 0x14514514, 0x94514514])).round(3).tolist()
    [0.0, 1.409000039100647, -1.409000039100647]
    """
    p = tail_probability(words)
    w = negative_log(np.float32(4) * p * (np.float32(1) - p))
    s = square_root(np.maximum(w, np.float32(0))) - np.float32(2.25)
    z = estrin(NORMAL_COEFFICIENTS, s) * (np.float32(1) - np.float32(2) * p)
    sign = words.view(np.int32) & np.int32(-0x80000000)
    return (z.view(np.int32) ^ sign).view(np.float32)


def normals_of(distance: Words, direction: Words) -> tuple[Floats, Floats]:
    """Return two independent standard normals from two words: up to 6.6 sigma.

    The error is 2e-5 of the radius. The method comes from Box and Muller, "A note on the generation
    of random normal deviates" (1958). The angle is at most an eighth of a turn to either side. The
    top bit of ``direction`` exchanges sine and cosine, and the next one is the cosine's sign.

    >>> one, other = normals_of(np.uint32([0, 0]), np.uint32([0, 0x80000000]))
    >>> [f"{x:.2f}" for x in (*one, *other)]
    ['6.66', '0.00', '0.00', '6.66']
    """
    low = distance.view(np.int32) & np.int32(0x7FFFFFFF)
    u = (low.astype(np.float32) + np.float32(0.5)) * np.float32(4.6566129e-10)
    radius = square_root(np.maximum(negative_log(u), np.float32(0)))
    bits = direction.view(np.int32)
    f = (bits << np.int32(2)).astype(np.float32) * np.float32(4.6566129e-10)
    f2 = f * f
    s0, s1, s2 = SINE_COEFFICIENTS
    c0, c1, c2 = COSINE_COEFFICIENTS
    sine = ((f2 * s2 + s1) * f2 + s0) * f
    cosine = (f2 * c2 + c1) * f2 + c0
    sign = (bits << np.int32(1)) & np.int32(-0x80000000)
    signed = (cosine.view(np.int32) ^ sign).view(np.float32)
    exchanged = bits < 0
    one = np.where(exchanged, sine, signed) * radius
    return one, np.where(exchanged, signed, sine) * radius


def word_at(shape: tuple[int, ...], draw: int, stream: Stream) -> Words:
    """Return one random word for each pixel, (height, width).

    Pixel (x, y) takes word y % 4 of the counter (x, y // 4, draw, stage). ``shape`` begins with
    height and width. ``draw`` numbers the draws of one stage.
    """
    words = words_at(shape, draw, stream)
    return np.stack(words, axis=1).reshape(-1, shape[1])[: shape[0]]


def words_at(shape: tuple[int, ...], draw: int, stream: Stream) -> tuple[Words, ...]:
    """Return the four words of each counter (x, y // 4, draw, stage), each (height / 4, width)."""
    height, width = shape[:2]
    quarter = np.arange((height + 3) // 4, dtype=np.uint32)[:, None]
    return philox(np.arange(width, dtype=np.uint32), quarter, draw, stream.stage, stream)


def normal_at(shape: tuple[int, ...], draw: int, stream: Stream) -> Floats:
    """Return a standard normal for each pixel, (height, width); arguments of :func:`word_at`.

    In each group of four rows, rows 0 and 1 share the counter's first two words, rows 2 and 3 the
    others.
    """
    word0, word1, word2, word3 = words_at(shape, draw, stream)
    pairs = *normals_of(word0, word1), *normals_of(word2, word3)
    return np.stack(pairs, axis=1).reshape(-1, shape[1])[: shape[0]]


def normal_of_line(count: int, stream: Stream) -> Floats:
    """Return a standard normal for each of the first ``count`` rows or columns, (count,)."""
    return normal_of(philox(np.arange(count, dtype=np.uint32), 0, 0, stream.stage, stream)[0])
