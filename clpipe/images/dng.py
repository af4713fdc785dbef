"""Digital Negatives (DNG): the raw of a chain as a file that any raw converter opens.

Source: Adobe, Digital Negative (DNG) Specification 1.4.0.0, 2012. The first directory holds a
preview and fields of the whole file. A second directory below it holds the mosaic.
"""

import struct
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from clpipe.base.about import __version__
from clpipe.base.errors import ImageError, RequestError
from clpipe.base.files import Stored, write_atomic
from clpipe.base.types import Array, Doubles, Floats
from clpipe.camera.colorimetry import adaptation
from clpipe.camera.noise import NoiseModel
from clpipe.camera.profile import SRGB_TO_XYZ, Camera
from clpipe.camera.spectra import sight_of
from clpipe.images import tiff
from clpipe.images.encoding import SIMULATED
from clpipe.images.tags import Tags, exif
from clpipe.reference.cfa import PATTERNS
from clpipe.reference.curve import to_8_bit
from clpipe.reference.filter_array import FilterArray
from clpipe.reference.transfer import srgb_curve

PREVIEW_SIDE = 512  # px, at most
STANDARD_LIGHT_A, D65 = 17, 21  # EXIF's LightSource numbers of these illuminants
NO_BLACK_RENDER = 1  # DefaultBlackRender: the converter subtracts nothing near black
CURVE_POINTS = 33
D50_XYZ = np.array([0.9642, 1.0, 0.8251])  # CIE XYZ of the white D50, Y = 1; sources differ by 1e-4

# Tags of offset fields, which are filled in last.
STRIP_OFFSETS, SUB_IFDS, EXIF_IFD = 273, 330, 34665


@dataclass(frozen=True)
class Negative:
    """The metadata of a raw that a converter needs.

    Args:
        step: the step of the chain whose image is the raw; None is the image that enters the chain.
        array: the filter array, with the gains of white balance.
        black_level, white_level: in DN.
        xyz_to_camera: the matrix from CIE XYZ under D65 to the raw's channels before white balance,
            (channel, 3).
        noise: the noise model; None if it is unknown.
        tone: the tone curve for this raw, applied to linear sRGB, (height, width, 3), in units of
            the white level.
        camera: the camera whose sensitivities give the colours for two lights; None writes
            ``xyz_to_camera`` alone.
    """

    step: str | None
    array: FilterArray
    black_level: float
    white_level: int
    xyz_to_camera: Doubles
    noise: NoiseModel | None
    tone: Callable[[Floats], Floats]
    camera: Camera | None = None


# The numbers of channels in a DNG (CFAPattern).
CFA_COLORS = {"R": 0, "G": 1, "B": 2, "C": 3, "M": 4, "Y": 5, "W": 6}


def plane_order(array: FilterArray) -> list[str]:
    """Return the channels of an array in the order of a DNG's planes.

    The channel that replaces green is in the middle, where converters that know only red, green and
    blue expect it.
    """
    channels = list(array.channels)
    if "G" in channels or not {*"RB"} <= {*channels}:
        return channels
    return ["R", *(letter for letter in channels if letter not in "RB"), "B"]


ARRAY_SEPARATOR = (
    ", filter array "  # follows a model's name if the array differs from the real camera's
)


def array_suffix(array: FilterArray) -> str:
    """Return the suffix of a model's name that contains its array; "" for a Bayer pattern.

    The suffix keeps converters from using their colours of the real model. clpipe reads the array
    from it if LibRaw does not know the pattern.
    """
    return "" if array.pattern in PATTERNS else f"{ARRAY_SEPARATOR}{array.pattern}"


def check_array(array: FilterArray) -> None:
    """Check that a DNG can hold the raw of a filter array.

    Raises:
        RequestError: the array has a channel that DNG does not define.
    """
    unknown = [letter for letter in array.channels if letter not in CFA_COLORS]
    if unknown and not array.is_gray:
        raise RequestError(
            f"--format dng: {array.name} has the channel {unknown[0]}, but DNG only allows "
            f"{', '.join(CFA_COLORS)}, and sensors of one channel; use --format npy"
        )


def check_channels(array: FilterArray) -> None:
    """Check that converters open the DNG of a filter array. LibRaw opens none with two channels.

    Raises:
        RequestError: they do not.
    """
    if len(array.channels) == 2:
        raise RequestError(
            f"--format dng: {array.name} has only the channels {' and '.join(array.channels)}, but "
            "LibRaw opens no DNG of two channels; use --format npy, or --keep quantize"
        )


