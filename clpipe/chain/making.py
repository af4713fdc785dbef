"""Build chains from settings: resolve each parameter, and reject stages that do not fit."""

import re
from collections.abc import Mapping

from clpipe.base.errors import KeyedError, RequestError
from clpipe.base.text import one_line, unknown_name
from clpipe.base.tracing import Traced, with_changes
from clpipe.camera.lens import calibration_of
from clpipe.camera.optics import IN_PIXELS, Optics
from clpipe.camera.profile import Camera, load_camera
from clpipe.camera.spectra import DEFAULT_ILLUMINANT, Sight, sight_of
from clpipe.chain.chain import Chain, Step
from clpipe.chain.exposures import check_exposures
from clpipe.chain.families import chain_of_family
from clpipe.chain.isos import check_cameras
from clpipe.chain.keys import LENS, NOISE, RENDER, setting_error
from clpipe.chain.methods import base_name, validation_errors
from clpipe.chain.registry import all_stages, check_passes, stage_in, user_code_errors
from clpipe.chain.settings import Settings
from clpipe.chain.sites import with_enough_planes
from clpipe.reference.filter_array import FilterArray
from clpipe.reference.geometry import Scaling
from clpipe.stage import Context, Kind, LensMethod, Method, Stage, StageRole, Unchanged
from clpipe.stages.projection import WideAngle
from clpipe.stages.spectral_response import CameraResponse


def make_chain(
    settings: Settings,
    source: Kind | None = None,
    start_at: str | None = None,
    until: str | None = None,
) -> Chain:
    """Return the chain of settings, with every parameter resolved.

    A stage that is listed a second time is called ``stage_2``, and so on. For settings with draws,
    all values that can be drawn are checked, and the chain is an example, for the image key "". To
    get the chain of an image, pass the result of :meth:`Settings.drawn`.

    Args:
        settings: all values that are set.
        source: the kind of image that enters. None is the kind of :func:`entry_kind`, or the kind
            that ``start_at`` reads.
        start_at: the first step to run. Earlier steps are resolved as well, because the image has
            been through them (pattern, gains, noise, levels).
        until: the last step to run.

    Raises:
        RequestError: the image kinds of two stages do not fit, the camera is unknown, the ISO is
            outside its range, or a step is not in the chain.
    """
    check_cameras(settings)
    draws, settings = settings.draws, settings.drawn("")
    camera = load_camera(settings.camera)
    ends = source, start_at, until

    def build(settings: Settings) -> Chain:
        return _build_chain(settings, camera, *ends)

    chain = chain_of_family(settings, camera, ends, build)
    return with_changes(chain, {"draws": draws}) if draws else chain


def _build_chain(
    settings: Settings, camera: Camera, source: Kind | None, start_at: str | None, until: str | None
) -> Chain:
    """Return the chain of settings without draws, see :func:`make_chain`."""
    steps = resolve_steps(settings, camera, source or (None if start_at else entry_kind(settings)))
    names = [step.name for step in steps]
    for name in settings.parameters:
        if name not in names and name not in all_stages():
            raise KeyedError(name, unknown_name("stage in this chain", name, names))
    for end in (start_at, until):
        if end not in (None, *names):
            raise RequestError(unknown_name("stage in this chain", str(end), names))
    first = names.index(start_at) if start_at else 0
    last = names.index(until) + 1 if until else len(steps)
    if first >= last:
        raise RequestError(
            f"no stage is left to run, because {start_at} comes after {until}; exchange --start-at "
            "and --until"
            if steps
            else "stages: no stage is left to run; list at least one that is not skipped"
        )
    if source is None:
        source = steps[first].stage.reads
    chain = Chain(tuple(steps[first:last]), source, camera, settings, tuple(names))
    check_exposures(chain)
    _check_curve(chain)
    chain = with_enough_planes(chain)
    noiseless = NOISE in settings.skip and any(step.adds_noise for step in chain.steps)
    return chain.without_noise() if noiseless else chain


def entry_kind(settings: Settings) -> Kind:
    """Return the kind of image that enters a whole chain: linear RGB, or display values.

    Display values enter if the first stage reads them.

    >>> entry_kind(Settings(stages=("inverse_gamma", "mosaic"))).label, entry_kind(Settings()).label
    ('display', 'rgb')
    """
    stages = (all_stages().get(base_name(name)) for name in settings.stages)
    first = next((s for s in stages if s and s.name not in settings.skip), None)
    return Kind.DISPLAY if first and first.reads is Kind.DISPLAY else Kind.RGB


