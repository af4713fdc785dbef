"""Options that several commands share. Those that need the stages are in chain_options."""

from pathlib import Path

import click

json_option = click.option("--json", "as_json", is_flag=True, help="Print JSON.")

device_option = click.option(
    "--device",
    "selector",
    metavar="SEL",
    help="An index or a part of a name from 'clpipe devices', or numpy.",
)

stage_file_option = click.option(
    "--stage-file",
    "stage_files",
    multiple=True,
    type=click.Path(path_type=Path),
    metavar="FILE.py",
    help="Load a stage of your own; may be repeated.",
)
