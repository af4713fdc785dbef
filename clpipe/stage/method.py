"""Methods, whose fields are their parameters, and the stages to which they belong."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from enum import Enum
from functools import cache, cached_property
from pathlib import Path
from typing import Any, ClassVar, Self, TypeAlias

from pydantic import BaseModel, ConfigDict, Field, JsonValue, PrivateAttr

from clpipe.base.types import Floats
from clpipe.reference.geometry import NO_MARGINS, Geometry, Margins
from clpipe.stage.context import Context, ReferenceContext
from clpipe.stage.passes import Arguments, CompileTime, Kind, Pass


def parameter(
    default: Any,
    text: str,
    unit: str = "",
    auto: str = "",
    structural: bool = False,
    file: bool = False,
    optics: bool = False,
    **limits: Any,
) -> Any:
    """Declare a parameter: default, one sentence, unit, limits (ge, gt, le, lt).

    Args:
        default: the default; None for a value that the camera or the chain decides.
        text: one sentence that describes it.
        unit: its unit, if it has one.
        auto: source of the value if the parameter is None.
        structural: whether it is compiled into the kernel. All other parameters may change from
            image to image at no cost.
        file: whether it is the name of a file, which in a configuration is relative to that file.
        optics: whether it states the fact of that name in :class:`~clpipe.camera.optics.Optics`,
            for all stages. If it is None, it takes the value that another one states.
        **limits: ge, gt, le, lt.
    """
    if unknown := limits.keys() - {"ge", "gt", "le", "lt"}:
        raise TypeError(f"parameter() got {', '.join(sorted(unknown))}; limits are ge, gt, le, lt")
    extra: dict[str, JsonValue] = {
        "unit": unit,
        "auto": auto,
        "structural": structural,
        "file": file,
        "optics": optics,
    }
    return Field(default, description=text, json_schema_extra=extra, **limits)


def camera_parameter(text: str, unit: str = "", more: str = "", **options: Any) -> Any:
    """Declare a parameter whose value is the camera's, if it has one, see :func:`parameter`.

    ``more`` continues the words "from the camera".
    """
    return parameter(None, text, unit, f"from the camera{more}", **options)


def optics_parameter(text: str, unit: str = "", more: str = "", **limits: Any) -> Any:
    """Declare a parameter that states a fact of the optics, see :func:`parameter`.

    ``more`` continues the words "the camera's".
    """
    return parameter(None, text, unit, f"the camera's{more}", optics=True, **limits)


class Method(BaseModel):
    """One way to perform a stage. A subclass declares its parameters as fields.

    A subclass overrides :meth:`passes`, :meth:`arguments` and :meth:`reference`. It also overrides
    other methods if their defaults are not right for it.
    """

    # Schemas are built on first use, because a run needs only a few of them.
    model_config = ConfigDict(
        frozen=True, extra="forbid", strict=True, allow_inf_nan=False, defer_build=True
    )

    method: ClassVar[str]
    kernel: ClassVar[str]  # file name in kernels/, without .cl
    summary: ClassVar[str]
    # Largest difference between kernel and reference; 0 means bit for bit.
    tolerance: ClassVar[float] = 0.0
    example: ClassVar[Mapping[str, Any]] = {}  # parameters for checks, if the defaults do nothing
    # Parameters for checks that use other code paths.
    other_examples: ClassVar[tuple[Mapping[str, Any], ...]] = ()
    # Parameters of which you may set only one. An option replaces a configuration's parameter, and
    # a manifest's parameter replaces an option's.
    alternatives: ClassVar[frozenset[str]] = frozenset()
    # Whether the method accepts mosaics of any filter array. Other methods of its stage may accept
    # only Bayer patterns.
    any_array: ClassVar[bool] = False
    # Arrays for checks, if the method accepts no others.
    only_arrays: ClassVar[tuple[str, ...]] = ()
    # Whether the method's image may have overscan. If so, the method acts in the same way
    # everywhere, or counts positions from the frame, which ``margins`` locates.
    overscan: ClassVar[bool] = False

    _margins: Margins = PrivateAttr(default_factory=lambda: NO_MARGINS)  # not copied with the model

    @property
    def margins(self) -> Margins:
        """The margins of the image that it reads, outside the frame."""
        return self._margins

    def __setattr__(self, name: str, value: Any) -> None:
        """Reject the assignment, because chains share methods.

        Raises:
            AttributeError: always. pydantic rejects only fields, so private attributes need this.
        """
        raise AttributeError(
            f"{type(self).__name__}.{name} cannot be set, because chains share methods; use the "
            f"copy that with_state({name}=...) returns"
            if name in self.__private_attributes__
            else f"{type(self).__name__}.{name} cannot be set, because chains share methods; "
            "declare a private attribute, and use the copy that with_state returns"
        )

    def with_state(self, **values: Any) -> Self:
        """Return a copy with other private attributes.

        Args:
            **values: the values, by the attributes' names, with their underscores.

        Raises:
            AttributeError: the class declares no private attribute of a name.

        Example:
            >>> from pydantic import PrivateAttr
            >>> class Gain(Method):
            ...     _range: float = PrivateAttr(1.0)
            ...
            ...     def resolve(self, context):
            ...         return self.with_state(_range=context.camera.signal_range)
            >>> Gain().with_state(_range=2.0)._range
            2.0
        """
        if unknown := values.keys() - self.__private_attributes__.keys():
            raise AttributeError(
                f"{type(self).__name__} declares no private attribute {', '.join(sorted(unknown))}"
            )
        other = self.model_copy()
        assert other.__pydantic_private__ is not None  # _margins is declared here
        other.__pydantic_private__.update(values)
        return other

    def with_margins(self, margins: Margins) -> Self:
        """Return the (resolved) method for an image with overscan."""
        return self.with_state(_margins=margins)

    def with_image_state_of(self, other: "Method") -> Self:
        """Return the (resolved) method for the image that belongs to another one of its step."""
        return self.with_margins(other.margins)

    def optics(self) -> Mapping[str, float]:
        """Return the facts of the optics that this unresolved method states, by their names."""
        return {
            n: v
            for n in parameters_with(type(self), "optics")
            if (v := getattr(self, n)) is not None
        }

    def resolve(self, context: Context) -> "Method":
        """Return the method with a value for every parameter that camera or chain decides."""
        return self.with_optics(context)

    def with_optics(self, context: Context) -> Self:
        """Return a copy in which known optics replace the parameters that are None."""
        names = parameters_with(type(self), "optics")
        values = {name: getattr(context.optics, name) for name in names}
        return self.with_defaults(**values) if values else self

    def next_context(self, context: Context) -> Context:
        """Return the context of the next step, from this (resolved) method's."""
        return context

    def passes(self) -> tuple[Pass, ...]:
        """The kernel functions, in order; none if the image does not change."""
        raise NotImplementedError(type(self).__name__)

    def geometry(self) -> Geometry | None:
        """The way this (resolved) method moves pixels; None if it moves none."""
        return None

    def estimates_for(self, width: int, height: int) -> Mapping[str, float]:
        """Return the numbers that follow from the image size, for the estimates of a sidecar."""
        return {}

    def without_noise(self) -> "Method | None":
        """The (resolved) method without its noise; None if nothing remains of it."""
        return None if any(each.random for each in self.passes()) else self

    def noise_free(self, context: Context) -> "Method | None":
        """Return the unresolved method for a chain without noise (``--truth clean``).

        The method is without its own noise, and :meth:`Context.noise_parameters` are zeros for its
        parameters. A method that only removes noise becomes :class:`Noiseless`.

        Args:
            context: the context of the step, with ``clean`` set.

        Returns:
            The resolved method; None if nothing remains of it.
        """
        return self.resolve(context).without_noise()

    def variance(self, input_variance: Floats, signal: Floats, context: Context) -> Floats | None:
        """Return the noise variance after this (resolved) method, from the variance before it.

        A method that adds independent noise adds its variance; one that scales the image scales it.

        Args:
            input_variance: the variance in the image that the method reads, in its unit squared. It
                is float32 of the image's shape, or of shape () if it is the same everywhere. It is
                not modified.
            signal: that image without noise, (height, width[, channel]).
            context: the context of the step.

        Returns:
            The variance in the image that the method writes; None if it cannot be computed.
        """
        return None if self.passes() else input_variance

    def arguments(self, context: Context) -> Arguments:
        """Return the kernel arguments by name, from the resolved parameters.

        The default takes those of the passes that have the name of a parameter or of a property. A
        structural parameter is compiled in, like the "pattern" of the mosaic and the "extent" of
        the image.
        """
        found: dict[str, Any] = {}
        for name in dict.fromkeys(name for each in self.passes() for name in each.all_arguments):
            if name in FROM_CONTEXT:
                found[name] = FROM_CONTEXT[name](context)
            elif name in parameters_with(type(self), "structural"):
                found[name] = CompileTime(str(getattr(self, name)).upper())
            elif hasattr(type(self), name) or name in type(self).model_fields:
                found[name] = getattr(self, name)
        return found

    def reference(self, image: Floats, inputs: ReferenceContext) -> Floats:
        """Run the stage in NumPy: (height, width[, channel]) float32 in and out."""
        raise NotImplementedError(type(self).__name__)

    def with_defaults(self, **values: Any) -> Self:
        """Return a copy in which ``values`` replace the parameters that are None.

        NumPy's numbers become those of Python.
        """
        missing = {
            name: value.item() if hasattr(value, "item") else value
            for name, value in values.items()
            if getattr(self, name) is None and value is not None
        }
        return self.model_copy(update=missing) if missing else self