def resolve_steps(settings: Settings, camera: Camera, kind: Kind | None) -> list[Step]:
    """Return the steps of settings in order, each resolved in the context after the earlier steps.

    A step that does nothing is skipped if its image kind does not fit.

    Args:
        settings: all values that are set.
        camera: the camera of the settings.
        kind: the kind of image that enters; None is the kind that the first step reads.

    Raises:
        RequestError: the image kinds of two stages do not fit.
    """
    methods = {name: settings.method(name) for name in settings.step_names}
    optics = optics_of(settings, camera, methods)
    time = optics.exposure_time
    sight, render = sight_of_render(settings, camera, methods), settings.render
    context = Context(
        camera,
        settings.iso,
        light=illuminant_gains(methods, camera, sight),
        wavelengths=render.wavelengths,
        illuminant=render.illuminant,
        sight=sight,
        optics=optics,
        exposure_time=time,
    )
    if sight and render.wavelengths:
        context = context.replace(array_ahead=_array_ahead(settings, methods, context))
    steps: list[Step] = []
    previous, takes_lens = "the input", not settings.named_lens
    wide_step = ""  # the step after which the picture is no longer in perspective
    for name, configured in methods.items():
        stage = all_stages()[base_name(name)].for_kind(kind)
        selected = stage.method_at_step(configured, bool(settings.parameters.get(name)), context)
        with (
            validation_errors(name, type(selected)),
            user_code_errors(f"stage {name}", stage.folder),
        ):
            fits = stage.reads is (kind or stage.reads)
            method = selected
            is_resolved = fits or isinstance(selected, LensMethod)
            if is_resolved:
                try:
                    method = selected.resolve(context)
                except RequestError:
                    if wide_step:
                        _check_after_wide(wide_step, name, selected)
                    raise
            takes_lens |= isinstance(selected, LensMethod) and not isinstance(method, Unchanged)
            if wide_step and is_resolved and method.passes():
                _check_after_wide(wide_step, name, selected)
            if fits and isinstance(method, WideAngle):
                wide_step = f"{name}.method={method.method}"
            if not fits:
                if isinstance(method, Unchanged) and stage.reads is stage.writes:
                    continue  # thus --skip gamma does not require you to skip later idle stages
                raise RequestError(misfit_message(name, stage, previous, kind or stage.reads))
            _check_array(name, method, context)
            after = method.next_context(context)
            if (optics_set := method.optics()) and method.passes():
                after = after.replace(optics=after.optics.set_to(optics_set))
        # Otherwise the stage has been checked.
        if stage.folder and not isinstance(context.iso, Traced):
            check_passes(name, stage, method, context)
        steps.append(Step(name, stage, method, context))
        context = after
        kind, previous = stage.writes, name
    if not takes_lens:
        raise setting_error(_unused_lens(settings, methods))
    _check_pixels(steps)
    return steps


def sight_of_render(
    settings: Settings, camera: Camera, methods: Mapping[str, Method]
) -> Sight | None:
    """Return the camera's sight in the light of a render; None if spectra do not matter.

    Raises:
        RequestError: the camera has no sensitivities, or the light is unknown or not used.
    """
    render = settings.render
    if not render.illuminant and not render.wavelengths:
        return None
    name = stage_in(StageRole.SPECTRUM).name
    if render.wavelengths and not isinstance(methods.get(name), CameraResponse):
        if render.illuminant:
            raise setting_error(
                f"render.illuminant: found {render.illuminant}, but spectra that are not read with "
                f"{name}.method=camera already contain their light; remove it"
            )
        return None
    return sight_of(camera, render.illuminant or DEFAULT_ILLUMINANT)


def _array_ahead(
    settings: Settings, methods: Mapping[str, Method], context: Context
) -> FilterArray:
    """Return the array of the first mosaic of a chain; without one, a Bayer pattern."""
    stage = stage_in(StageRole.PATTERN)
    if stage.name not in methods:
        return context.filter_array
    is_set = bool(settings.parameters.get(stage.name))
    method = stage.method_at_step(methods[stage.name], is_set, context)
    return method.next_context(context).filter_array


def illuminant_gains(
    methods: Mapping[str, Method], camera: Camera, sight: Sight | None
) -> tuple[float, float]:
    """Return the gains of red and blue that balance the light.

    They are the set ones, else those of the camera's sight, else the camera's.
    """
    method = methods.get(stage_in(StageRole.BALANCE_OF_LIGHT).name)
    red, blue = sight.gains if sight else camera.white_balance_gains
    return getattr(method, "red_gain", None) or red, getattr(method, "blue_gain", None) or blue


def optics_of(settings: Settings, camera: Camera, methods: Mapping[str, Method]) -> Optics:
    """Return the optics in the settings, the render's camera and the steps of a chain.

    Raises:
        RequestError: two values contradict each other, the lens is unknown, or the lens does not
            have these settings.
    """
    stated = [
        (key, name, value)
        for key, name in OPTICS_SETTINGS.items()
        if (value := getattr(settings, key)) is not None
    ]
    stated += [(f"{RENDER}.{name}", name, v) for name, v in settings.render.optics.items()]
    for step, method in methods.items():
        stated += [(f"{step}.{name}", name, value) for name, value in method.optics().items()]
    optics = Optics.of(stated)
    if not settings.named_lens:
        return optics
    set_to = optics.focal_length, optics.f_number, optics.focus_distance
    try:
        lens = calibration_of(settings.lens, camera, *set_to)
    except KeyedError:
        _check_lens_name(settings.lens)
        raise
    return optics.with_lens(lens)


