"""The options of a run, each with its name, type, range and choices.

The options of ``clpipe run``, the checks of :func:`clpipe.run`, and the options that other commands
share are derived from these keys. The docstring of :func:`clpipe.run` describes them, also in the
help of commands.
"""

from pathlib import Path
from typing import Any, Literal, get_args

from clpipe.base.errors import RequestError
from clpipe.base.text import unknown_name
from clpipe.chain.formats import ALL_FORMATS, CLIP_FORMATS
from clpipe.chain.identity import MAX_FRAMES
from clpipe.chain.keys import CODE, KEYS, Key
from clpipe.chain.rendition import BASELINES, TRUTHS
from clpipe.images.pixels import MAX_PIXELS
from clpipe.images.video import Codec

Moments = Literal["start", "middle", "end", "all", "rows"]
Transfer = Literal["srgb", "linear"]
Gaps = Literal["hold", "black", "cut"]
RedoName = Literal["missing", "old", "damaged", "all"]

MAX_PATCHES = 9999  # patches per image; file names have four digits
DEFAULT_PATCHES = 16  # patches per image

_ALL = (
    Key("inputs", list, metavar="INPUT"),
    Key("config", list, metavar="NAME|FILE", heading="+Camera"),
    KEYS["camera"]._replace(type_=list, text=""),
    KEYS["iso"]._replace(type_=str, text="", metavar="ISO,...|LOW..HIGH"),
    Key("start_at", str, metavar="STAGE", heading="Chain"),
    Key("until", str, metavar="STAGE", heading="Chain"),
    KEYS[CODE],
    Key("output", Path, metavar="OUT", heading="+Pictures"),
    Key("format", list, choices=(*ALL_FORMATS, *CLIP_FORMATS), heading="+Pictures"),
    Key("keep", list, metavar="STAGE|all", heading="+Pictures"),
    Key("bracket", str, metavar="EV,EV,...", heading="Pictures"),
    Key("frames", int, metavar="N", above=0, most=MAX_FRAMES, heading="+Pictures"),
    Key("patch", int, metavar="SIZE", above=0, heading="+Pictures"),
    Key(
        "patches_per_image",
        int,
        "The number of patches at random places, or grid for adjacent patches that cover the "
        "picture.",
        "N|grid",
        f"{DEFAULT_PATCHES}",
        above=0,
        most=MAX_PATCHES,
        heading="Pictures",
    ),
    Key(
        "augment",
        bool,
        "Flip patches and rotate them by multiples of 90 degrees, at random. The CFA pattern "
        "stays the same.",
        heading="Pictures",
    ),
    Key("webdataset", int, metavar="N", above=0, most=10**6, heading="Pictures"),
    Key("codec", str, choices=get_args(Codec), heading="Clips"),
    Key("crf", int, metavar="N", above=-1, most=51, heading="Clips"),
    Key("bit_rate", str, metavar="RATE", heading="Clips"),
    Key("bit_depth", int, metavar="BITS", above=7, most=10, heading="Clips"),
    Key("fps", str, metavar="RATE", heading="Clips"),
    Key("gaps", str, choices=get_args(Gaps), heading="Clips"),
    Key("decoded", bool, heading="Clips"),
    Key("truth", list, choices=(*TRUTHS, *BASELINES), heading="+Truth"),
    Key("carry", list, metavar="NAME[:KIND][=FILE]", heading="+Truth"),
    Key("truth_at", str, choices=get_args(Moments), heading="Truth"),
    Key("sequence", bool, heading="+Inputs"),
    Key("poses", Path, metavar="FILE", heading="+Inputs"),
    Key("repeat", int, metavar="N", above=0, most=10**6, heading="+Inputs"),
    Key("exclude", list, metavar="GLOB", heading="+Inputs"),
    Key("layer", str, metavar="NAME", heading="Inputs"),
    Key("transfer", str, choices=get_args(Transfer), heading="Inputs"),
    Key("max_pixels", int, metavar="N", above=0, most=MAX_PIXELS, heading="Inputs"),
    Key("device", list, metavar="SEL", heading="+Batches"),
    Key("redo", str, choices=get_args(RedoName), heading="+Batches"),
    Key("jobs", int, metavar="N", above=0, most=1024, heading="Batches"),
    Key("processes", int, metavar="N", above=0, most=1024, heading="Batches"),
    Key("memory", str, metavar="SIZE", heading="Batches"),
    Key("shard", str, metavar="I/N", heading="Batches"),
    Key("dask", str, metavar="ADDRESS", heading="Batches"),
    Key("max_failures", str, metavar="N|N%", heading="Batches"),
    Key("trace", Path, metavar="FILE.json", heading="Batches"),
)
OPTIONS = {key.name: key for key in _ALL}


def check_option(name: str, value: Any) -> None:
    """Check that a value, which has the type of an option, is in its range or one of its choices.

    Raises:
        RequestError: it is not.
    """
    key = OPTIONS[name]
    if key.type_ is int and isinstance(value, int) and not key.allows(value):
        raise RequestError(f"found {name} {value}; expected {key.allowed}")
    for each in value if key.choices and key.type_ is list else ():
        if each not in key.choices:
            raise RequestError(unknown_name(name, each, key.choices))
