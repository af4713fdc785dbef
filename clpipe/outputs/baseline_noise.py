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

LARGEST = 1.0  # of full scale, the largest sigma
CURVE = 65  # intensities at which the sigma of INTENSITY is known
FINE = 1024  # bins of the histogram of the clean picture
QUANTILES = np.array([NormalDist().inv_cdf((i + 0.5) / 64) for i in range(64)])
QUANTILES /= QUANTILES.std()
INDEPENDENT_LEFT = 0.25  # averaging 2x2 leaves this share of the variance of independent noise
ROUNDS = 8  # of applying noise to the picture, at most; four are usually enough
CLOSE = 0.003  # relative error of a variance at which the search stops


@dataclass(eq=False)
class Spread:
    """The noise of a noisy picture, and the intensities of its clean one, taken one by one.

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
    _clean: Floats | None = None  # only if noise has to be applied to it
    _mask: Mask | None = None  # the pixels in which noise is matched; None is all
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
            self._noisy = self._shown(picture)
        elif rendition == developed and self._noisy is not None:
            truth = self._shown(picture)
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
                np.histogram(np.clip(plane, -0.5, 1.5), FINE, (-0.5, 1.5))[0]
                for plane in self._selected(picture).T
            ]

    def _shown(self, picture: Floats) -> Floats:
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
        wanted = np.diag(self._covariance)
        curves = [np.ones(2)] * 3 if baseline == IID else self._curves
        left = INDEPENDENT_LEFT if self.matching.match == HALVED else 1.0
        channels = zip(wanted / left, curves, self._intensities, strict=True)
        strengths = np.array([strength_for(*channel) for channel in channels])
        method = self._with_strength(baseline, strengths)
        if self._clean is None or not (wanted > 0).all():
            return method, {}
        # JPEG's luma and chroma couple the channels, so the error of a channel depends on all
        # strengths. Broyden's method (1965) in logarithms, starting from the unit matrix.
        clean, best, reached, least = self._shown(self._clean), method, np.ones(3), np.inf
        slope, step, before = np.eye(3), np.zeros(3), np.zeros(3)
        for _ in range(ROUNDS):
            noise = self._shown(run_reference(method, self._clean)) - clean
            ratio = np.diag(self._covariance_of(noise)) / wanted
            error = np.log(np.maximum(ratio, 1e-3))
            if np.abs(error).max() < least:
                best, reached, least = method, ratio, np.abs(error).max()
            if least < CLOSE:
                break
            if step.any():
                slope += np.outer(error - before - slope @ step, step) / (step @ step)
            before, step = error, (np.linalg.pinv(slope) @ -error).clip(-1, 1)
            strengths = strengths * np.exp(step / 2)
            method = self._with_strength(baseline, strengths)
        names = (f"variance_ratio_{name.lower()}" for name in CHANNELS)
        return best, dict(zip(names, reached.round(4).tolist(), strict=True))

    def _with_strength(self, baseline: str, strengths: Doubles) -> IidGaussian | IntensityDependent:
        """Return the noise of a baseline, with factors for its sigma in red, green and blue."""
        correlation = 0.0, 0.0, 0.0
        if self.matching.correlated:
            sigma = np.sqrt(np.maximum(np.diag(self._covariance), 1e-12))
            table = (self._covariance / np.outer(sigma, sigma)).clip(-1, 1).round(7)
            correlation = float(table[0, 1]), float(table[0, 2]), float(table[1, 2])
        method: IidGaussian | IntensityDependent
        if baseline == IID:
            r, g, b = (min(float(s), LARGEST) for s in strengths.round(7))
            method = IidGaussian(sigma=(r, g, b), correlation=correlation)
        else:
            curves = zip(strengths, self._curves, strict=True)
            scaled = (np.minimum(s * curve, LARGEST).round(7) for s, curve in curves)
            red, green, blue = (tuple(map(float, curve)) for curve in scaled)
            method = IntensityDependent(sigma=(red, green, blue), correlation=correlation)
        how = {"match": self.matching.match, "correlated": self.matching.correlated}
        return method.model_copy(update=how)


def curve_of(truth: Floats, noise: Floats) -> Doubles:
    """Return sigma before clipping at :data:`CURVE` intensities from 0 to 1.

    It is interpolated linearly between intensities that occur.

    Args:
        truth, noise: values of one channel, (pixel,).
    """
    place = np.rint(truth * (CURVE - 1)).astype(np.intp)
    noise = noise.astype(np.float64)
    count = np.bincount(place, minlength=CURVE)
    mean = np.bincount(place, noise, CURVE) / np.maximum(count, 1)
    square = np.bincount(place, noise * noise, CURVE) / np.maximum(count, 1)
    sigma = np.sqrt(np.maximum(square - mean * mean, 0))
    seen = np.flatnonzero(count > 1)
    return unclipped(np.interp(np.arange(CURVE), seen, sigma[seen]))


def unclipped(sigmas: Doubles) -> Doubles:
    """Return the sigmas before clipping that give ``sigmas`` after it, at :data:`CURVE` points."""
    v = np.linspace(0, 1, CURVE)[:, None]
    low, high = np.zeros(CURVE), np.full(CURVE, LARGEST)
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
        intensities: a histogram of the picture in :data:`FINE` bins from -0.5 to 1.5.
    """
    v = (np.arange(FINE) + 0.5) * 2 / FINE - 0.5
    relative = np.interp(v, np.linspace(0, 1, len(curve)), curve)
    share = intensities / intensities.sum()
    low, high = 0.0, LARGEST / max(float(relative.max()), 1e-12)
    for _ in range(50):
        middle = (low + high) / 2
        noisy = np.clip(v[:, None] + (middle * relative)[:, None] * QUANTILES, 0, 1)
        noise = noisy - np.clip(v, 0, 1)[:, None]
        found = share @ (noise**2).mean(1) - (share @ noise.mean(1)) ** 2
        low, high = (middle, high) if found < variance else (low, middle)
    return (low + high) / 2
