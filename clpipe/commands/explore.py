"""``clpipe explore``: a page on which a camera is tried on renders."""

import os
from pathlib import Path
from typing import Any

import click

from clpipe.base.errors import ImageError, RequestError
from clpipe.base.extras import require
from clpipe.chain.keys import KEYS
from clpipe.commands.chain_options import chain_options, device_option, options, request_of
from clpipe.commands.options import Command, json_option
from clpipe.commands.printing import show_json
from clpipe.engine.device import open_device
from clpipe.inputs.find import find_jobs
from clpipe.inputs.lenses import lens_notes
from clpipe.inputs.loader import ImageLoader


@click.command("explore", cls=Command)
@click.argument("inputs", nargs=-1, required=True, metavar="RENDER...")
@chain_options
@options(KEYS["dump"], "transfer", "layer", "max_pixels")
@device_option
@json_option
@click.option(
    "--port",
    type=click.IntRange(1, 65535),
    metavar="N",
    help="The port of the page, to be forwarded from another machine. [default: a free one]",
)
def explore(
    inputs: tuple[str, ...],
    selector: str | None,
    as_json: bool,
    port: int | None,
    **chosen: Any,
) -> None:
    """Try a camera on renders: a page on this machine, developed live as settings change.

    It has a control for every parameter of every stage, and shows any stage, pixel values, the
    histogram, the noise of a part, the time of each launch, and another setting or the clean
    picture beside. What is found is saved as a configuration, or copied as a command; both give the
    same picture. Only this machine can open the page, and only by the address that is printed.

    \b
    clpipe explore render.exr
    clpipe explore renders/ --iso 3200 -c paper
    """
    require("clpipe explore", "starlette", "uvicorn", "matplotlib")
    from clpipe.explorer.explorer import Explorer
    from clpipe.explorer.server import Server

    request = request_of(chosen)
    loader = ImageLoader(request)
    jobs = loader.exposures(find_jobs(inputs, Path(os.devnull), loader.endings()))
    loader.first_chain(jobs)  # a wrong request is refused here
    explorer = Explorer(jobs, request, open_device(selector))
    for note in lens_notes(loader.settings, jobs):
        click.echo(f"clpipe: {note}", err=True)
    try:
        explorer.check()
    except ImageError as error:
        raise RequestError(
            f"{error}. clpipe explore takes what clpipe run takes: linear renders, camera raws, "
            "and photographs with -c unprocess"
        ) from None
    server = Server(explorer, port or 0)
    if as_json:
        show_json({"address": server.address, "images": len(jobs)})
    else:
        click.echo(f"{explorer.label}: open {server.address} in a browser; Ctrl-C ends")
    server.run()
