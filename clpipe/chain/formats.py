"""The file formats of --format."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Format:
    """A file format: its extension, the bits per sample, and whether samples are floats."""

    extension: str
    bits: int
    floats: bool = False


FORMATS = {  # formats of pictures
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

NPY = "npy"  # also a format of kept images
DNG = "dng"  # contains the raw instead of the picture

ALL_FORMATS = (*FORMATS, DNG)

CLIP_FORMATS = ("mp4", "mkv")  # contain the pictures of a sequence; only clpipe run writes them

# Aliases of formats.
ALIASES = {"jpeg": "jpg", "tiff": "tif", "tiff16": "tif16", "tiff32": "tif32"}


def format_named(text: str) -> str:
    """Return the format that a text names, in any case or by an alias; else the text itself.

    >>> format_named("JPEG"), format_named("tiff16"), format_named("webp")
    ('jpg', 'tif16', 'webp')
    """
    name = text.lower().removeprefix(".")
    return ALIASES.get(name, name if name in (*ALL_FORMATS, *CLIP_FORMATS) else text)


def extension_of(format_: str) -> str:
    """Return the extension of a format, without the dot.

    >>> extension_of("png16"), extension_of("dng")
    ('png', 'dng')
    """
    return DNG if format_ == DNG else FORMATS[format_].extension
