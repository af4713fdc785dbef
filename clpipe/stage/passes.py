"""Image kinds, and passes: functions of a kernel file, as the planner places them."""

from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum
from typing import Any

import numpy as np

from clpipe.base.tracing import float32, value_of
from clpipe.base.types import Array
from clpipe.reference.resample import Axis, Resampler


class Kind(Enum):
    """A kind of image: what its samples mean, its OpenCL type, its planes."""

    RGB = ("rgb", "rgb", ("R", "G", "B"))  # linear, 1 = sensor full scale at EV 0
    MOSAIC = ("mosaic", "vf", ("Y",))  # signal: 0 = black level, 1 = white level
    RAW = ("raw", "vf", ("Y",))  # mosaic in DN
    DISPLAY = ("display", "rgb", ("R", "G", "B"))  # as a screen wants it, 0..1
    YCBCR = ("ycbcr", "ycbcr", ("Y", "Cb", "Cr"))  # inside a stage only
    PAIR = ("pair", "pair", ("first", "second"))  # two planes of anything, inside a stage only

    def __init__(self, label: str, c_type: str, channels: tuple[str, ...]) -> None:
        self.label = label
        self.c_type = c_type
        self.channels = channels

    @property
    def c_name(self) -> str:
        """The name in the kernel library's functions, such as ``tap_mosaic``."""
        return "mosaic" if self.c_type == "vf" else self.c_type


class NoiseScope(Enum):
    """The owner of a draw of noise; the random key is made of it."""

    IMAGE = "image"  # each image has its own
    CAMERA = "camera"  # fixed pattern: the same in all images of a camera


@dataclass(frozen=True)
class Pointwise:
    """Makes a pixel of that pixel.

    Args:
        inline_at_taps: whether a stencil after it may redo it at each of its taps, where that costs
            less than to store the image.
        inverse_of: of the first pass of a stage, the function that it undoes, bit for bit. If that
            is the last pass of the stage before, with arguments of the same values, neither is
            done.
    """

    inline_at_taps: bool = False
    inverse_of: str = ""


@dataclass(frozen=True)
class TableLookup:
    """Takes each channel of a pixel through the argument "table"."""


@dataclass(frozen=True)
class Stencil:
    """Makes a pixel of its neighbours.

    Args:
        radius: how far away the neighbours are at most, in rows and in columns.
        vectors_per_row: 0 where the function returns its pixel. One that does not fills an array,
            its last argument, with 4 rows of COLUMNS vectors: of that many, on one lane of one.
    """

    radius: int
    vectors_per_row: int = 0


@dataclass(frozen=True)
class Resample:
    """Makes a pixel of a smaller or bent image of pixels of the image.

    Args:
        resampler: which pixels are of which.
        radius: how far from these places the function reads.
    """

    resampler: Resampler
    radius: int = 0


@dataclass(frozen=True)
class LineTable:
    """Makes a table, named by ``writes``, with a value for each row or column, from no image."""

    axis: Axis


@dataclass(frozen=True)
class Reduction:
    """Sums over the whole image, or a histogram of it, and a few numbers estimated from that.

    Args:
        finish: the function that computes the estimates.
        estimates: names of the estimated numbers, at most four; passes after it may take them.
        finish_arguments: of that function, as ``arguments`` of :class:`Pass`.
        bins: of the histogram; 0 for sums.
    """

    finish: str
    estimates: tuple[str, ...]
    finish_arguments: tuple[str, ...] = ()
    bins: int = 0


Access = Pointwise | TableLookup | Stencil | Resample | LineTable | Reduction


@dataclass(frozen=True)
class Pass:
    """One function of a method's kernel file, and how the planner may place it.

    Args:
        function: its name.
        access: how it touches pixels.
        arguments: those after the pixel, in order: names from :meth:`Method.arguments`, from the
            estimates of an earlier :class:`Reduction`, or of the table of an earlier
            :class:`LineTable`.
        reads: images of the stage: "src" is its input, any other name an image between its passes.
        writes: another such name, or "dst", the stage's output.
        kind: of what it writes; None is what the stage writes.
        random: what the noise belongs to, for a function whose first argument is a random stream.
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
    def gives(self) -> tuple[str, ...]:
        """Arguments that it makes for later passes: its estimates, and its table."""
        estimates = self.access.estimates if isinstance(self.access, Reduction) else ()
        return *estimates, self.writes


@dataclass(frozen=True)
class CompileTime:
    """An argument that is compiled in, as OpenCL text."""

    text: str


Argument = np.float32 | np.uint32 | np.int32 | Array | CompileTime
# By name. A float becomes a np.float32; None is a parameter that is not resolved yet.
Arguments = Mapping[str, Argument | float | None]


def typed_arguments(arguments: Arguments) -> dict[str, Argument]:
    """Kernel arguments as kernels take them.

    >>> typed_arguments({"gain": 0.5, "count": np.uint32(3)})
    {'gain': np.float32(0.5), 'count': np.uint32(3)}
    """
    typed: dict[str, Any] = {name: v for name, v in arguments.items() if v is not None}
    floats = {name: float32(v) for name, v in typed.items() if isinstance(value_of(v), float)}
    return typed | floats


def bytes_of(argument: Argument) -> bytes:
    """An argument's value, to compare it.

    >>> bytes_of(np.float32(1)) == bytes_of(np.float32(1.0)), bytes_of(CompileTime("1u"))
    (True, b'1u')
    """
    return argument.text.encode() if isinstance(argument, CompileTime) else argument.tobytes()