def xyz_to_camera(colours: Doubles, array: FilterArray) -> Doubles:
    """Return a raw's ColorMatrix, (channel, 3): CIE XYZ under D65 to channels before white balance.

    It maps the white D65 to AsShotNeutral, so a converter needs no chromatic adaptation. Its scale
    is that of Adobe's matrices: the white D50 becomes 1 in the strongest channel.

    Args:
        colours: the 3x3 matrix from linear sRGB to the mosaic's colours after white balance.
        array: the filter array, with the gains of white balance.

    >>> from clpipe.camera.profile import load_camera
    >>> from clpipe.reference.filter_array import parse_array
    >>> camera = load_camera("sony-a7r2")
    >>> array = parse_array("RG/GB", camera.white_balance_gains)
    >>> xyz_to_camera(camera.srgb_to_camera(), array).round(3).tolist()[0]
    [0.663, -0.19, -0.048]
    """
    responses = np.stack([array.responses[letter] for letter in plane_order(array)])
    levels = [array.levels[letter] for letter in plane_order(array)]
    matrix = np.diag(levels) @ responses @ colours @ np.linalg.inv(SRGB_TO_XYZ)
    return np.asarray(matrix / (matrix @ D50_XYZ).max())


def two_light_fields(camera: Camera) -> tiff.Directory:
    """Return ColorMatrix and ForwardMatrix for the lights A and D65, from a camera's sensitivities.

    ColorMatrix converts CIE XYZ in the light to the raw's channels, and ForwardMatrix converts
    channels after white balance to CIE XYZ under D50.
    """
    fields: tiff.Directory = {}
    for number, (name, exif_number) in enumerate((("A", STANDARD_LIGHT_A), ("D65", D65))):
        sight, d65 = sight_of(camera, name), SRGB_TO_XYZ.sum(1)
        to_xyz = SRGB_TO_XYZ @ sight.to_srgb
        red, blue = sight.gains
        in_light = adaptation(d65, sight.white_xyz) @ to_xyz @ np.diag([red, 1, blue])
        color = np.linalg.inv(in_light)
        color /= (color @ D50_XYZ).max()
        forward = adaptation(d65, D50_XYZ) @ to_xyz
        fields |= {
            50721 + number: tiff.signed_rational(*color.ravel().round(7)),  # ColorMatrix
            50778 + number: tiff.short(exif_number),  # CalibrationIlluminant
            50964 + number: tiff.signed_rational(*forward.ravel().round(7)),  # ForwardMatrix
        }
    return fields


