"""Digital Negatives: the raw of a chain as a file that any raw converter opens.

Adobe, Digital Negative (DNG) Specification 1.4.0.0, 2012: a preview in the first directory, the
mosaic in a second one below it.
"""

import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from clpipe.base.about import __version__
from clpipe.base.errors import ImageError
from clpipe.base.files import write_beside
from clpipe.base.types import Array, Floats
from clpipe.camera.noise import NoiseModel
from clpipe.camera.profile import SRGB_TO_XYZ
from clpipe.images.encoding import SIMULATED, exif
from clpipe.images.tags import Tags
from clpipe.images.tiff import (
    _byte,
    _double,
    _exif_directory,
    _image,
    _long,
    _packed,
    _rational,
    _short,
    _signed_rational,
    _size,
    _text,
)
from clpipe.reference.cfa import Pattern, red_site
from clpipe.reference.curve import to_8_bit
from clpipe.reference.transfer import srgb_curve

PREVIEW_SIDE = 512
D65 = 21  # as EXIF's LightSource counts illuminants
D50_XYZ = np.array([0.9642, 1.0, 0.8251])


@dataclass(frozen=True)
class Negative:
    """What a converter must know of a raw.

    ``step`` makes it; None is the image that enters the chain. Levels are in DN, gains (red, blue)
    those of white balance with green = 1; ``xyz_to_camera`` is 3x3, from XYZ under D65 to what the
    sensor sees.
    """

    step: str | None
    pattern: Pattern
    black_level: float
    white_level: int
    gains: tuple[float, float]
    xyz_to_camera: NDArray[np.float64]
    noise: NoiseModel | None


def xyz_to_camera(colours: NDArray[np.float64], gains: tuple[float, float]) -> NDArray[np.float64]:
    """The ColorMatrix of a raw: XYZ under D65 to what the sensor sees, before white balance.

    The white of D65 becomes 1/gain, which is AsShotNeutral, so that a converter has no other light
    to adapt to. Scaled as Adobe's are: the white of D50 becomes 1 in the strongest channel.

    Args:
        colours: 3x3, linear sRGB to the mosaic's colours after white balance.
        gains: red, blue.

    >>> from clpipe.camera.profile import load_camera
    >>> camera = load_camera("sony-a7r2")
    >>> xyz_to_camera(camera.srgb_to_camera(), camera.white_balance_gains).round(3).tolist()[0]
    [0.663, -0.19, -0.048]
    """
    red, blue = gains
    matrix = np.diag([1 / red, 1, 1 / blue]) @ colours @ np.linalg.inv(SRGB_TO_XYZ)
    return np.asarray(matrix / (matrix @ D50_XYZ).max())


