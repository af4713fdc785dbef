"""A chain: settings resolved for a camera, an ISO and each stage's place, ready to plan."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial

from clpipe.base.errors import KeyedError, RequestError
from clpipe.base.text import one_of
from clpipe.camera.lens import calibration_of
from clpipe.camera.noise import NoiseModel
from clpipe.camera.optics import Optics
from clpipe.camera.profile import Camera, load_camera
from clpipe.chain.draws import Draw
from clpipe.chain.isos import check_cameras
from clpipe.chain.keys import LENS, NOISE, RENDER
from clpipe.chain.methods import base_name, numbered, validation_errors
from clpipe.chain.registry import all_stages, check_passes, user_code_errors
from clpipe.chain.settings import Settings
from clpipe.reference.geometry import NO_MARGINS, Composition, Margins
from clpipe.reference.intrinsics import Intrinsics
from clpipe.reference.random import Stream, stream_of
from clpipe.reference.resample import Resampler, sizes
from clpipe.stage import (
    Context,
    FromLens,
    Kind,
    Method,
    Noiseless,
    NoiseScope,
    OfPanorama,
    Resample,
    Stage,
    StageRole,
    Unchanged,
)
from clpipe.stage.context import asks_for_noise


@dataclass(frozen=True)
class Step:
    """A stage in its place in a chain: its method, resolved, and the context that it reads.

    ``follows_noise`` is False where the method was resolved without a look at the noise.
    """

    name: str
    stage: Stage
    method: Method
    context: Context
    follows_noise: bool = True

    @property
    def adds_noise(self) -> bool:
        """Whether it adds noise, as its method says."""
        return self.method.without_noise() is not self.method

    def __repr__(self) -> str:
        return f"Step({self.name}, {self.method.method})"


@dataclass(frozen=True, eq=False)
class Chain:
    """A chain of stages, ready to plan.

    Compared by identity, so that plans and runners can be cached per chain.
    """

    steps: tuple[Step, ...]
    source: Kind
    camera: Camera
    settings: Settings
    names: tuple[str, ...]  # of all steps, with those before start_at and after until
    draws: Mapping[str, Draw] = field(default_factory=dict)  # the settings are an example of these
    margins: Margins = NO_MARGINS  # of what enters, beyond the picture

    def __repr__(self) -> str:
        return f"Chain({self.settings.label}, {self.label})"

    @property
    def label(self) -> str:
        """The first and the last step, for people."""
        names = [step.name for step in self.steps]
        return f"{names[0]}..{names[-1]}" if len(names) > 1 else "".join(names)

    @property
    def iso(self) -> float:
        """The ISO."""
        return self.settings.iso

    @property
    def seed(self) -> int:
        """The seed of the noise."""
        return self.settings.seed

    def streams(self, step: Step, noise_key: str) -> dict[NoiseScope, Stream]:
        """The random streams of a step for one image.

        Image noise is keyed on the seed and the noise key, fixed pattern noise on the camera.
        """
        return {
            NoiseScope.IMAGE: stream_of(f"image:{self.seed}:{noise_key}", step.name),
            NoiseScope.CAMERA: stream_of(f"camera:{self.camera.name}", step.name),
        }

    @property
    def optics(self) -> Optics:
        """The camera's optics, as far as they are known."""
        last = self.steps[-1]
        return last.context.optics.set_to(last.method.optics())

    @property
    def result(self) -> Kind:
        """The kind of image that comes out."""
        return self.steps[-1].stage.writes if self.steps else self.source

    def size(self, width: int, height: int) -> tuple[int, int]:
        """The width and height of what comes out, in px, from those of what enters."""
        return sizes(self._resamplings, width, height)[-1]

    @cached_property
    def geometry(self) -> Composition | None:
        """The map from pixels of what comes out to what enters; None if each stays."""
        moves = tuple(filter(None, (step.method.geometry() for step in self.steps)))
        return Composition(moves) if moves else None

    def intrinsics(self, width: int, height: int, shot: Mapping[str, float]) -> Intrinsics | None:
        """The intrinsics of what comes out; None where they are not known.

        Args:
            width, height: of what enters, in px.
            shot: what the image says itself, see :meth:`Intrinsics.of_render`.

        Raises:
            RequestError: what is known contradicts itself.
        """
        known = self.intrinsics_of_render(*self.margins.inside(width, height), shot)
        return self.geometry.intrinsics(known, width, height) if self.geometry else known

    def intrinsics_of_render(
        self, width: int, height: int, shot: Mapping[str, float]
    ) -> Intrinsics | None:
        """The intrinsics of what enters, of its size without margins; see :meth:`intrinsics`."""
        known = {**shot, **self.optics.for_image(width, height)}
        if self.optics.is_sensor_of_lens and "sensor_width" in shot:
            known["sensor_width"] = shot["sensor_width"]
        return Intrinsics.of_render(width, height, known, self.optics.places)

    @cached_property
    def _resamplings(self) -> tuple[Resampler, ...]:
        passes = (p for step in self.steps for p in step.method.passes())
        return tuple(p.access.resampler for p in passes if isinstance(p.access, Resample))

    @property
    def noise(self) -> NoiseModel | None:
        """The sensor noise in the image that comes out; None where none was added."""
        last = self.steps[-1]
        return last.method.next_context(last.context).noise

    @property
    def is_noisy(self) -> bool:
        """Whether a step draws random numbers."""
        return any(p.random for s in self.steps for p in s.method.passes())

    def without_noise(self) -> "Chain":
        """The chain without the noise of its steps.

        A step that only adds noise is left out, or, where it is the last, does nothing.

        Raises:
            RequestError: no step adds noise.
        """
        left = [(step, step.method.without_noise()) for step in self.steps]
        if all(method is step.method for step, method in left):
            raise RequestError(
                "no stage of this chain adds noise; every frame would be the same, "
                "and there is no noise to know the truth of"
            )
        return self._with(left, clean=False)

    def cleaned(self) -> "Chain":
        """The chain without noise and without all that its strength chose: nothing is denoised.

        Raises:
            RequestError: a user's stage does not allow it.
        """
        left = []
        for step in self.steps:
            name, folder = step.name, step.stage.folder
            method = self.settings.method(name)
            if not step.follows_noise and type(method).noise_free is Method.noise_free:
                left.append((step, step.method.without_noise()))  # as it would be resolved again
                continue
            context = replace(step.context, clean=True)
            with validation_errors(name, type(method)), user_code_errors(f"stage {name}", folder):
                own = method.noise_free(context)
                left.append((step, own and own.as_for(step.method)))
        return self._with(left, clean=True)

    def _with(self, methods: Sequence[tuple[Step, Method | None]], clean: bool) -> "Chain":
        """The chain with other methods in its steps, and no noise; see :meth:`without_noise`."""
        *others, (last, method) = methods
        steps = tuple(
            replace(step, method=method, context=replace(step.context, noise=None, clean=clean))
            for step, method in (*others, (last, method or Noiseless()))
            if method
        )
        return replace(self, steps=steps)

    def select(self, names: Sequence[str]) -> tuple[str, ...]:
        """The names of steps, each once; "all" is every step.

        Raises:
            RequestError: the chain has no such step.
        """
        if "all" in names:
            return tuple(step.name for step in self.steps)
        return tuple(self.step_named(name).name for name in dict.fromkeys(names))

    def through(self, names: Sequence[str]) -> "Chain":
        """The chain up to the last of these steps; all of it where none is named."""
        places = [place for place, step in enumerate(self.steps) if step.name in names]
        return replace(self, steps=self.steps[: places[-1] + 1]) if places else self

    def step_in(self, role: StageRole) -> Step | None:
        """The first step whose stage has a role; None where the chain has none."""
        return next((step for step in self.steps if step.stage.role is role), None)

    def step_named(self, name: str) -> Step:
        """The step of that name.

        Raises:
            RequestError: the chain has no such step.
        """
        for step in self.steps:
            if step.name == name:
                return step
        raise RequestError(one_of("stage in this chain", name, [s.name for s in self.steps]))


