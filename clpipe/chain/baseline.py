"""Baselines: the clean picture with independent noise, as strong as the noise of the noisy one.

It is what synthetic data usually has, to be compared with a camera's noise. The strength is that of
the whole picture, edges and all, in each channel, as the finished pictures have it: what is cut off
below black and above white counts as it does there.
"""

from dataclasses import dataclass, field, replace
from functools import lru_cache
from statistics import NormalDist

import numpy as np

from clpipe.base.errors import RequestError
from clpipe.base.types import Array, Doubles, Floats
from clpipe.chain.chain import Chain
from clpipe.chain.truth import CLEAN, picture_without_noise
from clpipe.stages.picture_noise import IidGaussian, IntensityDependent

IID, INTENSITY = BASELINES = ("iid", "intensity")

STEP = "picture_noise"  # the step that adds it
LARGEST = 1.0  # of full scale, the largest sigma
CURVE = 65  # intensities at which the sigma of INTENSITY is known
FINE = 1024  # intensities of the clean picture that are told apart
QUANTILES = np.array([NormalDist().inv_cdf((i + 0.5) / 64) for i in range(64)])
QUANTILES /= QUANTILES.std()


@dataclass(eq=False)
class Spread:
    """The noise of a noisy picture, and the intensities of its clean one; they come one by one.

    Args:
        names: of the renditions that they are measured on: the noisy picture, its truth as it is
            developed, and its clean truth, in the order in which they come.
    """

    names: tuple[str, ...]
    _noisy: Floats | None = None
    _variance: list[float] = field(default_factory=list)
    _curves: list[Doubles] = field(default_factory=list)
    _intensities: list[Array] = field(default_factory=list)

    def take(self, name: str, picture: Floats) -> None:
        """Take what is to be known of a picture; others are left alone.

        Args:
            name: of the rendition.
            picture: (height, width, 3) display values, float32.
        """
        noisy, developed, clean = self.names
        if name == noisy:
            self._noisy = np.clip(picture, 0, 1)
        elif name == developed and self._noisy is not None:
            truth = np.clip(picture, 0, 1)
            noise = self._noisy - truth
            self._noisy = None
            self._variance = [float(noise[..., c].var(dtype=np.float64)) for c in range(3)]
            self._curves = [curve_of(truth[..., c], noise[..., c]) for c in range(3)]
        elif name == clean:
            self._intensities = [
                np.histogram(np.clip(picture[..., c], -0.5, 1.5), FINE, (-0.5, 1.5))[0]
                for c in range(3)
            ]

    def method(self, baseline: str) -> IidGaussian | IntensityDependent:
        """The noise of a baseline, one of :data:`BASELINES`."""
        channels = zip(self._variance, self._curves, self._intensities, strict=True)
        if baseline == IID:
            flat = np.ones(2)
            red, green, blue = (round(strength_for(v, flat, n), 7) for v, _, n in channels)
            return IidGaussian(sigma=(red, green, blue))
        curves = [np.minimum(strength_for(v, c, n) * c, LARGEST).round(7) for v, c, n in channels]
        r, g, b = (tuple(map(float, curve)) for curve in curves)
        return IntensityDependent(sigma=(r, g, b))


def curve_of(truth: Floats, noise: Floats) -> Doubles:
    """Sigma at :data:`CURVE` intensities from 0 to 1 of noise that is then clipped.

    Between intensities that occur it is a line.

    Args:
        truth, noise: of a channel, of one shape.
    """
    place = np.rint(truth * (CURVE - 1)).astype(np.intp).ravel()
    noise = noise.ravel().astype(np.float64)
    count = np.bincount(place, minlength=CURVE)
    mean = np.bincount(place, noise, CURVE) / np.maximum(count, 1)
    square = np.bincount(place, noise * noise, CURVE) / np.maximum(count, 1)
    sigma = np.sqrt(np.maximum(square - mean * mean, 0))
    seen = np.flatnonzero(count > 1)
    return unclipped(np.interp(np.arange(CURVE), seen, sigma[seen]))


def unclipped(sigmas: Doubles) -> Doubles:
    """The sigma at each of :data:`CURVE` intensities whose noise has that sigma after clipping."""
    v = np.linspace(0, 1, CURVE)[:, None]
    low, high = np.zeros(CURVE), np.full(CURVE, LARGEST)
    for _ in range(40):
        middle = (low + high) / 2
        found = np.clip(v + middle[:, None] * QUANTILES, 0, 1).std(1)
        low, high = np.where(found < sigmas, middle, low), np.where(found < sigmas, high, middle)
    return (low + high) / 2


def strength_for(variance: float, curve: Doubles, intensities: Array) -> float:
    """The factor of a sigma curve that gives a picture's noise a variance, after clipping.

    Args:
        variance: of the finished noise.
        curve: relative sigmas at intensities evenly spaced from 0 to 1.
        intensities: how often each of :data:`FINE` intensities from -0.5 to 1.5 occurs.
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


@lru_cache(maxsize=64)
def baseline_of(chain: Chain) -> Chain:
    """The chain of a baseline: the clean picture's, with noise behind it that is not known yet.

    Args:
        chain: of the noisy picture.

    Raises:
        RequestError: the chain adds no noise, has noise on the finished picture already, or has no
            step for it.
    """
    step = next((step for step in chain.steps if step.name == STEP), None)
    if step is None:
        raise RequestError(f"--baseline: its noise is that of {STEP}, and this chain has none")
    if step.adds_noise:
        raise RequestError(f"--baseline: {STEP} adds noise already; leave one of them out")
    clean = picture_without_noise(CLEAN, chain)
    steps = *(each for each in clean.steps if each.name != STEP), step
    return with_noise(replace(clean, steps=steps), IidGaussian(sigma=(0.0, 0.0, 0.0)))


def with_noise(chain: Chain, noise: IidGaussian | IntensityDependent) -> Chain:
    """The chain of a baseline, with its noise."""
    *others, step = chain.steps
    return replace(chain, steps=(*others, replace(step, method=noise.resolve(step.context))))
