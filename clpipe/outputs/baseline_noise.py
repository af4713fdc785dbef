"""Finds the strength of a baseline's noise that matches the noise of the noisy picture.

A baseline is a simple noise model for comparison. The variance of each channel is matched in the
finished pictures, where values are clipped at black and at white.
"""

from dataclasses import dataclass, field
from statistics import NormalDist

import numpy as np

from clpipe.base.types import Array, Doubles, Floats, Mask
from clpipe.chain.rendition import IID, Rendition
from clpipe.images.encoding import Encoding
from clpipe.images.jpeg import JpegEncoding, jpeg_round_trip
from clpipe.outputs.noise_areas import FLAT, HALVED, covariance, halved, select_flat
from clpipe.reference.curve import to_8_bit
from clpipe.stage import run_reference
from clpipe.stages.picture_noise import CHANNELS, IidGaussian, IntensityDependent, NoNoise

MAX_SIGMA = 1.0  # largest sigma, relative to full scale
CURVE_POINTS = 65  # intensities at which the sigma of INTENSITY is known
HISTOGRAM_BINS = 1024  # bins of the histogram of the clean picture
QUANTILES = np.array([NormalDist().inv_cdf((i + 0.5) / 64) for i in range(64)])
QUANTILES /= QUANTILES.std()
INDEPENDENT_LEFT = 0.25  # averaging 2x2 leaves this share of the variance of independent noise
MAX_ITERATIONS = 8  # iterations; each applies noise to the picture, and four are usually enough
TOLERANCE = 0.003  # the search stops at this relative error of a variance


@dataclass(eq=False)
class NoiseMatcher:
    """Measures the noise of a noisy picture, and matches the noise of baselines to it.

    Pass the pictures to :meth:`take` one by one.

    Args:
        renditions: the pictures to measure, in the order of :meth:`take`: the noisy picture, its
            ground truth of development, and its clean ground truth.
        matching: in which pixels, and on which encoding, the baseline's noise is matched.
        encoding: how the pictures are encoded.
    """

    renditions: tuple[Rendition, Rendition, Rendition]
    matching: NoNoise
    encoding: Encoding
    _noisy: Floats | None = None
    _clean: Floats | None = None  # None if no noise has to be applied to the clean picture
    _mask: Mask | None = None  # the pixels in which noise is matched; None means all
    _covariance: Doubles = field(default_factory=lambda: np.zeros((3, 3)))
    _curves: list[Doubles] = field(default_factory=list)
    _intensities: list[Array] = field(default_factory=list)

    def take(self, rendition: Rendition, picture: Floats) -> None:
        """Measure a picture. Renditions that are not needed are ignored.

        Args:
            rendition: the rendition of the picture.
            picture: (height, width, 3) display values, float32.
        """
        noisy, developed, clean = self.renditions
        if rendition == noisy:
            self._noisy = self._as_displayed(picture)
        elif rendition == developed and self._noisy is not None:
            truth = self._as_displayed(picture)
            noise = self._noisy - truth
            self._noisy = None
            if self.matching.match == FLAT:
                self._mask = select_flat(truth, noise[None], np.ones(truth.shape[:2], bool))
            self._covariance = self._covariance_of(noise)
            planes = zip(self._selected(truth).T, self._selected(noise).T, strict=True)
            self._curves = [curve_of(*each) for each in planes]
        elif rendition == clean:
            if self.matching.jpeg or self.matching.match == HALVED:
                self._clean = picture.copy()
            self._intensities = [
                np.histogram(np.clip(plane, -0.5, 1.5), HISTOGRAM_BINS, (-0.5, 1.5))[0]
                for plane in self._selected(picture).T
            ]

    def _as_displayed(self, picture: Floats) -> Floats:
        """Return a picture as users see it: clipped at black and white, or after JPEG encoding."""
        if not self.matching.jpeg:
            return np.clip(picture, 0, 1)
        encoding = JpegEncoding(self.encoding.jpeg_quality, self.encoding.jpeg_subsampling)
        return np.asarray(
            jpeg_round_trip(to_8_bit(picture), encoding) / np.float32(255), np.float32
        )

    def _selected(self, picture: Floats) -> Floats:
        """Return the pixels in which noise is matched, (pixel, 3)."""
        return picture.reshape(-1, 3) if self._mask is None else picture[self._mask]

    def _covariance_of(self, noise: Floats) -> Doubles:
        """Return the 3x3 covariance of red, green and blue in the pixels that are matched."""
        if self.matching.match == HALVED:
            return covariance(halved(noise[None]))
        return covariance(self._selected(noise)[None, None])

    def method(self, baseline: str) -> tuple[IidGaussian | IntensityDependent, dict[str, float]]:
        """Return the noise of a baseline, one of :data:`clpipe.chain.rendition.BASELINES`.

        Returns:
            The method. If its noise had to be applied to the picture, also the ratio of its
            variance to that of the picture's noise, by name; otherwise {}.
        """
        target = np.diag(self._covariance)
        curves = [np.ones(2)] * 3 if baseline == IID else self._curves
        remaining = INDEPENDENT_LEFT if self.matching.match == HALVED else 1.0
        channels = zip(target / remaining, curves, self._intensities, strict=True)
        strengths = np.array([strength_for(*channel) for channel in channels])
        method = self._with_strength(baseline, strengths)
        if self._clean is None or not (target > 0).all():
            return method, {}
        # JPEG's luma and chroma couple the channels, so the error of a channel depends on all
        # strengths. Solve for them with Broyden's method (1965) in logarithms. Start from the unit
        # matrix.
        clean, best, best_ratio, best_error = (
            self._as_displayed(self._clean),
            method,
            np.ones(3),
            np.inf,
        )
        slope, step, before = np.eye(3), np.zeros(3), np.zeros(3)
        for _ in range(MAX_ITERATIONS):
            noise = self._as_displayed(run_reference(method, self._clean)) - clean
            ratio = np.diag(self._covariance_of(noise)) / target
            error = np.log(np.maximum(ratio, 1e-3))
            if np.abs(error).max() < best_error:
                best, best_ratio, best_error = method, ratio, np.abs(error).max()
            if best_error < TOLERANCE:
                break
            if step.any():
                slope += np.outer(error - before - slope @ step, step) / (step @ step)
            before, step = error, (np.linalg.pinv(slope) @ -error).clip(-1, 1)
            strengths = strengths * np.exp(step / 2)
            method = self._with_strength(baseline, strengths)
        names = (f"variance_ratio_{name.lower()}" for name in CHANNELS)
        return best, dict(zip(names, best_ratio.round(4).tolist(), strict=True))

    def _with_strength(self, baseline: str, strengths: Doubles) -> IidGaussian | IntensityDependent:
        """Return the noise of a baseline, with factors for its sigma in red, green and blue."""
        correlation = 0.0, 0.0, 0.0
        if self.matching.correlated:
            sigma = np.sqrt(np.maximum(np.diag(self._covariance), 1e-12))
            table = (self._covariance / np.outer(sigma, sigma)).clip(-1, 1).round(7)
            correlation = float(table[0, 1]), float(table[0, 2]), float(table[1, 2])
        method: IidGaussian | IntensityDependent
        if baseline == IID:
            r, g, b = (min(float(s), MAX_SIGMA) for s in strengths.round(7))
            method = IidGaussian(sigma=(r, g, b), correlation=correlation)
        else:
            curves = zip(strengths, self._curves, strict=True)
            scaled = (np.minimum(s * curve, MAX_SIGMA).round(7) for s, curve in curves)
            red, green, blue = (tuple(map(float, curve)) for curve in scaled)
            method = IntensityDependent(sigma=(red, green, blue), correlation=correlation)
        matching_settings = {"match": self.matching.match, "correlated": self.matching.correlated}
        return method.model_copy(update=matching_settings)


