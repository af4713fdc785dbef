"""A chain: settings resolved for a camera, an ISO and the place of each stage, ready to plan."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, wraps
from typing import Any, TypeVar

from clpipe.base.errors import RequestError
from clpipe.base.text import unknown_name
from clpipe.base.tracing import NotTraceableError, Trace, with_changes
from clpipe.camera.noise import NoiseModel
from clpipe.camera.optics import Optics
from clpipe.camera.profile import Camera
from clpipe.chain.draws import Draw
from clpipe.chain.methods import validation_errors
from clpipe.chain.registry import user_code_errors
from clpipe.chain.settings import Settings
from clpipe.reference.filter_array import FilterArray
from clpipe.reference.geometry import NO_MARGINS, Composition, Margins
from clpipe.reference.intrinsics import Intrinsics
from clpipe.reference.random import Stream, stream_of
from clpipe.reference.resample import Resampler, sizes
from clpipe.stage import (
    Argument,
    Bands,
    Context,
    Kind,
    Method,
    Noiseless,
    NoiseScope,
    Pass,
    Resample,
    Stage,
    StageRole,
    bytes_of,
    typed_arguments,
)
from clpipe.stages.shutter import Rows

T = TypeVar("T")


@dataclass(frozen=True)
class Step:
    """A stage in a chain: its resolved method, and the context in which it runs."""

    name: str
    stage: Stage
    method: Method
    context: Context

    @cached_property
    def passes(self) -> tuple[Pass, ...]:
        """The passes of the step's method."""
        return self.method.passes()

    @cached_property
    def arguments(self) -> Mapping[str, Argument]:
        """The kernel arguments of the step's method, by name; none if it has no passes."""
        return typed_arguments(self.method.arguments(self.context)) if self.passes else {}

    @cached_property
    def adds_noise(self) -> bool:
        """Whether the step's method adds noise."""
        return self.method.without_noise() is not self.method

    def equals(self, other: "Step") -> bool:
        """Return whether another step does the same with the same numbers."""
        optics = self.context.optics, other.context.optics
        equals = self == other and optics[0] == optics[1] and self.passes == other.passes
        # Without arguments, there is nothing else to compare.
        if not equals or "arguments" not in vars(self):
            return equals
        mine, theirs = self.arguments, other.arguments
        return mine.keys() == theirs.keys() and all(
            bytes_of(value) == bytes_of(theirs[name]) for name, value in mine.items()
        )

    def __repr__(self) -> str:
        return f"Step({self.name}, {self.method.method})"


