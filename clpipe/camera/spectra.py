"""Spectra: lights, the eye, and what a sensor sees of them.

All integrals are sums over :data:`GRID`. Curves are linear between their points.
"""

import csv
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache, cached_property, lru_cache
from importlib import resources

import numpy as np

from clpipe.base.cache import BoundedCache, Identity
from clpipe.base.errors import RequestError
from clpipe.base.reading import read_text
from clpipe.base.text import unknown_name
from clpipe.base.types import Doubles
from clpipe.base.url_text import local_path
from clpipe.camera.colorimetry import adaptation, lab_of
from clpipe.camera.profile import SRGB_TO_XYZ, Camera, built_in_cameras, load_camera
from clpipe.camera.sensitivities import LETTERS, Sensitivities

STEP = 0.1  # nm
GRID = np.linspace(300.0, 1100.0, 8001)  # nm
ILLUMINANTS = ("A", "D65", "F11", "LED-B3")
DEFAULT_ILLUMINANT = "D65"  # the white of a render in sRGB
PLANCK_TIMES_LIGHT_SPEED = 1.98644586e-25  # J m (CODATA 2018)
ROUNDS = 20  # of Gauss-Newton; it converges in fewer
# Ideal dyes: filters without a curve of their own pass the light of these colours together.
DYES = {"W": "RGB", "L": "RGB", "Y": "RG", "C": "GB", "M": "RB"}


@cache
def _standard() -> dict[str, Doubles]:
    """Return the columns of standard.csv, by their headings; "nm" is the wavelength."""
    file = resources.files("clpipe.camera") / "data" / "standard.csv"
    names, *rows = (x.split(",") for x in file.read_text().splitlines() if x[0] != "#")
    return dict(zip(names, np.array(rows, float).T, strict=True))


def _on_grid(name: str, outside: float | None = 0.0) -> Doubles:
    """Return a column of standard.csv on the grid; None outside its range continues its ends."""
    table = _standard()
    return np.interp(GRID, table["nm"], table[name], outside, outside)


@cache
def observer() -> Doubles:
    """The CIE 1931 colour-matching functions, (wavelength, 3), with an integral of y of 1."""
    curves = np.stack([_on_grid(name) for name in "xyz"], axis=-1)
    return np.asarray(curves / (curves[:, 1].sum() * STEP))


def reflectances() -> Doubles:
    """190 reflectances to which colour matrices are fitted, (sample, wavelength)."""
    file = resources.files("clpipe.camera") / "data" / "reflectances.csv"
    rows = np.array([x.split(",") for x in file.read_text().splitlines() if x[0] != "#"], float)
    return np.stack([np.interp(GRID, _standard()["nm"], row) for row in rows])


def light(name: str) -> Doubles:
    """Return the spectrum of a light on the grid, scaled to the CIE luminance Y = 1.

    A is the formula of CIE 15:2018, D65, F11 and LED-B3 are its tables.

    >>> round(float(light("A")[2600] / light("A")[1500]), 3)  # 560 nm over 450 nm
    3.022

    Args:
        name: one of :data:`ILLUMINANTS`, or a CSV file with rows of wavelength (nm) and power.

    Raises:
        RequestError: the light is unknown, or its file is not of this form.
    """
    if name in ILLUMINANTS:
        return _named_light(name)
    if not name.endswith(".csv"):
        raise RequestError(
            f"render.illuminant: {unknown_name('light', name, ILLUMINANTS)}; or name a .csv file "
            "with rows of wavelength (nm) and power"
        )
    try:
        return _light_of(read_text(local_path("render.illuminant", name)), name)
    except OSError as error:
        raise RequestError(f"render.illuminant: {name}: {error.strerror}") from None


@cache
def _named_light(name: str) -> Doubles:
    if name == "A":
        power = (560 / GRID) ** 5 * np.expm1(1.435e7 / 2848 / 560)
        return _scaled(power / np.expm1(1.435e7 / (2848 * GRID)))
    return _scaled(_on_grid(name, None if name == "D65" else 0.0))


@lru_cache(maxsize=16)
def _light_of(text: str, name: str) -> Doubles:
    """Return the light of a CSV file. Its first row may be a heading.

    Raises:
        RequestError: it is not of this form.
    """
    points: dict[float, float] = {}
    for number, row in enumerate(csv.reader(text.splitlines()), 1):
        cells = [cell.strip() for cell in row if cell.strip()]
        if not cells or cells[0].startswith("#"):
            continue
        try:
            nm, power = map(float, cells)
        except ValueError:
            nm = power = math.nan
            if not points and number == 1:
                continue
        if not (0 < nm < math.inf and 0 <= power < math.inf) or nm in points:
            raise RequestError(
                f"render.illuminant: {name}, row {number}: found {', '.join(cells)}; expected a "
                "wavelength in nm that occurs once, and a power of 0 or more"
            )
        points[nm] = power
    known = sorted(points)
    spectrum = np.interp(GRID, known or [0.0], [points[nm] for nm in known] or [0.0], 0, 0)
    if spectrum @ observer()[:, 1] <= 0:
        raise RequestError(f"render.illuminant: {name}: the eye sees nothing of this light")
    return _scaled(spectrum)


