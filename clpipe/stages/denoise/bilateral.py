"""The bilateral filter."""

from dataclasses import replace
from math import e, log2
from typing import ClassVar, Literal

import numpy as np

from clpipe.base.types import Floats
from clpipe.reference.colour import rgb_to_ycbcr, ycbcr_to_rgb
from clpipe.reference.image import smooth, tap
from clpipe.stage import (
    Arguments,
    Context,
    Kind,
    Pass,
    ReferenceContext,
    Stencil,
    parameter,
    typed_arguments,
)
from clpipe.stages.denoise.strength import WindowDenoiser

# Sigma of the range weight, in multiples of strength * noise, by the guide. The paper's images have
# the second one. With the first, noise is as weak, and edges are no sharper than without noise.
RANGES = {"smooth": 1.2, "image": 3.0}


class Bilateral(WindowDenoiser):
    """Bilateral filter (Tomasi and Manduchi, ICCV 1998) in YCbCr.

    The weight of luma depends on the distance in luma, and that of both chroma planes on their
    common distance. It is a Gaussian of sigma 1.2 * strength * noise. By default, distances are
    those of a binomial mean of 3x3 pixels. Distances of the image contain the noise of the filtered
    pixel, so edges become sharper with more noise.
    """

    method: ClassVar = "bilateral"
    kernel: ClassVar = "denoise_bilateral"
    summary: ClassVar = "bilateral filter on luma and, more strongly, on chroma"
    tolerance: ClassVar = 2e-4  # the kernel's exp is a short polynomial
    function: ClassVar = "bilateral"
    names: ClassVar = ("spatial_scale", "luma_scale", "chroma_scale")

    spatial_sigma: float = parameter(
        1.5, "Sigma of the Gaussian weight of spatial distance.", "px", gt=0, le=100
    )
    guide: Literal["smooth", "image"] = parameter(
        "smooth",
        "Source of the distances: a mean of 3x3 pixels, or like in the paper the image itself.",
        structural=True,
    )

    @property
    def reaches(self) -> tuple[int, int]:
        luma, chroma = super().reaches
        return luma if self.luma_strength else 0, chroma if self.chroma_strength else 0

    @property
    def range(self) -> float:
        """Sigma of the range weight, in multiples of strength * noise."""
        return RANGES[self.guide]

    def passes(self) -> tuple[Pass, ...]:
        first, stencil, last = super().passes()
        if self.guide == "image":
            return first, replace(stencil, function="bilateral_by_itself"), last
        smoothing = Pass("smooth", Stencil(1), (), ("planes",), "guide", Kind.YCBCR)
        return first, smoothing, replace(stencil, reads=("planes", "guide")), last

    @property
    def effect(self) -> str:
        luma, chroma = (f"{self.range * amount:.3g}" for amount in self.amounts)
        return f"range sigma = {self.range:g} * strength * noise: luma {luma}, chroma {chroma}"

    def arguments(self, context: Context) -> Arguments:
        luma, chroma = self.amounts
        return {
            **super().arguments(context),
            "spatial_scale": gaussian_scale(self.spatial_sigma),
            "luma_scale": gaussian_scale(self.range * luma),
            "chroma_scale": gaussian_scale(self.range * chroma),
        }

    def reference(self, image: Floats, inputs: ReferenceContext) -> Floats:
        planes = rgb_to_ycbcr(image)
        numbers = typed_arguments(self.arguments(inputs.context))
        luma, chroma = planes[..., :1], planes[..., 1:]
        near = numbers["spatial_scale"]
        guide = smooth(planes) if self.guide == "smooth" else planes
        y, c = guide[..., :1], guide[..., 1:]
        luma = bilateral(luma, y, self.reaches[0], near, numbers["luma_scale"])
        chroma = bilateral(chroma, c, self.reaches[1], near, numbers["chroma_scale"])
        return ycbcr_to_rgb(np.concatenate([luma, chroma], axis=-1))


def bilateral(
    planes: Floats, guide: Floats, reach: int, spatial_scale: float, scale: float
) -> Floats:
    """Filter (height, width, plane) bilaterally by the guide's common distance (eq. 5 and 6).

    A weight is 2^(spatial_scale * distance^2 + scale * difference^2). The distance is in px and the
    difference in signal units; see :func:`gaussian_scale`.

    >>> step = np.float32([[[0], [0], [1], [1]]])
    >>> result = bilateral(step, step, 1, gaussian_scale(1.0), gaussian_scale(0.1))
    >>> result[0, :, 0].round(3).tolist()
    [0.0, 0.0, 1.0, 1.0]
    """
    total, weights = planes.copy(), np.ones_like(planes[..., :1])
    offsets = range(-reach, reach + 1)
    for dx, dy in ((dx, dy) for dy in offsets for dx in offsets if (dx, dy) != (0, 0)):
        other = tap(planes, dx, dy)
        squared = ((tap(guide, dx, dy) - guide) ** 2).sum(-1, keepdims=True)
        near = np.float32(dx * dx + dy * dy) * spatial_scale
        weight = np.exp2(np.maximum(near + squared * scale, np.float32(-30)))
        total += weight * other
        weights += weight
    return total / weights


def gaussian_scale(sigma: float) -> float:
    """Return the factor c for which exp(-x^2 / (2 sigma^2)) = 2^(c * x^2)."""
    return -log2(e) / (2 * max(sigma, 1e-6) ** 2)
