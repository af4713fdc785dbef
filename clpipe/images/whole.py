"""Checks whether a picture's file is complete; a power loss may leave only a part of it."""

from pathlib import Path

import numpy as np
import OpenImageIO as oiio

from clpipe.base.errors import ImageError
from clpipe.images.openimageio import SIGNATURES, open_image
from clpipe.images.pixels import DEFAULT_MAX_PIXELS
from clpipe.images.raw import check_raw
from clpipe.images.samples import read_samples

NPY = b"\x93NUMPY"


def is_complete(path: Path) -> bool:
    """Return whether all of a picture can be read.

    A file in a format that clpipe does not write, or too large to be checked, counts as complete,
    because it may be valuable.

    Raises:
        OSError: the file cannot be read.
    """
    with path.open("rb") as file:
        signature = file.read(16)
    try:
        if NPY.startswith(signature[: len(NPY)] or b"-"):
            np.load(path, mmap_mode="r", allow_pickle=False)
        elif path.suffix == ".dng":
            check_raw(path)
        elif signature.startswith(SIGNATURES):
            with open_image(path) as image:
                spec = image.spec()
                if spec.width * spec.height <= DEFAULT_MAX_PIXELS:
                    read_samples(path, image, 0, range(spec.nchannels), oiio.UNKNOWN)
    except (ImageError, ValueError):
        return False
    return bool(signature.strip(b"\0"))
