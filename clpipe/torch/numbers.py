"""Random numbers on tensors, bit for bit equal to :mod:`clpipe.reference`.

Functions of single numbers, such as normals of random words, are those of the reference: they run
on tensors that have NumPy's interface. PyTorch cannot multiply unsigned 32-bit words, so Philox's
words are stored in ``int64``, where a product keeps its low 64 bits. Images are (sample, height,
width), and each sample has its own key. Apart from :func:`square_root` and :func:`inverse_root`,
functions have no derivatives.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, TypeAlias

import numpy as np
import torch
from numpy.lib.mixins import NDArrayOperatorsMixin
from torch import Tensor

from clpipe.reference import math, random
from clpipe.reference.poisson import LARGE, poisson_large, poisson_small

WORD = 0xFFFFFFFF

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


# NumPy's types and functions whose names differ in PyTorch.
TYPES: dict[Any, Any] = {np.float32: torch.float32, np.int32: torch.int32}
FUNCTIONS = {"left_shift": torch.bitwise_left_shift, "right_shift": torch.bitwise_right_shift}


class Array(NDArrayOperatorsMixin):
    """A tensor with NumPy's interface, as far as :mod:`clpipe.reference` uses it.

    >>> (np.float32(0.5) * Array(torch.tensor([2.0, -4.0]))).tensor
    tensor([ 1., -2.])
    """

    def __init__(self, tensor: Tensor) -> None:
        self.tensor = tensor

    def __array_ufunc__(self, function: np.ufunc, method: str, *inputs: Any) -> "Array":
        return self._call(function, inputs)

    def __array_function__(
        self, function: Callable[..., Any], types: Any, inputs: Any, keywords: Mapping[str, Any]
    ) -> "Array":
        return self._call(function, inputs)

    def _call(self, function: Callable[..., Any], inputs: Any) -> "Array":
        tensors = [x.tensor if isinstance(x, Array) else _constant(x) for x in inputs]
        name = function.__name__
        found = FUNCTIONS[name] if name in FUNCTIONS else getattr(torch, name)
        return Array(found(*tensors))

    def view(self, type_: type) -> "Array":
        """Return the same bits as another type."""
        return Array(self.tensor.view(TYPES[type_]))

    def astype(self, type_: type) -> "Array":
        """Return the same numbers as another type."""
        return Array(self.tensor.to(TYPES[type_]))


@lru_cache(maxsize=256, typed=True)
def _constant(value: Any) -> Tensor:
    return torch.as_tensor(value)


def on_tensors(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return a function of NumPy arrays as a function of tensors, without a derivative.

    >>> on_tensors(math.square_root)(torch.tensor([4.0, 9.0])).round(decimals=4)
    tensor([2., 3.])
    """

    def on(*tensors: Tensor) -> Any:
        result = function(*map(Array, tensors))
        return tuple(x.tensor for x in result) if isinstance(result, tuple) else result.tensor

    return on


raw_inverse_root = on_tensors(math.inverse_root)
normal_of = on_tensors(random.normal_of)
normals_of = on_tensors(random.normals_of)
large_poisson = on_tensors(poisson_large)
small_poisson = on_tensors(poisson_small)


def poisson_of(mean: Tensor, words: Tensor) -> Tensor:
    """The counterpart of :func:`clpipe.reference.poisson.poisson_of`."""
    result: Tensor = large_poisson(mean.clamp(min=float(LARGE)), words)
    small = mean < float(LARGE)
    # Use the sum only for small means, because it takes most of the time.
    result[small] = small_poisson(mean[small], words[small])
    return result


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
