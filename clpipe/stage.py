"""What a stage is: the image kinds it reads and writes, how it touches pixels, its parameters.

A stage is declared once, in ``clpipe/stages/<name>.py``, as a :class:`Stage` with one or more
:class:`Method` classes. The fields of a method are its parameters; everything that is said of them
anywhere (validation, help, ``--set``, kernel arguments, the sidecar) is derived from there.
"""

import typing
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from enum import Enum
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar, Self, get_args, get_origin

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, JsonValue

from clpipe.base.types import Array, Floats
from clpipe.camera.noise import NoiseModel
from clpipe.camera.profile import DEFAULT_CAMERA, IDENTITY, Camera, Matrix, load_camera
from clpipe.reference.cfa import PATTERNS, Pattern, red_site
from clpipe.reference.curve import curve_index
from clpipe.reference.random import Stream, stream_of

# What a stage file may import from here.
__all__ = [
    "Access",
    "Argument",
    "Array",
    "Context",
    "Curve",
    "Floats",
    "Frame",
    "GaussianNoise",
    "Kind",
    "Literal",
    "Method",
    "NoiseScope",
    "Noiseless",
    "Pass",
    "Stage",
    "Unchanged",
    "odd_size",
    "parameter",
    "run_reference",
    "variant_label",
    "variants",
]


class Kind(Enum):
    """A kind of image: what its samples mean, how it is called in OpenCL, its planes."""

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
        """What the kernel library calls it in ``tap_*`` and ``store_*``."""
        return "mosaic" if self.c_type == "vf" else self.c_type


class Access(Enum):
    """How a pass touches pixels."""

    POINTWISE = "pointwise"  # a pixel from that pixel
    CURVE = "curve"  # pointwise, each channel through the table named "table"
    STENCIL = "stencil"  # a pixel from its neighbours
    LINES = "lines"  # a table with a value a row or column, from no image
    SUMS = "sums"  # sums over the whole image, then a few numbers estimated from them
    HISTOGRAM = "histogram"  # counts over the whole image, then a few numbers estimated from them


class NoiseScope(Enum):
    """What noise belongs to, and so what its random key is made of."""

    IMAGE = "image"  # new in each image
    CAMERA = "camera"  # fixed: the same across images, views and ISOs


@dataclass(frozen=True)
class Pass:
    """One function of a method's kernel file, and how the planner may place it.

    ``reads`` and ``writes`` name images of the stage: ``src`` is its input, ``dst`` its output, any
    other name is scratch. A STENCIL with a ``block`` gets an array for it, row by row, as its last
    argument, where others return a pixel. ``arguments`` are, in order, names from
    :meth:`Method.arguments`, from ``estimates`` of an earlier SUMS pass, or the line table that an
    earlier LINES pass writes.
    """

    function: str
    access: Access = Access.POINTWISE
    arguments: tuple[str, ...] = ()
    reads: tuple[str, ...] = ("src",)
    writes: str = "dst"
    kind: Kind | None = None  # of what it writes; None: what the stage writes
    radius: int = 0
    random: NoiseScope | None = None  # gets a random stream as its first argument
    block: int = 0  # STENCIL: one call gives 4 rows of that many vectors, which share work
    cheap: bool = False  # so cheap that a stencil after it may redo it at each tap
    lines: str = ""  # LINES: "rows" or "columns"
    finish: str = ""  # SUMS, HISTOGRAM: the function that turns these into the estimates
    finish_arguments: tuple[str, ...] = ()  # of that function
    estimates: tuple[str, ...] = ()  # SUMS, HISTOGRAM: names of the numbers, at most four
    bins: int = 0  # HISTOGRAM: how many


@dataclass(frozen=True)
class Literal:
    """An argument that is compiled in, as OpenCL text."""

    text: str


Argument = np.float32 | np.uint32 | np.int32 | Array | Literal


