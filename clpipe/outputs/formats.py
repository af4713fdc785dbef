"""TODO."""

from dataclasses import dataclass

from clpipe.base.types import Array
from clpipe.engine.runner import Result
from clpipe.reference.curve import to_16_bit


@dataclass(frozen=True)
class Format:
    """A kind of file: how its name ends, and how many bits its samples have; floats or not."""

    ending: str
    bits: int
    floats: bool = False


FORMATS = {
    "jpg": Format("jpg", 8),
    "png": Format("png", 8),
    "png16": Format("png", 16),
    "tif": Format("tif", 8),
    "tif16": Format("tif", 16),
    "tif32": Format("tif", 32, floats=True),
    "exr": Format("exr", 32, floats=True),
    "exr16": Format("exr", 16, floats=True),
}


DNG = "dng"  # not of the last image, but of the raw


EVERY_FORMAT = (*FORMATS, DNG)


SIDECAR = "json"


def ending_of(format_: str) -> str:
    """How the name of a file of a format ends."""
    return DNG if format_ == DNG else FORMATS[format_].ending


def samples(result: Result, format_: Format) -> Array:
    """The last image as a format for display holds it."""
    if format_.bits == 8:
        assert result.encoded is not None
        return result.encoded
    assert result.final is not None
    return result.final if format_.floats else to_16_bit(result.final)
