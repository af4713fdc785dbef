"""Spectral sensitivities of a sensor's colours."""

from typing import Annotated

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, model_validator

from clpipe.base.types import Doubles

Wavelength = Annotated[float, Field(ge=200, le=3000)]  # nm
Response = Annotated[float, Field(ge=-0.05, le=100)]  # measurements may lie slightly below 0


class Sensitivities(BaseModel):
    """The response of each colour of a filter array to light, by wavelength.

    Values are relative: only their ratios between wavelengths and colours have a meaning. They are
    for energy, like the colour-matching functions of an observer.

    >>> curves = {"R": (0.0, 1.0), "G": (1.0, 0.5), "B": (1.0, 0.0)}
    >>> sensitivities = Sensitivities(wavelengths=(500, 600), curves=curves)
    >>> sensitivities.at(np.array([450.0, 550.0, 600.0])).tolist()
    [[0.0, 0.0, 0.0], [0.5, 0.75, 0.5], [1.0, 0.5, 0.0]]
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    wavelengths: Annotated[tuple[Wavelength, ...], Field(min_length=2, max_length=2000)]
    curves: Annotated[dict[str, tuple[Response, ...]], Field(min_length=1, max_length=8)]

    @model_validator(mode="after")
    def _check_consistency(self) -> "Sensitivities":
        if np.any(np.diff(self.wavelengths) <= 0):
            raise ValueError("wavelengths must ascend")
        for letter, curve in self.curves.items():
            if len(curve) != len(self.wavelengths):
                raise ValueError(
                    f"curves.{letter} has {len(curve)} values, but there are "
                    f"{len(self.wavelengths)} wavelengths"
                )
            if max(curve) <= 0:
                raise ValueError(f"curves.{letter} is nowhere above 0")
        return self

    def at(self, wavelengths: Doubles) -> Doubles:
        """Return the curves at wavelengths, (wavelength, colour): linear between, 0 outside.

        Args:
            wavelengths: nm.
        """
        curves = [
            np.interp(wavelengths, self.wavelengths, curve, left=0.0, right=0.0)
            for curve in self.curves.values()
        ]
        return np.stack(curves, axis=-1)

    @property
    def summary(self) -> str:
        """The wavelength at which each curve is highest, as text.

        >>> Sensitivities(wavelengths=(500, 600), curves={"R": (0.2, 1), "G": (1, 0.5)}).summary
        'R 600 nm, G 500 nm'
        """
        peaks = (self.wavelengths[int(np.argmax(curve))] for curve in self.curves.values())
        return ", ".join(f"{c} {nm:g} nm" for c, nm in zip(self.curves, peaks, strict=True))