@dataclass(frozen=True)
class Context:
    """What is known of the image where a stage stands in the chain."""

    camera: Camera
    iso: float
    pattern: Pattern = "RGGB"
    gains: tuple[float, float] = (1.0, 1.0)  # red, blue: taken out by inverse_white_balance
    applied_gains: tuple[float, float] = (1.0, 1.0)  # red, blue: put back by white_balance
    colours: Matrix = IDENTITY  # linear sRGB to what red, green and blue are, white-balanced
    noise: NoiseModel | None = None  # of the sensor noise that was added
    black_level: float | None = None  # DN, as quantize used them
    white_level: float | None = None

    def known_noise(self) -> tuple[float, float]:
        """The a and b of the sensor noise: as they were used, else as the camera has them."""
        model = self.noise or self.camera.noise(self.iso)
        return model.a, model.b

    @property
    def cfa(self) -> Literal:
        """The pattern as a compiled-in kernel argument."""
        red_x, red_y = red_site(self.pattern)
        return Literal(f"(cfa){{{red_x}, {red_y}}}")


def parameter(
    default: Any,
    text: str,
    unit: str = "",
    auto: str = "",
    structural: bool = False,
    file: bool = False,
    **limits: Any,
) -> Any:
    """Declare a parameter: default, one sentence, unit, limits (ge, gt, le, lt).

    ``auto`` says where the value comes from when it is left at None. ``structural`` values are
    compiled into the kernel; all others may change from image to image at no cost. ``file`` is the
    name of a file, which a configuration gives relative to itself.
    """
    if unknown := limits.keys() - {"ge", "gt", "le", "lt"}:
        raise TypeError(f"parameter() got {', '.join(sorted(unknown))}; limits are ge, gt, le, lt")
    extra: dict[str, JsonValue] = {
        "unit": unit,
        "auto": auto,
        "structural": structural,
        "file": file,
    }
    return Field(default, description=text, json_schema_extra=extra, **limits)


