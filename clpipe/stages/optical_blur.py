"""Blur by the optics before the photosites: lens, low-pass filter, and photosite area."""

from dataclasses import replace
from functools import lru_cache
from math import erf, sqrt
from pathlib import Path
from typing import ClassVar, Self

import numpy as np
from pydantic import field_validator

from clpipe.base.errors import ImageError
from clpipe.base.types import Doubles, Floats
from clpipe.reference.convolve import NEGLIGIBLE, blur, convolve, tap_radius, taps_of
from clpipe.stage import (
    Arguments,
    CompileTime,
    Context,
    Kind,
    Method,
    Pass,
    ReferenceContext,
    StageRole,
    Stencil,
    Unchanged,
    parameter,
    pure,
    rgb_stage,
)
from clpipe.stages.vignetting import relative_radius

WAVELENGTHS = (0.600, 0.540, 0.460)  # um, about the middle of the passbands of red, green and blue
MAX_PSF_SIZE = 65  # px; the side of a measured point spread function
OVERSAMPLING = 8  # samples per pixel for the calculation of diffraction
# Share of the light of a diffraction pattern that is kept, because its rings are infinite.
ENCLOSED_ENERGY = 0.995
DEFAULT_SIGMA = 0.65  # px
MAX_UNROLLED_RADIUS = 3  # px; a wider blur takes two launches, one along rows and one along columns


def line_spread(sigma: float, low_pass: float, pixel_area: float) -> Doubles:
    """Return the light of a pixel along a row or a column: (pixel,) of odd length, of sum 1.

    The light is uniform over the pixel's square, blurred by a Gaussian, doubled by the low-pass
    filter, and collected by photosites of some side. All arguments are in px; see :class:`Lens`.

    >>> line_spread(0, 0, 0).tolist(), line_spread(0, 1, 0).tolist()
    ([0.0, 1.0, 0.0], [0.25, 0.5, 0.25])
    >>> line_spread(0.3, 0, 0).round(2).tolist()
    [0.0, 0.05, 0.9, 0.05, 0.0]
    """
    reach = int(np.ceil(4 * sigma + (low_pass + pixel_area) / 2 + 0.5))
    edges = np.arange(-reach, reach + 2) - 0.5
    samples = 64 if pixel_area else 1
    positions = ((np.arange(samples) + 0.5) / samples - 0.5) * pixel_area
    positions = np.concatenate([positions - low_pass / 2, positions + low_pass / 2])
    from_edges = edges[:, None] - positions
    if sigma:
        cumulative = (1 + np.vectorize(erf)(from_edges / (sigma * sqrt(2)))) / 2
    else:
        cumulative = (np.sign(from_edges) + 1) / 2
    light = np.diff(cumulative, axis=0).mean(1)
    return np.asarray(light / light.sum(), np.float64)