# Kernel arguments that every method has.
FROM_CONTEXT: Mapping[str, Callable[[Context], CompileTime]] = {
    "pattern": lambda context: context.cfa,
    "extent": lambda context: CompileTime("e"),
}


@cache
def parameters_with(method: type[Method], trait: str) -> tuple[str, ...]:
    """Return the parameters of a method with a trait of :func:`parameter`, such as "optics"."""
    extras: dict[str, Any] = {k: f.json_schema_extra for k, f in method.model_fields.items()}
    return tuple(name for name, extra in extras.items() if extra and extra.get(trait))


Methods: TypeAlias = tuple[type[Method], ...]


class StageRole(Enum):
    """Roles, by which the rest of clpipe finds stages, instead of by their names."""

    EXPOSURE = "its ev is changed by a bracket"
    SPECTRUM = "it reads the bands of a spectral render"
    SHUTTER = "its subframes are files of one exposure"
    VIEW = "it makes images from a render of the whole surroundings"
    PATTERN = "its pattern is that of a raw input"
    LEVELS = "its black_level and white_level are those of a raw input"
    BALANCE_OF_LIGHT = "its red_gain and blue_gain are divided out, like in the light of a raw"
    BALANCE = "its red_gain and blue_gain are those of a raw input"
    COLOURS_OF_LIGHT = "it is skipped for a raw input, because the sensor already saw its light"
    COLOURS = "its matrix is that of a raw input"
    LENS = "it changes the light before it reaches the sensor"
    FALLOFF = "it defines the fall-off of light"
    RESPONSE = "it is a part of the curve from light to codes"
    SENSOR = "it is an effect of the sensor on the mosaic, before the raw"
    SENSOR_OFFSETS = "like SENSOR; its sigma is that of offsets that it adds"
    SENSOR_NOISE = "like SENSOR; it adds the shot and read noise"
    RAW = "it rounds the mosaic to a raw"
    DENOISING = "its strength follows camera and ISO"
    BASELINE = "its noise is that of a baseline"


