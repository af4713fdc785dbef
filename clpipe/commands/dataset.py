"""``clpipe dataset``: make a dataset of a scene or of a directory of renders."""

import sys
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import click
from rich.console import Console

from clpipe.base.errors import RequestError
from clpipe.base.files import check_folder
from clpipe.batch.execution import ExecutionOptions
from clpipe.batch.images import Images
from clpipe.batch.run_log import Summary
from clpipe.batch.session import Run
from clpipe.chain.keys import CODE
from clpipe.chain.options import OPTIONS
from clpipe.chain.panorama import projection_of
from clpipe.chain.registry import stage_in
from clpipe.chain.rendition import CLEAN, LIGHTS, TRUTHS
from clpipe.chain.request import Request
from clpipe.commands.chain_options import (
    SETTINGS,
    device_option,
    format_option,
    option,
    options,
    set_option,
    settings_in,
)
from clpipe.commands.options import (
    EXISTING,
    ExistingPath,
    GroupedCommand,
    Option,
    json_lines_option,
    options_on_command_line,
    output_option,
    quiet_option,
)
from clpipe.commands.progress import Reporter, follow, print_line
from clpipe.inputs.panoramas import wide_lens_of
from clpipe.inputs.series import Series, split_series
from clpipe.reference.panorama import CUBE
from clpipe.reference.projection import visible_faces
from clpipe.reference.wide import MODELS
from clpipe.scenes.blender import Rendering
from clpipe.scenes.card import CardContents, write_card
from clpipe.scenes.record import store_credits
from clpipe.scenes.source import NOTE, RENDERS, UNIT, Source, from_folder, from_leaves, from_scene
from clpipe.scenes.view_request import (
    DEFAULT_VIEWS,
    PATHS,
    parse_box,
    parse_frames,
    parse_resolution,
    requested_views,
)
from clpipe.stage import StageRole

# Options that apply only to a scene.
VIEW_OPTIONS = ("views", "path", "box", "frames")
RENDER_OPTIONS = (*VIEW_OPTIONS, "resolution", "samples", "denoise", "time_limit", "blender")

LEAVES = "leaves"  # the source that needs no renderer
LEAVES_OPTIONS = ("views", "resolution", "palette")

render_option = partial(click.option, cls=Option, heading="Renders")