class Method(BaseModel):
    """One way to do a stage. Subclasses declare parameters as fields and override what follows."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)

    method: ClassVar[str]
    kernel: ClassVar[str]  # file name in kernels/, without .cl
    summary: ClassVar[str]
    tolerance: ClassVar[float] = 0.0  # of the kernel against the reference; 0: bit for bit
    example: ClassVar[Mapping[str, Any]] = {}  # to be checked with, where defaults do nothing
    other_examples: ClassVar[tuple[Mapping[str, Any], ...]] = ()  # that take another way

    def resolve(self, context: Context) -> Self:
        """The same method with every parameter that was left to the camera or the chain filled."""
        return self

    def after(self, context: Context) -> Context:
        """What is known after this (resolved) stage."""
        return context

    def passes(self) -> tuple[Pass, ...]:
        """The kernel functions, in order; none where the image stays as it is."""
        raise NotImplementedError(type(self).__name__)

    def without_noise(self) -> "Method | None":
        """What is left of this (resolved) method without noise; None where that is nothing."""
        return None if any(each.random for each in self.passes()) else self

    def variance(self, before: Floats, signal: Floats, context: Context) -> Floats | None:
        """The variance of the noise behind this (resolved) method, from that of the noise before.

        A method that draws random numbers of mean 0 adds theirs; one that scales scales it.

        Args:
            before: the variance in the image that enters, in its unit squared; float32 of the
                image's shape, or of shape () where it is the same everywhere. It is not changed.
            signal: the image that enters, without noise, (height, width[, channel]).
            context: what is known there.

        Returns:
            The same of the image that comes out; None where that cannot be said.
        """
        return None if self.passes() else before

    def arguments(self, context: Context) -> Mapping[str, Argument]:
        """Kernel arguments by name, from the resolved parameters."""
        return {}

    def reference(self, image: Floats, frame: "Frame") -> Floats:
        """The stage in NumPy: (height, width[, channel]) float32 in and out."""
        raise NotImplementedError(type(self).__name__)

    def filled(self, **values: Any) -> Self:
        """A copy in which those of ``values`` replace parameters that are None."""
        missing = {k: v for k, v in values.items() if getattr(self, k) is None}
        return self.model_copy(update=missing) if missing else self


class Unchanged(Method):
    """The image stays as it is, at no cost. Subclasses say how that is called."""

    kernel: ClassVar = ""

    def passes(self) -> tuple[Pass, ...]:
        return ()

    def reference(self, image: Floats, frame: "Frame") -> Floats:
        return image


class Noiseless(Unchanged):
    """What is left of a stage that does nothing but add noise, without it."""

    method: ClassVar = "none"
    summary: ClassVar = "no noise"


class Curve(Method):
    """A curve on each channel. Subclasses give its table, see :mod:`clpipe.reference.curve`."""

    kernel: ClassVar = "curve"

    def table(self) -> Floats:
        """The table; the same object for the same parameters, so that it is uploaded once."""
        raise NotImplementedError(type(self).__name__)

    def passes(self) -> tuple[Pass, ...]:
        return (Pass("curve", Access.CURVE, ("table",)),)

    def arguments(self, context: Context) -> Mapping[str, Argument]:
        return {"table": self.table()}

    def reference(self, image: Floats, frame: "Frame") -> Floats:
        return np.asarray(self.table()[curve_index(image)])


class GaussianNoise(Method):
    """Gaussian noise of one sigma; where that is 0, the image stays as it is, at no cost.

    Subclasses say where the sigma comes from, how it is drawn, and what it is in NumPy; and where
    it is not that of an offset, its variance.
    """

    method: ClassVar = "gaussian"
    example: ClassVar = {"sigma": 0.01}

    sigma: float | None = parameter(
        None,
        "Standard deviation of the offsets.",
        "signal",
        "from the camera and ISO",
        ge=0,
        le=1,
    )

    def draw(self) -> tuple[Pass, ...]:
        """The kernel functions, where there is noise."""
        raise NotImplementedError(type(self).__name__)

    def passes(self) -> tuple[Pass, ...]:
        return self.draw() if self.sigma else ()

    def variance(self, before: Floats, signal: Floats, context: Context) -> Floats:
        return before + np.float32(self.sigma) ** 2

    def arguments(self, context: Context) -> Mapping[str, Argument]:
        return {"sigma": np.float32(self.sigma)}


def odd_size(size: int, largest: int) -> int:
    """The width of a window, checked.

    >>> odd_size(5, 15)
    5

    Raises:
        ValueError: it is even, below 1 or above ``largest``.
    """
    if size % 2 == 0 or not 1 <= size <= largest:
        raise ValueError(f"it must be odd, 1 to {largest}")
    return size


def variants(method: type[Method]) -> Iterator[dict[str, Any]]:
    """What is compiled differently: the defaults, then each other choice of a structural parameter,
    then the method's other examples.

    The CFA pattern is not among them: whoever goes through variants goes through patterns anyway.
    """
    yield {}
    for name, field in method.model_fields.items():
        extra: Any = field.json_schema_extra
        choices = get_args(field.annotation)
        named = get_origin(field.annotation) is typing.Literal and choices != PATTERNS
        if extra["structural"] and named:
            yield from ({name: choice} for choice in choices if choice != field.default)
    yield from map(dict, method.other_examples)


def variant_label(method: type[Method], values: Mapping[str, Any]) -> str:
    """A method and what is not at its default."""
    return " ".join([method.method, *(f"{name}={value}" for name, value in values.items())])


@dataclass
class Frame:
    """What a reference needs besides the image and its parameters.

    ``estimates`` is where a stage puts numbers that it estimates from the image, such as gains.
    """

    context: Context
    stream: Mapping[NoiseScope, Stream]
    estimates: dict[str, float]


def run_reference(
    method: Method, image: Floats, iso: float = 100, pattern: Pattern = "RGGB"
) -> Floats:
    """A method's reference on an image, as the first stage after a mosaic of the default camera.

    For examples and for trying things out; noise is that of the image key "".
    """
    context = Context(load_camera(DEFAULT_CAMERA), iso, pattern)
    resolved = method.resolve(context)
    stream = {owner: stream_of(owner.value, resolved.method) for owner in NoiseScope}
    return resolved.reference(image, Frame(context, stream, {}))


@dataclass(frozen=True)
class Stage:
    """A named step of the chain. The first method is the default.

    ``explain`` says in a few lines how the automatic parameters follow from what is known.
    """

    name: str
    summary: str
    reads: Kind
    writes: Kind
    methods: tuple[type[Method], ...]
    explain: Callable[[Context], str] | None = None  # more about it, with numbers
    folder: Path | None = None  # of the kernel files, where they are not clpipe's own

    @cached_property
    def by_name(self) -> dict[str, type[Method]]:
        """The methods by their names."""
        return {m.method: m for m in self.methods}
