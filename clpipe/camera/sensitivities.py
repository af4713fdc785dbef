"""Spectral sensitivities of a sensor's colours."""

from typing import Annotated

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, model_validator

from clpipe.base.errors import RequestError
from clpipe.base.types import Doubles

Wavelength = Annotated[float, Field(ge=200, le=3000)]  # nm
LETTERS = "RGBWYCMIL"  # red, green, blue, clear, yellow, cyan, magenta, infrared, no filter
FILTERS = "lens_transmission", "infrared_cut"
Share = Annotated[float, Field(ge=0, le=1)]
Response = Annotated[float, Field(ge=-0.05, le=100)]  # measurements may lie slightly below 0


class Sensitivities(BaseModel):
    """The response of each colour of a filter array to light, by wavelength.

    Curves are relative and for energy, like the colour-matching functions of an observer: they have
    any unit. Or they are quantum efficiencies, in electrons per photon.

    >>> curves = {"R": (0.0, 1.0), "G": (1.0, 0.5), "B": (1.0, 0.0)}
    >>> sensitivities = Sensitivities(wavelengths=(500, 600), curves=curves)
    >>> sensitivities.at(np.array([450.0, 550.0, 600.0])).tolist()
    [[0.0, 0.0, 0.0], [0.5, 0.75, 0.5], [1.0, 0.5, 0.0]]
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    wavelengths: Annotated[tuple[Wavelength, ...], Field(min_length=2, max_length=2000)]
    # By the letters of a filter array.
    curves: Annotated[dict[str, tuple[Response, ...]], Field(min_length=1, max_length=8)]
    quantum_efficiencies: bool = False  # whether the curves are electrons per photon
    # Shares of the light that the lens and a filter against infrared pass, at the wavelengths; ()
    # if the curves contain them.
    lens_transmission: tuple[Share, ...] = ()
    infrared_cut: tuple[Share, ...] = ()

    @model_validator(mode="after")
    def _check_consistency(self) -> "Sensitivities":
        if np.any(np.diff(self.wavelengths) <= 0):
            raise ValueError("wavelengths must ascend")
        if unknown := self.curves.keys() - {*LETTERS}:
            raise ValueError(
                f"curves: found {', '.join(sorted(unknown))}; a colour is one of the letters "
                f"{', '.join(LETTERS)}"
            )
        filters = {name: getattr(self, name) for name in FILTERS}
        tables = {f"curves.{letter}": curve for letter, curve in self.curves.items()}
        for name, curve in (tables | {k: v for k, v in filters.items() if v}).items():
            if len(curve) != len(self.wavelengths):
                raise ValueError(
                    f"{name} has {len(curve)} values, but there are {len(self.wavelengths)} "
                    "wavelengths"
                )
            if max(curve) <= 0:
                raise ValueError(f"{name} is nowhere above 0")
            if self.quantum_efficiencies and max(curve) > 1:
                raise ValueError(f"{name} goes up to {max(curve):g}, above a quantum efficiency")
        return self

    def at(self, wavelengths: Doubles) -> Doubles:
        """Return the responses to energy at wavelengths, (wavelength, colour).

        They are linear between the wavelengths of the curves, and 0 outside.

        Args:
            wavelengths: nm.
        """

        def interpolated(curve: tuple[float, ...]) -> Doubles:
            return np.interp(wavelengths, self.wavelengths, curve, left=0.0, right=0.0)

        found = np.stack([interpolated(curve) for curve in self.curves.values()], axis=-1)
        for filter_ in filter(None, (self.lens_transmission, self.infrared_cut)):
            found = found * interpolated(filter_)[:, None]
        # A photon of a longer wavelength has less energy.
        return found * wavelengths[:, None] if self.quantum_efficiencies else found

    def electrons_per_energy(self, efficiency: float | None) -> float:
        """Return the factor from :meth:`at` to quantum efficiency times wavelength in m.

        Args:
            efficiency: the highest quantum efficiency of all colours. Relative curves need it.

        Raises:
            RequestError: it is needed, but None.
        """
        if self.quantum_efficiencies:
            return 1e-9
        if efficiency is None:
            raise RequestError(
                "the camera's sensitivities are relative, and its profile has no "
                "quantum_efficiency; set exposure.quantum_efficiency to that of the most sensitive "
                "colour at its peak"
            )
        peaks = np.array([*self.curves.values()]).max(0) / np.array(self.wavelengths)
        return efficiency / float(peaks.max()) * 1e-9

    @property
    def summary(self) -> str:
        """The wavelength at which each curve is highest, as text.

        >>> Sensitivities(wavelengths=(500, 600), curves={"R": (0.2, 1), "G": (1, 0.5)}).summary
        'R 600 nm, G 500 nm'
        """
        peaks = (self.wavelengths[int(np.argmax(curve))] for curve in self.curves.values())
        return ", ".join(f"{c} {nm:g} nm" for c, nm in zip(self.curves, peaks, strict=True))