def make_chain(
    settings: Settings,
    source: Kind | None = None,
    start_at: str | None = None,
    until: str | None = None,
) -> Chain:
    """The chain of settings, every parameter resolved.

    A stage that is listed a second time is called ``stage_2``, and so on. Settings with draws give
    an example, that of the image key "", after a check of all that can be drawn; the chain of an
    image is made of its :meth:`Settings.drawn`.

    Args:
        settings: all values that are set.
        source: the kind of image that enters; None is that of :func:`entry`, or, with ``start_at``,
            what that step reads.
        start_at: the first step to run. The steps before it are resolved too, because what they do
            to the image (pattern, gains, noise, levels) has been done.
        until: the last step to run.

    Raises:
        RequestError: image kinds that do not fit, an unknown camera, an ISO outside its range, or a
            step that is not in the chain.
    """
    check_cameras(settings)
    draws, settings = settings.draws, settings.drawn("")
    camera = load_camera(settings.camera)
    steps = resolved_steps(settings, camera, source or (None if start_at else entry(settings)))
    names = [step.name for step in steps]
    for name in settings.parameters:
        if name not in names and name not in all_stages():
            raise KeyedError(name, one_of("stage in this chain", name, names))
    first, last = 0, len(steps)
    for name in (n for n in (start_at, until) if n is not None):
        if name not in names:
            raise RequestError(one_of("stage in this chain", name, names))
    if start_at is not None:
        first = names.index(start_at)
    if until is not None:
        last = names.index(until) + 1
    if first >= last:
        raise RequestError(
            f"nothing is left to do; {start_at} comes after {until}"
            if steps
            else "stages: nothing is left to do; no stage is listed, or every one was skipped"
        )
    if source is None:
        source = steps[first].stage.reads
    chain = Chain(tuple(steps[first:last]), source, camera, settings, tuple(names), draws)
    noiseless = NOISE in settings.skip and any(step.adds_noise for step in chain.steps)
    return chain.without_noise() if noiseless else chain