@dataclass(frozen=True, eq=False)
class Chain:
    """A chain of stages, ready to plan.

    Chains are compared by identity, so that plans and runners can be cached per chain.
    """

    steps: tuple[Step, ...]
    source: Kind
    camera: Camera
    settings: Settings
    names: tuple[str, ...]  # all steps, including those before start_at and after until
    # The settings are an example of these draws.
    draws: Mapping[str, Draw] = field(default_factory=dict)
    margins: Margins = NO_MARGINS  # the overscan of the chain's input
    # Results that all chains of this structure share, see `cached_by_structure`. None shares none.
    structure: dict[Any, Any] | None = field(default=None, init=False)

    def __repr__(self) -> str:
        return f"Chain({self.settings.label}, {self.label})"

    @property
    def label(self) -> str:
        """The first and the last step, as text for people."""
        names = self.step_names
        return f"{names[0]}..{names[-1]}" if len(names) > 1 else "".join(names)

    @cached_property
    def bands(self) -> int:
        """The number of bands of a spectral source; 0 for another source."""
        access = [pass_.access for pass_ in self.steps[0].passes[:1]] if self.steps else []
        return access[0].count if access and isinstance(access[0], Bands) else 0

    @property
    def source_channels(self) -> int:
        """The number of samples in a pixel of the source."""
        return self.bands or len(self.source.channels)

    @property
    def iso(self) -> float:
        """The ISO."""
        return self.settings.iso

    @property
    def seed(self) -> int:
        """The seed of the noise."""
        return self.settings.seed

    def stream(self, step: str, scope: NoiseScope, noise_key: str) -> Stream:
        """Return the random stream of a step for one image.

        Image noise is seeded by the seed and the noise key, fixed-pattern noise by the camera.
        """
        if scope is NoiseScope.IMAGE:
            return stream_of(f"image:{self.seed}:{noise_key}", step)
        return stream_of(f"camera:{self.camera.name}", step)

    @cached_property
    def arguments(self) -> Mapping[str, Mapping[str, Argument]]:
        """The kernel arguments of the steps, by step name."""
        return {step.name: step.arguments for step in self.steps}

    @cached_property
    def optics(self) -> Optics:
        """The camera's optics, as far as they are known."""
        last = self.steps[-1]
        return last.context.optics.set_to(last.method.optics())

    @cached_property
    def context_after(self) -> Context:
        """The context of the resulting image."""
        last = self.steps[-1]
        return last.method.next_context(last.context)

    @cached_property
    def step_names(self) -> tuple[str, ...]:
        """The names of the steps."""
        return tuple(step.name for step in self.steps)

    @cached_property
    def light_layer_steps(self) -> tuple[str, ...]:
        """The names of the steps that need the light in a layer of the image's file."""
        named = ((step.name, step.method) for step in self.steps)
        return tuple(n for n, each in named if isinstance(each, Rows) and each.light_layer)

    @cached_property
    def raw_step_name(self) -> str | None:
        """The name of the last step that makes a raw in DN; None if there is none."""
        raws = [step.name for step in self.steps if step.stage.writes is Kind.RAW]
        return raws[-1] if raws else None

    @cached_property
    def raw_context(self) -> Context:
        """The context of the raw in DN; without a raw, of the image that enters."""
        if self.raw_step_name is None:
            return self.steps[0].context
        maker = self.step_named(self.raw_step_name)
        return maker.method.next_context(maker.context)

    @cached_property
    def filter_array(self) -> FilterArray:
        """The filter array of the raw, or of the mosaic if the chain makes no raw."""
        if self.raw_step_name:
            return self.raw_context.filter_array
        if self.result is Kind.MOSAIC:
            return self.context_after.filter_array
        if self.source in (Kind.RAW, Kind.MOSAIC):
            return self.steps[0].context.filter_array
        step = self.step_in(StageRole.PATTERN) or self.steps[-1]
        return step.method.next_context(step.context).filter_array

    @cached_property
    def result(self) -> Kind:
        """The kind of the resulting image."""
        return self.steps[-1].stage.writes if self.steps else self.source

    def size(self, width: int, height: int) -> tuple[int, int]:
        """Return the width and height in px of the result, for the size of an input."""
        return sizes(self._resamplings, width, height)[-1]

    @cached_property
    def geometry(self) -> Composition | None:
        """The map from pixels of the result to pixels of the input; None if no pixel moves."""
        moves = tuple(filter(None, (step.method.geometry() for step in self.steps)))
        return Composition(moves) if moves else None

    def intrinsics(self, width: int, height: int, shot: Mapping[str, float]) -> Intrinsics | None:
        """Return the intrinsics of the result; None if they are unknown.

        Args:
            width: the width of the input in px.
            height: its height in px.
            shot: the camera values in the image's file, see :meth:`Intrinsics.of_render`.

        Raises:
            RequestError: the camera's values contradict each other.
        """
        known = self.intrinsics_of_render(*self.margins.frame_size(width, height), shot)
        return self.geometry.intrinsics(known, width, height) if self.geometry else known

    def intrinsics_of_render(
        self, width: int, height: int, shot: Mapping[str, float]
    ) -> Intrinsics | None:
        """Return the intrinsics of an input whose size excludes margins, see :meth:`intrinsics`."""
        known = {**shot, **self.optics.for_image(width, height)}
        if self.optics.has_lens_sensor and "sensor_width" in shot:
            known["sensor_width"] = shot["sensor_width"]
        return Intrinsics.of_render(width, height, known, self.optics.places)

    @cached_property
    def _resamplings(self) -> tuple[Resampler, ...]:
        passes = (p for step in self.steps for p in step.passes)
        return tuple(p.access.resampler for p in passes if isinstance(p.access, Resample))

    @property
    def noise(self) -> NoiseModel | None:
        """The sensor noise in the result; None if none was added."""
        return self.context_after.noise

    @cached_property
    def is_noisy(self) -> bool:
        """Whether a step draws random numbers."""
        return any(p.random for s in self.steps for p in s.passes)

    def with_methods(self, methods: Mapping[str, Method]) -> "Chain":
        """Return the chain with other methods of some steps, by step name."""
        steps = (replace(s, method=methods[s.name]) if s.name in methods else s for s in self.steps)
        return replace(self, steps=tuple(steps))

    def with_settings(self, settings: Settings) -> "Chain":
        """Return the chain with other settings, which resolve to the same steps."""
        return with_changes(self, {"settings": settings})

    def traced(self, trace: Trace) -> "Chain":
        """Return the chain with all properties computed, as far as they can be traced."""
        is_complete = True
        for step in self.steps:
            is_complete &= not trace.contains_traced(step.passes)
            _ = step.adds_noise
            try:
                with trace.attempt():
                    _ = step.arguments
            except NotTraceableError:
                vars(step).pop("arguments", None)
                is_complete = False
        for name in COMPUTED:
            getattr(self, name)
        _ = is_complete and self.arguments
        return with_changes(self, {"structure": {} if is_complete else None})

    def equals(self, other: "Chain") -> bool:
        """Return whether another chain has the same steps with the same numbers."""
        pairs = list(zip(self.steps, other.steps, strict=False))
        return len(self.steps) == len(other.steps) and all(
            mine.equals(step) for mine, step in pairs
        )

    def derive(self, make: Callable[["Chain"], "Chain"]) -> "Chain":
        """Return ``make(self)``; subclasses may compute it."""
        return make(self)

    def without_noise(self) -> "Chain":
        """Return the chain without the noise of its steps.

        A step that only adds noise is skipped. If it is the last step, it does nothing.

        Raises:
            RequestError: no step adds noise.
        """
        return self.derive(Chain._without_noise)

    def _without_noise(self) -> "Chain":
        methods = [(step, step.method.without_noise()) for step in self.steps]
        if all(method is step.method for step, method in methods):
            raise RequestError(
                "no stage of this chain adds noise, so frames would be identical and there is no "
                "ground truth to write; add a noise stage, or remove --frames and --truth"
            )
        return self._with(methods, clean=False)

    def without_noise_or_denoising(self) -> "Chain":
        """Return the chain without noise, and without denoising chosen by the strength of noise.

        Raises:
            RequestError: a user's stage raises an error.
        """
        return self.derive(Chain._without_noise_or_denoising)

    def _without_noise_or_denoising(self) -> "Chain":
        methods = []
        for step in self.steps:
            name, folder = step.name, step.stage.folder
            is_set = bool(self.settings.parameters.get(name))
            method = step.stage.method_at_step(self.settings.method(name), is_set, step.context)
            context = step.context.replace(clean=True)
            with validation_errors(name, type(method)), user_code_errors(f"stage {name}", folder):
                noise_free = method.noise_free(context)
                methods.append((step, noise_free and noise_free.with_image_state_of(step.method)))
        return self._with(methods, clean=True)

    def _with(self, methods: Sequence[tuple[Step, Method | None]], clean: bool) -> "Chain":
        """Return the chain with other methods and without noise; see :meth:`without_noise`."""
        *others, (last, method) = methods
        kept = [(s, m) for s, m in (*others, (last, method or Noiseless())) if m]
        shared = {id(step.context): step.context for step, _ in kept}  # most steps share a context
        contexts = {key: c.replace(noise=None, clean=clean) for key, c in shared.items()}
        steps = (replace(s, method=m, context=contexts[id(s.context)]) for s, m in kept)
        return replace(self, steps=tuple(steps))

    def select(self, names: Sequence[str]) -> tuple[str, ...]:
        """Return the names of steps, each once; "all" is every step.

        Raises:
            RequestError: the chain has no such step.
        """
        if "all" in names:
            return self.step_names
        return tuple(self.step_named(name).name for name in dict.fromkeys(names))

    def up_to(self, names: Sequence[str]) -> "Chain":
        """Return the chain up to the last of these steps; the whole chain if none is named."""
        indices = [place for place, step in enumerate(self.steps) if step.name in names]
        return replace(self, steps=self.steps[: indices[-1] + 1]) if indices else self

    def step_in(self, role: StageRole) -> Step | None:
        """Return the first step whose stage has a role; None if there is none."""
        return next((step for step in self.steps if step.stage.role is role), None)

    def step_named(self, name: str) -> Step:
        """Return the step with a name.

        Raises:
            RequestError: the chain has no such step.
        """
        if name not in self.step_names:
            raise RequestError(unknown_name("stage in this chain", name, self.step_names))
        return self.steps[self.step_names.index(name)]


# The computed properties of a chain, apart from its arguments, which a trace may not have.
COMPUTED = tuple(
    name
    for name, value in vars(Chain).items()
    if isinstance(value, cached_property) and name != "arguments"
)


def cached_by_structure(function: Callable[..., T]) -> Callable[..., T]:
    """Return a function that is computed once for all chains that differ only in numbers.

    Its result must depend only on names, stages, passes and its other arguments.
    """

    @wraps(function)
    def cached(chain: Chain, *others: Any) -> T:
        if chain.structure is None:
            return function(chain, *others)
        key = function, *others
        if key not in chain.structure:
            chain.structure[key] = function(chain, *others)
        found: T = chain.structure[key]
        return found

    return cached
