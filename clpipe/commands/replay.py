"""``clpipe replay``: recompute a picture from its sidecar, and compare it."""

import sys
from pathlib import Path

import click

from clpipe.base.errors import ImageError, RequestError
from clpipe.batch.execution import ExecutionOptions
from clpipe.batch.images import Images
from clpipe.batch.replay import replay_of
from clpipe.batch.session import Run
from clpipe.chain.keys import CODE
from clpipe.commands.chain_options import device_option, options, out_option
from clpipe.commands.options import EXISTING, Command, json_option, quiet_option
from clpipe.commands.printing import show_json
from clpipe.commands.progress import follow


@click.command("replay", cls=Command)
@click.argument("sidecar", type=EXISTING, metavar="SIDECAR")
@click.argument("image", required=False, type=EXISTING, metavar="[INPUT]")
@out_option
@device_option
@options(CODE, "memory", "max_pixels")
@quiet_option
@json_option
def replay(
    sidecar: Path,
    image: Path | None,
    output: Path,
    stage_files: tuple[Path, ...],
    selector: str | None,
    memory: int | None,
    max_pixels: int | None,
    quiet: bool,
    as_json: bool,
) -> None:
    """Recompute a sidecar's picture and compare it byte for byte, or say what has changed.

    If the picture's input was moved, name it as INPUT. Other files that were used, such as a camera
    profile or a curve, must be unchanged. A stage file that the sidecar names runs only if you also
    name it with --stage-file.

    The exit status is 0 if the bytes are the same.

    \b
    clpipe replay out/render.json -o again
    """
    original = replay_of(sidecar, [image] if image else [], max_pixels, stage_files)
    selectors = () if selector is None else (selector,)
    execution = ExecutionOptions(output, selectors, memory)
    try:
        run = Run(
            original.request, Images(known_jobs=[original.job]), execution, arguments=sys.argv[1:]
        )
    except RequestError as error:
        raise RequestError(f"{sidecar}: {error}") from None
    follow(run, run.outcomes(run.jobs), quiet or as_json)
    if run.summary.exit_status:
        sys.exit(run.summary.exit_status)
    (rendition,) = run.writer.renditions_of(original.job)
    files = run.writer.files(original.job, rendition)
    try:
        same, text = original.comparison(files.sidecar)
    except ImageError as error:
        raise RequestError(str(error)) from None
    picture = files.pictures[0]
    if as_json:
        show_json({"picture": str(picture), "same": same, "text": text})
    else:
        click.echo(f"{picture}: {text}", err=True)
    sys.exit(0 if same else 1)
