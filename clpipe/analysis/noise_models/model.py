"""The noise of a sensor from a file of another program, and the camera profile made from it."""

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from clpipe.base.text import printable
from clpipe.camera.profile import SRGB_TO_XYZ, Camera, Matrix, built_in_name, load_camera
from clpipe.camera.text import profile_text

# The middles of the ranges in Brooks et al. (CVPR 2019): red 1.9 to 2.4, blue 1.5 to 1.9.
DEFAULT_GAINS = (2.15, 1.70)

# Slope and offset of ln(read noise in 14-bit DN) as a function of ln(system gain). They are means
# over the five cameras of Wei et al., CVPR 2020 (github.com/Vandermode/ELD).
READ_NOISE_SLOPE, READ_NOISE_OFFSET = 0.600, 1.521
READ_NOISE_RANGE = 15871.0  # DN of the signal 1 in Wei et al.: 14 bits, black level 512

NOT_IN_FILE = "not in the file, and not known; assumed to be zero"


@dataclass(frozen=True)
class Levels:
    """The black and white level of a sensor in DN, and their source."""

    black: float
    white: float
    source: str


TEN_BITS = Levels(64, 1023, "not in the file; assumed: 10 bits, black 64")
FOURTEEN_BITS = Levels(512, 16383, "not in the file; assumed: 14 bits, black 512")


@dataclass(frozen=True)
class Law:
    """Var[y] = a*y + b at an ISO; b is None if not known."""

    iso: float
    a: float
    b: float | None


@dataclass(frozen=True)
class SensorModel:
    """The noise of a camera that a file states.

    Attributes:
        make: the make of the camera; "unknown" if the file does not state it.
        model: the model of the camera.
        laws: one law for each ISO, ascending, at least one; a and b are above 0.
        source: the source of the laws.
        levels: the levels of the file, or assumed levels.
        in_file: whether the levels are from the file.
        gains: white balance gains of red and blue (green = 1), if the file states them.
        xyz_to_camera: the matrix from XYZ to camera RGB at D65, if it is known.
        matrix_source: the source of the matrix.
    """

    make: str
    model: str
    laws: Sequence[Law]
    source: str
    levels: Levels
    in_file: bool = False
    gains: tuple[float, float] | None = None
    xyz_to_camera: Matrix | None = None
    matrix_source: str = ""

    @property
    def name(self) -> str:
        """The name for a profile: make and model in lower case, with hyphens."""
        words = re.findall(r"[^\W_]+", f"{self.make} {self.model}".casefold())
        return "-".join(word for word in dict.fromkeys(words) if word != "corporation")

    def profile(self, name: str) -> str:
        """Return the text of a camera profile.

        system_gain = a * range and read_noise = sqrt(b) * range (EMVA 1288), where the range is
        the white level minus the black level. If the camera is built in, values that the file does
        not state are those of the built-in profile.

        Args:
            name: the name of the profile.
        """
        built_in = built_in_name(f"{self.make} {self.model}")
        known = load_camera(built_in) if built_in else None
        levels = self.levels
        if known and not self.in_file:
            source = f"not in the file; those of the built-in {known.name}"
            levels = Levels(known.black_level, known.white_level, source)
        unit = levels.white - levels.black
        gain_source, read_source = self.source, f"{self.source}; read_noise = sqrt(b) * range"
        if any(law.b is None for law in self.laws):
            read_source = (
                f"not known; assumed: ln(sigma) = {READ_NOISE_SLOPE} ln(system_gain) + "
                f"{READ_NOISE_OFFSET} in 14-bit DN, the mean of five cameras in Wei et al. "
                "2020 (github.com/Vandermode/ELD). Single cameras differ by a factor of 2"
            )
        colours, sources = self._colours(known)
        values = {
            "name": name,
            "make": printable(self.make),
            "model": printable(self.model),
            "black_level": levels.black,
            "white_level": levels.white,
            **colours,
            "iso_range": (self.laws[0].iso, self.laws[-1].iso),
        }
        stage = {
            "iso": [law.iso for law in self.laws],
            "system_gain": [law.a * unit for law in self.laws],
            "read_noise": [read_noise(law) * unit for law in self.laws],
        }
        return profile_text(
            values,
            [stage],
            {
                "system_gain": f"{gain_source}; system_gain = a * range",
                "read_noise": read_source,
                "levels": levels.source,
                **sources,
                "row_noise": NOT_IN_FILE,
                "column_noise": NOT_IN_FILE,
                "fixed_pattern": f"PRNU, DSNU, hot and dead pixels: {NOT_IN_FILE}",
                "full_well": "not in the file; the ADC clips first",
            },
        )

    def _colours(self, known: Camera | None) -> tuple[dict[str, Any], dict[str, str]]:
        """Return white balance gains and matrix of the profile, with their sources."""
        matrix: Matrix | None
        if self.xyz_to_camera:
            gains, matrix = gains_at_d65(self.xyz_to_camera), self.xyz_to_camera
            source = "D65 through xyz_to_camera: green/red and green/blue of the camera neutral"
            matrix_source = self.matrix_source
        elif known:
            gains, matrix = known.white_balance_gains, known.xyz_to_camera
            source = matrix_source = f"not in the file; as the built-in {known.name} has it"
        else:
            gains, matrix = self.gains or DEFAULT_GAINS, None
            source = "as the file has it, as shot"
            if not self.gains:
                source = "not in the file; assumed: the middle of the range of Brooks et al. 2019"
            matrix_source = "not in the file, so colours stay as they are"
        colours: dict[str, Any] = {"white_balance_gains": gains}
        if matrix:
            colours["xyz_to_camera"] = matrix
        return colours, {"white_balance_gains": source, "xyz_to_camera": matrix_source}


def read_noise(law: Law) -> float:
    """Return the standard deviation without light in signal units; estimated if it is unknown."""
    if law.b is not None:
        return math.sqrt(law.b)
    gain = law.a * READ_NOISE_RANGE
    return math.exp(READ_NOISE_SLOPE * math.log(gain) + READ_NOISE_OFFSET) / READ_NOISE_RANGE


def gains_at_d65(xyz_to_camera: Matrix) -> tuple[float, float]:
    """Return the white balance gains of red and blue (green = 1) at D65.

    >>> gains_at_d65(((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)))
    (1.0521, 0.9182)
    """
    red, green, blue = np.array(xyz_to_camera) @ SRGB_TO_XYZ.sum(1)
    return round(float(green / red), 4), round(float(green / blue), 4)
