"""Poisson numbers on tensors, bit for bit equal to :mod:`clpipe.reference.poisson`."""

import torch
from torch import Tensor

from clpipe.reference.poisson import LARGE, TERMS, A, B, C
from clpipe.torch.numbers import (
    estrin,
    exponential,
    f32,
    normal_of,
    raw_inverse_root,
    tail_probability,
)

CDF_TERMS = 11  # terms of the lower half of the CDF, for a mean of 10


def poisson_of(mean: Tensor, words: Tensor) -> Tensor:
    """The counterpart of :func:`clpipe.reference.poisson.poisson_of`, without a derivative."""
    result = _large(mean.clamp(min=float(LARGE)), words)
    small = mean < float(LARGE)
    # Use the sum only for small means, because it takes most of the time.
    result[small] = _small(mean[small], words[small])
    return result


def _small(mean: Tensor, words: Tensor) -> Tensor:
    p = tail_probability(words)
    terms = [exponential(-mean)]
    cdf, lower = terms[0], torch.zeros_like(mean)
    for k in range(1, TERMS + 1):
        terms.append(terms[-1] * (mean * f32(1 / k)))
        if k <= CDF_TERMS:
            lower = lower + (cdf < p)
            cdf = cdf + terms[-1]
    rest, upper = torch.zeros_like(mean), torch.zeros_like(mean)
    for term in terms[:0:-1]:
        rest = rest + term
        upper = upper + (rest > p)
    return torch.where(words >= 0, upper, lower)


def _large(mean: Tensor, words: Tensor) -> Tensor:
    w, r = normal_of(words), raw_inverse_root(mean)
    s = (w * r).clamp(min=f32(-1.3))
    whole = torch.where(mean < float(1 << 22), _nearest(mean), mean)
    terms = (w * w) * estrin(A, s) + (estrin(B, s) + estrin(C, s) * (r * r))
    v = ((mean * r) * w + terms) + (mean - whole)
    rounded = _nearest(v)
    floor = torch.where(rounded > v, rounded - 1, rounded)
    return (whole + floor).clamp(min=0)


def _nearest(v: Tensor) -> Tensor:
    return (v + 12582912.0) - 12582912.0
