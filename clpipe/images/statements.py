"""Reads what a file states about its samples: colours, transfer curve, alpha, orientation."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio

from clpipe.base.errors import ImageError
from clpipe.base.reading import read_errors
from clpipe.base.text import printable
from clpipe.base.types import Array, Floats
from clpipe.images import png, radiance
from clpipe.images.colour import CIE_XYZ
from clpipe.images.colour_names import ColourSpace, space_of
from clpipe.images.openimageio import radiance_header
from clpipe.images.pixels import convert_by_rows
from clpipe.images.spectral import spectral_warnings
from clpipe.images.tags import FLIPS, upright
from clpipe.images.vocabularies import vocabulary_warnings


@dataclass(frozen=True)
class Statements:
    """What a file states about its samples.

    Args:
        chromaticities: x and y of red, green, blue and white; None means linear sRGB.
        neutral: x and y of OpenEXR's adoptedNeutral.
        orientation: EXIF's orientation of the stored samples; 1 is upright.
        alpha: the number of a straight alpha channel, by which colours must be multiplied; -1 if
            there is none.
        is_associated: whether colours are already multiplied by an alpha channel.
        curve: how light is encoded, see :class:`clpipe.images.png.PngColours`; "" if not stated.
        is_inverted: whether 0 is white, which OpenImageIO applies only to 8-bit samples.
        header: the header of a Radiance picture.
        warnings: sentences about statements that are not applied.
        space: the colour space that an OpenEXR file names.
    """

    chromaticities: Any = None
    neutral: Any = None
    orientation: int = 1
    alpha: int = -1
    is_associated: bool = False
    curve: str = ""
    is_inverted: bool = False
    header: radiance.RadianceHeader | None = None
    warnings: tuple[str, ...] = ()
    space: ColourSpace | None = None

    def warnings_with(self, transfer: str) -> tuple[str, ...]:
        """Return the warnings if samples are decoded with a transfer curve."""
        if self.curve in ("", transfer):
            return self.warnings
        note = f"its transfer curve {self.curve} is not applied; it is read as {transfer}"
        return (*self.warnings, note)

    def light(self, pixels: Array) -> Array:
        """Return linear light: converted from a Radiance picture's samples, otherwise unchanged."""
        if (header := self.header) is None:
            return pixels
        return convert_by_rows(lambda rows: radiance.to_light(rows, header), pixels)

    def upright(self, pixels: Array) -> Array:
        """Return pixels rotated upright."""
        return pixels if self.orientation == 1 else upright(pixels, self.orientation)


def read_statements(path: Path, file: Any, xyz: bool = False, spectral: bool = False) -> Statements:
    """Return what a file states about the samples of its current part.

    Args:
        path: the file.
        file: the open ``oiio.ImageInput``.
        xyz: whether the channels are X, Y and Z.
        spectral: whether the channels are spectral bands.

    Raises:
        ImageError: the file cannot be read.
    """
    spec, format_ = file.spec(), file.format_name()
    warnings = spectral_warnings(spec) if spectral else []
    aspect = spec.getattribute("PixelAspectRatio")
    header = radiance_header(path) if format_ == "hdr" else None
    if header:
        aspect = 1 / header.pixel_aspect  # Radiance states height over width
    if isinstance(aspect, float) and abs(aspect - 1) > 1e-3:
        warnings.append(
            f"its pixel aspect ratio of {aspect:.4g} is not applied; pixels are read as square"
        )
    if nits := spec.getattribute("whiteLuminance"):
        warnings.append(f"its whiteLuminance of {nits:g} cd/m2 is not used; 1.0 is white")
    if profile := _profile(spec):
        warnings.append(
            f"its ICC profile, {printable(profile)}, is not applied; it is read as sRGB"
        )
    is_inverted = spec.getattribute("tiff:PhotometricInterpretation") == 0
    if is_inverted and spec.format.basetype in (oiio.HALF, oiio.FLOAT, oiio.DOUBLE):
        warnings.append("it states that 0 is white (MinIsWhite), which is not applied to floats")
    part = file.current_subimage()
    if format_ == "tiff":
        if file.seek_subimage(part + 1, 0):
            warnings.append("it has several pages; only the first one was read")
        file.seek_subimage(part, 0)
        file.geterror()  # clears the error: the next page need not exist
    chromaticities = CIE_XYZ if xyz else spec.getattribute("chromaticities")
    space, notes = _named_space(path, spec) if format_ == "openexr" else (None, [])
    warnings += notes
    chromaticities = chromaticities or (space and space.chromaticities)
    curve = ""
    chunks: Mapping[bytes, bytes] = {}
    if format_ == "png":
        with read_errors(path):
            chunks = png.read_chunks(path)
        colours = png.png_colours(chunks)
        chromaticities = chromaticities or colours.chromaticities
        if colours.curve not in ("", "srgb", "linear"):
            curve = f"{colours.curve} ({colours.chunk} chunk)"
        else:
            curve = colours.curve
        if colours.unknown:
            warnings.append(f"its cICP chunk states unknown {colours.unknown}; it is read as sRGB")
    warnings += vocabulary_warnings(path, format_, spec, chunks)
    stated = spec.getattribute("Orientation") if format_ != "openexr" else 1
    if header:
        stated = header.orientation  # OpenImageIO 3.2 swaps two of the eight orientations
    is_straight = bool(spec.getattribute("oiio:UnassociatedAlpha"))
    alpha = spec.alpha_channel
    return Statements(
        chromaticities if chromaticities or header is None else header.chromaticities,
        spec.getattribute("adoptedNeutral"),
        stated if stated in FLIPS else 1,
        alpha if is_straight else -1,
        not is_straight and 0 <= alpha < spec.nchannels,
        curve,
        is_inverted and spec.format.basetype != oiio.UINT8,
        header,
        tuple(warnings),
        space,
    )


def _named_space(path: Path, spec: Any) -> tuple[ColourSpace | None, list[str]]:
    """Return the colour space that an OpenEXR file names, or None, and warnings.

    Raises:
        ImageError: as for :func:`~clpipe.images.colour_names.space_of`.
    """
    try:
        space, warnings = space_of(spec)
    except ImageError as error:
        raise ImageError(f"{path}: {error}") from None
    if space and space.encoding:
        warnings.append(f"its samples, encoded as {printable(space.name)}, were decoded")
    return space, warnings


def _profile(spec: Any) -> str:
    """Return the name of an ICC profile; "" if there is none, or if it is sRGB's."""
    if spec.getattribute("ICCProfile") is None:
        return ""
    name = str(spec.getattribute("ICCProfile:profile_description") or "without a name")
    return "" if "srgb" in name.lower() else name


def over_black(light: Array, alpha: Array) -> Floats:
    """Return linear light, (height, width[, 3]), times alpha, which composites it over black."""
    return light * (alpha if light.ndim == 2 else alpha[..., np.newaxis])
