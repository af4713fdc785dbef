"""Finds the spectral bands of a file by the names of its channels."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

from clpipe.base.errors import ImageError
from clpipe.base.text import printable

LEAST = 4  # bands of a spectrum; fewer channels named like wavelengths may be something else
LIGHT_SPEED = 299_792_458.0  # m/s
FACTORS = {"": 1.0, "n": 1e-9, "u": 1e-6, "m": 1e-3, "k": 1e3, "M": 1e6, "G": 1e9, "T": 1e12}
# A wavelength or frequency: S0.550,00nm of Fichet et al. (JCGT 10(3), 2021) and pbrt, 550nm,
# band_550nm as named for Mitsuba's specfilm, or 550. The decimal sign is a comma or a point.
NAME = re.compile(
    r"(?:(?P<layer>\w*[A-Za-z]\w*(?:\.\w*[A-Za-z]\w*)*)\.)?(?:[A-Za-z]+_)?"
    r"(?P<number>\d+(?:[.,]\d+)?(?:[eE][+-]?\d+)?)(?:(?P<prefix>[numkMGT]?)(?P<unit>m|Hz))?"
)
WITHOUT_UNIT = (300, 1100)  # nm; the range of plain numbers that are wavelengths
SPECTRAL = "spectral"  # the name by which --layer selects the bands
STOKES = ("S1", "S2", "S3")  # layers of polarised light (Fichet et al.)
REFLECTIVE = "T"  # the layer of reflectances
OF_SPECTRA = ("EV", "lensTransmission", "cameraResponse")  # attributes (Fichet et al.)


@dataclass(frozen=True)
class Spectrum:
    """The bands of a layer, from short to long wavelengths.

    Args:
        layer: its name; "" if the channels have none.
        wavelengths: of the bands, nm.
        channels: their numbers in the part.
        part: the number of the part in the file.
        view: the number of the view in a stereo picture.
        name: the name of the layer, without the view's name.
    """

    layer: str
    wavelengths: tuple[float, ...]
    channels: tuple[int, ...]
    part: int = 0
    view: int = 0
    name: str = ""

    @property
    def component(self) -> str:
        """The last part of its name, such as S0."""
        return self.name.rpartition(".")[2]

    def is_in(self, layer: str) -> bool:
        """Return whether it is in a layer, or in a part or view of this name, in any case."""
        names = self.layer.lower(), self.name.lower()
        return layer.lower() in names or names[0].startswith(f"{layer.lower()}.")

    def __str__(self) -> str:
        layer = f" (layer {self.layer})" if self.layer else ""
        low, high = self.wavelengths[0], self.wavelengths[-1]
        return f"{len(self.channels)} spectral bands from {low:g} to {high:g} nm{layer}"


def spectra_in(names: Sequence[str]) -> list[Spectrum]:
    """Return the spectra among channels, in the order of their layers' names.

    >>> names = ["R", *(f"S0.{nm},50nm" for nm in (500, 400, 600, 700))]
    >>> [spectrum] = spectra_in(names)
    >>> spectrum.wavelengths, spectrum.channels, str(spectrum)[:40]
    ((400.5, 500.5, 600.5, 700.5), (2, 1, 3, 4), '4 spectral bands from 400.5 to 700.5 nm ')

    Args:
        names: of a part's channels.
    """
    bands: dict[str, list[tuple[float, int]]] = {}
    for channel, name in enumerate(names):
        if match := NAME.fullmatch(name):
            value = float(match["number"].replace(",", ".")) * FACTORS[match["prefix"] or ""]
            if not match["unit"]:
                if not WITHOUT_UNIT[0] <= value <= WITHOUT_UNIT[1]:
                    continue
                value *= 1e-9
            metres = LIGHT_SPEED / value if match["unit"] == "Hz" and value else value
            bands.setdefault(match["layer"] or "", []).append((round(metres * 1e9, 6), channel))
    ordered = {layer: sorted(found) for layer, found in bands.items() if len(found) >= LEAST}
    found = []
    for layer, listed in sorted(ordered.items()):
        wavelengths, channels = zip(*listed, strict=True)
        found.append(Spectrum(layer, wavelengths, channels, name=layer))
    return found


def spectral_warnings(spec: Any) -> list[str]:
    """Return warnings about what a file with bands states in its ``oiio.ImageSpec``."""
    stated = {name: spec.getattribute(name) for name in OF_SPECTRA}
    warnings = [
        f"its {name}, {printable(str(value))[:60]}, is not applied"
        for name, value in stated.items()
        if value is not None
    ]
    if "Mitsuba" in str(spec.getattribute("generatedBy") or ""):
        warnings.append(
            "its bands are read as radiance per nm; the response of each band of Mitsuba's "
            "specfilm must therefore have the integral 1"
        )
    return warnings


def light_in(path: Path, spectra: Sequence[Spectrum], layer: str | None = None) -> Spectrum:
    """Return the spectrum of the light among those of a file.

    Args:
        path: the file, for messages.
        spectra: its spectra in this layer, at least one.
        layer: the name of the layer; None or :data:`SPECTRAL` chooses.

    Raises:
        ImageError: no spectrum is light, several may be it, or two bands are the same.
    """
    emitted = [each for each in spectra if each.component not in (*STOKES, REFLECTIVE)]
    if not emitted:
        raise ImageError(
            f"{path}: its {spectra[0]} are reflectances or parts of polarised light, not the light "
            "that reaches a camera. Render the scene under a light, and write the layer S0"
        )
    first = min(each.view for each in emitted)
    emitted = [each for each in emitted if each.view == first]
    others = [each.component for each in spectra if each.view == first]
    if polarised := [name for name in STOKES if name in others]:
        raise ImageError(
            f"{path}: this light is polarised (layers {', '.join(polarised)}), but clpipe's "
            f"filters are not. To use only its intensity, add --layer {emitted[0].layer}"
        )
    if len(emitted) > 1:
        raise ImageError(
            f"{path}: {len(emitted)} layers hold spectral bands: {', '.join(map(str, emitted))}. "
            f"Name one with --layer, such as {emitted[0].layer or emitted[1].layer}"
        )
    found = emitted[0]
    if repeated := [nm for nm, after in pairwise(found.wavelengths) if after <= nm]:
        raise ImageError(f"{path}: two of its channels are the band of {repeated[0]:g} nm")
    return found
