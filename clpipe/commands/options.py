"""Options that several commands share. Those that need the stages are in chain_options."""

from pathlib import Path

import click

from clpipe.images.dump import TYPES

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

raw_size_option = click.option(
    "--raw-size", metavar="WxH", help="Width and height of headerless dumps (.raw)."
)

raw_type_option = click.option(
    "--raw-type", type=click.Choice(list(TYPES)), help="How headerless dumps store a sample."
)
