"""Digital Negatives (DNG): the raw of a chain as a file that any raw converter opens.

After Adobe, Digital Negative (DNG) Specification 1.4.0.0, 2012: the first directory holds a preview
and what applies to the whole file, a second one below it holds the mosaic.
"""

import struct
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from clpipe.base.about import __version__
from clpipe.base.errors import ImageError
from clpipe.base.files import Stored, write_whole
from clpipe.base.types import Array, Doubles, Floats
from clpipe.camera.noise import NoiseModel
from clpipe.camera.profile import SRGB_TO_XYZ
from clpipe.images import tiff
from clpipe.images.encoding import SIMULATED
from clpipe.images.tags import Tags, exif
from clpipe.reference.cfa import Pattern, red_site
from clpipe.reference.curve import to_8_bit
from clpipe.reference.transfer import srgb_curve

PREVIEW_SIDE = 512  # px, at most
D65 = 21  # EXIF's LightSource of that illuminant
NO_BLACK_RENDER = 1  # DefaultBlackRender: the converter takes nothing off near black
CURVE_POINTS = 33
D50_XYZ = np.array([0.9642, 1.0, 0.8251])  # CIE XYZ of the white D50, Y = 1; sources differ by 1e-4

# Tags of fields that point to other parts of the file; their values are known last.
STRIP_OFFSETS, SUB_IFDS, EXIF_IFD = 273, 330, 34665


@dataclass(frozen=True)
class Negative:
    """What a raw converter needs to know of a raw.

    ``step`` is the step of the chain whose image is the raw; None is the image that enters the
    chain. Levels are in DN; ``gains`` are those of white balance for red and blue (green = 1).
    ``xyz_to_camera`` is the 3x3 matrix from CIE XYZ under D65 to the sensor's RGB before white
    balance. ``noise`` is None where it is unknown. ``tone`` is the tone curve that the raw is meant
    for: on linear sRGB, (height, width, 3), in units of the white level.
    """

    step: str | None
    pattern: Pattern
    black_level: float
    white_level: int
    gains: tuple[float, float]
    xyz_to_camera: Doubles
    noise: NoiseModel | None
    tone: Callable[[Floats], Floats]


def xyz_to_camera(colours: Doubles, gains: tuple[float, float]) -> Doubles:
    """The 3x3 ColorMatrix of a raw: CIE XYZ under D65 to the sensor's RGB before white balance.

    It maps the white D65 to 1/gain, which is AsShotNeutral, so a converter needs no chromatic
    adaptation. It is scaled as Adobe's matrices: the white D50 becomes 1 in the strongest channel.

    Args:
        colours: 3x3, linear sRGB to the mosaic's colours after white balance.
        gains: white balance gains of red and blue.

    >>> from clpipe.camera.profile import load_camera
    >>> camera = load_camera("sony-a7r2")
    >>> xyz_to_camera(camera.srgb_to_camera(), camera.white_balance_gains).round(3).tolist()[0]
    [0.663, -0.19, -0.048]
    """
    red, blue = gains
    matrix = np.diag([1 / red, 1, 1 / blue]) @ colours @ np.linalg.inv(SRGB_TO_XYZ)
    return np.asarray(matrix / (matrix @ D50_XYZ).max())


