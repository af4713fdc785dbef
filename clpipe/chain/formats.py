"""The file formats that can be asked for."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Format:
    """A kind of file: the ending of its name, the bits of a sample, and whether it is a float."""

    ending: str
    bits: int
    floats: bool = False


FORMATS = {  # of the last image
    "jpg": Format("jpg", 8),
    "png": Format("png", 8),
    "png16": Format("png", 16),
    "tif": Format("tif", 8),
    "tif16": Format("tif", 16),
    "tif32": Format("tif", 32, floats=True),
    "exr": Format("exr", 32, floats=True),
    "exr16": Format("exr", 16, floats=True),
    "npy": Format("npy", 16, floats=True),
}

NPY = "npy"  # of NumPy: of images of steps, too
DNG = "dng"  # of the raw

EVERY_FORMAT = (*FORMATS, DNG)

# What else formats are called.
OTHER_NAMES = {"jpeg": "jpg", "tiff": "tif", "tiff16": "tif16", "tiff32": "tif32"}


def format_named(text: str) -> str:
    """The format of a name, however it is spelt; the text itself where there is none.

    >>> format_named("JPEG"), format_named("tiff16"), format_named("webp")
    ('jpg', 'tif16', 'webp')
    """
    name = text.lower().removeprefix(".")
    return OTHER_NAMES.get(name, name if name in EVERY_FORMAT else text)


def ending_of(format_: str) -> str:
    """The ending of the name of a file of a format, without a dot.

    >>> ending_of("png16"), ending_of("dng")
    ('png', 'dng')
    """
    return DNG if format_ == DNG else FORMATS[format_].ending