def curve_of(truth: Floats, noise: Floats) -> Doubles:
    """Return sigma before clipping at :data:`CURVE_POINTS` intensities from 0 to 1.

    It is interpolated linearly between intensities that occur.

    Args:
        truth: values of one channel without noise, (pixel,).
        noise: the noise of this channel, (pixel,).
    """
    index = np.rint(truth * (CURVE_POINTS - 1)).astype(np.intp)
    noise = noise.astype(np.float64)
    count = np.bincount(index, minlength=CURVE_POINTS)
    mean = np.bincount(index, noise, CURVE_POINTS) / np.maximum(count, 1)
    square = np.bincount(index, noise * noise, CURVE_POINTS) / np.maximum(count, 1)
    sigma = np.sqrt(np.maximum(square - mean * mean, 0))
    occupied = np.flatnonzero(count > 1)
    return unclipped_sigmas(np.interp(np.arange(CURVE_POINTS), occupied, sigma[occupied]))


def unclipped_sigmas(sigmas: Doubles) -> Doubles:
    """Return the sigmas before clipping that give ``sigmas`` after clipping.

    Both have :data:`CURVE_POINTS` values.
    """
    v = np.linspace(0, 1, CURVE_POINTS)[:, None]
    low, high = np.zeros(CURVE_POINTS), np.full(CURVE_POINTS, MAX_SIGMA)
    for _ in range(40):
        middle = (low + high) / 2
        found = np.clip(v + middle[:, None] * QUANTILES, 0, 1).std(1)
        low, high = np.where(found < sigmas, middle, low), np.where(found < sigmas, high, middle)
    return (low + high) / 2


def strength_for(variance: float, curve: Doubles, intensities: Array) -> float:
    """Return the factor of a sigma curve with which a picture's noise has a given variance.

    Args:
        variance: the variance after clipping.
        curve: relative sigmas at intensities evenly spaced from 0 to 1.
        intensities: a histogram of the picture in :data:`HISTOGRAM_BINS` bins from -0.5 to 1.5.
    """
    v = (np.arange(HISTOGRAM_BINS) + 0.5) * 2 / HISTOGRAM_BINS - 0.5
    relative = np.interp(v, np.linspace(0, 1, len(curve)), curve)
    share = intensities / intensities.sum()
    low, high = 0.0, MAX_SIGMA / max(float(relative.max()), 1e-12)
    for _ in range(50):
        middle = (low + high) / 2
        noisy = np.clip(v[:, None] + (middle * relative)[:, None] * QUANTILES, 0, 1)
        noise = noisy - np.clip(v, 0, 1)[:, None]
        found = share @ (noise**2).mean(1) - (share @ noise.mean(1)) ** 2
        low, high = (middle, high) if found < variance else (low, middle)
    return (low + high) / 2
