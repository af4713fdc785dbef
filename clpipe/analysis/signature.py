"""The signature of a finished picture's noise: what tells one camera's development from another's.

A picture is compared with the mean of many of the same scene (or with its truth), in places that
are flat and not clipped. All figures are of eight-bit levels, 0 to 255.
"""

from dataclasses import asdict, dataclass

import numpy as np
from numpy.typing import NDArray

from clpipe.analysis.spatial import energy_left
from clpipe.base.types import Doubles, Mask

DRIFT = 12.0  # px; what is smoother than this is no noise but light or focus that changed
SMOOTH = 3.0  # px, of the picture in which flat places are looked for
FLAT = 60  # percentile of the gradient
BIN = 8  # levels; the noise of a bin is compared with that bin's sigma
FEWEST = 200  # samples of a bin
DARKEST, BRIGHTEST = 30, 225  # luma

LUMA = np.array([0.299, 0.587, 0.114])  # BT.601


@dataclass(frozen=True)
class Signature:
    """The columns of a signature; NaN where one cannot be computed."""

    rms: float  # of luma, in levels
    kurtosis: float  # of luma over the sigma of its intensity; 3 for Gaussian noise
    beyond_4_sigma: float  # share of samples, in 1e-4; 0.63 for Gaussian noise
    right: float  # autocorrelation of luma, one pixel to the right
    below: float
    diagonal: float
    two_right: float
    half: float  # share of luma's variance that 2x2 averaging leaves; 0.25 if independent
    chroma_right: float  # autocorrelation of chroma, mean of Cb and Cr
    red_green: float  # correlation of the noise of red and green
    chroma_rms: float  # of Cb and Cr together, in levels

    def record(self) -> dict[str, float]:
        """The columns by name."""
        return asdict(self)


def luma(pixels: NDArray[np.number]) -> Doubles:
    """BT.601 luma of (..., 3) levels."""
    return np.asarray(pixels @ LUMA, np.float64)


def chroma(noise: Doubles, of_luma: Doubles) -> tuple[Doubles, Doubles]:
    """Cb and Cr of (height, width, 3) noise whose luma is ``of_luma``."""
    return 0.564 * (noise[..., 2] - of_luma), 0.713 * (noise[..., 0] - of_luma)


def flat_places(mean: NDArray[np.number], darkest: float = DARKEST) -> Mask:
    """Where a picture without noise is flat and neither dark nor bright, (height, width).

    Flat is below the 60th percentile of the gradient of the smoothed luma, and two pixels away from
    what is not.

    Args:
        mean: (height, width, 3), 0 to 255.
        darkest: the least luma that counts.
    """
    from scipy import ndimage

    y = luma(mean)
    smooth = ndimage.gaussian_filter(y, SMOOTH)
    gradient = np.hypot(ndimage.sobel(smooth, 0), ndimage.sobel(smooth, 1))
    flat = ndimage.binary_erosion(gradient <= np.percentile(gradient, FLAT), np.ones((5, 5)))
    return np.asarray(flat & (y >= darkest) & (y <= BRIGHTEST))


def noise_of(picture: NDArray[np.number], mean: NDArray[np.number]) -> Doubles:
    """The noise of a picture, (height, width, 3): its difference from the mean without slow drift.

    Drift is the difference under a Gaussian of 12 px. It is taken out in the cosine transform,
    which continues the picture as its mirror image, and takes a fifth of the time.

    Args:
        picture: (height, width, 3), 0 to 255; in floats of the result's precision.
        mean: the same scene without noise.
    """
    from scipy import fft

    noise = np.subtract(picture, mean, dtype=np.result_type(picture, mean, np.float32))
    down, right = (
        np.exp(-0.5 * (DRIFT * np.pi * np.arange(size) / size) ** 2) for size in noise.shape[:2]
    )
    kept = (1 - np.outer(down, right)).astype(noise.dtype)
    return np.asarray(fft.idctn(fft.dctn(noise, axes=(0, 1)) * kept[..., None], axes=(0, 1)))


def standardised(noise: Doubles, mean: Doubles, mask: Mask) -> Doubles:
    """The samples of luma noise, each over the sigma of its intensity's bin, (sample,).

    Bins of fewer than 200 samples are left out.

    Args:
        noise: of luma, (height, width).
        mean: luma without noise.
        mask: the pixels that count.
    """
    bins = (mean[mask] // BIN).astype(int)
    values = noise[mask]
    parts = [values[bins == k] for k in np.unique(bins)]
    kept = [v / v.std() for v in parts if v.size >= FEWEST and v.std() > 0]
    return np.concatenate(kept) if kept else np.zeros(0)


def lag(noise: Doubles, mask: Mask, down: int, right: int) -> float:
    """The autocorrelation of noise at a lag, among the pixels that count."""
    height, width = noise.shape
    here = np.s_[: height - down, : width - right]
    there = np.s_[down:, right:]
    both = mask[here] & mask[there]
    variance = (noise[mask] ** 2).mean() if mask.any() else 0.0
    if not both.any() or variance == 0:
        return np.nan
    return float((noise[here] * noise[there])[both].mean() / variance)


def signature(
    picture: NDArray[np.number], mean: NDArray[np.number], mask: Mask | None = None
) -> Signature:
    """The signature of the noise of a picture.

    Args:
        picture: (height, width, 3), 0 to 255.
        mean: the same scene without noise, or the mean of many pictures of it.
        mask: the pixels that count; None: :func:`flat_places` of the mean.

    >>> generator = np.random.default_rng(0)
    >>> grey = np.full((200, 200, 3), 128.0)
    >>> found = signature(grey + generator.normal(0, 5, grey.shape), grey)
    >>> round(found.kurtosis, 1), round(found.half, 2), abs(found.right) < 0.02
    (3.0, 0.25, True)
    """
    mask = flat_places(mean) if mask is None else mask
    noise = noise_of(picture, mean)
    y = luma(noise)
    cb, cr = chroma(noise, y)
    z = standardised(y, luma(mean), mask)
    kurtosis = (z**4).mean() / (z**2).mean() ** 2 if z.size else np.nan
    red, green = noise[..., 0][mask], noise[..., 1][mask]
    power = np.sqrt((red**2).sum() * (green**2).sum())
    some = mask.any()
    return Signature(
        rms=float(np.sqrt((y[mask] ** 2).mean())) if some else np.nan,
        kurtosis=float(kurtosis),
        beyond_4_sigma=float(1e4 * (np.abs(z) > 4).mean()) if z.size else np.nan,
        right=lag(y, mask, 0, 1),
        below=lag(y, mask, 1, 0),
        diagonal=lag(y, mask, 1, 1),
        two_right=lag(y, mask, 0, 2),
        half=energy_left(y[None], mask),
        chroma_right=(lag(cb, mask, 0, 1) + lag(cr, mask, 0, 1)) / 2,
        red_green=float((red * green).sum() / power) if power else np.nan,
        chroma_rms=float(np.sqrt(((cb[mask] ** 2 + cr[mask] ** 2) / 2).mean())) if some else np.nan,
    )