def _check_lens_name(name: str) -> None:
    """Check that a lens is not named by a lens model, such as fisheye.

    Raises:
        KeyedError: it is.
    """
    model = "_".join(re.findall(r"[a-z0-9]+", name.lower()))
    for stage in all_stages().values():
        models = stage.role is StageRole.VIEW or any(
            issubclass(m, LensMethod) for m in stage.methods
        )
        if models and any(each.method == model for each in stage.methods):
            raise setting_error(
                f"lens: '{one_line(name)}' is a model, not the name of a lens such as 'Canon EF "
                f"50mm f/1.8'; remove lens, and set {stage.name}.method={model} and its parameters"
            )


# The optics that each key of the settings sets.
OPTICS_SETTINGS = dict(zip(LENS[1:], ("focal_length", "f_number", "focus_distance"), strict=True))


def _check_after_wide(wide: str, name: str, method: Method) -> None:
    """Check that a step can follow one that makes the picture of a wide lens.

    Args:
        wide: the step of the wide lens, for the message.
        name: the name of the step, which does something.
        method: the method of the step, as it was set.

    Raises:
        RequestError: the step needs a picture in perspective.
    """
    if isinstance(method, LensMethod):
        raise setting_error(
            f"lens: a lens from lensfun needs a picture in perspective, but {wide} already "
            f"applies a wide lens; remove lens, or skip {wide}"
        )
    if "fx" in type(method).model_fields:
        raise KeyedError(
            name,
            f"{name}.method={method.method}: this method needs a picture in perspective, but "
            f"{wide} makes the picture of a wide lens; skip {name}, or use a method with lengths "
            "in px",
        )


def _check_curve(chain: Chain) -> None:
    """Check that a chain inverts a piecewise linear curve only if it has applied one to the DN.

    Raises:
        KeyedError: the chain makes linear DN, and a later step inverts a curve.
    """
    maker = None
    for step in chain.steps:
        is_levels = step.stage.role is StageRole.LEVELS and not step.context.knots
        if maker and is_levels and getattr(step.method, "knots", None):
            raw = maker.name
            raise setting_error(
                f"{step.name}.knots: found knots, but {raw}.method={maker.method.method} "
                f"applies no curve; set {raw}.method=pwl and {raw}.knots, and remove "
                f"{step.name}.knots"
            )
        maker = step if step.stage.writes is Kind.RAW else maker


def _check_pixels(steps: list[Step]) -> None:
    """Check that no step with lengths in the render's pixels follows a step that rescales.

    Raises:
        KeyedError: such a step follows.
    """
    moving = [step for step in steps if type(step.method).geometry is not Method.geometry]
    scaled = next((step for step in moving if isinstance(step.method.geometry(), Scaling)), None)
    if scaled is None:
        return
    for step in steps[steps.index(scaled) + 1 :]:
        stated = next((each for each in IN_PIXELS if getattr(step.method, each, None)), None)
        if stated and step.passes:
            raise setting_error(
                f"{step.name}.{stated}: found {getattr(step.method, stated):g} px, measured in "
                f"the render, but the earlier stage {scaled.name} changes the size of pixels; "
                f"list {step.name} before {scaled.name}"
            )


def _check_array(name: str, method: Method, context: Context) -> None:
    """Check that a method that supports only Bayer patterns gets one.

    Raises:
        KeyedError: the mosaic has another filter array.
    """
    array = context.array
    if array and any("pattern" in pass_.all_arguments for pass_ in method.passes()):
        stage = all_stages()[base_name(name)]
        default = stage.default_method and stage.default_method(context)
        fitting = [m.method for m in ((default,) if default else stage.methods) if m.any_array]
        rest = f"use {name}.method={' or '.join(fitting)}" if fitting else f"skip {name}"
        raise KeyedError(
            name,
            f"{name}.method={method.method}: this method supports only Bayer patterns, but the "
            f"mosaic is {array.name}; {rest}",
        )


def _unused_lens(settings: Settings, methods: Mapping[str, Method]) -> str:
    """Return the message for a lens that is set, but that no step uses."""
    known = "lensfun has neither distortion nor vignetting for it at these settings; remove it"
    stages = " or ".join(s.name for s in all_stages().values() if "lens" in s.by_name)
    takes_it = any(isinstance(method, LensMethod) for method in methods.values())
    why = known if takes_it else f"no step uses it; set the method of {stages} to lens"
    return f"lens: found {settings.lens}, but {why}"


def misfit_message(name: str, stage: Stage, before: str, kind: Kind) -> str:
    """Return the message for a stage that does not fit: why, and which stages could precede it."""
    bridges = [s.name for s in all_stages().values() if (s.reads, s.writes) == (kind, stage.reads)]
    help_ = f"list {' or '.join(bridges)} between them" if bridges else f"skip {name} as well"
    if before == "the input":
        help_ += f", or use an image of that kind with --start-at {name}"
    return f"stage {name} reads {stage.reads.label}, but {before} gives {kind.label}; {help_}"