def preview(dn: Array, negative: Negative) -> Array:
    """A small sRGB picture of a mosaic, (height, width, 3) uint8, at most 512 pixels a side.

    Each pixel is one red, green and blue site of the mosaic, as noisy as they are, and has the tone
    curve: RawTherapee makes its own curve so that its picture has as many dark and bright pixels.
    """
    rows, columns = (max(side // 2, 1) for side in dn.shape)
    block = -(-max(rows, columns) // PREVIEW_SIDE)
    high, wide, middle = max(rows // block, 1), max(columns // block, 1), block // 2 * 2
    red_x, red_y = red_site(negative.pattern)

    def site(x: int, y: int) -> Floats:
        top, left = min(middle + y, dn.shape[0] - 1), min(middle + x, dn.shape[1] - 1)
        found = dn[top :: 2 * block, left :: 2 * block]
        return found[:high, :wide].astype(np.float32)

    green = (site(1 - red_x, red_y) + site(red_x, 1 - red_y)) / 2
    planes = np.stack([site(red_x, red_y), green, site(1 - red_x, 1 - red_y)], axis=-1)
    signal = (planes - negative.black_level) / (negative.white_level - negative.black_level)
    neutral = np.array([1 / negative.gains[0], 1, 1 / negative.gains[1]])
    clipped = np.clip(signal / neutral, 0, 1) * neutral
    to_camera = negative.xyz_to_camera @ SRGB_TO_XYZ
    linear = clipped @ np.linalg.inv(to_camera).T * to_camera.sum(1)[1]
    picture = negative.tone(np.clip(linear, 0, 1).astype(np.float32))
    shown = np.clip(picture.astype(np.float64), 0, 1)  # which rounding may leave
    return to_8_bit(srgb_curve(shown).astype(np.float32))


def tone_fields(negative: Negative) -> tiff.Directory:
    """The tone curve for converters that take one from a DNG, as Adobe's do.

    There is no BaselineExposure: it is for cameras that expose otherwise than such a curve expects.
    Adobe's software would clip the headroom for it, and the others that were tried ignore it.
    """
    light = np.linspace(0, 1, CURVE_POINTS, dtype=np.float32) ** 2  # curves bend most near black
    curve = negative.tone(np.repeat(light[None, :, None], 3, axis=-1))[0, :, 0]
    return {
        50940: tiff.float32(*np.stack([light, curve], axis=-1).ravel()),  # ProfileToneCurve
        51110: tiff.long(NO_BLACK_RENDER),  # DefaultBlackRender
    }


def main_directory(
    small: Array, negative: Negative, tags: Tags, orientation: int
) -> tiff.Directory:
    """The first directory: the preview, the camera, and what a converter needs for colour.

    Its offsets are 0 until the file is laid out. Arguments as :func:`write_dng`, with the preview.
    """
    whole_name = tags.model if tags.model.startswith(tags.make) else f"{tags.make} {tags.model}"
    red, blue = negative.gains
    return {
        **tiff.image_fields(small, subfile_type=1, photometric=2),  # RGB
        **noise_fields(negative),
        **tone_fields(negative),
        **({306: tiff.text(tags.taken)} if tags.taken else {}),  # DateTime
        271: tiff.text(tags.make),  # Make
        # Model. It is not the real camera's name: for that one RawTherapee cuts off optically black
        # columns and sets its own white level, and LibRaw uses its own matrix, even for a name that
        # only begins like it.
        272: tiff.text(SIMULATED + tags.model),
        274: tiff.short(orientation),  # Orientation
        305: tiff.text(f"clpipe {__version__}"),  # Software
        SUB_IFDS: tiff.long(0),
        EXIF_IFD: tiff.long(0),
        50706: tiff.byte(1, 4, 0, 0),  # DNGVersion
        50707: tiff.byte(1, 1, 0, 0),  # DNGBackwardVersion
        50708: tiff.text(SIMULATED + whole_name),  # UniqueCameraModel
        50721: tiff.signed_rational(*negative.xyz_to_camera.ravel().round(7)),  # ColorMatrix1
        50728: tiff.rational(1 / red, 1, 1 / blue),  # AsShotNeutral
        50778: tiff.short(D65),  # CalibrationIlluminant1
    }


def raw_directory(dn: Array, negative: Negative) -> tiff.Directory:
    """The directory of the mosaic, (height, width) in DN; its offset is 0 until it is known."""
    return {
        **tiff.image_fields(dn, subfile_type=0, photometric=32803),  # a colour filter array
        **noise_fields(negative),
        33421: tiff.short(2, 2),  # CFARepeatPatternDim
        33422: tiff.byte(*("RGB".index(colour) for colour in negative.pattern)),  # CFAPattern
        50710: tiff.byte(0, 1, 2),  # CFAPlaneColor
        50711: tiff.short(1),  # CFALayout: rectangular
        50713: tiff.short(1, 1),  # BlackLevelRepeatDim
        50714: tiff.rational(negative.black_level),  # BlackLevel
        50717: tiff.long(negative.white_level),  # WhiteLevel
        50719: tiff.long(0, 0),  # DefaultCropOrigin
        50720: tiff.long(dn.shape[1], dn.shape[0]),  # DefaultCropSize
    }


def noise_fields(negative: Negative) -> tiff.Directory:
    """NoiseProfile: a and b for each colour; nothing where the noise is unknown.

    The specification puts it beside the mosaic, but Adobe's SDK looks for it in the first
    directory, so both have it.
    """
    noise = negative.noise
    return {51041: tiff.double(*[noise.a, noise.b] * 3)} if noise else {}


def write_dng(
    path: Path, mosaic: Floats, negative: Negative, tags: Tags, orientation: int = 1
) -> Stored:
    """Write a raw as a DNG 1.4: every DN unchanged, in 16 bits, uncompressed.

    Args:
        path: the file.
        mosaic: (height, width), whole DN of 0 to 65535.
        negative: what a converter needs to know of it.
        tags: the camera, the ISO and the shot.
        orientation: EXIF's; a converter turns the picture by it.

    Raises:
        ImageError: the file cannot be written, or a sample is not a whole DN of 0 to 65535.
    """
    with np.errstate(invalid="ignore"):
        dn = mosaic.astype("<u2")
    if not np.array_equal(dn, mosaic):
        raise ImageError(
            f"{path}: holds samples that are not whole DN of 0 to 65535, which a DNG needs"
        )
    small = preview(dn, negative)
    main, raw = main_directory(small, negative, tags, orientation), raw_directory(dn, negative)
    shot = tiff.exif_fields(exif(tags, *dn.shape))

    # The file: header, the three directories, the preview, the mosaic.
    raw_offset = 8 + tiff.directory_size(main)
    shot_offset = raw_offset + tiff.directory_size(raw)
    small_offset = shot_offset + tiff.directory_size(shot)
    dn_offset = small_offset + small.nbytes + small.nbytes % 2
    main[STRIP_OFFSETS] = tiff.long(small_offset)
    main[SUB_IFDS] = tiff.long(raw_offset)
    main[EXIF_IFD] = tiff.long(shot_offset)
    raw[STRIP_OFFSETS] = tiff.long(dn_offset)
    head = b"II*\0" + struct.pack("<I", 8)
    for directory, offset in ((main, 8), (raw, raw_offset), (shot, shot_offset)):
        head += tiff.directory_bytes(directory, offset)
    head += small.tobytes().ljust(dn_offset - small_offset, b"\0")

    return write_whole(path, head, np.ascontiguousarray(dn).data.cast("B"))
