"""Methods on the signal of a mosaic, written once for NumPy and for PyTorch.

Such a method overrides :meth:`SignalMethod.apply` instead of ``reference``. NumPy runs it on one
image, as the reference of the kernel. :mod:`clpipe.torch` runs it on a batch.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, TypeAlias

import numpy as np
from numpy.typing import NDArray

from clpipe.base.types import Floats
from clpipe.reference.filter_array import periodic_indices
from clpipe.reference.math import inverse_root, square_root
from clpipe.reference.poisson import poisson_of
from clpipe.reference.random import (
    Stream,
    in_upper_half,
    normal_at,
    normal_of_line,
    philox,
    upper_bits,
    word_at,
)
from clpipe.reference.tukey_lambda import tukey_lambda_of
from clpipe.stage.context import Context, ReferenceContext
from clpipe.stage.method import Method
from clpipe.stage.passes import CompileTime, NoiseScope

# A float32 array (height, width), or a tensor (sample, height, width). Both have the operators + -
# * < and the methods clip and abs.
Signal: TypeAlias = Any
Numbers: TypeAlias = Mapping[str, Any]  # each value is a np.float32, or a tensor (sample, 1, 1)


ExtraArguments: TypeAlias = Callable[[Any, Context], tuple[Any, ...]]


def no_arguments(method: Any, context: Context) -> tuple[Any, ...]:
    """Return no further arguments."""
    return ()


class Backend(ABC):
    """Functions and random numbers that :meth:`SignalMethod.apply` uses besides operators.

    Random numbers are new in each image, except with :meth:`fixed`.
    """

    where: ClassVar[Callable[..., Any]]
    minimum: ClassVar[Callable[..., Any]]
    square_root: ClassVar[Callable[..., Any]]
    inverse_root: ClassVar[Callable[..., Any]]
    rounded: ClassVar[Callable[..., Any]]  # rounds to the nearest whole number, ties to even
    photons: ClassVar[Callable[..., Any]]  # returns Poisson numbers for means and random words
    # Returns noise for random words, a shape and a scale.
    tukey_lambda: ClassVar[Callable[..., Any]]
    in_upper_half: ClassVar[Callable[..., Any]]  # returns whether a word's top bit is 0
    tap: ClassVar[Callable[..., Any]]  # returns the signal's value dx to the right and dy below

    @abstractmethod
    def normals(self, draw: int = 0) -> Signal:
        """Return a standard normal for each pixel."""

    @abstractmethod
    def words(self, draw: int = 0) -> Any:
        """Return a random word of 32 bits for each pixel."""

    @abstractmethod
    def lines(self, count: int) -> Signal:
        """Return ``count`` standard normals, (..., count)."""

    @abstractmethod
    def uniform(self) -> Signal:
        """Return one number from 0 to 1, (..., 1, 1)."""

    @abstractmethod
    def rows(self) -> Signal:
        """Return the numbers of the rows, from 0, (..., height, 1)."""

    @abstractmethod
    def tiled(self, cell: list[list[Signal]]) -> Signal:
        """Repeat a cell of 2x2 numbers, (..., 1, 1) each, over the image."""

    @abstractmethod
    def fixed(
        self, function: Callable[..., Floats], extra: ExtraArguments = no_arguments
    ) -> Signal:
        """Return values that are fixed to a sensor.

        Args:
            function: a NumPy function of the height, the width, the stream of the sensor, and
                ``extra``. Returns (height or 1, width).
            extra: further arguments, from the method and its context.
        """


class SignalMethod(Method):
    """A method on the signal of a mosaic that NumPy and PyTorch share."""

    @classmethod
    def apply(cls, y: Signal, n: Numbers, backend: Backend) -> Signal:
        """Return the signal after this method.

        Use only ``+ - *``, comparisons and ``backend``, which round equally everywhere. Constants
        are Python numbers that float32 represents exactly.

        Args:
            y: the signal before this method.
            n: the numbers among :meth:`arguments`, by name.
            backend: functions and random numbers.
        """
        raise NotImplementedError(cls.__name__)

    @classmethod
    def on_tensors(cls) -> bool:
        """Return whether PyTorch can use :meth:`apply`: a subclass may have its own reference."""
        return cls.reference is SignalMethod.reference

    def reference(self, image: Floats, inputs: ReferenceContext) -> Floats:
        if not self.passes():
            return image
        numbers = scalar_arguments(self.arguments(inputs.context))
        result: Floats = self.apply(image, numbers, NumpyBackend(self, inputs, image.shape))
        return result


def sensor_normals(height: int, width: int, stream: Stream) -> Floats:
    """Return a standard normal for each pixel of a sensor, for :meth:`Backend.fixed`."""
    return normal_at((height, width), 0, stream)


def sensor_bits(height: int, width: int, stream: Stream) -> NDArray[np.int32]:
    """Return a whole number from 0 to 2^31 - 1 for each pixel of a sensor."""
    return upper_bits(word_at((height, width), 0, stream))


def scalar_arguments(arguments: Mapping[str, Any]) -> dict[str, np.float32]:
    """Return the numbers among the arguments of a kernel."""
    return {
        name: np.float32(value)
        for name, value in arguments.items()
        if not isinstance(value, CompileTime | np.ndarray)
    }


@dataclass(frozen=True)
class NumpyBackend(Backend):
    """The backend of one image in NumPy.

    Args:
        method: the (resolved) method.
        inputs: its context and streams.
        size: height and width of the image.
    """

    method: Method
    inputs: ReferenceContext
    size: tuple[int, ...]

    where = staticmethod(np.where)
    minimum = staticmethod(np.minimum)
    square_root = staticmethod(square_root)
    inverse_root = staticmethod(inverse_root)
    rounded = staticmethod(np.rint)
    photons = staticmethod(poisson_of)
    tukey_lambda = staticmethod(tukey_lambda_of)
    in_upper_half = staticmethod(in_upper_half)

    def tap(self, image: Floats, dx: int, dy: int) -> Floats:
        # Borders continue the filter array, as on the device.
        periods, reach = self.inputs.context.filter_array.period, max(abs(dx), abs(dy))
        (rows, height), (columns, width) = zip(periods, image.shape, strict=True)
        down = periodic_indices(height, rows, reach)[reach + dy :][:height]
        across = periodic_indices(width, columns, reach)[reach + dx :][:width]
        shifted: Floats = image[down][:, across]
        return shifted

    @property
    def _stream(self) -> Stream:
        return self.inputs.stream[NoiseScope.IMAGE]

    def normals(self, draw: int = 0) -> Signal:
        return normal_at(self.size, draw, self._stream)

    def words(self, draw: int = 0) -> Any:
        return word_at(self.size, draw, self._stream)

    def lines(self, count: int) -> Signal:
        return normal_of_line(count, self._stream)

    def uniform(self) -> Signal:
        zero = np.zeros((1, 1), np.uint32)
        word, *_ = philox(zero, 0, 0, self._stream.stage, self._stream)
        return upper_bits(word).astype(np.float32) * np.float32(4.6566129e-10)

    def rows(self) -> Signal:
        return np.arange(self.size[0], dtype=np.float32)[:, None]

    def tiled(self, cell: list[list[Signal]]) -> Signal:
        height, width = self.size[:2]
        repeats = (height + 1) // 2, (width + 1) // 2
        return np.tile(np.block(cell), repeats)[:height, :width]

    def fixed(
        self, function: Callable[..., Floats], extra: ExtraArguments = no_arguments
    ) -> Signal:
        height, width = self.size[:2]
        stream = self.inputs.stream.get(NoiseScope.CAMERA)
        return function(height, width, stream, *extra(self.method, self.inputs.context))
