"""Non-local means."""

from collections.abc import Iterator, Mapping
from math import e, log2, sqrt
from typing import ClassVar

import numpy as np

from clpipe.reference.colour import rgb_to_ycbcr, ycbcr_to_rgb
from clpipe.reference.image import mirrored, tap
from clpipe.stage import Context, Frame, Kind, Pass
from clpipe.stages.denoise.law import MID_GREY, Denoiser, noise_of_luma_and_chroma, size_of
from clpipe.types import Floats

FACTOR = 1.1  # of h; the best in PSNR for both planes on our picture, ISO 1600 to 12800
PATCH = 9  # pixels


class NonLocalMeans(Denoiser):
    """Non-local means (Buades, Coll and Morel, CVPR 2005; IPOL 2011) in YCbCr, 3x3 patches.

    A pixel becomes the mean of the pixels of its window, each weighted by how alike the patches
    around the two are in luma and chroma together, exp(-max(d^2 - 2 sigma^2, 0) / h^2) with
    h = 1.1 * strength * noise. As noise grows with the light, the patches' distance is divided by
    the variance that a, b and the gains predict at the level of the patch, relative to mid grey.
    """

    method: ClassVar = "non_local_means"
    kernel: ClassVar = "denoise_non_local_means"
    summary: ClassVar = "mean of the pixels whose surroundings look alike; the best, and slow"
    tolerance: ClassVar = 2e-4  # the kernel's exp is a short polynomial
    function: ClassVar = "non_local_means"
    names: ClassVar = (
        "noise_slope",
        "noise_offset",
        "luma_bias",
        "chroma_bias",
        "luma_scale",
        "chroma_scale",
    )
    extra_reach: ClassVar = 1
    block: ClassVar = 4
    enter: ClassVar = Pass(
        "to_noise_units",
        arguments=("luma_unit", "chroma_unit"),
        writes="planes",
        kind=Kind.YCBCR,
    )
    leave: ClassVar = Pass(
        "from_noise_units", arguments=("luma_unit", "chroma_unit"), reads=("filtered",)
    )

    luma_size: int = size_of("luma", 9, 15)
    chroma_size: int = size_of("chroma", 9, 15)

    def numbers(self, context: Context) -> Mapping[str, np.float32]:
        assert self.luma_noise is not None and self.chroma_noise is not None
        # The distance of two patches is the mean of both planes' d^2 / sigma^2: in these units it
        # is a plain sum of squares over the patch.
        luma_unit = max(self.luma_noise, 1e-6) * sqrt(2 * PATCH)
        chroma_unit = max(self.chroma_noise, 1e-6) * sqrt(2 * PATCH)
        # Variance over that at mid grey, as a function of luma in noise units.
        variance, _ = noise_of_luma_and_chroma(context)
        at_grey = variance.at(MID_GREY)
        slope, offset = variance.slope / at_grey, variance.offset / at_grey
        return {
            "luma_unit": np.float32(luma_unit),
            "chroma_unit": np.float32(chroma_unit),
            "noise_slope": np.float32(slope * luma_unit / PATCH),
            "noise_offset": np.float32(max(offset, 1e-6)),
            "luma_bias": bias_of(self.luma_strength),
            "chroma_bias": bias_of(self.chroma_strength),
            "luma_scale": decay_of(FACTOR * self.luma_strength),
            "chroma_scale": decay_of(FACTOR * self.chroma_strength),
        }

    def reference(self, image: Floats, frame: Frame) -> Floats:
        n = self.numbers(frame.context)
        units = np.array([n["luma_unit"], n["chroma_unit"], n["chroma_unit"]], np.float32)
        planes = rgb_to_ycbcr(image) / units
        level = np.maximum(patch_sum(planes[..., 0]), np.float32(0))
        variance = level * n["noise_slope"] + n["noise_offset"]
        biases = np.array([n["luma_bias"], *[n["chroma_bias"]] * 2], np.float32)
        scales = np.array([n["luma_scale"], *[n["chroma_scale"]] * 2], np.float32)
        luma_reach, chroma_reach = self.reaches
        reach = max(self.reaches)
        total, weights = np.zeros_like(planes), np.zeros_like(planes)
        for dx, dy, distance in patch_distances(planes, reach):
            distance /= variance
            weight = np.exp2(
                np.maximum(np.maximum(distance[..., None] - biases, 0) * scales, np.float32(-30))
            )
            away = max(abs(dx), abs(dy))
            weight *= np.array([away <= luma_reach, *[away <= chroma_reach] * 2], np.float32)
            total += weight * tap(planes, dx, dy)
            weights += weight
        return ycbcr_to_rgb(total / weights * units)


def patch_distances(planes: Floats, reach: int, step: int = 1) -> Iterator[tuple[int, int, Floats]]:
    """Squared distances of each pixel's 3x3 patch from those in its window (IPOL 2011, eq. 2).

    ``planes`` is (height, width, plane). For each offset dx, dy of the window, ``step`` px apart,
    the sum over patch and planes comes as (height, width).

    >>> step = np.float32([[[0], [0], [0], [1], [1], [1]]])
    >>> {dx: d[0].tolist() for dx, dy, d in patch_distances(step, 1) if dy == 0}[1]
    [0.0, 3.0, 3.0, 3.0, 0.0, 0.0]
    """
    height, width = planes.shape[:2]
    around = mirrored(planes, reach + 1)
    centre = around[reach:, reach:][: height + 2, : width + 2]
    offsets = range(-reach, reach + 1, step)
    for dx, dy in ((dx, dy) for dy in offsets for dx in offsets):
        other = around[reach + dy :, reach + dx :][: height + 2, : width + 2]
        squared = ((other - centre) ** 2).sum(-1)
        down = squared[:-2] + squared[1:-1] + squared[2:]
        yield dx, dy, down[:, :-2] + down[:, 1:-1] + down[:, 2:]


def bias_of(strength: float) -> np.float32:
    """What noise alone makes of a distance in units of its variance (IPOL 2011, section 3).

    Two samples of noise differ by 2 sigma^2 in the mean. A strength below 1 takes sigma to be less.
    """
    return np.float32(2 * min(strength, 1) ** 2)


def decay_of(h: float) -> np.float32:
    """What a distance is multiplied by to get the log2 of its weight, exp(-distance / h^2)."""
    return np.float32(-log2(e) / max(h, 1e-3) ** 2)


def patch_sum(image: Floats) -> Floats:
    """Sum over the 3x3 pixels around each pixel of a (height, width) plane.

    >>> patch_sum(np.float32([[1, 2, 4]])).tolist()
    [[15.0, 21.0, 24.0]]
    """
    rows = tap(image, -1, 0) + image + tap(image, 1, 0)
    return tap(rows, 0, -1) + rows + tap(rows, 0, 1)
