"""Image kinds, and passes: functions of a kernel file, as the planner places them."""

from dataclasses import dataclass
from enum import Enum

import numpy as np

from clpipe.base.types import Array
from clpipe.reference.resample import Resampler


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
        """Its name in the kernel library's functions, such as ``tap_mosaic``."""
        return "mosaic" if self.c_type == "vf" else self.c_type


class Access(Enum):
    """How a pass touches pixels."""

    POINTWISE = "pointwise"  # a pixel from that pixel
    CURVE = "curve"  # pointwise, each channel through the table named "table"
    STENCIL = "stencil"  # a pixel from its neighbours
    RESAMPLE = "resample"  # a pixel of a smaller or bent image from pixels of the image
    LINES = "lines"  # a table with a value a row or column, from no image
    SUMS = "sums"  # sums over the whole image, then a few numbers estimated from them
    HISTOGRAM = "histogram"  # counts over the whole image, then a few numbers estimated from them


class NoiseScope(Enum):
    """What a draw of noise belongs to; the random key is made of it."""

    IMAGE = "image"  # each image has its own
    CAMERA = "camera"  # fixed pattern: the same in all images of a camera


@dataclass(frozen=True)
class Pass:
    """One function of a method's kernel file, and how the planner may place it.

    ``reads`` and ``writes`` name images of the stage: ``src`` is its input, ``dst`` its output, any
    other name an image between its passes. ``arguments`` are the function's arguments after the
    pixel, in order: names from :meth:`Method.arguments`, from the ``estimates`` of an earlier SUMS
    or HISTOGRAM pass, or of the table that an earlier LINES pass writes.

    A function returns its pixel. A STENCIL with a ``block`` instead fills an array, its last
    argument, with 4 rows of COLUMNS vectors: of that many, on one lane of one.

    The first pass of a stage may undo the last one of the stage before, bit for bit: if ``undoes``
    names that one's function and both have arguments of the same values, neither is done.
    """

    function: str
    access: Access = Access.POINTWISE
    arguments: tuple[str, ...] = ()
    reads: tuple[str, ...] = ("src",)
    writes: str = "dst"
    kind: Kind | None = None  # of what it writes; None: what the stage writes
    radius: int = 0
    random: NoiseScope | None = None  # takes a random stream as its first argument
    block: int = 0  # STENCIL: vectors in a row of the block; 0 returns a pixel
    cheap: bool = False  # a stencil after it may redo it at each tap
    undoes: str = ""  # POINTWISE: see above
    lines: str = ""  # LINES: "rows" or "columns"
    finish: str = ""  # SUMS, HISTOGRAM: the function that computes the estimates
    finish_arguments: tuple[str, ...] = ()  # of that function
    estimates: tuple[str, ...] = ()  # SUMS, HISTOGRAM: names of the numbers, at most four
    bins: int = 0  # HISTOGRAM: how many
    resampling: Resampler | None = None  # RESAMPLE: how it is made


@dataclass(frozen=True)
class CompileTime:
    """An argument that is compiled in, as OpenCL text."""

    text: str


Argument = np.float32 | np.uint32 | np.int32 | Array | CompileTime
