"""What a stage is: the image kinds it reads and writes, how it touches pixels, its parameters.

A stage is declared once, in ``clpipe/stages/<name>.py``, as a :class:`Stage` with one or more
:class:`Method` classes. The fields of a method are its parameters; their validation, help,
``--set``, kernel arguments and sidecar entries are all derived from that declaration.
"""

import typing
import weakref
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from enum import Enum
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar, Self, get_args, get_origin

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, JsonValue, PrivateAttr

from clpipe.base.types import Array, Floats
from clpipe.camera.noise import NoiseModel
from clpipe.camera.profile import DEFAULT_CAMERA, IDENTITY, Camera, Matrix, load_camera
from clpipe.reference.cfa import PATTERNS, Pattern, red_site
from clpipe.reference.curve import curve_index
from clpipe.reference.defocus import Depth
from clpipe.reference.geometry import NO_MARGINS, Geometry, Margins
from clpipe.reference.random import Stream, stream_of
from clpipe.reference.resample import Resampler

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
class Literal:
    """An argument that is compiled in, as OpenCL text."""

    text: str


Argument = np.float32 | np.uint32 | np.int32 | Array | Literal


@dataclass(frozen=True)
class Context:
    """What the steps before a stage say of the image that it reads."""

    camera: Camera
    iso: float
    pattern: Pattern = "RGGB"
    gains: tuple[float, float] = (1.0, 1.0)  # red, blue: taken out by inverse_white_balance
    applied_gains: tuple[float, float] = (1.0, 1.0)  # red, blue: put back by white_balance
    headroom: float = 0.0  # stops by which exposure darkened the scene
    colours: Matrix = IDENTITY  # linear sRGB to what red, green and blue are, white-balanced
    noise: NoiseModel | None = None  # of the sensor noise that was added
    lens: Mapping[str, Mapping[str, Any]] | None = None  # tables of stages, by their names
    # Of the render's camera: what [output] says, as Intrinsics.of_render takes it.
    render: Mapping[str, float] = field(default_factory=dict, compare=False, repr=False)
    clean: bool = False  # the image has no noise, and nothing may follow from what it would have
    black_level: float | None = None  # DN, as quantize used them
    white_level: float | None = None
    # Of the image, which holds it: chains are kept longer. Chains of one structure are alike.
    depth: weakref.ref[Depth] | None = field(default=None, compare=False, repr=False)

    def noise_parameters(self) -> tuple[float, float]:
        """The a and b of the noise that was added, else the camera's; of a clean image, zeros."""
        if self.clean:
            return 0.0, 0.0
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

    Args:
        default: the default; None for a value that the camera or the chain decides.
        text: one sentence about it.
        unit: its unit, if it has one.
        auto: where a value comes from that is left at None.
        structural: whether it is compiled into the kernel; any other parameter may change from
            image to image at no cost.
        file: whether it is the name of a file, which a configuration gives relative to itself.
        **limits: ge, gt, le, lt.
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
    """One way to do a stage. A subclass declares its parameters as fields.

    It overrides :meth:`passes`, :meth:`arguments` and :meth:`reference`, and of the other methods
    those that do not hold for it as they are.
    """

    # Schemas are built when they are first used: of most methods, in no run.
    model_config = ConfigDict(
        frozen=True, extra="forbid", strict=True, allow_inf_nan=False, defer_build=True
    )

    method: ClassVar[str]
    kernel: ClassVar[str]  # file name in kernels/, without .cl
    summary: ClassVar[str]
    tolerance: ClassVar[float] = 0.0  # kernel against reference; 0 is bit for bit
    example: ClassVar[Mapping[str, Any]] = {}  # parameters for checks, where defaults do nothing
    other_examples: ClassVar[tuple[Mapping[str, Any], ...]] = ()  # that take other paths
    # Parameters of which one may be set: a configuration's gives way to an option's, and that to a
    # manifest's.
    alternatives: ClassVar[frozenset[str]] = frozenset()
    # Whether its image may go on beyond the picture: it does the same everywhere, or counts places
    # from the picture, which ``margins`` says.
    overscan: ClassVar[bool] = False

    _margins: Margins = PrivateAttr(NO_MARGINS)

    @property
    def margins(self) -> Margins:
        """How far the image that it reads goes on beyond the picture."""
        return self._margins

    def around(self, margins: Margins) -> Self:
        """This (resolved) method for an image that goes on beyond the picture."""
        other = self.model_copy()
        other._margins = margins
        return other

    def resolve(self, context: Context) -> "Method":
        """The method with a value for every parameter that was left to the camera or the chain."""
        return self

    def after(self, context: Context) -> Context:
        """The context of the next step, from this (resolved) method's."""
        return context

    def passes(self) -> tuple[Pass, ...]:
        """The kernel functions, in order; none if the image stays as it is."""
        raise NotImplementedError(type(self).__name__)

    def geometry(self) -> Geometry | None:
        """How this (resolved) method moves pixels; None if each stays where it is."""
        return None

    def of_size(self, width: int, height: int) -> Mapping[str, float]:
        """What follows for an image of that size that it reads; a sidecar has it as estimates."""
        return {}

    def without_noise(self) -> "Method | None":
        """This (resolved) method without its noise; None if nothing is left of it."""
        return None if any(each.random for each in self.passes()) else self

    def where_clean(self, context: Context) -> "Method | None":
        """What this method, as it was set, becomes in a chain without noise (``--truth clean``).

        It is without its own noise, and what follows from :meth:`Context.noise_parameters` follows
        from zeros. A method that only takes noise away becomes :class:`Noiseless`.

        Args:
            context: the context of the step, with ``clean`` set.

        Returns:
            The resolved method; None if nothing is left of it.
        """
        return self.resolve(context).without_noise()

    def variance(self, before: Floats, signal: Floats, context: Context) -> Floats | None:
        """The variance of the noise after this (resolved) method, from the variance before it.

        A method that adds independent noise adds its variance; one that scales the image scales it.

        Args:
            before: the variance in the image that the method reads, in its unit squared; float32 of
                the image's shape, or of shape () if it is the same everywhere. It is not modified.
            signal: that image without noise, (height, width[, channel]).
            context: the context of the step.

        Returns:
            The variance in the image that the method writes; None if it cannot be computed.
        """
        return None if self.passes() else before

    def arguments(self, context: Context) -> Mapping[str, Argument]:
        """Kernel arguments by name, from the resolved parameters."""
        return {}

    def reference(self, image: Floats, frame: "Frame") -> Floats:
        """The stage in NumPy: (height, width[, channel]) float32 in and out."""
        raise NotImplementedError(type(self).__name__)

    def filled(self, **values: Any) -> Self:
        """A copy in which ``values`` replace the parameters that are None."""
        missing = {k: v for k, v in values.items() if getattr(self, k) is None}
        return self.model_copy(update=missing) if missing else self


