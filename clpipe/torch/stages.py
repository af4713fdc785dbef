"""The stages between a clean mosaic and the noisy one, on tensors: one function for each method.

Each does what its method's ``reference`` does, with the same operations in the same order, and so
has its bits. What is fixed to a sensor is taken from NumPy, once for each camera and size.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import torch
from torch import Tensor

from clpipe.base.types import Floats
from clpipe.chain.chain import Step
from clpipe.reference import random as of_sensor
from clpipe.reference.image import mirror
from clpipe.reference.math import negative_log
from clpipe.reference.random import Stream
from clpipe.stage import Method
from clpipe.stages import (
    banding,
    black_level_error,
    blooming,
    column_noise,
    crosstalk,
    dark_current,
    dark_shading,
    defect_pixels,
    dsnu,
    normalize,
    prnu,
    quantize,
    random_telegraph,
    row_noise,
)
from clpipe.stages.sensor_noise.gaussian import Gaussian
from clpipe.stages.sensor_noise.no_noise import NoNoise
from clpipe.stages.sensor_noise.poisson import Poisson
from clpipe.stages.sensor_noise.skewed_gaussian import SkewedGaussian
from clpipe.torch import numbers
from clpipe.torch.numbers import Streams, f32, inverse_root, square_root
from clpipe.torch.poisson import poisson_of

MOST_MAPS = 256  # of sensors that are kept, of some MB each at most


@dataclass(frozen=True)
class Group:
    """Samples that have one method, and what it needs beside their mosaics.

    Args:
        steps: of each sample, its step with the method.
        numbers: the kernel's arguments by name, (sample, 1, 1).
        streams: of noise that is new in each sample.
        sensors: of each sample, the stream of what is fixed to its camera.
        places: of each sample, the row and the column of its upper left corner on the sensor.
        area: height and width of the part of a sensor that the places are in.
        size: height and width of the samples.
    """

    steps: Sequence[Step]
    numbers: Mapping[str, Tensor]
    streams: Streams
    sensors: Sequence[Stream]
    places: Sequence[tuple[int, int]]
    area: tuple[int, int]
    size: tuple[int, int]

    def normals(self, draw: int = 0) -> Tensor:
        """Standard normals that are new in each sample."""
        return numbers.normal_at(*self.size, draw, self.streams)

    def words(self, draw: int = 0) -> Tensor:
        """Words that are new in each sample."""
        return numbers.word_at(*self.size, draw, self.streams)

    def fixed(
        self,
        make: Callable[..., Floats],
        own: Callable[[Any], tuple[Any, ...]] = lambda step: (),
    ) -> Tensor:
        """What is fixed to the samples' sensors, (sample or 1, height or 1, width).

        Args:
            make: it, of a height, a width, the camera's stream, and what is ``own``;
                (height or 1, width).
            own: what else a step's depends on.
        """
        on, (height, width) = self.streams.keys.device, self.size
        maps = [
            _map(make, self.area, stream, own(step), on)
            for step, stream in zip(self.steps, self.sensors, strict=True)
        ]
        each = list(zip(maps, self.places, strict=True))
        if all(m is maps[0] for m in maps) and len(set(self.places)) == 1:
            each = each[:1]
        rows = [y if len(m) > 1 else 0 for m, (y, _) in each]
        return torch.stack(
            [m[y : y + height, x : x + width] for y, (m, (_, x)) in zip(rows, each, strict=True)]
        )


@lru_cache(maxsize=MOST_MAPS)
def _map(
    make: Callable[..., Floats],
    area: tuple[int, int],
    stream: Stream,
    own: tuple[Any, ...],
    on: torch.device,
) -> Tensor:
    return torch.from_numpy(np.array(make(*area, stream, *own), np.float32)).to(on)


def _tapped(y: Tensor, dx: int, dy: int) -> Tensor:
    """As :func:`clpipe.reference.image.tap`."""
    if dx:
        columns = mirror(np.arange(y.shape[2]) + dx, y.shape[2])
        y = y[:, :, torch.from_numpy(columns).to(y.device)]
    if dy:
        rows = mirror(np.arange(y.shape[1]) + dy, y.shape[1])
        y = y[:, torch.from_numpy(rows).to(y.device)]
    return y


def _crosstalk(y: Tensor, given: Group) -> Tensor:
    across = _tapped(y, -1, 0) + _tapped(y, 1, 0)
    down = _tapped(y, 0, -1) + _tapped(y, 0, 1)
    return y + ((across + down) - y * 4) * given.numbers["share"]


def _sensor_normals(height: int, width: int, stream: Stream) -> Floats:
    return of_sensor.normal_at((height, width), 0, stream)


def _sensor_bits(height: int, width: int, stream: Stream) -> Any:
    """The upper 31 bits of a sensor's words, int32."""
    return (of_sensor.word_at((height, width), 0, stream) >> np.uint32(1)).view(np.int32)


