"""``clpipe run``: images through the chain, on this machine or on a cluster."""

import sys
from pathlib import Path
from typing import Any, Literal

import click

from clpipe.base.errors import RequestError
from clpipe.base.extras import require
from clpipe.batch.api import MOST
from clpipe.batch.session import Images, Run
from clpipe.batch.where import Where
from clpipe.chain.rendition import BASELINES, TRUTHS, parse_bracket
from clpipe.chain.request import Request
from clpipe.commands.chain_options import (
    TRUTHS_HELP,
    carry_option,
    format_option,
    keep_option,
    patch_options,
    series_options,
    truth_at_option,
)
from clpipe.commands.input_options import (
    annotations_option,
    exclude_option,
    layer_option,
    max_pixels_option,
    poses_option,
    transfer_option,
)
from clpipe.commands.options import (
    GroupedCommand,
    dump_option,
    json_lines_option,
    memory_option,
    out_option,
    quiet_option,
)
from clpipe.commands.progress import follow, print_line
from clpipe.inputs.annotations import Annotations, parsed
from clpipe.inputs.bop import is_by_image, read_bop
from clpipe.inputs.coco import read_coco
from clpipe.inputs.find import Shard, parse_shard
from clpipe.inputs.kitti import read_kitti
from clpipe.inputs.series import Series, parse_isos
from clpipe.outputs.annotations import write_annotations
from clpipe.outputs.existing import Redo
from clpipe.outputs.patches import PER_IMAGE


@click.command("run", cls=GroupedCommand)
@click.argument("inputs", nargs=-1, metavar="INPUT...")
@out_option
@series_options
@format_option
@keep_option
@click.option(
    "--truth",
    multiple=True,
    type=click.Choice([*TRUTHS, *BASELINES]),
    help=f"{TRUTHS_HELP}, or the clean picture with independent noise of the same strength, equal "
    "everywhere (iid) or by intensity (intensity). iid and intensity come with the truths that "
    "they are made of. May be repeated.",
)
@carry_option
@truth_at_option
@click.option(
    "--frames",
    type=click.IntRange(1, MOST["frames"]),
    metavar="N",
    help="Make a burst of N frames of each image: each with its own noise, and their truth.",
)
@click.option(
    "--bracket",
    callback=lambda _context, _option, text: () if text is None else parse_bracket(text),
    metavar="EV,EV,...",
    help="Make an exposure of each image for each of these EVs, which are added to exposure.ev; "
    "each has its own noise, and its own frames and truths.",
)
@patch_options
@exclude_option
@poses_option
@annotations_option
@layer_option
@transfer_option
@dump_option
@max_pixels_option
@click.option(
    "--redo",
    type=click.Choice([each.value for each in Redo]),
    default=Redo.OLD.value,
    show_default=True,
    help="Make again pictures that are missing or asked for otherwise (missing), also those of "
    "another clpipe (old), also damaged ones (damaged), or all, even files of others (all). To "
    "find damaged ones, all files are read.",
)
@click.option(
    "--device",
    "selectors",
    multiple=True,
    metavar="SEL",
    help="An index or a part of a name from 'clpipe devices', or numpy; may be repeated. [default: "
    "the first GPU and all of its kind, else the CPU]",
)
@memory_option
@click.option(
    "--jobs",
    "threads",
    type=click.IntRange(1, MOST["jobs"]),
    metavar="N",
    help="Threads that decode, and as many that encode. [default: one for each processor]",
)
@click.option(
    "--processes",
    type=click.IntRange(1, MOST["processes"]),
    metavar="N",
    help="Processes that share the work, each with its part of the processors and devices. "
    "[default: as many as pay for the number and size of the images]",
)
@click.option(
    "--shard",
    default="1/1",
    metavar="I/N",
    callback=lambda _context, _option, text: parse_shard(text),
    help="Do only part I of N of the images, for job arrays.",
)
@click.option(
    "--webdataset",
    "per_tar",
    type=click.IntRange(1, MOST["webdataset"]),
    metavar="N",
    help="Pack N images at a time into OUT/000000.tar and so on, for WebDataset.",
)
@click.option(
    "--dask",
    metavar="ADDRESS",
    help="Run on the workers of a Dask scheduler (tcp://HOST:8786); they must see the same files.",
)
@quiet_option
@json_lines_option
@click.option(
    "--trace",
    type=click.Path(path_type=Path),
    metavar="FILE.json",
    help="Write a timeline of the run, for Perfetto or chrome://tracing.",
)
def run(
    inputs: tuple[str, ...],
    output: Path,
    cameras: tuple[str, ...],
    isos: str | None,
    exclude: tuple[str, ...],
    poses: Path | None,
    annotations: Path | None,
    redo: str,
    selectors: tuple[str, ...],
    memory: int | None,
    threads: int | None,
    processes: int | None,
    shard: Shard,
    per_tar: int | None,
    dask: str | None,
    quiet: bool,
    json_lines: bool,
    trace: Path | None,
    **options: Any,
) -> None:
    """Run images through the chain: files, folders, globs or manifests (.csv, .jsonl).

    Renders are linear float images (EXR). Camera raws enter behind the stages that add noise.

    Each image makes OUT/NAME.jpg and OUT/NAME.json, the sidecar with everything that was used. A
    second run makes only what is missing or has changed. OUT/run.jsonl is the log.

    \b
    clpipe run render.exr -o out --camera sony-a7r2 --iso 3200
    clpipe run renders/ -o out --truth clean --set denoise.luma_strength=2
    """
    series = Series(cameras, parse_isos(isos) if isos is not None else ())
    annotated = None
    if annotations is not None:
        annotated = read_annotations(annotations, per_tar, shard)
    patches = options["patch"], options["patches_per_image"], options["augment"]
    options["patches_per_image"] = patch_count(*patches)
    made = Run(
        Request.from_options(camera=series.camera, iso=series.iso, **options),
        Images(inputs, exclude, poses, series, shard, per_tar),
        Where(output, selectors, memory, threads, Redo(redo), trace, processes),
        dask,
        sys.argv[1:],
        print_line if json_lines else None,
    )
    if not made.jobs:
        click.echo(f"shard {shard.number} of {shard.of} has no images", err=True)
        return
    follow(made, made.outcomes(made.jobs), quiet or json_lines)
    if annotated and not made.summary.interrupted:
        for folder in series.under(output):
            for line in write_annotations(folder, annotated):
                click.echo(line, err=True)
    sys.exit(made.summary.exit_status)


def read_annotations(path: Path, per_tar: int | None, shard: Shard) -> Annotations:
    """The annotations of a run's renders.

    Raises:
        RequestError: they cannot be read, or the run has not all of its pictures in its folder.
    """
    require("--annotations", "pycocotools", "shapely")
    if per_tar or shard.of > 1:
        raise RequestError(
            "--annotations: they are written of all pictures of a folder; leave --webdataset and "
            "--shard out, or run once more without --shard when all parts are done"
        )
    if path.is_dir():
        return read_kitti(path)
    values = parsed(path)
    return read_bop(path) if is_by_image(values) else read_coco(path, values)


def patch_count(
    patch: int | None, per_image: int | Literal["grid"] | None, augment: bool
) -> int | Literal["grid"]:
    """How many patches of an image are made; 0 is none.

    Raises:
        RequestError: something is asked of patches, but there are none.
    """
    if patch is None and (per_image is not None or augment):
        option = "--augment" if augment else "--patches-per-image"
        raise RequestError(f"{option}: it is about patches; say --patch SIZE as well")
    return 0 if patch is None else per_image or PER_IMAGE
