"""``clpipe explore``: try a camera on renders, on a page in the browser."""

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
    help="The TCP port that serves the page. Set it to forward the port through SSH, for example. "
    "[default: a free port]",
)
def explore(
    inputs: tuple[str, ...], selector: str | None, as_json: bool, port: int | None, **chosen: Any
) -> None:
    """Try a camera on renders, on a page in the browser that updates as you change settings.

    The page has a control for every parameter of every stage. It shows the image of any stage,
    pixel values, the histogram, the noise of a region and the time of each launch. You can compare
    the picture with other settings or with the clean picture. Save the settings as a configuration,
    or copy them as a command. Both give the same picture. Only this machine can open the page, at
    the printed address.

    \b
    clpipe explore render.exr
    clpipe explore renders/ --iso 3200 -c paper
    """
    require("clpipe explore", "explore")
    from clpipe.explorer.explorer import Explorer
    from clpipe.explorer.server import Server

    request = request_of(chosen)
    loader = ImageLoader(request)
    jobs = loader.exposures(find_jobs(inputs, Path(os.devnull), loader.endings()))
    loader.first_chain(jobs)  # rejects a wrong request
    explorer = Explorer(jobs, request, open_device(selector))
    for note in lens_notes(loader.settings, jobs):
        click.echo(f"clpipe: {note}", err=True)
    try:
        explorer.check()
    except ImageError as error:
        raise RequestError(
            f"{error}. clpipe explore reads the same inputs as clpipe run: linear renders, camera "
            "raws, and photographs with -c unprocess"
        ) from None
    server = Server(explorer, port or 0)
    if as_json:
        show_json({"address": server.address, "images": len(jobs)})
    else:
        click.echo(f"{explorer.label}: open {server.address} in a browser; press Ctrl-C to stop")
    server.run()