def diffraction_psf(
    sigma: float, low_pass: float, pixel_area: float, f_number: float, pitch: float
) -> Doubles:
    """Return the light of :func:`line_spread` with diffraction: a point spread function.

    It has the shape (height, width, 3), and is the Fourier transform of the product of all transfer
    functions. That of a round aperture is (2 / pi)(acos(v) - v sqrt(1 - v^2)), v = frequency *
    wavelength * f-number (Goodman, Introduction to Fourier Optics, 3rd ed. 2005, eq. 6-31).

    Args:
        sigma: as for :func:`line_spread`.
        low_pass: as for :func:`line_spread`.
        pixel_area: as for :func:`line_spread`.
        f_number: of the lens.
        pitch: of the photosites, in um.
    """
    size = 2 * MAX_PSF_SIZE * OVERSAMPLING
    frequency = np.fft.fftfreq(size, 1 / OVERSAMPLING)  # cycles per pixel
    axis_transfer = np.exp(-2 * (np.pi * sigma * frequency) ** 2) * np.cos(
        np.pi * low_pass * frequency
    )
    axis_transfer *= np.sinc(pixel_area * frequency) * np.sinc(frequency)
    radial = np.hypot(frequency[:, None], frequency)
    planes = []
    for wavelength in WAVELENGTHS:
        v = np.minimum(radial * wavelength * f_number / pitch, 1)
        transfer = 2 / np.pi * (np.arccos(v) - v * np.sqrt(1 - v**2))
        light = np.fft.ifft2(transfer * axis_transfer[:, None] * axis_transfer).real[
            ::OVERSAMPLING, ::OVERSAMPLING
        ]
        planes.append(np.fft.fftshift(np.maximum(light, 0)))
    psf = np.stack(planes, -1)
    centre = psf.shape[0] // 2
    for reach in range(MAX_PSF_SIZE // 2 + 1):
        part = psf[centre - reach : centre + reach + 1, centre - reach : centre + reach + 1]
        if (part.sum((0, 1)) >= ENCLOSED_ENERGY * psf.sum((0, 1))).all():
            break
    return np.asarray(part / part.sum((0, 1)))


@lru_cache(maxsize=16)
def read_psf(path: str) -> Doubles:
    """Return the point spread function in an image file, (height, width, 3), each channel of sum 1.

    Raises:
        ValueError: the file cannot be read, or does not contain such a function.
    """
    from clpipe.images.read import ReadOptions, read_source  # this import is slow and rarely needed

    try:
        pixels = read_source(Path(path), Kind.RGB, ReadOptions(transfer="linear")).pixels
    except ImageError as error:
        raise ValueError(str(error)) from None
    height, width = pixels.shape[:2]
    if height % 2 == 0 or width % 2 == 0 or max(height, width) > MAX_PSF_SIZE:
        raise ValueError(
            f"{path}: a point spread function has odd sides up to {MAX_PSF_SIZE} px, and its "
            f"middle pixel is the centre; this image is {width}x{height}"
        )
    if pixels.min() < 0:
        raise ValueError(
            f"{path}: a point spread function has no negative values, but the "
            f"smallest here is {pixels.min():g}"
        )
    total = pixels.sum((0, 1), dtype=np.float64)
    if not total.all():
        raise ValueError(f"{path}: every pixel of a channel is 0; give each channel some light")
    return np.asarray(pixels / total)


@pure
@lru_cache(maxsize=64)
def half_line_spread(sigma: float, low_pass: float, pixel_area: float) -> Floats:
    """Return the middle and one side of :func:`line_spread`, without negligible weights.

    >>> [round(float(weight), 2) for weight in half_line_spread(0.4, 0, 0)]
    [0.79, 0.11]
    """
    light = line_spread(sigma, low_pass, pixel_area)
    side = light[len(light) // 2 :]
    remaining_light = 2 * np.cumsum(side[::-1])[::-1]
    kept = side[remaining_light > NEGLIGIBLE / 2]
    return np.asarray(kept / (2 * kept.sum() - kept[0]), np.float32)


@pure
@lru_cache(maxsize=64)
def line_taps(sigma: float, low_pass: float, pixel_area: float) -> tuple[Floats, Floats]:
    """Return the taps of :func:`half_line_spread` along a row, and those along a column."""
    side = half_line_spread(sigma, low_pass, pixel_area).astype(np.float64)
    row = np.concatenate([side[:0:-1], side])[None, :, None].repeat(3, 2)
    return taps_of(row), taps_of(row.transpose(1, 0, 2))


@pure
@lru_cache(maxsize=64)
def lens_taps(
    sigma: float, low_pass: float, pixel_area: float, f_number: float, pitch: float, psf: str
) -> Floats:
    """Return the taps of a lens; see :class:`Lens`. An ``f_number`` of 0 disables diffraction."""
    if f_number:
        kernel = diffraction_psf(sigma, low_pass, pixel_area, f_number, pitch)
    else:
        line = line_spread(sigma, low_pass, pixel_area)
        kernel = np.multiply.outer(line, line)[..., None].repeat(3, 2)
    return taps_of(convolve_psfs(read_psf(psf), kernel) if psf else kernel)


def convolve_psfs(first: Doubles, second: Doubles) -> Doubles:
    """Return the convolution of two point spread functions."""
    height, width = (a + b - 1 for a, b in zip(first.shape, second.shape[:2], strict=False))
    total = np.zeros((height, width, 3))
    for (y, x), weights in zip(np.ndindex(*second.shape[:2]), second.reshape(-1, 3), strict=True):
        total[y : y + first.shape[0], x : x + first.shape[1]] += first * weights
    return total


class Lens(Method):
    """The blur of a good lens, so that hard edges alias no more than in photographs.

    The point spread function is the Gaussian of the lens's aberrations. You can add the diffraction
    of an aperture, the four spots of a low-pass filter, and the area of the photosites. The light
    of a pixel of the render is uniform over the pixel. The modulation transfer function of
    aberrations along a row is therefore exp(-2 (pi sigma f)^2) sinc(f), f in cycles per pixel,
    apart from aliasing. Renderers average over pixels themselves, so photosites are points by
    default. The blur only moves light, so the mean does not change.

    >>> from clpipe.stage import run_reference
    >>> dot = np.zeros((3, 5, 3), np.float32)
    >>> dot[1, 2] = 1
    >>> run_reference(Lens(), dot)[1, :, 0].astype(float).round(2).tolist()
    [0.01, 0.12, 0.32, 0.12, 0.01]
    """

    method: ClassVar = "lens"
    kernel: ClassVar = "convolve"
    overscan: ClassVar = True
    summary: ClassVar = (
        "a good lens; optionally diffraction, a low-pass filter or a measured function"
    )
    example: ClassVar = {"sigma": 0.7}
    other_examples: ClassVar = (
        {"sigma": 1.6},
        {"sigma": 0.3, "f_number": 11.0, "low_pass": 0.6},
        {"corner": 0.8},
    )

    sigma: float | None = parameter(
        None,
        "Sigma of the lens's aberrations; 0 disables them.",
        "px",
        f"{DEFAULT_SIGMA:g}, 0 with a psf",
        ge=0,
        le=8,
    )
    f_number: float | None = parameter(
        None, "f-number for diffraction.", "", "no diffraction", optics=True, ge=0.5, le=64
    )
    pixel_pitch: float | None = parameter(
        None,
        "Distance between photosites, for diffraction.",
        "um",
        "from the camera",
        optics=True,
        gt=0,
        le=100,
    )
    low_pass: float = parameter(
        0.0,
        "Distance between the spots of an optical low-pass filter; 0 means none.",
        "px",
        ge=0,
        le=4,
    )
    pixel_area: float = parameter(
        0.0, "Side of a photosite's light-sensitive square; 0 is a point.", "px", ge=0, le=1
    )
    corner: float = parameter(
        0.0,
        "Sigma of a blur that is added at the corners, and decreases to none at the centre.",
        "px",
        ge=0,
        le=4,
    )
    psf: str | None = parameter(
        None,
        "Image of a measured point spread function, up to 65x65, in linear light.",
        "",
        "none",
        file=True,
    )

    @field_validator("psf")
    @classmethod
    def _check_psf(cls, psf: str | None) -> str | None:
        if psf is not None:
            read_psf(psf)
        return psf

    def resolve(self, context: Context) -> Self:
        pitch = context.optics.pixel_pitch or context.camera.pixel_pitch
        if self.f_number and not (pitch or self.pixel_pitch):
            raise ValueError(
                "pixel_pitch: diffraction needs this parameter, but the profile of camera "
                f"{context.camera.name} does not contain it; set pixel_pitch in um"
            )
        return self.with_defaults(sigma=0.0 if self.psf else DEFAULT_SIGMA, pixel_pitch=pitch)

    @property
    def _separable_arguments(self) -> tuple[float, float, float] | None:
        """The arguments of :func:`line_spread` if it describes the whole blur, else None."""
        assert self.sigma is not None
        is_separable = self.f_number is None and self.psf is None
        return (self.sigma, self.low_pass, self.pixel_area) if is_separable else None

    @property
    def _taps(self) -> Floats:
        assert self.sigma is not None
        pitch = (self.pixel_pitch or 0.0) if self.f_number else 0.0
        return lens_taps(
            self.sigma, self.low_pass, self.pixel_area, self.f_number or 0.0, pitch, self.psf or ""
        )

    def passes(self) -> tuple[Pass, ...]:
        if not self.corner:
            return self._even_passes()
        reach = len(half_line_spread(self.corner, 0, 0)) - 1
        names = ("extent", "corner_reach", "corner_weights")
        *others, last = self._even_passes() or (None,)
        field = Pass("field_blur", Stencil(reach), names, ("even",) if last else ("src",))
        return (*others, *([replace(last, writes="even", kind=Kind.RGB)] if last else []), field)

    def _even_passes(self) -> tuple[Pass, ...]:
        """The passes of the blur that is the same in the whole image."""
        lines = self._separable_arguments
        if lines is None:
            radius = tap_radius(self._taps)
            return (Pass("convolve", Stencil(radius), ("taps", "count")),)
        reach = len(half_line_spread(*lines)) - 1
        if reach == 0:
            return ()
        if reach <= MAX_UNROLLED_RADIUS:
            return (Pass("blur", Stencil(reach), ("reach", "weights")),)
        across, down = (("across", "count"), ("down", "count"))
        return (
            Pass("convolve", Stencil(reach), across, writes="rows"),
            Pass("convolve", Stencil(reach), down, reads=("rows",)),
        )

    def arguments(self, context: Context) -> Arguments:
        return {**self._even_arguments(), **(self._corner_arguments() if self.corner else {})}

    def _corner_arguments(self) -> Arguments:
        weights = half_line_spread(self.corner, 0, 0)
        reach = CompileTime(str(len(weights) - 1))
        return {"extent": CompileTime("e"), "corner_reach": reach, "corner_weights": weights}

    def _even_arguments(self) -> Arguments:
        lines = self._separable_arguments
        if lines is None:
            return {"taps": self._taps, "count": len(self._taps)}
        weights = half_line_spread(*lines)
        if len(weights) - 1 <= MAX_UNROLLED_RADIUS:
            return {"reach": CompileTime(str(len(weights) - 1)), "weights": weights}
        across, down = line_taps(*lines)
        return {"across": across, "down": down, "count": len(across)}

    def reference(self, image: Floats, inputs: ReferenceContext) -> Floats:
        resolved = self.resolve(inputs.context)
        even = resolved._even_reference(image)
        if not self.corner:
            return even
        blurred = blur(even, half_line_spread(self.corner, 0, 0))
        share = np.minimum(relative_radius(image), np.float32(1))[..., None]
        return np.asarray(even + share * (blurred - even))

    def _even_reference(self, image: Floats) -> Floats:
        lines = self._separable_arguments
        if lines is None:
            return convolve(image, self._taps)
        weights = half_line_spread(*lines)
        if len(weights) - 1 <= MAX_UNROLLED_RADIUS:
            return blur(image, weights)
        across, down = line_taps(*lines)
        return convolve(convolve(image, across), down)


class NoBlur(Unchanged):
    """No blur: the image keeps the sharpness of the render."""

    summary: ClassVar = "no blur"


STAGE = rgb_stage(
    "optical_blur",
    "Blur by the lens and by the filter before the sensor.",
    (Lens, NoBlur),
    role=StageRole.LENS,
)