def entry(settings: Settings) -> Kind:
    """The kind of image that enters a whole chain: linear RGB, or display where the first stage
    reads that.

    >>> entry(Settings(stages=("inverse_gamma", "mosaic"))).label, entry(Settings()).label
    ('display', 'rgb')
    """
    stages = (all_stages().get(base_name(name)) for name in settings.stages)
    first = next((s for s in stages if s and s.name not in settings.skip), None)
    return Kind.DISPLAY if first and first.reads is Kind.DISPLAY else Kind.RGB


def step_names(settings: Settings) -> list[str]:
    """The names of the steps that are not skipped; a repeated stage gets a number.

    >>> step_names(Settings(stages=("exposure", "mosaic", "exposure"), skip=("mosaic",)))
    ['exposure', 'exposure_2']
    """
    return [name for name in numbered(settings.stages) if name not in settings.skip]


def resolved_steps(settings: Settings, camera: Camera, kind: Kind | None) -> list[Step]:
    """The steps of settings, in order, each resolved with what the steps before it did.

    A step that does nothing is left out where it does not fit.

    Args:
        settings: all values that are set.
        camera: the camera of the settings.
        kind: the kind of image that enters; None is what the first step reads.

    Raises:
        RequestError: image kinds do not fit.
    """
    methods = {name: settings.method(name) for name in step_names(settings)}
    optics = optics_of(settings, camera, methods)
    time = optics.exposure_time
    context = Context(camera=camera, iso=settings.iso, optics=optics, exposure_time=time)
    steps: list[Step] = []
    before, takes_lens = "the input", not settings.lens
    wide = ""  # the step behind which the picture is no longer in perspective
    for name, own in methods.items():
        stage = all_stages()[base_name(name)].reading(kind)
        with validation_errors(name, type(own)), user_code_errors(f"stage {name}", stage.folder):
            fits = stage.reads is (kind or stage.reads)
            method, follows_noise = own, True
            if fits or isinstance(own, FromLens):
                try:
                    method, follows_noise = asks_for_noise(partial(own.resolve, context))
                except RequestError:
                    _check_behind(wide, name, own, is_at_work=True)
                    raise
            takes_lens |= isinstance(own, FromLens) and not isinstance(method, Unchanged)
            if fits or isinstance(own, FromLens):  # or it was not resolved
                _check_behind(wide, name, own, bool(method.passes()))
            if fits and isinstance(method, OfPanorama):
                wide = f"{name}.method={method.method}"
            if not fits:
                if isinstance(method, Unchanged) and stage.reads is stage.writes:
                    continue  # so that gamma can be skipped without what does nothing behind it
                raise RequestError(misfit(name, stage, before, kind or stage.reads))
            after = method.next_context(context)
            if method.passes():
                after = replace(after, optics=after.optics.set_to(method.optics()))
        if stage.folder:
            check_passes(name, stage, method, context)
        # What a user's stage looks at, nobody knows.
        steps.append(Step(name, stage, method, context, follows_noise or bool(stage.folder)))
        context = after
        kind, before = stage.writes, name
    if not takes_lens:
        raise KeyedError("lens", _unused_lens(settings, methods))
    return steps