def preview(dn: Array, negative: Negative) -> Array:
    """Return a small sRGB picture of a mosaic, (height, width, 3) uint8, at most 512 px per side.

    A pixel is the mean of each channel in one period of the mosaic. It has the tone curve, because
    RawTherapee matches the histogram of its own picture to the preview's histogram.
    """
    array = negative.array
    down, across = array.period
    rows, columns = max(dn.shape[0] // down, 1), max(dn.shape[1] // across, 1)
    block = -(-max(rows, columns) // PREVIEW_SIDE)
    high, wide = max(rows // block, 1), max(columns // block, 1)
    middle_y, middle_x = block // 2 * down, block // 2 * across

    def site(x: int, y: int) -> Floats:
        top, left = min(middle_y + y, dn.shape[0] - 1), min(middle_x + x, dn.shape[1] - 1)
        samples = dn[top :: down * block, left :: across * block]
        return samples[:high, :wide].astype(np.float32)

    def mean(letter: str) -> Floats:
        samples = [site(x, y) for y, x in np.argwhere(array.letters == letter).tolist()]
        return np.asarray(sum(samples[1:], samples[0]) / len(samples), np.float32)

    planes = np.stack([mean(letter) for letter in plane_order(array)], axis=-1)
    signal = (planes - negative.black_level) / (negative.white_level - negative.black_level)
    neutral = np.array([array.levels[letter] for letter in plane_order(array)])
    clipped = np.clip(signal / neutral, 0, 1) * neutral
    if array.is_gray:
        linear = np.repeat(clipped, 3, axis=-1)
    else:
        to_camera = negative.xyz_to_camera @ SRGB_TO_XYZ
        strongest = neutral.argmax()
        linear = clipped @ np.linalg.pinv(to_camera).T * to_camera.sum(1)[strongest]
    picture = negative.tone(np.clip(linear, 0, 1).astype(np.float32))
    encoded = np.clip(picture.astype(np.float64), 0, 1)  # rounding may leave values outside 0 to 1
    return to_8_bit(srgb_curve(encoded).astype(np.float32))


def tone_fields(negative: Negative) -> tiff.Directory:
    """Return the tone curve, for converters that read one from a DNG, like Adobe's.

    BaselineExposure is not written. It is for cameras whose exposure does not fit such a curve.
    Adobe's software would clip the headroom, and other converters that were tried ignore it.
    """
    light = np.linspace(0, 1, CURVE_POINTS, dtype=np.float32) ** 2  # curves bend most near black
    curve = negative.tone(np.repeat(light[None, :, None], 3, axis=-1))[0, :, 0]
    return {
        50940: tiff.float32(*np.stack([light, curve], axis=-1).ravel()),  # ProfileToneCurve
        51110: tiff.long(NO_BLACK_RENDER),  # DefaultBlackRender
    }


def main_directory(
    thumbnail: Array, negative: Negative, tags: Tags, orientation: int
) -> tiff.Directory:
    """Return the first directory: the preview, the camera, and fields for colour.

    Its offsets are 0 until they are known. The arguments are those of :func:`write_dng`, and the
    preview ``thumbnail``.
    """
    whole_name = tags.model if tags.model.startswith(tags.make) else f"{tags.make} {tags.model}"
    neutral = [negative.array.levels[letter] for letter in plane_order(negative.array)]
    colour: tiff.Directory = {}
    if not negative.array.is_gray:
        colour = {
            50721: tiff.signed_rational(*negative.xyz_to_camera.ravel().round(7)),  # ColorMatrix1
            50728: tiff.rational(*neutral),  # AsShotNeutral
            50778: tiff.short(D65),  # CalibrationIlluminant1
            **(two_light_fields(negative.camera) if negative.camera else {}),
        }
    return {
        **tiff.image_fields(thumbnail, subfile_type=1, photometric=2),  # photometric 2 is RGB
        **noise_fields(negative),
        **tone_fields(negative),
        **({306: tiff.text(tags.taken)} if tags.taken else {}),  # DateTime
        271: tiff.text(tags.make),  # Make
        # Model. This name differs from the real camera's name. With the real name, RawTherapee
        # would crop optically black columns and set its own white level. LibRaw uses its own matrix
        # even if a name only begins with the name of a real camera.
        272: tiff.text(SIMULATED + tags.model),
        274: tiff.short(orientation),  # Orientation
        305: tiff.text(f"clpipe {__version__}"),  # Software
        SUB_IFDS: tiff.long(0),
        EXIF_IFD: tiff.long(0),
        50706: tiff.byte(1, 4, 0, 0),  # DNGVersion
        50707: tiff.byte(1, 1, 0, 0),  # DNGBackwardVersion
        # UniqueCameraModel
        50708: tiff.text(SIMULATED + whole_name + array_suffix(negative.array)),
        **colour,
    }


def raw_directory(dn: Array, negative: Negative) -> tiff.Directory:
    """Return the directory of a mosaic, (height, width) in DN. Its offset is 0 at first."""
    array = negative.array
    filters: tiff.Directory = {}
    if not array.is_gray:
        filters = {
            33421: tiff.short(*array.period),  # CFARepeatPatternDim
            # CFAPattern
            33422: tiff.byte(*(CFA_COLORS[letter] for row in array.rows for letter in row)),
            # CFAPlaneColor
            50710: tiff.byte(*(CFA_COLORS[letter] for letter in plane_order(array))),
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
    """Return the field NoiseProfile, a and b for each colour; {} if the noise is unknown.

    The specification requires it in the mosaic's directory, but Adobe's SDK reads it from the first
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
        negative: its metadata.
        tags: the camera, the ISO and the shot.
        orientation: EXIF's value, by which a converter rotates the picture.

    Raises:
        ImageError: the file cannot be written, or a sample is not a whole DN of 0 to 65535.
    """
    with np.errstate(invalid="ignore"):
        dn = mosaic.astype("<u2")
    if not np.array_equal(dn, mosaic):
        raise ImageError(
            f"{path}: this raw has samples that are not whole DN from 0 to 65535, which a DNG "
            "requires; use --format npy"
        )
    thumbnail = preview(dn, negative)
    main, raw = main_directory(thumbnail, negative, tags, orientation), raw_directory(dn, negative)
    shot = tiff.exif_fields(exif(tags, *dn.shape))

    # The file: header, the three directories, the preview, the mosaic.
    raw_offset = 8 + tiff.directory_size(main)
    shot_offset = raw_offset + tiff.directory_size(raw)
    thumbnail_offset = shot_offset + tiff.directory_size(shot)
    dn_offset = thumbnail_offset + thumbnail.nbytes + thumbnail.nbytes % 2
    main[STRIP_OFFSETS] = tiff.long(thumbnail_offset)
    main[SUB_IFDS] = tiff.long(raw_offset)
    main[EXIF_IFD] = tiff.long(shot_offset)
    raw[STRIP_OFFSETS] = tiff.long(dn_offset)
    head = b"II*\0" + struct.pack("<I", 8)
    for directory, offset in ((main, 8), (raw, raw_offset), (shot, shot_offset)):
        head += tiff.directory_bytes(directory, offset)
    head += thumbnail.tobytes().ljust(dn_offset - thumbnail_offset, b"\0")

    return write_atomic(path, head, np.ascontiguousarray(dn).data.cast("B"))