def _scaled(spectrum: Doubles) -> Doubles:
    return np.asarray(spectrum / (spectrum @ observer()[:, 1] * STEP))


def band_edges(wavelengths: Sequence[float]) -> Doubles:
    """Return the edges of bands, nm: half-way between neighbours, and as far outside at the ends.

    >>> band_edges((400, 410, 430)).tolist()
    [395.0, 405.0, 420.0, 440.0]
    """
    centres = np.asarray(wavelengths, float)
    inner = (centres[1:] + centres[:-1]) / 2
    return np.r_[2 * centres[0] - inner[0], inner, 2 * centres[-1] - inner[-1]]


def band_weights(curves: Doubles, wavelengths: Sequence[float]) -> Doubles:
    """Return the exact integral of each curve over each band, (band, curve).

    The sum of a cube's bands with these weights is its integral with the curves, because a cube is
    constant within a band.

    >>> ramp = (GRID - GRID[0])[:, None]
    >>> band_weights(ramp, (300.5, 301.5, 302.5)).ravel().tolist()
    [0.5, 1.5, 2.5]

    Args:
        curves: on the grid, (wavelength, curve). They are 0 outside of it.
        wavelengths: of the bands, nm, ascending.
    """
    steps = (curves[1:] + curves[:-1]) / 2
    below = np.concatenate([np.zeros_like(curves[:1]), np.cumsum(steps, axis=0)])
    at = (np.clip(band_edges(wavelengths), GRID[0], GRID[-1]) - GRID[0]) / STEP
    cell = np.minimum(at.astype(int), GRID.size - 2)
    part = (at - cell)[:, None]
    slope = curves[cell + 1] - curves[cell]
    inside = part * curves[cell] + part**2 / 2 * slope
    return np.diff(below[cell] + inside, axis=0) * STEP


def missed_by(wavelengths: Sequence[float], curve: Doubles) -> float:
    """Return the share of a curve on the grid that is outside of bands."""
    low, *_, high = band_edges(wavelengths)
    return float(curve[(low > GRID) | (high < GRID)].sum() / curve.sum())


