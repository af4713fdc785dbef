"""``clpipe report``: write a report of a run as one HTML file."""

import os
from pathlib import Path

import click

from clpipe.base.errors import RequestError
from clpipe.base.extras import require
from clpipe.base.files import check_suffix, write_new
from clpipe.commands.options import EXISTING, Command, json_option, output_option
from clpipe.commands.printing import show_json
from clpipe.commands.progress import status_line
from clpipe.outputs.existing import is_marked


@click.command("report", cls=Command)
@click.argument("folders", metavar="OUT [OUT2]", nargs=-1, required=True, type=EXISTING)
@output_option("FILE.html", "The report to write. [default: OUT/report.html]", required=False)
@json_option
def report(folders: tuple[Path, ...], output: Path | None, as_json: bool) -> None:
    """Report on a run: its figures, pictures, noise and settings, in one HTML file.

    OUT is the output directory of clpipe run, finished or not, with or without tars. The file opens
    in any browser, without a network. It has a contact sheet with filters, a slider between
    pictures and their ground truth with enlarged crops, and measured and requested noise. It also
    has the chain with its parameters, drawn values, failures and warnings. To compare two runs,
    name both directories.

    \b
    clpipe report out
    clpipe report out other -o both.html
    """
    if len(folders) > 2:
        raise RequestError(
            f"found {len(folders)} directories; name one for a report, or two to compare them"
        )
    path = output or folders[0] / "report.html"
    check_suffix("-o", path, ".html")
    if os.path.lexists(path) and not is_marked(path):
        raise RequestError(
            f"{path}: clpipe did not write this file, so it is not overwritten; move it, or name "
            "another file with -o"
        )
    require("clpipe report", "report")
    from clpipe.reports.page import html
    from clpipe.reports.run import read_run

    with status_line() as show:
        show("sidecars")
        page = html([read_run(folder) for folder in folders], show).encode()
    size = write_new(path, page).size
    if as_json:
        show_json({"report": str(path), "bytes": size})
    else:
        click.echo(f"wrote {path} ({size / 2**20:.1f} MiB)")
