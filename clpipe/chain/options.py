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
    Key("output", Path, metavar="OUT"),
    Key("config", list, metavar="NAME|FILE"),
    KEYS["camera"]._replace(type_=list, text=""),
    KEYS["iso"]._replace(type_=str, text="", metavar="ISO,ISO,..."),
    Key("start_at", str, metavar="STAGE"),
    Key("until", str, metavar="STAGE"),
    KEYS[CODE],
    Key("format", list, choices=(*ALL_FORMATS, *CLIP_FORMATS)),
    Key("keep", list, metavar="STAGE|all"),
    Key("carry", list, metavar="NAME[:KIND][=FILE]"),
    Key("truth", list, choices=(*TRUTHS, *BASELINES)),
    Key("truth_at", str, choices=get_args(Moments)),
    Key("sequence", bool),
    Key("codec", str, choices=get_args(Codec)),
    Key("bit_depth", int, metavar="BITS", above=7, most=10),
    Key("crf", int, metavar="N", above=-1, most=51),
    Key("bit_rate", str, metavar="RATE"),
    Key("fps", str, metavar="RATE"),
    Key("gaps", str, choices=get_args(Gaps)),
    Key("decoded", bool),
    Key("frames", int, metavar="N", above=0, most=MAX_FRAMES),
    Key("bracket", str, metavar="EV,EV,..."),
    Key("patch", int, metavar="SIZE", above=0),
    Key(
        "patches_per_image",
        int,
        "The number of patches at random places, or grid for adjacent patches that cover the "
        "picture.",
        "N|grid",
        f"{DEFAULT_PATCHES}",
        above=0,
        most=MAX_PATCHES,
    ),
    Key(
        "augment",
        bool,
        "Flip patches and rotate them by multiples of 90 degrees, at random. The CFA pattern "
        "stays the same.",
    ),
    Key("exclude", list, metavar="GLOB"),
    Key("poses", Path, metavar="FILE"),
    Key("layer", str, metavar="NAME"),
    Key("transfer", str, choices=get_args(Transfer)),
    Key("max_pixels", int, metavar="N", above=0, most=MAX_PIXELS),
    Key("redo", str, choices=get_args(RedoName)),
    Key("webdataset", int, metavar="N", above=0, most=10**6),
    Key("max_failures", str, metavar="N|N%"),
    Key("shard", str, metavar="I/N"),
    Key("device", list, metavar="SEL"),
    Key("memory", str, metavar="SIZE"),
    Key("jobs", int, metavar="N", above=0, most=1024),
    Key("processes", int, metavar="N", above=0, most=1024),
    Key("dask", str, metavar="ADDRESS"),
    Key("trace", Path, metavar="FILE.json"),
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
