"""``clpipe meter``: meter sequences as a camera's control loops do, for a manifest."""

import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import click

from clpipe.base.errors import ImageError, RequestError
from clpipe.base.text import printable
from clpipe.chain.keys import CODE
from clpipe.commands.chain_options import device_option, options, request_of, set_option
from clpipe.commands.options import Command, json_option, output_option
from clpipe.commands.printing import show_json
from clpipe.engine.device import open_device
from clpipe.inputs.find import Job, find_jobs
from clpipe.inputs.loader import ImageLoader
from clpipe.inputs.metering import metered_jobs, write_exposures
from clpipe.inputs.sequences import in_sequences
from clpipe.stages.exposure.auto import Auto

EXPOSURE = "exposure"


@click.command("meter", cls=Command)
@click.argument("frames", nargs=-1, required=True, metavar="FRAMES...")
@output_option("EXPOSURES.csv", "The manifest to write.")
@options("config", CODE, "transfer", "layer", "max_pixels", "exclude")
@set_option
@device_option
@json_option
def meter(
    frames: tuple[str, ...],
    output: Path,
    assignments: tuple[str, ...],
    exclude: tuple[str, ...],
    selector: str | None,
    as_json: bool,
    **options: Any,
) -> None:
    """Meter the frames of sequences, and write their settings as a manifest for clpipe run.

    FRAMES are renders: files, directories, globs or manifests. The frames of each directory are a
    sequence, in the order of the numbers in their names. Exposure is metered like with
    exposure.method=auto. Set its parameters with --set exposure.NAME=VALUE, and those of the loops
    that follow it with --set control.NAME=VALUE. An estimated white balance is followed as well. A
    run of the manifest may process frames in any order, or recompute a single frame. To meter and
    run in one step, use clpipe run --sequence.

    \b
    clpipe meter renders/ -o exposures.csv --set control.smoothing=12
    clpipe run exposures.csv -o out --iso 1600
    """
    if output.suffix.lower() != ".csv":
        raise RequestError(f"--output: found {output}; expected a name that ends in .csv")
    if any(os.path.realpath(frame) == os.path.realpath(output) for frame in frames):
        raise RequestError(
            f"--output: found {output}, but this file is an input; choose another name"
        )
    request = request_of({"assignments": ("exposure.method=auto", *assignments), **options})
    loader = ImageLoader(request)
    found = loader.exposures(find_jobs(frames, Path(os.devnull), loader.endings(), exclude))
    jobs = in_sequences([without_exposure(job) for job in found])
    check_request(loader, jobs)
    metered: list[Job] = []
    records = []
    for job, reading in metered_jobs(loader, jobs, lambda: open_device(selector)):
        if error := reading.error:
            raise ImageError(loader.error_text(job, error)) from None
        metered.append(job)
        ev = job.values[EXPOSURE]["ev"]
        records.append({"frame": job.input, **reading.metered, "ev": ev})
        if not as_json:
            found_ev = reading.metered["metered_ev"]
            click.echo(f"{printable(job.input)}  metered {found_ev:+.2f} EV, exposed {ev:+.2f} EV")
    write_exposures(output, metered)
    if as_json:
        show_json({"manifest": str(output), "frames": records})
    else:
        click.echo(f"wrote {output}")


def without_exposure(job: Job) -> Job:
    """Return a job without the exposure in its manifest."""
    values = {key: value for key, value in job.values.items() if key != EXPOSURE}
    return replace(job, values=values)


def check_request(loader: ImageLoader, jobs: Sequence[Job]) -> None:
    """Check that frames can be metered.

    Raises:
        RequestError: a frame is a camera raw, a row of a manifest is wrong, or the chain does not
            use ``exposure.method=auto``.
    """
    for job in jobs:
        if loader.raw.is_raw(job.path):
            raise RequestError(
                f"{job.label}: this is a raw, and its exposure is fixed; give renders"
            )
    loader.check(jobs)
    for each in {id(one): one for one in map(loader.for_job, jobs)}.values():
        method = each.chain.step_named(EXPOSURE).method
        if not isinstance(method, Auto):
            raise RequestError(
                f"exposure.method: found {method.method}, but only auto measures the "
                "exposure; remove this setting"
            )
