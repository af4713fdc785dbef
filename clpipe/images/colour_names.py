"""Colour spaces by name: those of the Color Interop Forum, and OpenImageIO's.

The forum's "Color Space Encodings for Texture Assets and CG Rendering" (2025) defines names such as
lin_ap1_scene: the encoding, the primaries, and whether values are of the scene or of a display.
OpenEXR files state them as ``colorInteropID``, or as ``oiio:ColorSpace``.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from clpipe.base.errors import ImageError
from clpipe.base.text import printable
from clpipe.base.types import Doubles
from clpipe.images.colour import CIE_XYZ, SRGB
from clpipe.reference.transfer import inverse_srgb_curve

D65, ACES_WHITE = (0.3127, 0.3290), (0.32168, 0.33767)
PRIMARIES: dict[str, tuple[float, ...]] = {
    "rec709": SRGB,
    "ap0": (0.7347, 0.2653, 0.0, 1.0, 0.0001, -0.0770, *ACES_WHITE),
    "ap1": (0.713, 0.293, 0.165, 0.830, 0.128, 0.044, *ACES_WHITE),
    "p3d65": (0.680, 0.320, 0.265, 0.690, 0.150, 0.060, *D65),
    "rec2020": (0.708, 0.292, 0.170, 0.797, 0.131, 0.046, *D65),
    "adobergb": (0.64, 0.33, 0.21, 0.71, 0.15, 0.06, *D65),
    "ciexyzd65": CIE_XYZ,
    "xyzd65": CIE_XYZ,
}


def _power(exponent: float) -> Callable[[Doubles], Doubles]:
    return lambda encoded: np.copysign(np.abs(encoded) ** exponent, encoded)


def _srgb(encoded: Doubles) -> Doubles:
    return np.copysign(inverse_srgb_curve(np.abs(encoded)), encoded)


LINEAR = "lin"
# From encoded values to light. Negative values are mirrored.
DECODERS: dict[str, Callable[[Doubles], Doubles]] = {
    "srgb": _srgb,
    "g18": _power(1.8),
    "g22": _power(2.2),
    "g24": _power(2.4),
    "g26": _power(2.6),
}
NOT_DECODED = ("pq", "hlg", "srgbe")  # high dynamic range of displays; "srgbe" is extended sRGB
DATA = ("data", "raw", "non-color", "utility - raw")  # of values that are not colours
UNKNOWN = ("unknown",)
# Other programs' names of the forum's spaces, in lower case.
ALIASES = {
    "acescg": "lin_ap1_scene",
    "aces - acescg": "lin_ap1_scene",
    "lin_ap1": "lin_ap1_scene",
    "aces2065-1": "lin_ap0_scene",
    "aces - aces2065-1": "lin_ap0_scene",
    "lin_ap0": "lin_ap0_scene",
    "linear": "lin_rec709_scene",
    "scene_linear": "lin_rec709_scene",
    "linear rec.709": "lin_rec709_scene",
    "linear rec.709 (srgb)": "lin_rec709_scene",
    "lin_srgb": "lin_rec709_scene",
    "lin_rec709": "lin_rec709_scene",
    "linear rec.2020": "lin_rec2020_scene",
    "lin_rec2020": "lin_rec2020_scene",
    "linear p3-d65": "lin_p3d65_scene",
    "lin_p3d65": "lin_p3d65_scene",
    "linear cie-xyz d65": "lin_ciexyzd65_scene",
    "srgb": "srgb_rec709_scene",
    "srgb - texture": "srgb_rec709_scene",
    "rec709": "srgb_rec709_scene",
}


@dataclass(frozen=True)
class ColourSpace:
    """A colour space that a file names.

    Args:
        name: the name, as in the file.
        chromaticities: x and y of red, green, blue and white.
        encoding: a key of :data:`DECODERS`; "" for linear light.
        is_data: whether the values are no colours.
    """

    name: str
    chromaticities: tuple[float, ...] = SRGB
    encoding: str = ""
    is_data: bool = False


def colour_space(name: str) -> ColourSpace | None:
    """Return the colour space of a name, or None if it is not known.

    >>> colour_space("ACEScg").chromaticities[:2], colour_space("srgb_p3d65_display").encoding
    ((0.713, 0.293), 'srgb')
    >>> colour_space("data").is_data, colour_space("lin_mycamera_scene")
    (True, None)

    Raises:
        ImageError: it is encoded in a way that clpipe does not decode.
    """
    key = ALIASES.get(name.casefold(), name.casefold())
    if key in DATA:
        return ColourSpace(name, is_data=True)
    encoding, _, rest = key.partition("_")
    primaries = PRIMARIES.get(rest.removesuffix("_scene").removesuffix("_display"))
    if primaries is None:
        return None
    if encoding in NOT_DECODED:
        raise ImageError(
            f"its colour space {printable(name)} is encoded for a display of high dynamic range, "
            "which clpipe does not decode; write linear light"
        )
    if encoding != LINEAR and encoding not in DECODERS:
        return None
    return ColourSpace(name, primaries, "" if encoding == LINEAR else encoding)


def named_by(spec: Any) -> Iterator[tuple[str, str]]:
    """Yield the attributes of an OpenEXR file that name its colour space, and their values.

    Args:
        spec: an ``oiio.ImageSpec``.
    """
    is_aces = spec.getattribute("acesImageContainerFlag") == 1
    named = {"colorInteropID": spec.getattribute("colorInteropID")}
    named["acesImageContainerFlag"] = "lin_ap0_scene" if is_aces else None
    named["oiio:ColorSpace"] = spec.getattribute("oiio:ColorSpace")
    for attribute, value in named.items():
        if value and str(value).casefold() not in UNKNOWN:
            yield attribute, str(value)


def space_of(spec: Any) -> tuple[ColourSpace | None, list[str]]:
    """Return the colour space that an OpenEXR file names, or None, and warnings.

    Raises:
        ImageError: two names, or a name and the chromaticities, contradict each other; or the
            encoding is not decoded.
    """
    known: list[tuple[str, ColourSpace]] = []
    warnings: list[str] = []
    for attribute, name in named_by(spec):
        space = colour_space(name)
        if space:
            known.append((attribute, space))
        elif not warnings:
            warnings.append(
                f"its colour space {printable(name)} ({attribute}) is unknown; its colours are "
                "read as its chromaticities state, else as linear sRGB"
            )
    if not known:
        return None, warnings
    (first, space), *others = known
    for attribute, other in others:
        if not _is_same(space, other):
            raise _contradiction(f"{first} {space.name}", f"{attribute} {other.name}")
    stated = spec.getattribute("chromaticities")
    if stated is not None and not space.is_data and not _are_near(stated, space.chromaticities):
        numbers = ", ".join(f"{value:g}" for value in stated)
        raise _contradiction(f"{first} {space.name}", f"chromaticities {numbers}")
    return space, warnings


def _is_same(one: ColourSpace, two: ColourSpace) -> bool:
    is_same = one.is_data == two.is_data and one.encoding == two.encoding
    return is_same and _are_near(one.chromaticities, two.chromaticities)


def _are_near(one: Sequence[float], two: Sequence[float]) -> bool:
    return len(one) == len(two) and np.allclose(one, two, atol=5e-3)


def _contradiction(one: str, two: str) -> ImageError:
    return ImageError(
        f"its {printable(one)} and its {printable(two)} contradict each other; correct or remove "
        "one of these attributes"
    )