class SourcePath(ExistingPath):
    """A scene or a directory that exists, or the word for dead leaves."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        if value != LEAVES:
            return super().convert(value, param, ctx)
        if Path(LEAVES).exists():
            raise RequestError(
                f"{LEAVES}: this word makes dead leaves images, but a file or directory here has "
                f"the same name. Name it ./{LEAVES}, or run the command in another directory"
            )
        return None


@click.command("dataset", cls=GroupedCommand)
@click.argument("source", type=SourcePath(path_type=Path), metavar="SCENE.blend|FOLDER|leaves")
@output_option("DS", "The directory of the dataset. It is created if it does not exist.")
@render_option(
    "--views",
    heading="+Renders",
    type=click.IntRange(1, 100_000),
    metavar="N",
    help="Render N views around the point that the scene's camera looks at, or make N dead leaves "
    "images. [default: 24]",
)
@render_option(
    "--path",
    heading="+Renders",
    type=click.Choice(PATHS),
    help="The positions of views: a full circle (orbit), 60 degrees around the scene's camera "
    "(arc), or random positions in a box around it (random). [default: orbit]",
)
@render_option(
    "--box",
    metavar="X,Y,Z,X,Y,Z",
    type=parse_box,
    help="Two corners of the box of --path random. [default: half as wide as the distance from the "
    "camera to the point that it looks at]",
)
@render_option(
    "--frames",
    heading="+Renders",
    metavar="A-B",
    type=parse_frames,
    help="Render these frames of the scene, with the scene's camera, such as 1-24 or 1,5,9.",
)
@render_option(
    "--resolution",
    heading="+Renders",
    metavar="WxH",
    type=parse_resolution,
    help="The resolution of the renders in px. [default: the scene's; 512x512 for leaves]",
)
@render_option(
    "--samples",
    heading="+Renders",
    default=128,
    show_default=True,
    type=click.IntRange(1, 2**24),
    help="The number of light paths per pixel.",
)
@render_option(
    "--denoise/--no-denoise",
    default=True,
    show_default=True,
    help="Have Blender remove the noise of its light paths, which is not camera noise.",
)
@render_option(
    "--time-limit",
    type=click.FloatRange(0, min_open=True),
    metavar="SECONDS",
    help="Stop rendering a view after this time. The result then depends on the machine.",
)
@render_option(
    "--blender",
    metavar="PATH",
    help="An installed Blender, 4.2 or newer, or a Python with the package bpy. [default: this "
    "Python]",
)
@render_option(
    "--palette",
    type=EXISTING,
    metavar="IMAGE",
    help="A render or photograph whose colours dead leaves have. [default: drawn colours]",
)
@set_option
@options("config", "camera", "iso", *SETTINGS, "start_at", "until", CODE)
@option(
    OPTIONS["truth"]._replace(
        text="Write the picture without noise (development), without noise and denoising (clean), "
        "the clean mosaic (mosaic), or its noise variance (variance).",
        default_text=CLEAN,
        choices=tuple(truth for truth in TRUTHS if truth not in LIGHTS),
    ),
    default=(CLEAN,),
)
@options("carry", "poses")
@format_option
@click.option(
    "--licence",
    cls=Option,
    heading="Pictures",
    metavar="TEXT",
    help="The licence of the dataset, for its README, such as CC-BY-4.0 or a sentence.",
)
@click.option(
    "--author",
    cls=Option,
    heading="Pictures",
    metavar="TEXT",
    help="The author of the dataset, for its README.",
)
@click.option(
    "--lens-model",
    cls=Option,
    heading="Camera",
    type=click.Choice(sorted(MODELS)),
    help="Render the faces of a cube, and combine them into the picture of a wide lens of this "
    "model. Set its coefficients with --set projection.fx=300 and so on.",
)
@device_option
@quiet_option
@json_lines_option
def dataset(
    source: Path | None,
    output: Path,
    poses: Path | None,
    palette: Path | None,
    selector: str | None,
    lens_model: str | None,
    quiet: bool,
    json_lines: bool,
    **options: Any,
) -> None:
    """Make a dataset of a Blender scene, or of a directory of existing renders.

    The views of a scene are rendered to DS/renders, as linear EXRs with depth, normals, object
    numbers and, for frames, flow. Each is developed like in clpipe run, for each camera and ISO,
    while the next one is rendered. The dataset also has the cameras of the pictures (cameras.json,
    transforms.json, COLMAP's sparse/0), manifest.csv, train.txt and val.txt, a contact sheet and a
    README.

    A directory of renders is used unchanged, with the cameras.json or transforms.json in it. The
    word leaves makes dead leaves images, which need no renderer: textured shapes of all sizes that
    cover each other, with depth and labels. To resume an interrupted run, repeat the command. For
    other ISOs and cameras, views are not rendered again.

    \b
    clpipe dataset scene.blend -o set --iso 100,800,3200 --views 24
    clpipe dataset scene.blend -o film --frames 1-48 --iso 1600
    clpipe dataset renders/ -o set --iso 100,800 --camera sony-a7r2 --camera canon-5d2
    clpipe dataset leaves -o set --views 100 --resolution 512x512 --iso 800,3200
    """
    check_folder(output)
    attribution = {name: options.pop(name) for name in ("licence", "author")}
    rendering = {name: options.pop(name) for name in RENDER_OPTIONS}
    settings = settings_in(options)
    if lens_model:
        stage = stage_in(StageRole.VIEW).name
        view = settings.setdefault(stage, {})
        if "method" in view:
            raise RequestError(
                f"--lens-model: found {lens_model}, but --set {stage}.method={view['method']}; use "
                "only one of them"
            )
        view["method"] = lens_model
    series, values = split_series(settings, always=True)
    request = Request.from_options(values=values, **options)
    if not series.isos and "iso" not in request.settings().draws:
        series = replace(series, isos=(request.settings().iso,))
    series.jobs((), request.settings())  # raises errors before anything is rendered
    with ExitStack() as stack:
        if source is None:
            reject_options(LEAVES_OPTIONS, "a .blend, not to dead leaves")
            views, size = rendering["views"] or DEFAULT_VIEWS, rendering["resolution"]
            seed = request.settings().seed
            show = (lambda text: None) if quiet else partial(click.echo, err=True)
            renders = from_leaves(output, views, size or (512, 512), seed, palette, show)
        elif source.suffix.lower() == ".blend":
            reject_options(RENDER_OPTIONS, "dead leaves, not to a .blend")
            check_chain(request)
            program = rendering.pop("blender")
            job = rendering_from(source, output, poses, request.settings().seed, rendering)
            job = replace(job, faces=cube_faces(request, job.resolution))
            renders = from_scene(stack, job, output, program)
        else:
            reject_options((), "a .blend or dead leaves, not to existing renders")
            renders = from_folder(source, output, poses)
        request = replace(request, carry=request.carry or renders.layers)
        attribution = store_credits(output, attribution)
        echo = print_line if json_lines else None
        quiet |= json_lines
        summary = develop(renders, request, output, series, selector, quiet, attribution, echo)
    if renders.failure:
        raise renders.failure
    sys.exit(summary.exit_status)


def rendering_from(
    scene: Path, output: Path, poses: Path | None, seed: int, options: Mapping[str, Any]
) -> Rendering:
    """Return the job for Blender.

    Raises:
        RequestError: the options contradict each other.
    """
    rendering = dict(options)
    named = {name: rendering.pop(name) for name in VIEW_OPTIONS}
    views = requested_views(**named, poses=poses, seed=seed)
    # Paths are absolute, because Blender has another working directory.
    return Rendering(scene.absolute(), (output / RENDERS).absolute(), views, **rendering, seed=seed)


def cube_faces(request: Request, resolution: tuple[int, int] | None) -> dict[str, Any] | None:
    """Return the faces of a cube that a wide lens sees; None without such a lens.

    Args:
        request: a request with the lens.
        resolution: the size of a face in px; None matches the finest part of the picture.

    Raises:
        RequestError: a face is not square.
        ImageError: the lens is impossible.
    """
    projection = projection_of(request.chain()) if wide_lens_of(request.settings()) else None
    if projection is None:
        return None
    side, names = visible_faces(projection.lens)
    if resolution and resolution[0] != resolution[1]:
        raise RequestError(
            f"--resolution: found {resolution[0]}x{resolution[1]}, but a wide lens needs the faces "
            f"of a cube, which are square; use {side}x{side}, for example"
        )
    side = resolution[0] if resolution else side
    return {"side": side, "turns": {name: CUBE[name] for name in names}}


def check_chain(request: Request) -> None:
    """Check that a chain can be built for renders whose cameras are not known yet.

    Raises:
        RequestError: the chain cannot be built.
    """
    try:
        request.chain()
    except RequestError:
        try:
            request.for_image("", {"render": {"fx": 1000.0}}).chain()
            return  # only the focal length was missing, and the scene's cameras have one
        except RequestError:
            pass
        raise


def reject_options(allowed: Sequence[str], reason: str) -> None:
    """Reject options that apply only to other sources.

    Args:
        allowed: the options that apply to this one.
        reason: the sources that they apply to, and this one.

    Raises:
        RequestError: such an option is set.
    """
    for name, flag in options_on_command_line().items():
        if name in {*RENDER_OPTIONS, *LEAVES_OPTIONS} - {*allowed}:
            raise RequestError(f"{flag}: this option applies only to {reason}; remove it")


def develop(
    renders: Source,
    request: Request,
    output: Path,
    series: Series,
    selector: str | None,
    quiet: bool,
    attribution: Mapping[str, str],
    echo: Callable[[bytes], None] | None,
) -> Summary:
    """Develop each render when it is finished, then write the dataset's README and lists.

    Raises:
        ClpipeError: the run cannot continue.
    """
    jobs = renders.jobs() or ()
    images = Images(renders.inputs, poses=renders.poses, series=series, known_jobs=jobs)
    execution = ExecutionOptions(output, () if selector is None else (selector,))
    run = Run(request, images, execution, arguments=sys.argv[1:], echo=echo)
    reporter = Reporter(run, Console(stderr=True), quiet)
    show = (lambda text: None) if quiet else reporter.print

    if note := renders.about.get(NOTE):
        show(f"note: {note}")

    def stop() -> None:
        run.stop()
        renders.stop()

    outcomes = run.outcomes(renders.jobs_when_rendered(run.jobs, show))
    follow(run, outcomes, quiet, reporter, stop)
    if not run.summary.interrupted:
        unit = renders.about.get(UNIT, "as in the renders")
        about = CardContents(
            renders.about, attribution["licence"], attribution["author"], unit, sys.argv[1:]
        )
        written = write_card(output, RENDERS, about)
        show(f"wrote {', '.join(map(str, written))}")
    return run.summary
