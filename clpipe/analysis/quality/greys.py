"""Tone and noise of grey patches: OECF, SNR, dynamic range, contrast detection probability."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from clpipe.analysis.quality.visual_noise import visual_noise
from clpipe.base.types import Doubles

LUMINANCE = np.array([0.2125, 0.7154, 0.0721])  # weights of ISO 15739, for display values
CHROMA = 0.279, 0.088  # weights of the variances of R-Y and B-Y in its noise
HALF, NEARLY = 0.69, 0.3  # sigmas and levels below the highest level at saturation
ROUNDING = 12**-0.5  # the standard deviation of rounding to whole levels
TOLERANCE = 0.5  # of a contrast that is detected


@dataclass(frozen=True, eq=False)
class GreyPatches:
    """Pictures of grey patches, from dark to bright.

    Args:
        light: the luminance of each patch, 0.18 is a middle grey.
        levels: display values, (patch, frame, height, width, 3), 0 to 255.
        black: the mean level of a black patch, (3,); None if there is none.
        rounding: the standard deviation of the rounding of levels.
    """

    light: Doubles
    levels: Doubles
    black: Doubles | None = None
    rounding: float = 0.0

    @cached_property
    def means(self) -> Doubles:
        """The mean level of each patch and channel, (patch, 3): the OECF of ISO 14524."""
        return self.levels.mean((1, 2, 3))

    @property
    def luma(self) -> Doubles:
        """The mean level of each patch."""
        return self.means @ LUMINANCE

    @cached_property
    def sigma(self) -> Doubles:
        """The noise of each patch in levels (ISO 15739:2023, 6.2)."""
        y = self.levels @ LUMINANCE
        parts = y, self.levels[..., 0] - y, self.levels[..., 2] - y
        variances = [part.var((-2, -1)).mean(1) for part in parts]
        return np.sqrt(variances[0] + CHROMA[0] * variances[1] + CHROMA[1] * variances[2])

    @property
    def snr(self) -> Doubles:
        """The signal-to-noise ratio of each patch, dB; NaN without noise or slope.

        It is 20 log10 of luminance times the curve's slope over the noise, which is at least that
        of rounding.
        """
        signal = self.light * np.gradient(self.luma, self.light)
        useful = (signal > 0) & ~(self.light >= self.saturation)
        noise = np.maximum(self.sigma, self.rounding)
        useful &= noise > 1e-6
        return 20 * np.log10(np.where(useful, signal, np.nan) / np.where(useful, noise, np.nan))

    @property
    def gamma(self) -> Doubles:
        """The slope of each patch in the logarithms of level and luminance."""
        return np.gradient(np.log(np.maximum(self.luma, 0.5)), np.log(self.light))

    def visual_noise(self) -> Doubles:
        """Return the visual noise of each patch, see :func:`visual_noise`."""
        return np.array([visual_noise(each) for each in self.levels])

    def light_at(self, levels: Doubles) -> Doubles:
        """Return the light of levels, by the patches' mean levels of the same channel.

        Args:
            levels: (..., 3), 0 to 255.
        """
        light, means = self.light, self.means
        if self.black is not None:
            light, means = np.append(0, light), np.vstack([self.black, means])
        rising = np.maximum.accumulate(means) + 1e-9 * np.arange(len(light))[:, None]
        planes = [np.interp(levels[..., c], rising[:, c], light) for c in range(3)]
        return np.stack(planes, axis=-1)

    @property
    def saturation(self) -> float:
        """The luminance at which the curve reaches its highest level; NaN if no patch clips.

        Where noise makes half of the samples clip, their mean is 0.7 of the remaining sigma lower.
        """
        missing = self.luma[-1] - self.luma - HALF * self.sigma - NEARLY
        below = np.flatnonzero(missing > 0)
        if self.luma[-1] - self.luma[-2] > 1 or not len(below):
            return float("nan")
        ends = below[-1] + np.arange(2)
        return float(np.interp(0, -missing[ends], self.light[ends]))

    @property
    def dynamic_range(self) -> float:
        """Stops from the luminance at which the SNR is 1 to saturation (ISO 15739:2023, 6.4).

        NaN if no patch clips, or if the SNR of none is below 1.
        """
        snr, used = self.snr, self.light <= self.saturation
        dark = np.flatnonzero(used & ~(snr >= 0))
        if not len(dark) or dark[-1] + 1 >= used.sum():
            return float("nan")
        first = dark[-1] + 1
        low = snr[first - 1]
        start = np.log2(self.light[first])
        if np.isfinite(low):
            start = np.interp(0.0, snr[[first - 1, first]], np.log2(self.light[[first - 1, first]]))
        return float(np.log2(self.saturation) - start)

    def detection(self) -> tuple[Doubles, Doubles]:
        """Return luminances, and the probability that a contrast of 2:1 is detected there.

        Each pair takes a pixel from each of two patches. A pair detects the contrast if its own
        Michelson contrast in luminance differs by at most 50 %. The source is Geese, Seger and
        Paolillo, "Detection probabilities" (EI 2018). Without such patches there are no values.
        """
        seen = self.light_at(self.levels) @ LUMINANCE
        at, shares, rng = [], [], np.random.default_rng(0)
        for dark, light in enumerate(self.light):
            bright = int(np.abs(self.light - 2 * light).argmin())
            if abs(self.light[bright] / light - 2) < 0.02:
                one, two = seen[dark].ravel(), rng.permutation(seen[bright].ravel())
                contrast = (two - one) / np.maximum(two + one, 1e-12)
                at.append(2**0.5 * light)
                shares.append((np.abs(contrast * 3 - 1) <= TOLERANCE).mean())
        return np.array(at), np.array(shares)
