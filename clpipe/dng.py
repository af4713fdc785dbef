"""Digital Negatives: the raw of a chain as a file that any raw converter opens.

Adobe, Digital Negative (DNG) Specification 1.4.0.0, 2012: a preview in the first directory, the
mosaic in a second one below it.
"""

import struct
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import clpipe
from clpipe.camera import IDENTITY, SRGB_TO_XYZ
from clpipe.config import Chain
from clpipe.errors import ImageError, RequestError
from clpipe.image_io import Tags, write_beside
from clpipe.noise_model import NoiseModel
from clpipe.output import SIMULATED, exif, rational
from clpipe.reference.cfa import Pattern, red_site
from clpipe.reference.curve import to_8_bit
from clpipe.stage import Context, Kind
from clpipe.stages.gamma import srgb_curve
from clpipe.types import Array, Floats

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


def negative_of(chain: Chain) -> Negative:
    """The raw of a chain: what its last stage that gives DN makes, else the raw that enters it.

    Raises:
        RequestError: the chain has no raw, or one that DNG cannot hold.
    """
    makers = [step for step in chain.steps if step.stage.writes is Kind.RAW]
    first, last = chain.steps[0], chain.steps[-1]
    entered = not makers
    if entered and chain.source is not Kind.RAW:
        raise RequestError(
            "--format dng writes the raw in DN that quantize makes, but this chain starts on "
            f"{chain.source.label} and has no quantize; put it in, or use another format"
        )
    known = first.context if entered else makers[-1].method.after(makers[-1].context)
    end = last.method.after(last.context)
    balanced = any(step.stage.name == "white_balance" for step in chain.steps)
    gains = end.applied_gains if entered and balanced else known.gains
    levels = first.method if entered else known  # those of an image that enters, normalize is told
    black = _given(levels, "black_level", chain.camera.black_level)
    white = _given(levels, "white_level", chain.camera.white_level)
    if white != int(white):
        raise RequestError(
            f"--format dng: found a white level of {white:g}, but DNG wants whole DN; "
            f"--set quantize.white_level={white:.0f}"
        )
    return Negative(
        step=None if entered else makers[-1].name,
        pattern=known.pattern,
        black_level=black,
        white_level=int(white),
        gains=gains,
        xyz_to_camera=xyz_to_camera(_colours(known, end, entered), gains),
        noise=known.noise,
    )


def _given(of: object, name: str, otherwise: float) -> float:
    value = getattr(of, name, None)
    return otherwise if value is None else float(value)


def _colours(known: Context, end: Context, entered: bool) -> NDArray[np.float64]:
    """From linear sRGB to the mosaic's own colours, white-balanced.

    A render is in linear sRGB, and what color_matrix made of it before the mosaic is known. Of a
    camera's raw it is not known, but which matrix leads back to sRGB.
    """
    if entered and known.colours == IDENTITY:
        return np.asarray(np.linalg.inv(end.colours), np.float64)
    return np.array(known.colours)


def xyz_to_camera(colours: NDArray[np.float64], gains: tuple[float, float]) -> NDArray[np.float64]:
    """The ColorMatrix of a raw: XYZ under D65 to what the sensor sees, before white balance.

    The white of D65 becomes 1/gain, which is AsShotNeutral, so that a converter has no other light
    to adapt to. Scaled as Adobe's are: the white of D50 becomes 1 in the strongest channel.

    Args:
        colours: 3x3, linear sRGB to the mosaic's colours after white balance.
        gains: red, blue.

    >>> from clpipe.camera import load_camera
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


@dataclass(frozen=True)
class Field:
    """A field of a TIFF directory (TIFF 6.0, 1992): its type, how many values, their bytes."""

    type: int
    count: int
    data: bytes

    @property
    def padded(self) -> int:
        """The bytes that it takes outside the directory."""
        return 0 if len(self.data) <= 4 else len(self.data) + len(self.data) % 2


Directory = dict[int, Field]


def _byte(*values: int) -> Field:
    return Field(1, len(values), bytes(values))


def _text(text: str) -> Field:
    data = text.encode("ascii", "replace") + b"\0"
    return Field(2, len(data), data)


def _short(*values: int) -> Field:
    return Field(3, len(values), struct.pack(f"<{len(values)}H", *values))


def _long(*values: int) -> Field:
    return Field(4, len(values), struct.pack(f"<{len(values)}I", *values))


def _rational(*values: float) -> Field:
    pairs = [part for value in values for part in rational(value)]
    return Field(5, len(values), struct.pack(f"<{len(pairs)}I", *pairs))


def _signed_rational(*values: float) -> Field:
    pairs = [part for value in values for part in rational(value)]
    return Field(10, len(values), struct.pack(f"<{len(pairs)}i", *pairs))


def _double(*values: float) -> Field:
    return Field(12, len(values), struct.pack(f"<{len(values)}d", *values))


def _size(fields: Directory) -> int:
    return 6 + 12 * len(fields) + sum(field.padded for field in fields.values())


def _packed(fields: Directory, at: int) -> bytes:
    """A directory that stands ``at`` bytes into the file, with the values of its fields."""
    head, rest = struct.pack("<H", len(fields)), b""
    after = at + 6 + 12 * len(fields)
    for tag, field in sorted(fields.items()):
        value = field.data.ljust(4, b"\0")
        if field.padded:
            value = struct.pack("<I", after + len(rest))
            rest += field.data.ljust(field.padded, b"\0")
        head += struct.pack("<HHI", tag, field.type, field.count) + value
    return head + struct.pack("<I", 0) + rest


def _image(pixels: Array, kind: int, photometric: int) -> Directory:
    """What any picture in a TIFF says of itself; its place is 0 until it is known."""
    height, width = pixels.shape[:2]
    samples = pixels.shape[2] if pixels.ndim == 3 else 1
    return {
        254: _long(kind),  # 0: the picture itself, 1: a smaller one
        256: _long(width),
        257: _long(height),
        258: _short(*[pixels.itemsize * 8] * samples),
        259: _short(1),  # not compressed
        262: _short(photometric),
        273: _long(0),
        277: _short(samples),
        278: _long(height),  # rows, all in one strip
        279: _long(pixels.nbytes),
        284: _short(1),  # samples side by side
    }


def _exif_directory(tags: dict[str, float]) -> Directory:
    of: dict[str, tuple[int, Callable[..., Field]]] = {
        "ExposureTime": (33434, _rational),
        "PhotographicSensitivity": (34855, _short),
        "FocalLength": (37386, _rational),
        "FocalPlaneXResolution": (41486, _rational),
        "FocalPlaneYResolution": (41487, _rational),
        "FocalPlaneResolutionUnit": (41488, _short),
        "FocalLengthIn35mmFilm": (41989, _short),
    }
    fields = {36864: Field(7, 4, b"0230")}  # ExifVersion
    for name, value in tags.items():
        tag, field = of[name]
        fields[tag] = field(value)
    return fields


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
        305: _text(f"clpipe {clpipe.__version__}"),
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
