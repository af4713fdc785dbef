"""Spectra: lights, the eye, and what a sensor sees of them.

All integrals are sums over :data:`GRID`. Curves are linear between their points.
"""

import csv
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache, cached_property, lru_cache
from importlib import resources

import numpy as np

from clpipe.base.errors import RequestError
from clpipe.base.reading import read_text
from clpipe.base.text import unknown_name
from clpipe.base.types import Doubles
from clpipe.base.url_text import local_path
from clpipe.camera.colorimetry import adaptation, lab_of
from clpipe.camera.profile import SRGB_TO_XYZ, Camera
from clpipe.camera.sensitivities import Sensitivities

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
            f"render.illuminant: {unknown_name('light', name, ILLUMINANTS)}; or name a CSV file "
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
    rows = [row for row in csv.reader(text.splitlines()) if row and not row[0].startswith("#")]
    try:
        nm, power = np.array(rows[1:] if rows and rows[0][0].strip().isalpha() else rows, float).T
    except ValueError:
        nm = power = np.zeros(0)
    spectrum = np.interp(GRID, nm, power, 0, 0) if nm.size else np.zeros(GRID.size)
    is_valid = np.isfinite(spectrum).all() and spectrum.min() >= 0
    if not is_valid or np.any(np.diff(nm) <= 0) or spectrum @ observer()[:, 1] <= 0:
        raise RequestError(
            f"render.illuminant: {name}: this is not the spectrum of a light. Each row needs a "
            "wavelength in nm, in ascending order, and a power of 0 or more, some of it visible"
        )
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

    def response(self, channel: str) -> Doubles:
        """Return a channel's response to energy on the grid.

        Raises:
            RequestError: the sensitivities have no curve from which it follows.
        """
        curves = dict(zip(self.sensitivities.curves, self.sensitivities.at(GRID).T, strict=True))
        if channel in curves:
            return curves[channel]
        dyes = DYES.get(channel, channel)
        if missing := [letter for letter in dyes if letter not in curves]:
            raise RequestError(
                f"the camera's sensitivities have curves for {', '.join(curves)}, but not for "
                f"{missing[0]}, which the filter array needs; add this curve to the profile, or "
                "choose another mosaic"
            )
        return np.asarray(sum(curves[letter] for letter in dyes))

    def white(self, channel: str) -> float:
        """Return a channel's response to white."""
        return float(self.response(channel) @ self.light) * STEP

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
        return np.stack([red, 1 - red - blue, blue], axis=-1)

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

    def missed(self, wavelengths: Sequence[float], channel: str) -> float:
        """Return the share of a channel's response to white outside of the bands."""
        curve = self.response(channel) * self.light
        low, *_, high = band_edges(wavelengths)
        return float(curve[(low > GRID) | (high < GRID)].sum() / curve.sum())

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


@lru_cache(maxsize=64)
def _sight(text: str, light_bytes: bytes) -> Sight:
    sensitivities = Sensitivities.model_validate_json(text)
    return Sight(sensitivities, np.frombuffer(light_bytes))


def sight_of(camera: Camera, illuminant: str) -> Sight:
    """Return the sight of a camera in a light; the same object for the same values.

    Raises:
        RequestError: the camera's profile has no sensitivities, or the light is unknown.
    """
    spectrum = light(illuminant)
    if camera.sensitivities is None:
        raise RequestError(
            f"camera {camera.name}: its profile has no spectral sensitivities, which spectra and "
            "render.illuminant need. 'clpipe cameras' lists the cameras that have them, and "
            "'clpipe cameras import' adds them to a profile. To read a spectral render as one in "
            "sRGB, set spectral_response.method=srgb"
        )
    return _sight(camera.sensitivities.model_dump_json(), spectrum.tobytes())
