"""Options that say which chain to run, and what of it to write."""

from collections.abc import Callable
from typing import Any

import click

from clpipe.base.errors import RequestError
from clpipe.base.text import whole_number
from clpipe.chain.files import built_in_configs
from clpipe.chain.formats import EVERY_FORMAT, format_named
from clpipe.chain.keys import KEYS
from clpipe.chain.request import DEFAULTS, MOMENTS, MOST_PATCHES
from clpipe.commands.completion import (
    cameras,
    configs,
    parameters,
    stage_lists,
    steps,
    steps_or_all,
)
from clpipe.commands.options import stage_file_option
from clpipe.outputs.patches import PER_IMAGE
from clpipe.reference.carried import RESAMPLING


def about(key: str) -> str:
    """What the value of a key is, with its unit."""
    text, unit = KEYS[key].text, KEYS[key].unit
    return f"{text} In {unit}." if unit else text


camera_option = click.option(
    "--camera",
    metavar="NAME|FILE",
    shell_complete=cameras,
    help=f"A built-in camera, by name or model, or a profile (.toml). [default: {DEFAULTS.camera}]",
)

iso_option = click.option(
    "--iso",
    type=float,
    help=f"The ISO; noise and denoising follow from it. [default: {DEFAULTS.iso:g}]",
)

config_option = click.option(
    "-c",
    "--config",
    multiple=True,
    metavar="NAME|FILE",
    shell_complete=configs,
    help="A configuration, or several: "
    f"{', '.join(built_in_configs())}, or a TOML file. Each lies over those before "
    "it: of one with stages, the development goes behind their raw.",
)

set_option = click.option(
    "--set",
    "assignments",
    multiple=True,
    metavar="STAGE.PARAM=VALUE",
    shell_complete=parameters,
    help="Set a parameter; may be repeated. STAGE.method=NAME chooses a method; "
    "'{uniform=[1, 2]}' as the value draws one for each image.",
)

_SERIES_OPTIONS = (
    click.option(
        "--camera",
        "cameras",
        multiple=True,
        metavar="NAME|FILE",
        shell_complete=cameras,
        help="A built-in camera, by name or model, or a profile (.toml); several go to folders of "
        f"their own, OUT/CAMERA/NAME.jpg. [default: {DEFAULTS.camera}]",
    ),
    click.option(
        "--iso",
        "isos",
        metavar="ISO,ISO,...",
        help="The ISO; noise and denoising follow from it. Several go to folders of their own, "
        f"OUT/iso800/NAME.jpg. [default: {DEFAULTS.iso:g}]",
    ),
)

_CHAIN_OPTIONS = (
    click.option(
        "--lens",
        metavar="NAME",
        help=f"{about('lens')} [default: none]",
    ),
    click.option("--focal-length", type=float, help=about("focal_length")),
    click.option("--aperture", type=float, help=about("aperture")),
    click.option("--focus-distance", type=float, help=about("focus_distance")),
    click.option("--seed", type=int, help=f"{about('seed')} [default: {DEFAULTS.seed}]"),
    click.option("--noise-key", metavar="TEXT", help=about("noise_key")),
    set_option,
    click.option(
        "--stages",
        metavar="A,B,C",
        shell_complete=stage_lists,
        help="The stages to run, in order, in place of the default chain.",
    ),
    click.option(
        "--skip",
        multiple=True,
        metavar="STAGE",
        shell_complete=steps,
        help="Leave a stage out, or 'noise': that of all stages, while denoising and the rest stay "
        "as at that ISO; may be repeated.",
    ),
    click.option(
        "--start-at",
        metavar="STAGE",
        shell_complete=steps,
        help="The first stage to run, on kept images or mosaics.",
    ),
    click.option("--until", metavar="STAGE", shell_complete=steps, help="The last stage to run."),
    stage_file_option,
)


def chain_options(function: Callable[..., Any]) -> Callable[..., Any]:
    """The options that say which chain to run."""
    return _with(function, config_option, camera_option, iso_option, *_CHAIN_OPTIONS)


def series_options(function: Callable[..., Any]) -> Callable[..., Any]:
    """The options that say which chains to run, of several cameras and ISOs."""
    return _with(function, config_option, *_SERIES_OPTIONS, *_CHAIN_OPTIONS)


def _with(function: Callable[..., Any], *options: Callable[..., Any]) -> Callable[..., Any]:
    for option in reversed(options):
        function = option(function)
    return function


keep_option = click.option(
    "--keep",
    multiple=True,
    metavar="STAGE|all",
    shell_complete=steps_or_all,
    help="Write the image of a stage, too; as float EXR. May be repeated.",
)

_PATCH_OPTIONS = (
    click.option(
        "--patch",
        type=click.IntRange(1),
        metavar="SIZE",
        help="Write patches of SIZE px a side in place of pictures: OUT/NAME_0000.jpg and so on, "
        "with the bits that the picture has there. Images of --keep are .npy.",
    ),
    click.option(
        "--patches-per-image",
        callback=lambda _context, _option, text: None if text is None else patch_count(text),
        metavar="N|grid",
        help="How many, at random places, or all side by side that cover the picture. "
        f"[default: {PER_IMAGE}]",
    ),
    click.option(
        "--augment",
        is_flag=True,
        help="Flip patches and turn them by 90 degrees, at random; the CFA pattern stays.",
    ),
)


def patch_options(function: Callable[..., Any]) -> Callable[..., Any]:
    """The options that say which patches are written."""
    return _with(function, *_PATCH_OPTIONS)


def patch_count(text: str) -> int | str:
    """How many patches of an image: a number, or "grid".

    Raises:
        RequestError: it is neither.
    """
    if text == "grid":
        return text
    if 0 < (count := whole_number(text)) <= MOST_PATCHES:
        return count
    raise RequestError(
        f"--patches-per-image: found {text!r}; expected 1 to {MOST_PATCHES}, or grid"
    )


carry_option = click.option(
    "--carry",
    multiple=True,
    metavar="NAME[:KIND][=FILE]",
    help="Move a layer as the picture's pixels are moved. It goes to OUT/NAME.carried.exr: "
    "depth, normals, flow, object numbers, of the image's own file or of one beside it. KIND is "
    f"{', '.join(RESAMPLING)}, where its name does not say it, or png: depth in metres, which goes "
    "to OUT/NAME.LAYER.png, too, with 16 bits, in millimetres, or object numbers. FILE is where it "
    "is, as '../depth/{name}.exr', from the image's folder. [default: {name}_LAYER.exr or alike] "
    "May be repeated.",
)

TRUTHS_HELP = (
    "Write next to each picture the same without noise (development), without noise and denoising "
    "(clean), the mosaic without noise (mosaic), the variance of the mosaic's noise (variance)"
)

truth_at_option = click.option(
    "--truth-at",
    type=click.Choice(MOMENTS),
    default="middle",
    show_default=True,
    help="Of an exposure of several files (shutter.subframes), whose pose and carried layers go "
    "with the picture; all has the layers of its start and end, too.",
)


class FormatName(click.Choice[str]):
    """A format by any of its names."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> str:
        return super().convert(format_named(value), param, ctx)


format_option = click.option(
    "--format",
    "formats",
    multiple=True,
    type=FormatName(EVERY_FORMAT),
    help="The format of the last image, or dng for the raw that quantize makes; may be repeated. "
    "npy holds float16, DN as uint16, and makes those of --keep .npy, too. "
    "[default: jpg; exr, or npy of patches, where --until ends the chain earlier]",
)