@dataclass(frozen=True)
class Stage:
    """A stage with a name and methods; the first method is the default.

    ``explain`` describes in a few lines how automatic parameters follow from the context.

    ``also_reads`` lists further kinds that the stage may read and then also writes.

    ``role`` defines how code outside its chain uses it. ``default_method`` returns the method to
    use if nothing is set, from the context of the step. None stands for the default.
    """

    name: str
    summary: str
    reads: Kind
    writes: Kind
    methods: Methods
    explain: Callable[[Context], str] | None = None
    folder: Path | None = None  # folder of a plug-in's kernel files
    also_reads: tuple[Kind, ...] = ()
    role: StageRole | None = None
    default_method: Callable[[Context], Method | None] | None = None

    def method_at_step(self, method: Method, is_set: bool, context: Context) -> Method:
        """Return the method at a position of a chain: the one that is set, or the usual one.

        Args:
            method: the method in the settings.
            is_set: whether the settings mention the stage.
            context: context of the step.
        """
        default_method = None if is_set or not self.default_method else self.default_method(context)
        return default_method or method

    @property
    def is_sensor(self) -> bool:
        """Whether it is an effect of the sensor on the mosaic, such as noise."""
        return self.role in (
            StageRole.SENSOR,
            StageRole.SENSOR_OFFSETS,
            StageRole.SENSOR_NOISE,
        )

    def for_kind(self, kind: Kind | None) -> "Stage":
        """Return the stage for an entering image of a kind; itself if it does not read this
        kind."""
        return replace(self, reads=kind, writes=kind) if kind in self.also_reads and kind else self

    @cached_property
    def by_name(self) -> dict[str, type[Method]]:
        """The methods by their names."""
        return {m.method: m for m in self.methods}


def sensor_stage(
    name: str, summary: str, methods: Methods, role: StageRole = StageRole.SENSOR
) -> Stage:
    """Return a stage that is an effect of the sensor on the mosaic, see :class:`Stage`."""
    return Stage(name, summary, Kind.MOSAIC, Kind.MOSAIC, methods, role=role)


def rgb_stage(name: str, summary: str, methods: Methods, **options: Any) -> Stage:
    """Return a stage that reads and writes linear RGB, see :class:`Stage`."""
    return Stage(name, summary, Kind.RGB, Kind.RGB, methods, **options)