def preview(dn: Array, negative: Negative) -> NDArray[np.uint8]:
    """A small sRGB picture of a mosaic, (height, width, 3), at most 512 pixels a side.

    Each of its pixels is a block's mean, red, green and blue of their own sites.
    """
    rows, columns = (max(side // 2, 1) for side in dn.shape)
    block = -(-max(rows, columns) // PREVIEW_SIDE)
    high, wide = max(rows // block, 1), max(columns // block, 1)
    red_x, red_y = red_site(negative.pattern)

    def mean(x: int, y: int) -> Floats:
        site = dn[min(y, dn.shape[0] - 1) :: 2, min(x, dn.shape[1] - 1) :: 2]
        site = site[: high * block, : wide * block]
        tall, broad = site.shape[0] // high, site.shape[1] // wide
        blocks = site[: high * tall, : wide * broad].reshape(high, tall, wide, broad)
        return blocks.mean((1, 3), np.float32)

    green = (mean(1 - red_x, red_y) + mean(red_x, 1 - red_y)) / 2
    planes = np.stack([mean(red_x, red_y), green, mean(1 - red_x, 1 - red_y)], axis=-1)
    signal = (planes - negative.black_level) / (negative.white_level - negative.black_level)
    neutral = np.array([1 / negative.gains[0], 1, 1 / negative.gains[1]])
    clipped = np.clip(signal / neutral, 0, 1) * neutral
    to_camera = negative.xyz_to_camera @ SRGB_TO_XYZ
    linear = clipped @ np.linalg.inv(to_camera).T * to_camera.sum(1)[1]
    return to_8_bit(srgb_curve(np.clip(linear, 0, 1)).astype(np.float32))


def write_dng(
    path: Path, mosaic: Floats, negative: Negative, tags: Tags, orientation: int = 1
) -> None:
    """Write a raw as a DNG 1.4: every DN as it is, in 16 bits, not compressed.

    Args:
        path: the file.
        mosaic: (height, width), whole DN of 0 to 65535.
        negative: what is to be said of it.
        tags: the camera, the ISO and the shot.
        orientation: as EXIF has it; whoever develops the raw turns the picture by it.

    Raises:
        ImageError: the file cannot be written, or there are samples that are no whole DN.
    """
    with np.errstate(invalid="ignore"):
        dn = mosaic.astype("<u2")
    if not np.array_equal(dn, mosaic):
        raise ImageError(f"{path}: holds samples that are not whole DN of 0 to 65535, as in a DNG")
    small = preview(dn, negative)
    whole = tags.model if tags.model.startswith(tags.make) else f"{tags.make} {tags.model}"
    noise, (red, blue) = negative.noise, negative.gains
    # The specification puts it beside the mosaic, Adobe's SDK looks for it in the first directory.
    profile = {51041: _double(*[noise.a, noise.b] * 3)} if noise else {}
    main = _image(small, 1, 2) | profile  # RGB
    main |= {
        271: _text(tags.make),
        # Not the real camera's name: RawTherapee cuts off its optically black columns and sets its
        # white level by what it knows of that one, LibRaw gives its matrix, even if the name only
        # begins like it.
        272: _text(SIMULATED + tags.model),
        274: _short(orientation),
        305: _text(f"clpipe {__version__}"),
        330: _long(0),
        34665: _long(0),
        50706: _byte(1, 4, 0, 0),  # DNGVersion
        50707: _byte(1, 1, 0, 0),  # DNGBackwardVersion
        50708: _text(SIMULATED + whole),  # UniqueCameraModel
        50721: _signed_rational(*negative.xyz_to_camera.ravel().round(7)),  # ColorMatrix1
        50728: _rational(1 / red, 1, 1 / blue),  # AsShotNeutral
        50778: _short(D65),  # CalibrationIlluminant1
    }
    raw = _image(dn, 0, 32803) | profile  # a colour filter array
    raw |= {
        33421: _short(2, 2),  # CFARepeatPatternDim
        33422: _byte(*("RGB".index(colour) for colour in negative.pattern)),  # CFAPattern
        50710: _byte(0, 1, 2),  # CFAPlaneColor
        50711: _short(1),  # CFALayout: rectangular
        50713: _short(1, 1),  # BlackLevelRepeatDim
        50714: _rational(negative.black_level),
        50717: _long(negative.white_level),
        50719: _long(0, 0),  # DefaultCropOrigin
        50720: _long(dn.shape[1], dn.shape[0]),  # DefaultCropSize
    }
    shot = _exif_directory(exif(tags.iso, tags.output, max(dn.shape)))

    raw_at = 8 + _size(main)
    shot_at = raw_at + _size(raw)
    small_at = shot_at + _size(shot)
    dn_at = small_at + small.nbytes + small.nbytes % 2
    main |= {273: _long(small_at), 330: _long(raw_at), 34665: _long(shot_at)}
    raw[273] = _long(dn_at)
    head = b"II*\0" + struct.pack("<I", 8)
    head += _packed(main, 8) + _packed(raw, raw_at) + _packed(shot, shot_at)
    head += small.tobytes().ljust(dn_at - small_at, b"\0")

    def write(to: Path) -> None:
        with to.open("wb") as file:
            file.write(head)
            file.write(np.ascontiguousarray(dn).data)

    write_beside(path, write)