def _exponential(bits: Any, scale: np.float32) -> Floats:
    """Exponential numbers of mean 1, of words; ``scale`` is 1 over how many words there are."""
    u = (bits.astype(np.float32) + np.float32(0.5)) * scale
    return np.maximum(negative_log(u), np.float32(0))


def _prnu(y: Tensor, given: Group) -> Tensor:
    return y * (given.fixed(_sensor_normals) * given.numbers["sigma"] + 1)


def _dsnu(y: Tensor, given: Group) -> Tensor:
    return y + given.fixed(_sensor_normals) * given.numbers["sigma"]


def _hot(height: int, width: int, stream: Stream, limit: int) -> Floats:
    """The charge of hot pixels over the smallest, 0 elsewhere."""
    bits = _sensor_bits(height, width, stream)
    excess = np.float32(1) + _exponential(bits, np.float32(1 / max(limit, 1)))
    return np.where(bits < limit, excess, np.float32(0))


def _alive(height: int, width: int, stream: Stream, limit: int) -> Floats:
    return (_sensor_bits(height, width, stream) <= limit).astype(np.float32)


def _defect_pixels(y: Tensor, given: Group) -> Tensor:
    hot = given.fixed(_hot, lambda step: step.method.limits()[:1]) * given.numbers["hot_level"]
    alive = given.fixed(_alive, lambda step: step.method.limits()[1:])
    return torch.where(alive > 0, y + hot, 0.0)


def _blooming(y: Tensor, given: Group) -> Tensor:
    full, weight, spill = (given.numbers[name] for name in ("full", "first", "spill"))
    excess = (y - full).clamp(min=0)
    got = torch.zeros_like(y)
    for k in range(1, blooming.REACH + 1):
        got = got + (_tapped(excess, 0, -k) + _tapped(excess, 0, k)) * weight
        weight = weight * spill
    return torch.minimum(torch.minimum(y, full) + got, full)


def _gaussian(y: Tensor, given: Group) -> Tensor:
    n = given.numbers
    variance = (n["a"] * y + n.get("b", 0.0)).clamp(min=0)
    noisy = torch.minimum(y + given.normals() * square_root(variance), n["full_well"])
    return _with_read_noise(noisy, given)


def _skewed_gaussian(y: Tensor, given: Group) -> Tensor:
    n, normals = given.numbers, given.normals()
    a, shot = n["a"], n["a"] * y
    variance = (shot + n.get("b", 0.0)).clamp(min=f32(1e-30))
    inverse = inverse_root(variance)
    skew = shot.clamp(min=0) * inverse * inverse * (a * f32(1 / 6))
    linear = (variance - skew * skew) * inverse
    noisy = torch.minimum(y + ((linear + skew * normals) * normals - skew), n["full_well"])
    return _with_read_noise(noisy, given)


def _with_read_noise(y: Tensor, given: Group) -> Tensor:
    """The signal with Tukey lambda read noise, where that is not part of its Gaussian."""
    return y if "b" in given.numbers else y + _read_noise(given) * given.numbers["read_noise"]


def _read_noise(given: Group) -> Tensor:
    """Read noise of variance 1."""
    n = given.numbers
    if "shape" not in n:
        return given.normals(1)
    words = given.words(1)
    p = numbers.tail_probability(words)
    low, high = (
        numbers.exponential_minus_1(numbers.negative_log(q) * -n["shape"]) for q in (p, 1 - p)
    )
    z = (high - low) * n["scale"]
    return torch.where(words >= 0, z, -z)


class _Photons(torch.autograd.Function):
    """Poisson numbers; their derivative is taken as that of their mean."""

    @staticmethod
    def forward(ctx: Any, mean: Tensor, words: Tensor) -> Tensor:
        return poisson_of(mean, words)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None]:
        return gradients[0], None


def _poisson(y: Tensor, given: Group) -> Tensor:
    n = given.numbers
    electrons: Tensor = _Photons.apply(y.clamp(min=0) * n["chi"], given.words())
    counted = torch.minimum(electrons, n["full_well"])
    return counted * n["a"] + _read_noise(given) * n["read_noise"]


def _full_well(y: Tensor, given: Group) -> Tensor:
    return torch.minimum(y, given.numbers["full_signal"])


def _sensor_charge(height: int, width: int, stream: Stream) -> Floats:
    """Exponential numbers of mean 1, less 1."""
    bits = _sensor_bits(height, width, stream)
    return _exponential(bits, np.float32(4.6566129e-10)) - np.float32(1)


def _dark_current(y: Tensor, given: Group) -> Tensor:
    n = given.numbers
    more = given.fixed(_sensor_charge) * n["spread"]
    shot = square_root((more + n["mean"]).clamp(min=0) * n["per_electron"])
    return y + more + given.normals(1) * shot


def _levels(height: int, width: int, stream: Stream, share: float) -> Floats:
    """The distance of the two levels of telegraph pixels over the mean one's, 0 elsewhere."""
    bits = _sensor_bits(height, width, stream)
    limit = round(share * random_telegraph.WORDS)
    return np.where(bits < limit, _exponential(bits, np.float32(1 / max(limit, 1))), np.float32(0))


