"""Non-local means."""

from math import sqrt
from typing import ClassVar

import numpy as np

from clpipe.base.types import Floats
from clpipe.reference.colour import rgb_to_ycbcr, ycbcr_to_rgb
from clpipe.reference.image import tap
from clpipe.reference.patch import bias_of, decay_of, patch_distances, patch_sum
from clpipe.stage import Arguments, Context, Kind, Pass, ReferenceContext, typed_arguments
from clpipe.stages.denoise.strength import (
    MID_GREY,
    WindowDenoiser,
    noise_of_luma_and_chroma,
    size_parameter,
)

# h = FACTOR * strength * noise. Found by experiment: at strength 1 it is within 0.1 dB of the
# highest PSNR for the image in tests/data, ISO 1600 to 12800. tools/pages/quality.py measures that
# PSNR.
FACTOR = 1.1
PATCH = 9  # pixels of a patch


class NonLocalMeans(WindowDenoiser):
    """Non-local means (Buades, Coll and Morel, CVPR 2005; IPOL 2011) in YCbCr, 3x3 patches.

    A pixel becomes a weighted mean of the pixels in its window. The weight is ``exp(-max(d^2 - 2
    sigma^2, 0) / h^2)``, with h = 1.1 * strength * noise. d is the distance of the two patches in
    luma and chroma together. Noise grows with the light, so d^2 is divided by a relative variance.
    This is the one that a, b and the gains predict at the patch's level, over that at mid grey.
    """

    method: ClassVar = "non_local_means"
    kernel: ClassVar = "denoise_non_local_means"
    summary: ClassVar = "mean of pixels with similar surroundings: the best method, but slow"
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
    vectors_per_row: ClassVar = 4
    first_pass: ClassVar = Pass(
        "to_noise_units",
        arguments=("luma_unit", "chroma_unit"),
        writes="planes",
        kind=Kind.YCBCR,
    )
    last_pass: ClassVar = Pass(
        "from_noise_units", arguments=("luma_unit", "chroma_unit"), reads=("filtered",)
    )

    luma_size: int = size_parameter("luma", 9, 15)
    chroma_size: int = size_parameter("chroma", 9, 15)

    @property
    def effect(self) -> str:
        luma, chroma = (f"{FACTOR * amount:.3g}" for amount in self.amounts)
        return f"h = {FACTOR:g} * strength * noise: luma {luma}, chroma {chroma}"

    def arguments(self, context: Context) -> Arguments:
        assert self.luma_noise is not None and self.chroma_noise is not None
        # The squared distance of two patches is the mean of d^2 / sigma^2 over luma, chroma and the
        # patch. In these units it is a plain sum of squares.
        luma_unit = max(self.luma_noise, 1e-6) * sqrt(2 * PATCH)
        chroma_unit = max(self.chroma_noise, 1e-6) * sqrt(2 * PATCH)
        # The variance relative to mid grey, linear in luma in noise units.
        variance, _ = noise_of_luma_and_chroma(context)
        at_grey = variance.at(MID_GREY)
        slope, offset = variance.slope / at_grey, variance.offset / at_grey
        return {
            **super().arguments(context),
            "luma_unit": luma_unit,
            "chroma_unit": chroma_unit,
            "noise_slope": slope * luma_unit / PATCH,
            "noise_offset": max(offset, 1e-6),
            "luma_bias": bias_of(self.luma_strength),
            "chroma_bias": bias_of(self.chroma_strength),
            "luma_scale": decay_of(FACTOR * self.luma_strength),
            "chroma_scale": decay_of(FACTOR * self.chroma_strength),
        }

    def reference(self, image: Floats, inputs: ReferenceContext) -> Floats:
        n = typed_arguments(self.arguments(inputs.context))
        units = np.array([n["luma_unit"], n["chroma_unit"], n["chroma_unit"]], np.float32)
        planes = rgb_to_ycbcr(image) / units
        level = np.maximum(patch_sum(planes[..., 0]), np.float32(0))
        variance = level * n["noise_slope"] + n["noise_offset"]
        biases, scales = (n["luma_bias"], n["chroma_bias"]), (n["luma_scale"], n["chroma_scale"])
        filtered = non_local_means(planes, self.reaches, variance, biases, scales)
        return ycbcr_to_rgb(filtered * units)


def non_local_means(
    planes: Floats,
    reaches: tuple[int, int],
    variance: Floats,
    biases: tuple[np.float32, np.float32],
    scales: tuple[np.float32, np.float32],
) -> Floats:
    """Filter luma and chroma in noise units with non-local means (IPOL 2011, eq. 1 to 3).

    A weight is 2^(scale * max(d^2 / variance - bias, 0)), with d^2 the squared distance of two
    patches.

    Args:
        planes: (height, width, 3), Y, Cb and Cr, scaled so that d^2 is a plain sum of squares.
        reaches: the largest offsets in the windows of luma and of chroma, px.
        variance: (height, width), relative to mid grey.
        biases: for the weights of luma and of chroma.
        scales: for the weights of luma and of chroma.

    >>> noisy_edge = np.float32([0, 1, 0, 9, 8, 9])[None, :, None].repeat(3, axis=2)
    >>> biases, scales = (np.float32(2), np.float32(2)), (np.float32(-1), np.float32(-1))
    >>> variance = np.full((1, 6), 9, np.float32)
    >>> filtered = non_local_means(noisy_edge, (1, 1), variance, biases, scales)
    >>> (10 * filtered[0, :, 0]).round().astype(int).tolist()
    [5, 7, 0, 90, 83, 85]
    """
    of_planes = np.array([0, 1, 1])
    bias, scale, reach = (np.array(pair)[of_planes] for pair in (biases, scales, reaches))
    total, weights = np.zeros_like(planes), np.zeros_like(planes)
    for dx, dy, distance in patch_distances(planes, max(reaches)):
        excess = np.maximum((distance / variance)[..., None] - bias, np.float32(0))
        weight = np.exp2(np.maximum(excess * scale, np.float32(-30)))
        weight *= max(abs(dx), abs(dy)) <= reach
        total += weight * tap(planes, dx, dy)
        weights += weight
    return total / weights
