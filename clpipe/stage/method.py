"""Methods, whose fields are their parameters, and the stages that they are methods of."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from enum import Enum
from functools import cache, cached_property
from pathlib import Path
from typing import Any, ClassVar, Self

from pydantic import BaseModel, ConfigDict, Field, JsonValue, PrivateAttr

from clpipe.base.types import Floats
from clpipe.reference.geometry import NO_MARGINS, Geometry, Margins
from clpipe.stage.context import Context, ReferenceContext
from clpipe.stage.passes import Arguments, Kind, Pass


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
        text: one sentence about it.
        unit: its unit, if it has one.
        auto: where a value comes from that is left at None.
        structural: whether it is compiled into the kernel; any other parameter may change from
            image to image at no cost.
        file: whether it is the name of a file, which a configuration gives relative to itself.
        optics: whether it states what :class:`~clpipe.camera.optics.Optics` has under that name,
            for all stages; left at None, it is what another states.
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
    # Whether it takes mosaics of any filter array, where others of its stage know Bayer's alone.
    any_array: ClassVar[bool] = False
    only_arrays: ClassVar[tuple[str, ...]] = ()  # on which it is checked, where it takes no others
    # Whether its image may go on beyond the picture: it does the same everywhere, or counts places
    # from the picture, which ``margins`` says.
    overscan: ClassVar[bool] = False

    _margins: Margins = PrivateAttr(default_factory=lambda: NO_MARGINS)  # which is not copied

    @property
    def margins(self) -> Margins:
        """The margins of the image that it reads, beyond the picture."""
        return self._margins

    def with_margins(self, margins: Margins) -> Self:
        """The (resolved) method for an image that goes on beyond the picture."""
        other = self.model_copy()
        other._margins = margins
        return other

    def as_for(self, other: "Method") -> Self:
        """The (resolved) method for the image that another (resolved) one of its step is for."""
        return self.with_margins(other.margins)

    def optics(self) -> Mapping[str, float]:
        """Facts of the optics that this method, as it was set, states, by the names of Optics."""
        return {n: v for n in optics_names(type(self)) if (v := getattr(self, n)) is not None}

    def resolve(self, context: Context) -> "Method":
        """The method with a value for every parameter that was left to the camera or the chain."""
        return self.with_optics(context)

    def with_optics(self, context: Context) -> Self:
        """A copy in which what is known of the optics replaces the parameters that are None."""
        names = optics_names(type(self))
        known = {name: getattr(context.optics, name) for name in names}
        return self.with_defaults(**known) if known else self

    def next_context(self, context: Context) -> Context:
        """The context of the next step, from this (resolved) method's."""
        return context

    def passes(self) -> tuple[Pass, ...]:
        """The kernel functions, in order; none if the image stays as it is."""
        raise NotImplementedError(type(self).__name__)

    def geometry(self) -> Geometry | None:
        """The way this (resolved) method moves pixels; None if each stays where it is."""
        return None

    def estimates_for(self, width: int, height: int) -> Mapping[str, float]:
        """Numbers that follow from the size of the image that is read; a sidecar's estimates."""
        return {}

    def without_noise(self) -> "Method | None":
        """The (resolved) method without its noise; None if nothing is left of it."""
        return None if any(each.random for each in self.passes()) else self

    def noise_free(self, context: Context) -> "Method | None":
        """The method, as it was set, in a chain without noise (``--truth clean``).

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

    def arguments(self, context: Context) -> Arguments:
        """Kernel arguments by name, from the resolved parameters."""
        return {}

    def reference(self, image: Floats, given: ReferenceContext) -> Floats:
        """The stage in NumPy: (height, width[, channel]) float32 in and out."""
        raise NotImplementedError(type(self).__name__)

    def with_defaults(self, **values: Any) -> Self:
        """A copy in which ``values`` replace the parameters that are None."""
        missing = {k: v for k, v in values.items() if getattr(self, k) is None and v is not None}
        return self.model_copy(update=missing) if missing else self


@cache
def optics_names(method: type[Method]) -> tuple[str, ...]:
    """The parameters of a method that state its camera's optics; see :func:`parameter`."""
    extras: dict[str, Any] = {k: f.json_schema_extra for k, f in method.model_fields.items()}
    return tuple(name for name, extra in extras.items() if extra and extra.get("optics"))


class StageRole(Enum):
    """Roles, by which the rest of clpipe finds stages, and not by their names."""

    EXPOSURE = "its ev is what a bracket adds to"
    SHUTTER = "its subframes are files of one exposure"
    VIEW = "it makes pictures of what is seen all around"
    PATTERN = "its pattern is that of a raw that enters"
    LEVELS = "its black_level and white_level are those of a raw that enters"
    BALANCE_OF_LIGHT = "its red_gain and blue_gain are taken out, as a raw's light has them"
    BALANCE = "its red_gain and blue_gain are those of a raw that enters"
    COLOURS_OF_LIGHT = "it is not done to a raw that enters, whose light the sensor saw"
    COLOURS = "its matrix is that of a raw that enters"
    FALLOFF = "light falls off by its law"
    RESPONSE = "it is a part of the curve from light to codes"
    DENOISING = "its strength follows camera and ISO"
    BASELINE = "its noise is that of a baseline"


@dataclass(frozen=True)
class Stage:
    """A stage by name, with its methods; the first one is the default.

    ``explain`` describes in a few lines how automatic parameters follow from the context. ``also``
    are further kinds that it may read; it then writes the same kind. ``role`` is what it is beyond
    its chain. ``usual`` gives the method where nothing is set of the stage, by its context; None is
    the default.
    """

    name: str
    summary: str
    reads: Kind
    writes: Kind
    methods: tuple[type[Method], ...]
    explain: Callable[[Context], str] | None = None
    folder: Path | None = None  # of a plug-in's kernel files
    also: tuple[Kind, ...] = ()
    role: StageRole | None = None
    usual: Callable[[Context], Method | None] | None = None

    def chosen(self, method: Method, is_set: bool, context: Context) -> Method:
        """The method at a place of a chain: the one that is set, or what is usual there.

        Args:
            method: as the settings have it.
            is_set: whether they say anything of the stage.
            context: of the step.
        """
        usual = None if is_set or not self.usual else self.usual(context)
        return usual or method

    def reading(self, kind: Kind | None) -> "Stage":
        """The stage where an image of a kind enters it; the stage as it is if it reads no such."""
        return replace(self, reads=kind, writes=kind) if kind in self.also and kind else self

    @cached_property
    def by_name(self) -> dict[str, type[Method]]:
        """The methods by their names."""
        return {m.method: m for m in self.methods}
