"""``clpipe demo``: develop the render that clpipe contains, to try an installation."""

import sys
from pathlib import Path

import click

from clpipe.batch.api import run_of
from clpipe.commands.chain_options import device_option
from clpipe.commands.options import Command, OutputPath, json_lines_option
from clpipe.commands.progress import follow, print_line

RENDER = Path(__file__).parents[1] / "scenes" / "still_life.exr"
ISOS = "100,3200,12800"


@click.command("demo", cls=Command)
@click.option(
    "-o",
    "--output",
    type=OutputPath(path_type=Path),
    default="demo",
    show_default=True,
    metavar="OUT",
    help="The directory of the pictures.",
)
@device_option
@json_lines_option
def demo(output: Path, selector: str | None, json_lines: bool) -> None:
    """Develop a small render that clpipe contains at three ISOs, to try an installation.

    \b
    clpipe demo
    """
    options = {"inputs": [str(RENDER)], "output": output, "iso": ISOS, "device": selector}
    batch = run_of(options, {}, sys.argv[1:], print_line if json_lines else None)
    follow(batch, batch.outcomes(batch.jobs), json_lines)
    if not json_lines:
        click.echo(f"\nLook at {output}/iso*/still_life.jpg. To develop your render, use:")
        click.echo("clpipe run render.exr -o out --iso 3200")
    sys.exit(batch.summary.exit_status)
