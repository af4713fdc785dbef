"""The backend of :class:`clpipe.stage.SignalMethod` for PyTorch: a batch of samples at a time.

Its functions perform the same operations as NumPy's, in the same order, so results are bit for bit
equal. Patterns that are fixed to a sensor come from NumPy, once per camera and size.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import torch
from torch import Tensor

from clpipe.base.types import Floats
from clpipe.chain.chain import Step
from clpipe.reference.filter_array import periodic_indices
from clpipe.reference.random import Stream, in_upper_half
from clpipe.reference.tukey_lambda import tukey_lambda_of
from clpipe.stage.signal import Backend, ExtraArguments, no_arguments
from clpipe.torch import numbers
from clpipe.torch.numbers import Streams

MAX_CACHED_MAPS = 256  # cached sensor maps, each a few MB at most


class PoissonNumbers(torch.autograd.Function):
    """Poisson numbers, with the derivative of their mean."""

    @staticmethod
    def forward(ctx: Any, mean: Tensor, words: Tensor) -> Tensor:
        return numbers.poisson_of(mean, words)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None]:
        return gradients[0], None


class StraightThroughRound(torch.autograd.Function):
    """Rounding to whole numbers, ties to even, with a straight-through derivative.

    See Bengio et al., "Estimating or propagating gradients through stochastic neurons", 2013.
    """

    @staticmethod
    def forward(ctx: Any, x: Tensor) -> Tensor:
        return x.round()

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> Tensor:
        return gradients[0]


@dataclass(frozen=True)
class TorchBackend(Backend):
    """The backend of a batch of samples with the same method.

    Args:
        steps: the step of each sample with the method.
        streams: the streams of noise that is new in each sample.
        sensors: the stream of each sample's sensor.
        positions: the row and column of each sample's upper left corner on its sensor.
        area: height and width of the part of a sensor that contains the positions.
        size: height and width of the samples.
    """

    steps: Sequence[Step]
    streams: Streams
    sensors: Sequence[Stream]
    positions: Sequence[tuple[int, int]]
    area: tuple[int, int]
    size: tuple[int, int]

    where = staticmethod(torch.where)
    minimum = staticmethod(torch.minimum)
    square_root = staticmethod(numbers.square_root)
    inverse_root = staticmethod(numbers.inverse_root)
    rounded = staticmethod(StraightThroughRound.apply)
    photons = staticmethod(PoissonNumbers.apply)
    in_upper_half = staticmethod(numbers.on_tensors(in_upper_half))
    tukey_lambda = staticmethod(numbers.on_tensors(tukey_lambda_of))

    def tap(self, image: Tensor, dx: int, dy: int) -> Tensor:
        """The counterpart of :meth:`clpipe.stage.signal.NumpyBackend.tap`."""
        for axis, distance in ((1, dy), (2, dx)):
            if not distance:
                continue
            size, reach = image.shape[axis], abs(distance)
            rows = {
                period: periodic_indices(size, period, reach)[reach + distance :][:size]
                for period in {step.context.filter_array.period[axis - 1] for step in self.steps}
            }
            each = [rows[step.context.filter_array.period[axis - 1]] for step in self.steps]
            indices = torch.from_numpy(np.array(each if len(rows) > 1 else each[:1]))
            shape = (len(indices), size, 1) if axis == 1 else (len(indices), 1, size)
            image = torch.take_along_dim(image, indices.reshape(shape).to(image.device), axis)
        return image

    def normals(self, draw: int = 0) -> Tensor:
        return numbers.normal_at(*self.size, draw, self.streams)

    def words(self, draw: int = 0) -> Tensor:
        return numbers.word_at(*self.size, draw, self.streams)

    def lines(self, count: int) -> Tensor:
        return numbers.normal_of_line(count, self.streams)

    def uniform(self) -> Tensor:
        zero = torch.zeros(1, 1, 1, dtype=torch.int64, device=self._device)
        bits = (numbers.philox(zero, 0, 0, self.streams)[0] >> 1) & 0x7FFFFFFF
        return bits.float() * float(np.float32(4.6566129e-10))

    def rows(self) -> Tensor:
        return torch.arange(self.size[0], dtype=torch.float32, device=self._device)[None, :, None]

    def tiled(self, cell: list[list[Tensor]]) -> Tensor:
        height, width = self.size
        cells = torch.cat([torch.cat(row, 2) for row in cell], 1)
        return cells.repeat(1, (height + 1) // 2, (width + 1) // 2)[:, :height, :width]

    @property
    def _device(self) -> torch.device:
        return self.streams.keys.device

    def fixed(
        self, function: Callable[..., Floats], extra: ExtraArguments = no_arguments
    ) -> Tensor:
        height, width = self.size
        maps = [
            _fixed_map(function, self.area, stream, extra(step.method, step.context), self._device)
            for step, stream in zip(self.steps, self.sensors, strict=True)
        ]
        pairs = list(zip(maps, self.positions, strict=True))
        if all(m is maps[0] for m in maps) and len(set(self.positions)) == 1:
            pairs = pairs[:1]
        rows = [y if len(m) > 1 else 0 for m, (y, _) in pairs]
        return torch.stack(
            [m[y : y + height, x : x + width] for y, (m, (_, x)) in zip(rows, pairs, strict=True)]
        )


@lru_cache(maxsize=MAX_CACHED_MAPS)
def _fixed_map(
    make: Callable[..., Floats],
    area: tuple[int, int],
    stream: Stream,
    arguments: tuple[Any, ...],
    device: torch.device,
) -> Tensor:
    return torch.from_numpy(np.array(make(*area, stream, *arguments), np.float32)).to(device)
