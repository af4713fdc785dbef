"""``clpipe status``: show the progress of a run."""

import sys

import click

from clpipe.base.errors import RequestError
from clpipe.commands.options import Command, json_option
from clpipe.commands.printing import show_json


@click.command("status", cls=Command)
@click.argument("place", metavar="OUT|URL")
@json_option
def status(place: str, as_json: bool) -> None:
    """Show the progress of a run: its images, tars, failures and shards, from its logs.

    OUT is the output directory of clpipe run, or its URL. The run may be in progress, on any
    machine. The log of a run in a bucket is up to a minute old. The exit status is 0 if all images
    are done, else 1.

    \b
    clpipe status out
    clpipe status s3://sets/shot1
    """
    from clpipe.reports.status import part_text, read_status

    found = read_status(place)
    if not found.parts:
        raise RequestError(f"{place}: there is no log of a run; name the output of clpipe run")
    images, tars, errors = found.counts(), found.tar_counts(), found.errors()
    median, slow = found.slow_tars()
    if as_json:
        values = {"images": images, "tars": tars, "errors": errors, "slow_tars": slow}
        values["shards"] = {part: dict(each.start) for part, each in found.parts.items()}
        show_json({**values, "complete": found.is_complete})
    else:
        classes = ", ".join(f"{count} {name}" for name, count in errors.most_common())
        failed = f"{images['failed']} failed{f' ({classes})' * bool(classes)}"
        click.echo(f"{images['done']} of {images['images']} images done, {failed}")
        if tars["tars"]:
            done = f"{tars['done']} of {tars['tars']} tars done"
            click.echo(f"{done}, {tars['failed']} with failed images, {tars['missing']} missing")
        for name, seconds in slow.items():
            click.echo(f"slow: {name} took {seconds:.0f} s of work; the median is {median:.0f} s")
        for part, session in found.parts.items():
            click.echo(part_text(part, session))
        if missing := found.missing_shards():
            click.echo(f"{missing} shards have not begun")
    sys.exit(0 if found.is_complete else 1)
