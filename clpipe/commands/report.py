"""``clpipe report``: what a run made, as one HTML file to look at."""

import os
from pathlib import Path

import click

from clpipe.base.errors import RequestError
from clpipe.base.extras import require
from clpipe.base.files import write_new
from clpipe.commands.options import EXISTING, Command, json_option, output_option
from clpipe.commands.printing import show_json
from clpipe.commands.progress import told
from clpipe.outputs.existing import is_marked


@click.command("report", cls=Command)
@click.argument("folders", metavar="OUT [OUT2]", nargs=-1, required=True, type=EXISTING)
@output_option("FILE.html", "The file. [default: OUT/report.html]", required=False)
@json_option
def report(folders: tuple[Path, ...], output: Path | None, as_json: bool) -> None:
    """Look at a run: its figures, pictures, noise and settings, in one HTML file.

    OUT is the output folder of clpipe run, finished or not, with tars or without. The file opens
    from the disk in any browser, without a network: a contact sheet that filters, a slider between
    pictures and their truths with enlarged crops, noise against what was asked, the chain with its
    parameters, what was drawn, failures and warnings. Of two folders, the report compares the runs.

    \b
    clpipe report out
    clpipe report out other -o both.html
    """
    if len(folders) > 2:
        raise RequestError(f"found {len(folders)} folders; one is reported on, or two are compared")
    path = output or folders[0] / "report.html"
    if path.suffix != ".html":
        raise RequestError(f"-o: found {path}; expected a name that ends in .html")
    if os.path.lexists(path) and not is_marked(path):
        raise RequestError(
            f"{path}: clpipe did not write this file; move it, or name another with -o"
        )
    require("clpipe report", "jinja2", "matplotlib", "scipy")
    from clpipe.reports.page import html
    from clpipe.reports.run import read_run

    with told() as tell:
        tell("sidecars")
        page = html([read_run(folder) for folder in folders], tell).encode()
    size = write_new(path, page).size
    if as_json:
        show_json({"report": str(path), "bytes": size})
    else:
        click.echo(f"wrote {path} ({size / 2**20:.1f} MiB)")
