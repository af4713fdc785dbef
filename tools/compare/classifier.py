"""Separates patches of noise: scale-free statistics, a linear classifier, and distances."""

from collections.abc import Mapping, Sequence

import numpy as np

from clpipe.base.types import Doubles, Mask
from clpipe.reference.colour import LUMA

PATCH = 48  # px
RIDGE, SHRINKAGE = 1.0, 0.1
TINY = 1e-6  # levels; avoids division by 0 where there is no noise

Statistics = Mapping[str, Doubles]  # (patch, statistic), by camera


def statistics(noise: Doubles, level: Doubles) -> dict[str, float]:
    """Return the statistics of a patch. Names of colour statistics start with "colour"."""
    y = noise @ LUMA
    planes = {"Y": y, "Cb": noise[..., 2] - y, "Cr": noise[..., 0] - y}
    found: dict[str, float] = {}
    for name, plane in planes.items():
        own = of_plane(plane - plane.mean(), level)
        found |= {f"{name} {key}": value for key, value in own.items()}
    power = np.corrcoef(noise.reshape(-1, 3).T)
    red, green, blue = noise.std((0, 1))
    both = planes["Cb"].std() + planes["Cr"].std()
    colours = {"R-G": power[0, 1], "R-B": power[0, 2], "G-B": power[1, 2]}
    colours |= {
        "R/G": ratio(red, green),
        "B/G": ratio(blue, green),
        "chroma/luma": ratio(both, y.std()),
    }
    return found | {f"colour {key}": float(value) for key, value in colours.items()}


def of_plane(noise: Doubles, level: Doubles) -> dict[str, float]:
    """Return the statistics of one plane of a patch, (48, 48), whose mean is 0."""
    sigma = max(float(noise.std()), TINY)
    z = noise / sigma
    found = {f"{k} right": (z[:, k:] * z[:, :-k]).mean() for k in range(1, 7)}
    found |= {f"{k} below": (z[k:] * z[:-k]).mean() for k in (1, 2, 3)}
    found |= {f"{k} diagonal": (z[k:, k:] * z[:-k, :-k]).mean() for k in (1, 2)}
    for size in (2, 4, 8, 16):
        blocks = noise.reshape(PATCH // size, size, PATCH // size, size).mean((1, 3))
        found[f"left after {size}"] = 2 * ratio(size * blocks.std(), sigma)
    found |= {"skew": (z**3).mean(), "kurtosis": np.log((z**4).mean())}
    found["beyond 2.5"] = (abs(z) > 2.5).mean()
    window = np.outer(*[np.hanning(PATCH)] * 2)
    power = abs(np.fft.fft2(noise * window)) ** 2
    frequency = np.hypot(*np.meshgrid(*[np.fft.fftfreq(PATCH)] * 2))
    for k in range(4):
        inside = (frequency >= k / 8) & (frequency < (k + 1) / 8)
        found[f"band {k}"] = ratio(power[inside].sum(), power.sum())
    steep = np.hypot(*np.gradient(level))
    found["dark over bright"] = contrast(noise, level < np.median(level))
    found["steep over flat"] = contrast(noise, steep > np.percentile(steep, 75))
    return {key: float(value) for key, value in found.items()}


def contrast(noise: Doubles, mask: Mask) -> float:
    """Return the log ratio of noise inside and outside a mask; 0 if either part is empty."""
    some = mask.any() and not mask.all()
    return ratio(noise[mask].std(), noise[~mask].std()) if some else 0.0


def ratio(one: float, two: float) -> float:
    """Return the logarithm of a ratio of positive numbers."""
    return float(np.log((one + TINY) / (two + TINY)))


def over_white(plane: Doubles, mask: Mask, size: int) -> float:
    """Return the variance of ``size`` x ``size`` block means, relative to independent noise.

    The value is 1 for independent noise, and larger for coarse noise. Means include only pixels of
    the mask. Blocks with a tenth or more of their pixels outside the mask are excluded.

    Args:
        plane: (frame, height, width).
        mask: the pixels to include.
        size: the side of a block, px.

    >>> noise = np.random.default_rng(0).normal(size=(1, 512, 512))
    >>> 0.8 < over_white(noise, np.ones((512, 512), bool), 16) < 1.2
    True
    """
    height, width = (side // size * size for side in mask.shape)
    blocks = (height // size, size, width // size, size)
    count = mask[:height, :width].reshape(blocks).sum((1, 3))
    sums = (plane * mask)[:, :height, :width].reshape(len(plane), *blocks).sum((2, 4))
    kept = count > 0.9 * size**2
    variance = float((plane[:, mask] ** 2).mean()) if mask.any() else 0.0
    if not kept.any() or variance == 0:
        return float("nan")
    return float((sums[:, kept] ** 2 / count[kept]).mean() / variance)


def regression(x: Doubles, y: Doubles) -> Doubles:
    """Fit a ridge logistic regression by Newton's method; the last weight is the constant."""
    x = np.c_[x, np.ones(len(x))]
    ridge = RIDGE * np.eye(x.shape[1])
    ridge[-1, -1] = 1e-6
    weights = np.zeros(x.shape[1])
    for _ in range(30):
        p = 1 / (1 + np.exp(-np.clip(x @ weights, -30, 30)))
        hessian = (x * (p * (1 - p))[:, None]).T @ x + ridge
        step = np.linalg.solve(hessian, x.T @ (y - p) - ridge @ weights)
        weights += step
        if abs(step).max() < 1e-6:
            break
    return weights


def auc(real: Doubles, made: Doubles) -> float:
    """Return the probability that a real patch has the larger score."""
    order = np.argsort(np.argsort(np.r_[real, made]))
    return float(
        (order[: len(real)].sum() - len(real) * (len(real) - 1) / 2) / (len(real) * len(made))
    )


def held_out_auc(real: Statistics, made: Statistics, camera: str) -> float:
    """Return the AUC on one camera of a classifier that was trained on the others."""
    others = [name for name in real if name != camera]
    if not others:
        return float("nan")
    positive, negative = (np.concatenate([of[name] for name in others]) for of in (real, made))
    x, y = np.r_[positive, negative], np.r_[np.ones(len(positive)), np.zeros(len(negative))]
    mean, sigma = x.mean(0), x.std(0) + 1e-9
    weights = regression((x - mean) / sigma, y)
    scores = [
        np.c_[(of[camera] - mean) / sigma, np.ones(len(of[camera]))] @ weights
        for of in (real, made)
    ]
    return auc(*scores)


def distance(one: Doubles, two: Doubles, kept: Sequence[int]) -> float:
    """Return the Mahalanobis distance of mean statistics, with the pooled covariance of patches."""
    one, two = one[:, kept], two[:, kept]
    covariance = (np.cov(one.T) * len(one) + np.cov(two.T) * len(two)) / (len(one) + len(two))
    scale = np.sqrt(np.diag(covariance)) + 1e-9
    correlation = (1 - SHRINKAGE) * covariance / np.outer(scale, scale) + SHRINKAGE * np.eye(
        len(scale)
    )
    gap = (one.mean(0) - two.mean(0)) / scale
    return float(np.sqrt(gap @ np.linalg.solve(correlation, gap)))
