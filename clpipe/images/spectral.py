"""Finds the spectral bands of a file by the names of its channels."""

import re
from collections.abc import Sequence
from dataclasses import dataclass

LEAST = 4  # bands of a spectrum; fewer channels named like wavelengths may be something else
LIGHT_SPEED = 299_792_458.0  # m/s
FACTORS = {"": 1.0, "n": 1e-9, "u": 1e-6, "m": 1e-3, "k": 1e3, "M": 1e6, "G": 1e9, "T": 1e12}
# A wavelength or frequency with a unit: S0.550,00nm of Fichet et al. (JCGT 10(3), 2021) and pbrt,
# 550nm, or band.550.5nm. The decimal sign is a comma or a point.
NAME = re.compile(
    r"(?:(?P<layer>\w*[A-Za-z]\w*(?:\.\w*[A-Za-z]\w*)*)\.)?"
    r"(?P<number>\d+(?:[.,]\d+)?(?:[eE][+-]?\d+)?)(?P<prefix>[numkMGT]?)(?P<unit>m|Hz)"
)


@dataclass(frozen=True)
class Spectrum:
    """The bands of a layer, from short to long wavelengths.

    Args:
        layer: its name; "" if the channels have none.
        wavelengths: of the bands, nm.
        channels: their numbers in the file.
    """

    layer: str
    wavelengths: tuple[float, ...]
    channels: tuple[int, ...]

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
            value = float(match["number"].replace(",", ".")) * FACTORS[match["prefix"]]
            metres = LIGHT_SPEED / value if match["unit"] == "Hz" and value else value
            bands.setdefault(match["layer"] or "", []).append((round(metres * 1e9, 6), channel))
    ordered = {layer: sorted(found) for layer, found in bands.items() if len(found) >= LEAST}
    return [
        Spectrum(layer, *map(tuple, zip(*found, strict=True)))
        for layer, found in sorted(ordered.items())
    ]