@dataclass(frozen=True, eq=False)
class Sight:
    """A sensor in the light of a scene.

    White is a surface that reflects all of the light. A channel is the letter of a filter.

    >>> from clpipe.camera.profile import load_camera
    >>> [round(gain, 2) for gain in sight_of(load_camera("sony-a7r2"), "A").gains]
    [1.65, 2.54]

    Args:
        sensitivities: of the sensor.
        light: the spectrum of the light on the grid.
    """

    sensitivities: Sensitivities
    light: Doubles

    @cached_property
    def _curves(self) -> dict[str, Doubles]:
        return dict(zip(self.sensitivities.curves, self.sensitivities.at(GRID).T, strict=True))

    def response(self, channel: str) -> Doubles:
        """Return a channel's response to energy on the grid.

        Raises:
            RequestError: the sensitivities have no curve from which it follows.
        """
        curves = self._curves
        if channel in curves:
            return curves[channel]
        dyes = DYES.get(channel, channel)
        if missing := [letter for letter in dyes if letter not in curves]:
            if missing[0] not in LETTERS:
                raise RequestError("spectra are not polarised, so a sensor needs other filters")
            raise RequestError(
                f"the camera's sensitivities have curves for {', '.join(curves)}, but not for "
                f"{missing[0]}, which the filter array needs; add this curve to the profile, or "
                "choose another mosaic"
            )
        return np.asarray(sum(curves[letter] for letter in dyes))

    def white(self, channel: str) -> float:
        """Return a channel's response to white.

        Raises:
            RequestError: as for :meth:`response`, or the channel sees nothing of the light.
        """
        found = float(self.response(channel) @ self.light) * STEP
        if found <= 0:
            raise RequestError(
                f"{channel} of the camera sees nothing of the scene's light; set another "
                "render.illuminant, or choose another mosaic"
            )
        return found

    @cached_property
    def has_colours(self) -> bool:
        """Whether it sees red, green and blue."""
        return self.sensitivities.curves.keys() >= set("RGB")

    @cached_property
    def gains(self) -> tuple[float, float]:
        """The gains of red and blue that make white grey; green = 1."""
        if not self.has_colours:
            return 1.0, 1.0
        red, green, blue = map(self.white, "RGB")
        return green / red, green / blue

    @cached_property
    def white_xyz(self) -> Doubles:
        """CIE X, Y and Z of the light, Y = 1."""
        return np.asarray(self.light @ observer() * STEP)

    @cached_property
    def _white_balanced(self) -> Doubles:
        """The light times the response of red, green and blue, with an integral of 1."""
        seen = np.stack([self.response(c) / self.white(c) for c in "RGB"], axis=-1)
        return seen * self.light[:, None] * STEP

    @cached_property
    def to_srgb(self) -> Doubles:
        """The matrix from white-balanced camera RGB to linear sRGB, (3, 3); white stays white.

        It minimises the squared differences in CIELAB of :func:`reflectances` in this light, whose
        white the eye adapts to D65 (Bradford). This is the criterion of the Academy's P-2013-001.
        """
        samples = reflectances()
        seen = samples @ self._white_balanced
        xyz = samples @ (observer() * self.light[:, None]) * STEP
        adapted = adaptation(self.white_xyz, SRGB_TO_XYZ.sum(1))
        true = xyz @ (np.linalg.inv(SRGB_TO_XYZ) @ adapted).T
        # White stays white if each row adds up to 1, so two numbers of each are free.
        free, green = seen[:, [0, 2]] - seen[:, [1]], seen[:, [1]]

        def error(numbers: Doubles) -> Doubles:
            return (lab_of(green + free @ numbers.reshape(2, 3)) - lab_of(true)).ravel()

        found = np.linalg.lstsq(free, true - green, rcond=None)[0].ravel()
        for _ in range(ROUNDS):
            now = error(found)
            slopes = [(error(found + step) - now) / 1e-6 for step in 1e-6 * np.eye(6)]
            found = found - np.linalg.lstsq(np.stack(slopes, -1), now, rcond=None)[0]
        red, blue = found.reshape(2, 3)
        matrix = np.stack([red, 1 - red - blue, blue], axis=-1)
        if not np.isfinite(matrix).all() or abs(np.linalg.det(matrix)) < 1e-6:
            raise RequestError(
                "render.illuminant: this light has too few wavelengths, so the camera sees no "
                "colours; set another light"
            )
        return matrix

    @cached_property
    def from_srgb(self) -> Doubles:
        """The matrix from linear sRGB to white-balanced camera RGB in this light, (3, 3).

        A colour is a reflectance, the sum of those for red, green and blue (Mallett and Yuksel,
        Spectral Primary Decomposition for Rendering with sRGB Reflectance, EGSR 2019).
        """
        basis = np.stack([_on_grid(name, None) for name in ("red", "green", "blue")], axis=-1)
        matrix = self._white_balanced.T @ basis
        return np.asarray(matrix / matrix.sum(1, keepdims=True))

    def weights(self, wavelengths: Sequence[float], channels: Sequence[str]) -> Doubles:
        """Return the weights that add up bands to channels, of which white is 1, (band, channel).

        The bands are radiances on the scale of renderers: a constant spectrum of 1 has the CIE
        luminance Y = 1.
        """
        curves = np.stack([self.response(c) / self.white(c) for c in channels], axis=-1)
        return band_weights(curves, wavelengths)

    def electrons(self, channel: str, efficiency: float | None) -> float:
        """Return a channel's charge per second for white, e- over the etendue in m2 sr.

        White has the luminance of a constant spectrum of 1 W/(m2 sr nm).

        Args:
            channel: the letter of the filter.
            efficiency: the quantum efficiency of the most sensitive channel at its peak. Curves
                that are quantum efficiencies do not need it.

        Raises:
            RequestError: it is needed, but not known.
        """
        scale = self.sensitivities.electrons_per_energy(efficiency)
        return self.white(channel) * scale / PLANCK_TIMES_LIGHT_SPEED


SIGHTS: BoundedCache[Sight] = BoundedCache(64)


def sight_of(camera: Camera, illuminant: str) -> Sight:
    """Return the sight of a camera in a light; the same object for the same values.

    Raises:
        RequestError: the camera's profile has no sensitivities, or the light is unknown.
    """
    spectrum, sensitivities = light(illuminant), camera.sensitivities
    if sensitivities is None:
        known = [name for name in built_in_cameras() if load_camera(name).sensitivities]
        raise RequestError(
            f"camera {camera.name}: its profile has no spectral sensitivities, which spectra and "
            f"render.illuminant need. These cameras have them: {', '.join(known)}. 'clpipe cameras "
            "import' adds them to a profile. To read a spectral render as one in sRGB, set "
            "spectral_response.method=srgb"
        )
    key = Identity(sensitivities), Identity(spectrum)
    return SIGHTS.get(key, lambda: Sight(sensitivities, spectrum))