class Unchanged(Method):
    """Leaves the image as it is, at no cost. A subclass gives the method's name."""

    kernel: ClassVar = ""

    def passes(self) -> tuple[Pass, ...]:
        return ()

    def reference(self, image: Floats, frame: "Frame") -> Floats:
        return image


class Noiseless(Unchanged):
    """A stage that only adds noise, or only takes it away, where there is none."""

    method: ClassVar = "none"
    summary: ClassVar = "no noise"


class Curve(Method):
    """A curve on each channel. A subclass gives its table, see :mod:`clpipe.reference.curve`."""

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
    """Gaussian noise of one sigma; at sigma 0 the image stays as it is, at no cost.

    A subclass gives the default of sigma, the passes and the reference; and the variance, if the
    noise is not an offset.
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
        """The kernel functions for a sigma above 0."""
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
    """Parameters for each variant of a method that is compiled differently.

    The first is the defaults; then each other choice of a structural parameter; then the method's
    other examples. CFA patterns are no variants here, since they go with every variant.
    """
    yield {}
    for name, declared in method.model_fields.items():
        extra: Any = declared.json_schema_extra
        choices = get_args(declared.annotation)
        named = get_origin(declared.annotation) is typing.Literal and choices != PATTERNS
        if extra["structural"] and named:
            yield from ({name: choice} for choice in choices if choice != declared.default)
    yield from map(dict, method.other_examples)


def variant_label(method: type[Method], values: Mapping[str, Any]) -> str:
    """The name of a method with the parameters that are not at their defaults."""
    return " ".join([method.method, *(f"{name}={value}" for name, value in values.items())])


@dataclass
class Frame:
    """What a reference gets besides the image and its parameters.

    ``stream`` has the random streams by scope. A reference stores the numbers that it estimates
    from the image, such as gains, in ``estimates``.
    """

    context: Context
    stream: Mapping[NoiseScope, Stream]
    estimates: dict[str, float]


def run_reference(
    method: Method, image: Floats, iso: float = 100, pattern: Pattern = "RGGB"
) -> Floats:
    """The reference of a method on an image of the default camera, for examples and experiments.

    The noise is that of the image key "".
    """
    context = Context(load_camera(DEFAULT_CAMERA), iso, pattern)
    resolved = method.resolve(context)
    stream = {owner: stream_of(owner.value, resolved.method) for owner in NoiseScope}
    return resolved.reference(image, Frame(context, stream, {}))


@dataclass(frozen=True)
class Stage:
    """A stage by name, with its methods; the first one is the default.

    ``explain`` describes in a few lines how automatic parameters follow from the context. ``also``
    are further kinds that it may read; it then writes the same kind.
    """

    name: str
    summary: str
    reads: Kind
    writes: Kind
    methods: tuple[type[Method], ...]
    explain: Callable[[Context], str] | None = None
    folder: Path | None = None  # of a plug-in's kernel files
    also: tuple[Kind, ...] = ()

    def reading(self, kind: Kind | None) -> "Stage":
        """The stage where an image of a kind enters it; the stage as it is if it reads no such."""
        return replace(self, reads=kind, writes=kind) if kind in self.also and kind else self

    @cached_property
    def by_name(self) -> dict[str, type[Method]]:
        """The methods by their names."""
        return {m.method: m for m in self.methods}