def optics_of(settings: Settings, camera: Camera, methods: Mapping[str, Method]) -> Optics:
    """The optics that settings, the render's camera and the steps of a chain state.

    Raises:
        RequestError: two statements contradict each other, or the lens that is named cannot be
            found, or set so.
    """
    stated = [
        (key, name, value)
        for key, name in SETTINGS.items()
        if (value := getattr(settings, key)) is not None
    ]
    stated += [(f"{RENDER}.{name}", name, v) for name, v in settings.render.optics.items()]
    for step, method in methods.items():
        stated += [(f"{step}.{name}", name, value) for name, value in method.optics().items()]
    optics = Optics.of(stated)
    if not settings.lens:
        return optics
    set_to = optics.focal_length, optics.f_number, optics.focus_distance
    lens = calibration_of(settings.lens, camera, *set_to)
    return optics.with_lens(lens)


# By the keys of settings that state optics: what they state.
SETTINGS = dict(zip(LENS[1:], ("focal_length", "f_number", "focus_distance"), strict=True))


def _check_behind(wide: str, name: str, method: Method, is_at_work: bool) -> None:
    """See that a step can stand behind one that makes the picture of a wide lens.

    Args:
        wide: that one, for the message; "" where there is none.
        name: of the step.
        method: as it was set.
        is_at_work: whether it does anything.

    Raises:
        RequestError: it is of pictures in perspective.
    """
    if not wide or not is_at_work:
        return
    if isinstance(method, FromLens):
        raise KeyedError(
            "lens", f"lens: it is of pictures in perspective, but {wide} is a lens; leave one out"
        )
    if "fx" in type(method).model_fields:
        raise KeyedError(
            name,
            f"{name}.method={method.method}: it counts in the focal lengths of a picture in "
            f"perspective, but {wide} makes that of a wide lens; leave it out, or take a method "
            "that counts in px or in the picture's size",
        )


def _unused_lens(settings: Settings, methods: Mapping[str, Method]) -> str:
    """The message for a lens that is named, and that no step takes."""
    known = "lensfun knows neither distortion nor vignetting of it as it is set"
    stages = " or ".join(s.name for s in all_stages().values() if "lens" in s.by_name)
    takes_it = any(isinstance(method, FromLens) for method in methods.values())
    why = known if takes_it else f"no step takes it; that is done by {stages} with method lens"
    return f"lens: found {settings.lens}, but {why}; leave it out"


def misfit(name: str, stage: Stage, before: str, kind: Kind) -> str:
    """The message for a stage that cannot follow: why, and which stages could stand between."""
    bridges = [s.name for s in all_stages().values() if (s.reads, s.writes) == (kind, stage.reads)]
    help_ = f"put {' or '.join(bridges)} between them" if bridges else f"leave out {name} as well"
    if before == "the input":
        help_ += f", or enter there with an image of that kind: --start-at {name}"
    return f"stage {name} reads {stage.reads.label}, but {before} gives {kind.label}; {help_}"
