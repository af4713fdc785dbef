"""Image kinds, and passes: functions of a kernel file that the planner arranges."""

from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum
from typing import Any

import numpy as np

from clpipe.base.tracing import call, value_of
from clpipe.base.types import Array
from clpipe.reference.resample import Axis, Resampler


class Kind(Enum):
    """A kind of image: the meaning of its samples, its OpenCL type, its planes."""

    RGB = ("rgb", "rgb", ("R", "G", "B"))  # linear, 1 = sensor full scale at EV 0
    MOSAIC = ("mosaic", "vf", ("Y",))  # signal: 0 = black level, 1 = white level
    RAW = ("raw", "vf", ("Y",))  # mosaic in DN
    DISPLAY = ("display", "rgb", ("R", "G", "B"))  # for a screen, 0..1
    YCBCR = ("ycbcr", "ycbcr", ("Y", "Cb", "Cr"))  # inside a stage only
    PAIR = ("pair", "pair", ("first", "second"))  # any two planes, inside a stage only

    def __init__(self, label: str, c_type: str, channels: tuple[str, ...]) -> None:
        self.label = label
        self.c_type = c_type
        self.channels = channels

    @property
    def c_name(self) -> str:
        """The name in functions of the kernel library, for example ``tap_mosaic``."""
        return "mosaic" if self.c_type == "vf" else self.c_type


class NoiseScope(Enum):
    """The scope of a draw of noise, which is a part of the random key."""

    IMAGE = "image"  # each image has its own
    CAMERA = "camera"  # fixed pattern: the same in all images of a camera


@dataclass(frozen=True)
class Pointwise:
    """Computes a pixel from the pixel at the same position.

    Args:
        inline_at_taps: whether a later stencil may recompute it at each of its taps if that costs
            less than storing the image.
        inverse_of: for the first pass of a stage, the function that it inverts, bit for bit. If
            that function is the last pass of the previous stage, with arguments of the same values,
            both are omitted.
    """

    inline_at_taps: bool = False
    inverse_of: str = ""


@dataclass(frozen=True)
class TableLookup:
    """Maps each channel of a pixel through the argument "table"."""


@dataclass(frozen=True)
class Stencil:
    """Computes a pixel from its neighbours.

    Args:
        radius: largest distance of the neighbours, in rows and in columns.
        vectors_per_row: 0 if the function returns its pixel. Otherwise, it fills an array, its last
            argument, with 4 rows of COLUMNS vectors. COLUMNS is this number, or 1 on a single lane.
    """

    radius: int
    vectors_per_row: int = 0


@dataclass(frozen=True)
class Bands:
    """Computes a pixel from all bands of a spectral source. Only a chain's first pass can.

    The kernel file defines the function for each layout of the source, with these suffixes: _float
    (interleaved), _float_planes and _half_planes.

    Args:
        count: the number of bands.
    """

    count: int


@dataclass(frozen=True)
class Resample:
    """Computes a pixel of a resized or warped image from pixels of the image.

    Args:
        resampler: the mapping between the two images.
        radius: distance from the mapped positions up to which the function reads.
    """

    resampler: Resampler
    radius: int = 0


@dataclass(frozen=True)
class LineTable:
    """Makes a table, named by ``writes``, with a value for each row or column, without an image."""

    axis: Axis


@dataclass(frozen=True)
class Reduction:
    """Sums over the whole image, or its histogram, and a few numbers estimated from them.

    Args:
        finish: the function that computes the estimates.
        estimates: names of the estimated numbers, at most four; passes after it may take them.
        finish_arguments: arguments of that function, like ``arguments`` of :class:`Pass`.
        bins: of the histogram; 0 for sums.
    """

    finish: str
    estimates: tuple[str, ...]
    finish_arguments: tuple[str, ...] = ()
    bins: int = 0


Access = Pointwise | TableLookup | Stencil | Bands | Resample | LineTable | Reduction


# What a stage with state calls its result for the frame before, see :class:`Pass`.
PREVIOUS = "previous"


@dataclass(frozen=True)
class Pass:
    """One function of a method's kernel file, and how the planner may use it.

    Args:
        function: its name.
        access: how it accesses pixels.
        arguments: those after the pixel, in order. Their names are from :meth:`Method.arguments`,
            the estimates of an earlier :class:`Reduction`, or the table of an earlier
            :class:`LineTable`.
        reads: images of the stage: "src" is its input, "previous" its result for the frame before,
            any other name an image between its passes. A stage without a frame before does nothing.
        writes: another such name, or "dst", the stage's output.
        kind: kind of the image it writes; None is the kind that the stage writes.
        random: scope of the noise, for a function whose first argument is a random stream.
    """

    function: str
    access: Access = Pointwise()
    arguments: tuple[str, ...] = ()
    reads: tuple[str, ...] = ("src",)
    writes: str = "dst"
    kind: Kind | None = None
    random: NoiseScope | None = None

    @property
    def functions(self) -> tuple[str, ...]:
        """All functions of the kernel file that it names."""
        return self.function, *([self.access.finish] if isinstance(self.access, Reduction) else [])

    @property
    def all_arguments(self) -> tuple[str, ...]:
        """The arguments of all its functions."""
        further = self.access.finish_arguments if isinstance(self.access, Reduction) else ()
        return *self.arguments, *further

    @property
    def provides(self) -> tuple[str, ...]:
        """The arguments that it provides for later passes: its estimates, and its table."""
        estimates = self.access.estimates if isinstance(self.access, Reduction) else ()
        return *estimates, self.writes


@dataclass(frozen=True)
class CompileTime:
    """An argument that is compiled in, as OpenCL text."""

    text: str


Argument = np.float32 | np.uint32 | np.int32 | Array | CompileTime
# Arguments by name. None is a parameter that is not resolved yet.
Arguments = Mapping[str, Argument | float | None]
# What kernels take for the numbers of Python.
KERNEL_TYPES: dict[type, Any] = {float: np.float32, np.float64: np.float32, int: np.int32}


def typed_arguments(arguments: Arguments) -> dict[str, Any]:
    """Return kernel arguments in the types that kernels take.

    >>> typed_arguments({"gain": 0.5, "size": 7, "count": np.uint32(3)})
    {'gain': np.float32(0.5), 'size': np.int32(7), 'count': np.uint32(3)}
    """
    typed: dict[str, Any] = {}
    for name, value in arguments.items():
        if value is not None:
            kernel_type = KERNEL_TYPES.get(type(value_of(value)))
            typed[name] = call(kernel_type, value) if kernel_type else value
    return typed


def bytes_of(argument: Argument) -> bytes:
    """Return an argument's value in a form that can be compared.

    >>> bytes_of(np.float32(1)) == bytes_of(np.float32(1.0)), bytes_of(CompileTime("1u"))
    (True, b'1u')
    """
    return argument.text.encode() if isinstance(argument, CompileTime) else argument.tobytes()
