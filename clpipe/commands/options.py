"""TODO."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import click

from clpipe.chain.files import built_in_configs
from clpipe.chain.formats import EVERY_FORMAT
from clpipe.chain.request import DEFAULTS

stage_file_option = click.option(
    "--stage-file",
    "stage_files",
    multiple=True,
    type=click.Path(path_type=Path),
    metavar="FILE.py",
    help="Load a stage of your own; may be repeated.",
)


camera_option = click.option(
    "--camera",
    metavar="NAME|FILE",
    help=f"A built-in camera or a profile (.toml). [default: {DEFAULTS.camera}]",
)


iso_option = click.option(
    "--iso",
    type=float,
    help=f"The ISO; it sets noise and denoising. [default: {DEFAULTS.iso:g}]",
)


def chain_options(function: Callable[..., Any]) -> Callable[..., Any]:
    """The options that say what chain to run."""
    options = [
        click.option(
            "-c",
            "--config",
            metavar="NAME|FILE",
            help=f"Settings: {' or '.join(built_in_configs())}, or a TOML file.",
        ),
        camera_option,
        iso_option,
        click.option("--seed", type=int, help=f"The seed of the noise. [default: {DEFAULTS.seed}]"),
        click.option(
            "--set",
            "assignments",
            multiple=True,
            metavar="STAGE.PARAM=VALUE",
            help="Set a parameter; may be repeated. STAGE.method=NAME chooses a method. "
            "'{uniform=[1, 2]}' draws a value for each image.",
        ),
        click.option(
            "--stages",
            metavar="A,B,C",
            help="The stages to run, in order, instead of the default chain.",
        ),
        click.option(
            "--skip", multiple=True, metavar="STAGE", help="Leave a stage out; may be repeated."
        ),
        click.option("--start-at", metavar="STAGE", help="Enter here, with kept images, mosaics."),
        click.option("--until", metavar="STAGE", help="Leave the chain after this stage."),
        stage_file_option,
    ]
    for option in reversed(options):
        function = option(function)
    return function


device_option = click.option(
    "--device",
    "selector",
    metavar="SEL",
    help="An index or a part of a name from 'clpipe devices', or numpy.",
)


keep_option = click.option(
    "--keep",
    multiple=True,
    metavar="STAGE|all",
    help="Write a stage's image too, as float EXR; may be repeated.",
)


format_option = click.option(
    "--format",
    "formats",
    multiple=True,
    type=click.Choice(EVERY_FORMAT),
    help="Of the last image (dng: of the raw, as quantize makes it); may be repeated. "
    "[default: jpg; exr where --until cuts it off]",
)


json_option = click.option("--json", "as_json", is_flag=True, help="Print JSON.")
