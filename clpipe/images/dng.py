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
from clpipe.base.errors import ImageError, RequestError
from clpipe.base.files import Stored, write_whole
from clpipe.base.types import Array, Doubles, Floats
from clpipe.camera.noise import NoiseModel
from clpipe.camera.profile import SRGB_TO_XYZ
from clpipe.images import tiff
from clpipe.images.encoding import SIMULATED
from clpipe.images.tags import Tags, exif
from clpipe.reference.cfa import PATTERNS
from clpipe.reference.curve import to_8_bit
from clpipe.reference.filter_array import FilterArray
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
    chain. Levels are in DN. ``array`` is its filter array, with the gains of white balance.
    ``xyz_to_camera`` is the matrix from CIE XYZ under D65 to the raw's channels before white
    balance: (channel, 3). ``noise`` is None where it is unknown. ``tone`` is the tone curve that
    the raw is meant for: on linear sRGB, (height, width, 3), in units of the white level.
    """

    step: str | None
    array: FilterArray
    black_level: float
    white_level: int
    xyz_to_camera: Doubles
    noise: NoiseModel | None
    tone: Callable[[Floats], Floats]


# What a DNG calls channels (CFAPattern).
CODES = {"R": 0, "G": 1, "B": 2, "C": 3, "M": 4, "Y": 5, "W": 6}


def planes_of(array: FilterArray) -> list[str]:
    """The channels of an array in the order of a DNG's planes.

    What stands for green is in the middle, where converters that know red, green and blue alone
    look for it.
    """
    own = list(array.channels)
    if "G" in own or not {*"RB"} <= {*own}:
        return own
    return ["R", *(letter for letter in own if letter not in "RB"), "B"]


BEHIND = ", filter array "  # a model's name, where it has another one than it is known for


def array_suffix(array: FilterArray) -> str:
    """What the name of a model ends in, to which converters attach what they know of its colours.

    Readers of periods that converters do not know find the array there, too.
    """
    return "" if array.pattern in PATTERNS else f"{BEHIND}{array.pattern}"


def check_array(array: FilterArray) -> None:
    """See that a DNG can hold the raw of a filter array.

    Raises:
        RequestError: it has a channel that DNG does not know.
    """
    unknown = [letter for letter in array.channels if letter not in CODES]
    if unknown and not array.is_gray:
        raise RequestError(
            f"--format dng: {array.name} has the channel {unknown[0]}, which DNG does not know; it "
            f"knows {', '.join(CODES)}, and sensors of one channel"
        )


def check_channels(array: FilterArray) -> None:
    """See that converters open the DNG of a filter array; LibRaw opens none of two channels.

    Raises:
        RequestError: they do not.
    """
    if len(array.channels) == 2:
        raise RequestError(
            f"--format dng: {array.name} has the channels {' and '.join(array.channels)} only, and "
            "LibRaw opens no DNG of two channels; use --format npy, or --keep quantize"
        )


def xyz_to_camera(colours: Doubles, array: FilterArray) -> Doubles:
    """The ColorMatrix of a raw, (channel, 3): CIE XYZ under D65 to its channels, not balanced.

    It maps the white D65 to AsShotNeutral, so a converter needs no chromatic adaptation. It is
    scaled as Adobe's matrices: the white D50 becomes 1 in the strongest channel.

    Args:
        colours: 3x3, linear sRGB to the mosaic's colours after white balance.
        array: the filter array, with the gains of white balance.

    >>> from clpipe.camera.profile import load_camera
    >>> from clpipe.reference.filter_array import parse_array
    >>> camera = load_camera("sony-a7r2")
    >>> array = parse_array("RG/GB", camera.white_balance_gains)
    >>> xyz_to_camera(camera.srgb_to_camera(), array).round(3).tolist()[0]
    [0.663, -0.19, -0.048]
    """
    seen = np.stack([array.responses[letter] for letter in planes_of(array)])
    levels = [array.levels[letter] for letter in planes_of(array)]
    matrix = np.diag(levels) @ seen @ colours @ np.linalg.inv(SRGB_TO_XYZ)
    return np.asarray(matrix / (matrix @ D50_XYZ).max())


def preview(dn: Array, negative: Negative) -> Array:
    """A small sRGB picture of a mosaic, (height, width, 3) uint8, at most 512 pixels a side.

    Each pixel is one period of the mosaic, the mean of each channel's sites, and has the tone
    curve: RawTherapee makes its own curve so that its picture has as many dark and bright pixels.
    """
    array = negative.array
    down, across = array.period
    rows, columns = max(dn.shape[0] // down, 1), max(dn.shape[1] // across, 1)
    block = -(-max(rows, columns) // PREVIEW_SIDE)
    high, wide = max(rows // block, 1), max(columns // block, 1)
    middle_y, middle_x = block // 2 * down, block // 2 * across

    def site(x: int, y: int) -> Floats:
        top, left = min(middle_y + y, dn.shape[0] - 1), min(middle_x + x, dn.shape[1] - 1)
        found = dn[top :: down * block, left :: across * block]
        return found[:high, :wide].astype(np.float32)

    def mean(letter: str) -> Floats:
        found = [site(x, y) for y, x in np.argwhere(array.letters == letter).tolist()]
        return np.asarray(sum(found[1:], found[0]) / len(found), np.float32)

    planes = np.stack([mean(letter) for letter in planes_of(array)], axis=-1)
    signal = (planes - negative.black_level) / (negative.white_level - negative.black_level)
    neutral = np.array([array.levels[letter] for letter in planes_of(array)])
    clipped = np.clip(signal / neutral, 0, 1) * neutral
    if array.is_gray:
        linear = np.repeat(clipped, 3, axis=-1)
    else:
        to_camera = negative.xyz_to_camera @ SRGB_TO_XYZ
        strongest = neutral.argmax()
        linear = clipped @ np.linalg.pinv(to_camera).T * to_camera.sum(1)[strongest]
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
    neutral = [negative.array.levels[letter] for letter in planes_of(negative.array)]
    colour: tiff.Directory = {}
    if not negative.array.is_gray:  # which has no colours
        colour = {
            50721: tiff.signed_rational(*negative.xyz_to_camera.ravel().round(7)),  # ColorMatrix1
            50728: tiff.rational(*neutral),  # AsShotNeutral
            50778: tiff.short(D65),  # CalibrationIlluminant1
        }
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
        50708: tiff.text(
            SIMULATED + whole_name + array_suffix(negative.array)
        ),  # UniqueCameraModel
        **colour,
    }


def raw_directory(dn: Array, negative: Negative) -> tiff.Directory:
    """The directory of the mosaic, (height, width) in DN; its offset is 0 until it is known."""
    array = negative.array
    filters: tiff.Directory = {}
    if not array.is_gray:
        filters = {
            33421: tiff.short(*array.period),  # CFARepeatPatternDim
            33422: tiff.byte(
                *(CODES[letter] for row in array.rows for letter in row)
            ),  # CFAPattern
            50710: tiff.byte(*(CODES[letter] for letter in planes_of(array))),  # CFAPlaneColor
            50711: tiff.short(1),  # CFALayout: rectangular
        }
    return {
        # A colour filter array, or LinearRaw.
        **tiff.image_fields(dn, subfile_type=0, photometric=32803 if filters else 34892),
        **noise_fields(negative),
        **filters,
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
    planes = len(negative.array.channels)
    return {51041: tiff.double(*[noise.a, noise.b] * planes)} if noise else {}


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
