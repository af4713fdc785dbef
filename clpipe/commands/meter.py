"""``clpipe meter``: meter a sequence's auto exposure, smoothed over time, for a manifest."""

import os
from pathlib import Path
from typing import Any

import click

from clpipe.analysis.metering import check_request, exposures, to_meter, write_exposures
from clpipe.base.errors import RequestError
from clpipe.base.text import printable
from clpipe.chain.keys import CODE
from clpipe.commands.chain_options import device_option, options, request_of, set_option
from clpipe.commands.options import Command, json_option, output_option
from clpipe.commands.printing import show_json
from clpipe.engine.device import open_device
from clpipe.inputs.find import find_jobs
from clpipe.inputs.loader import ImageLoader


@click.command("meter", cls=Command)
@click.argument("frames", nargs=-1, required=True, metavar="FRAMES...")
@output_option("EXPOSURES.csv", "The manifest to write.")
@click.option(
    "--smooth",
    default=8.0,
    show_default=True,
    type=click.FloatRange(0, 1e6),
    metavar="FRAMES",
    help="The time constant of the smoothing, after which the exposure still lacks 1/e of a change "
    "of light. 0 disables smoothing.",
)
@options("config", CODE, "transfer", "layer", "max_pixels", "exclude")
@set_option
@device_option
@json_option
def meter(
    frames: tuple[str, ...],
    output: Path,
    smooth: float,
    assignments: tuple[str, ...],
    exclude: tuple[str, ...],
    selector: str | None,
    as_json: bool,
    **options: Any,
) -> None:
    """Meter the frames of a sequence, and write their exposures as a manifest for clpipe run.

    FRAMES are renders in order of time: files, directories, globs or manifests. Each is metered
    like with exposure.method=auto. Set its parameters with --set exposure.NAME=VALUE. The EVs are
    then smoothed, separately for each directory. A run of the manifest may process frames in any
    order, or recompute a single frame.

    \b
    clpipe meter renders/ -o exposures.csv --set exposure.metering=centre_weighted
    clpipe run exposures.csv -o out --iso 1600
    """
    if output.suffix.lower() != ".csv":
        raise RequestError(f"--output: found {output}; expected a name that ends in .csv")
    if any(os.path.realpath(frame) == os.path.realpath(output) for frame in frames):
        raise RequestError(
            f"--output: found {output}, but this file is an input; choose another name"
        )
    metering = ("exposure.method=auto", *assignments)
    request = request_of({"assignments": metering, "until": "exposure", **options})
    loader = ImageLoader(request)
    jobs = to_meter(
        loader.exposures(find_jobs(frames, Path(os.devnull), loader.endings(), exclude))
    )
    check_request(loader, jobs)
    metered = []
    for frame in exposures(loader, jobs, open_device(selector), smooth):
        metered.append(frame)
        if not as_json:
            name = printable(frame.job.input)
            click.echo(f"{name}  metered {frame.metered:+.2f} EV, exposed {frame.ev:+.2f} EV")
    write_exposures(output, metered)
    if as_json:
        frame_records = [
            {"frame": frame.job.input, "metered_ev": frame.metered, "ev": frame.ev}
            for frame in metered
        ]
        show_json({"manifest": str(output), "frames": frame_records})
    else:
        click.echo(f"wrote {output}")
