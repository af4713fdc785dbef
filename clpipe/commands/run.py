"""``clpipe run``: run images through the chain, on this machine or on a cluster."""

import sys
from pathlib import Path
from typing import Any

import click

from clpipe.base.errors import RequestError
from clpipe.base.extras import require
from clpipe.base.memory import format_bytes
from clpipe.base.text import format_duration
from clpipe.batch.api import run_of
from clpipe.batch.dry_run import plan_of
from clpipe.batch.images import Images
from clpipe.batch.session import Run
from clpipe.chain.keys import KEYS
from clpipe.chain.options import OPTIONS
from clpipe.commands.chain_options import SETTINGS, options, out_option, set_option, settings_in
from clpipe.commands.options import (
    EXISTING,
    GroupedCommand,
    Option,
    json_lines_option,
    quiet_option,
)
from clpipe.commands.progress import follow, print_line
from clpipe.inputs.annotations import Annotations, read_json
from clpipe.inputs.bop import is_by_image, read_bop
from clpipe.inputs.coco import read_coco
from clpipe.inputs.kitti import read_kitti
from clpipe.outputs.annotations import write_annotations

RUN_OPTIONS = [name for name in OPTIONS if name not in ("inputs", "output")]


@click.command("run", cls=GroupedCommand)
@click.argument("inputs", nargs=-1, metavar="INPUT...")
@out_option
@set_option
@options(*RUN_OPTIONS, *SETTINGS, KEYS["dump"])
@click.option(
    "--annotations",
    cls=Option,
    heading="+Inputs",
    type=EXISTING,
    metavar="PATH",
    help="Annotations of renders in the format of COCO, BOP or KITTI: COCO's JSON file, a "
    "scene_gt.json, or a directory of labels. They are warped like the pixels, by distortion, "
    "resizing and patches, and written to OUT.",
)
@click.option(
    "--dry-run",
    is_flag=True,
    help="Write nothing. Show how many images exist, and how long the others would take on this "
    "machine. A few are developed in a temporary directory.",
)
@click.option(
    "--metrics",
    type=click.Path(path_type=Path, dir_okay=False),
    metavar="FILE.prom",
    help="A file for the counts of the run, in the text format of Prometheus. It is replaced every "
    "10 s.",
)
@quiet_option
@json_lines_option
def run(
    annotations: Path | None,
    dry_run: bool,
    metrics: Path | None,
    quiet: bool,
    json_lines: bool,
    **options: Any,
) -> None:
    """Run images through the chain: files, folders, globs or manifests (.csv, .jsonl).

    Renders are linear float images (EXR). Camera raws skip the stages that add noise.

    For each image, OUT/NAME.jpg and OUT/NAME.json are written. The latter, the sidecar, contains
    all settings. A second run makes only pictures that are missing or have changed. OUT/run.jsonl
    is the log.

    \b
    clpipe run render.exr -o out --camera sony-a7r2 --iso 3200
    clpipe run renders/ -o out --truth clean --set denoise.luma_strength=2
    """
    settings = settings_in(options)
    batch = run_of(options, settings, sys.argv[1:], print_line if json_lines else None)
    if not batch.jobs:
        shard = batch.images.shard
        click.echo(f"shard {shard.number} of {shard.of} has no images", err=True)
        return
    if dry_run:
        show_plan(batch)
        return
    render_annotations = read_annotations(annotations, batch.images) if annotations else None
    follow(batch, batch.outcomes(batch.jobs), quiet or json_lines, metrics=metrics)
    if render_annotations and not batch.summary.interrupted:
        for folder in batch.images.series.folders_in(batch.execution.output):
            for line in write_annotations(folder, render_annotations):
                click.echo(line, err=True)
    sys.exit(batch.summary.exit_status)


def show_plan(batch: Run) -> None:
    """Print what a run would do."""
    plan = plan_of(batch)
    missing = plan.images - plan.existing
    click.echo(f"{plan.images} images: {plan.existing} exist, {missing} would be made")
    if missing:
        size, output = format_bytes(plan.input_bytes), format_bytes(plan.output_bytes)
        click.echo(f"input: {size}, about {plan.megapixels:.3g} megapixels")
        click.echo(f"output: about {output}, not counting tars")
        click.echo(f"time: about {format_duration(plan.seconds)} on this machine")
    for error in plan.errors:
        click.echo(f"clpipe: {error}", err=True)


def read_annotations(path: Path, images: Images) -> Annotations:
    """Return the annotations of a run's renders.

    Raises:
        RequestError: they cannot be read, or the run does not write all pictures as files.
    """
    require("--annotations", "annotations")
    if not images.is_whole:
        raise RequestError(
            "--annotations: this option applies only to all pictures of a directory; run "
            "again without --webdataset and --shard after all parts are done"
        )
    if path.is_dir():
        return read_kitti(path)
    values = read_json(path)
    return read_bop(path) if is_by_image(values) else read_coco(path, values)