def _random_telegraph(y: Tensor, given: Group) -> Tensor:
    step = (
        given.fixed(_levels, lambda step: (step.method.share,)) * given.numbers["amplitude"] * 0.5
    )
    return torch.where(given.words(1) >= 0, y + step, y - step)


def _shading(height: int, width: int, stream: Stream, per_px: np.float32, first: int) -> Floats:
    """The sum of two products of a curve over the rows and one over the columns."""
    down, across, other_down, other_across = (
        dark_shading.curve(width if k % 2 else height, first + k, per_px, stream) for k in range(4)
    )
    return down[:, None] * across + other_down[:, None] * other_across


def _dark_shading(y: Tensor, given: Group) -> Tensor:
    of_iso = given.fixed(_shading, lambda step: (np.float32(1 / step.method.length), 0))
    fixed = given.fixed(_shading, lambda step: (np.float32(1 / step.method.length), 4))
    return y + (of_iso * given.numbers["slope"] + fixed * given.numbers["offset"])


def _measured(
    height: int, width: int, stream: Stream, method: dark_shading.File, iso: float
) -> Floats:
    return method.at_iso(height, width, iso)


def _dark_shading_file(y: Tensor, given: Group) -> Tensor:
    return y + given.fixed(_measured, lambda step: (step.method, step.context.iso))


def _row_noise(y: Tensor, given: Group) -> Tensor:
    offsets = numbers.normal_of_line(given.size[0], given.streams) * given.numbers["sigma"][:, 0]
    return y + offsets[:, :, None]


def _sensor_columns(height: int, width: int, stream: Stream) -> Floats:
    return of_sensor.normal_of_line(width, stream)[None]


def _column_noise(y: Tensor, given: Group) -> Tensor:
    return y + given.fixed(_sensor_columns) * given.numbers["sigma"]


def _banding(y: Tensor, given: Group) -> Tensor:
    n, on = given.numbers, y.device
    zero = torch.zeros(1, 1, 1, dtype=torch.int64, device=on)
    bits = (numbers.philox(zero, 0, 0, given.streams)[0] >> 1) & numbers.LOW
    phase = bits.float() * f32(4.6566129e-10)
    rows = torch.arange(given.size[0], dtype=torch.float32, device=on)[None, :, None]
    turns = rows * n["frequency"] + phase
    whole = 12582912.0
    part = turns - ((turns + whole) - whole)
    z = 0.25 - (part.abs() - 0.25).abs()
    z2 = z * z
    first, *others, last = map(float, banding.SINE)
    total = z2 * first
    for coefficient in others:
        total = (total + coefficient) * z2
    sine = (total + last) * z
    return y + torch.where(part < 0, -sine, sine) * n["amplitude"]


def _black_level_error(y: Tensor, given: Group) -> Tensor:
    n, (height, width) = given.numbers, given.size
    normals = numbers.normal_of_line(4, given.streams) * n["sigma"][:, 0]
    cell = torch.stack(
        [n[f"bias_{c}{r}"][:, 0, 0] + normals[:, r + 2 * c] for r in (0, 1) for c in (0, 1)], 1
    )
    offsets = cell.reshape(-1, 2, 2).repeat(1, (height + 1) // 2, (width + 1) // 2)
    return y + offsets[:, :height, :width]


class _Rounded(torch.autograd.Function):
    """Whole numbers, ties to even; the derivative is that of the number before (straight through:
    Bengio et al., "Estimating or propagating gradients through stochastic neurons", 2013).
    """

    @staticmethod
    def forward(ctx: Any, x: Tensor) -> Tensor:
        return x.round()

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> Tensor:
        return gradients[0]


def _quantize(y: Tensor, given: Group) -> Tensor:
    n = given.numbers
    dn: Tensor = _Rounded.apply(y * n["range"] + n["black_level"])
    return torch.minimum(dn.clamp(min=0), n["white_level"])


def _normalize(y: Tensor, given: Group) -> Tensor:
    return (y - given.numbers["black_level"]) * given.numbers["scale"]


TWINS: Mapping[type[Method], Callable[[Tensor, Group], Tensor]] = {
    crosstalk.Neighbours: _crosstalk,
    prnu.Gaussian: _prnu,
    defect_pixels.Random: _defect_pixels,
    blooming.Column: _blooming,
    SkewedGaussian: _skewed_gaussian,
    Gaussian: _gaussian,
    Poisson: _poisson,
    NoNoise: _full_well,
    dark_current.Thermal: _dark_current,
    random_telegraph.TwoLevels: _random_telegraph,
    dsnu.Gaussian: _dsnu,
    dark_shading.Smooth: _dark_shading,
    dark_shading.File: _dark_shading_file,
    row_noise.Gaussian: _row_noise,
    column_noise.Gaussian: _column_noise,
    banding.Sine: _banding,
    black_level_error.Offsets: _black_level_error,
    quantize.Linear: _quantize,
    normalize.Linear: _normalize,
}
