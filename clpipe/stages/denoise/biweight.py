"""Means weighted by Tukey's biweight, which leave grain like a camera's."""

from collections.abc import Iterable
from typing import ClassVar, Self

import numpy as np

from clpipe.base.types import Floats
from clpipe.reference.colour import rgb_to_ycbcr, ycbcr_to_rgb
from clpipe.reference.image import smooth, tap
from clpipe.reference.roots import from_root, in_steps, noise_in_roots, root_of
from clpipe.stage import (
    Arguments,
    Context,
    Kind,
    Method,
    Pass,
    Pointwise,
    ReferenceContext,
    Stencil,
    parameter,
    typed_arguments,
)
from clpipe.stages.denoise.strength import MID_GREY, Denoiser, offset_of_roots, offset_parameter

# The difference that gets weight 0, in multiples of strength * noise.
RANGE_LUMA, RANGE_CHROMA = 16.0, 7.0
# The difference of luma that excludes a pixel from the mean of chroma, in multiples of the noise.
# Without it, small coloured patterns fade.
RANGE_GUIDE = 15.0
# Roots of the signal; the smallest noise for which luma is filtered, less than one level of 255.
# Found by experiment: at 0.006, an image at ISO 100 is further from the ground truth than without
# denoising.
MIN_NOISE = 0.0025

GRAIN = 0.15  # share of luma's noise that remains, at low noise

ADJACENT = ((-1, 0), (1, 0), (0, -1), (0, 1))  # offsets to the right and down
DIAGONAL = ((-1, -1), (1, -1), (-1, 1), (1, 1))


def biweight(centre: Floats, others: Iterable[tuple[Floats, Floats]]) -> Floats:
    """Return the weighted mean of each pixel and others, (height, width, plane).

    The weight of the centre is 1. That of the others is Tukey's biweight (Mosteller and Tukey
    1977), (1 - d^2)^2, or 0 if d is above 1.

    >>> step, far = np.float32([[[0], [0], [1], [1]]]), np.full((1, 4, 1), 2, np.float32)
    >>> biweight(step, [(tap(step, 1, 0), 0 * far), (far, far)])[0, :, 0].tolist()
    [0.0, 0.5, 1.0, 1.0]

    Args:
        centre: the pixels.
        others: other pixels for each of them, and d^2, (height, width, 1).
    """
    total, weights = centre.copy(), np.ones_like(centre[..., :1])
    for pixels, squared in others:
        weight = np.square(np.maximum(np.float32(1) - squared, np.float32(0)))
        total += weight * pixels
        weights += weight
    return np.asarray(total / weights)


class Biweight(Denoiser):
    """Means weighted by Tukey's biweight of the difference, on roots of luma and chroma.

    In roots of the signal, noise has the same size at all levels, and a dark colour does not pick
    up the noise of a bright one. The mean of luma is that of adjacent pixels, and the mean of
    chroma extends further. A share of luma's grain remains, like in cameras. The noise of a
    finished image is therefore fine-grained in luma, and coarser in chroma.

    Differences are those of a binomial mean of 3x3 pixels. Differences of the image itself would
    contain the noise of the filtered pixel. Its mean would then prefer pixels with similar noise,
    and edges would become sharper with more noise. Chroma is smoothed by the same mean first, also
    without noise, because cameras resolve less in chroma.
    """

    method: ClassVar = "biweight"
    kernel: ClassVar = "denoise_biweight"
    summary: ClassVar = "weighted mean of near pixels, as light as in cameras; keeps grain"
    tolerance: ClassVar = 5e-5  # the kernel's root is a short iteration

    luma_strength: float = parameter(
        0.12, "Strength on luma, relative to luma_noise; 0 disables it.", ge=0, le=100
    )
    chroma_strength: float = parameter(
        0.4,
        "Strength on chroma, relative to chroma_noise; 0 leaves only a mean of 3x3 pixels.",
        ge=0,
        le=100,
    )
    grain: float | None = parameter(
        None,
        "Share of luma's noise that is kept.",
        "",
        "0.15; less if there is much noise",
        ge=0,
        le=1,
    )
    chroma_scale: int = parameter(
        2,
        "Distance of the pixels whose chroma is averaged, along both axes.",
        "px",
        structural=True,
        ge=1,
        le=4,
    )
    offset: float | None = offset_parameter()

    @property
    def roots(self) -> tuple[float, float]:
        """The noise of luma and of chroma at mid grey, in roots of the signal."""
        assert self.luma_noise is not None and self.chroma_noise is not None
        assert self.offset is not None
        luma, chroma = self.luma_noise, self.chroma_noise
        at = MID_GREY, self.offset
        return noise_in_roots(luma, *at), noise_in_roots(chroma, *at)

    def resolve(self, context: Context) -> Self:
        resolved = super().resolve(context).with_defaults(offset=offset_of_roots(context))
        share = GRAIN if resolved.luma_strength else 0.0
        return resolved.with_defaults(grain=share / (1 + (resolved.roots[0] / 0.03) ** 2))

    @property
    def effect(self) -> str:
        luma, chroma = (f"{each:.3g}" for each in self.ranges)
        return f"differences of roots up to: luma {luma}, chroma {chroma}; grain {self.grain:.0%}"

    @property
    def ranges(self) -> tuple[float, float]:
        """The differences of luma and of chroma that have the weight 0, in roots of the signal."""
        luma, chroma = self.roots
        ranges = (
            RANGE_LUMA * self.luma_strength * np.hypot(luma, MIN_NOISE),
            RANGE_CHROMA * self.chroma_strength * chroma,
        )
        return max(ranges[0], 1e-6), max(ranges[1], 1e-6)

    @property
    def luma_share(self) -> float:
        """The weight of the squared difference of luma in that of colours."""
        reach = RANGE_GUIDE * np.hypot(self.roots[0], MIN_NOISE)
        return (self.ranges[0] / reach) ** 2

    def noise_free(self, context: Context) -> Method:
        off = dict.fromkeys(("luma_strength", "chroma_strength", "grain"), 0.0)
        none = dict.fromkeys(("luma_noise", "chroma_noise"), 0.0)
        return self.model_copy(update=off | none).with_defaults(offset=offset_of_roots(context))

    @property
    def is_low_pass(self) -> bool:
        """Whether only chroma is smoothed, like without noise."""
        return not (self.luma_strength or self.chroma_strength)

    def passes(self) -> tuple[Pass, ...]:
        units = ("luma_range", "chroma_range")
        if self.is_low_pass:
            filters = [Pass("smooth_chroma", Stencil(1), (), ("planes",), "filtered", Kind.YCBCR)]
        else:
            names = ("grain", "luma_share", "chroma_scale")
            stencil = Stencil(max(self.chroma_scale, 2))
            filters = [Pass("biweight", stencil, names, ("planes",), "filtered", Kind.YCBCR)]
        return (
            Pass(
                "light_to_roots",
                Pointwise(inverse_of="roots_to_light"),
                ("offset",),
                writes="roots",
            ),
            Pass(
                "roots_to_luma_chroma",
                arguments=units,
                reads=("roots",),
                writes="planes",
                kind=Kind.YCBCR,
            ),
            *filters,
            Pass("luma_chroma_to_light", arguments=("offset", *units), reads=("filtered",)),
        )

    def arguments(self, context: Context) -> Arguments:
        luma, chroma = self.ranges
        grain = self.grain if self.luma_strength else 1.0
        numbers = {"luma_range": luma, "chroma_range": chroma, "grain": grain}
        return {**super().arguments(context), **numbers}

    def reference(self, image: Floats, inputs: ReferenceContext) -> Floats:
        ranges = np.array([self.ranges[0], *[self.ranges[1]] * 2], np.float32)
        offset = np.float32(self.offset)
        planes = rgb_to_ycbcr(in_steps(root_of(image, offset))) * (np.float32(1) / ranges)
        luma, guide = planes[..., :1], smooth(planes)
        chroma = guide[..., 1:]
        if not self.is_low_pass:
            numbers = typed_arguments(self.arguments(inputs.context))
            adjacent = [
                (tap(luma, dx, dy), np.square(tap(guide[..., :1], dx, dy) - guide[..., :1]))
                for dx, dy in ADJACENT
            ]
            filtered = biweight(luma, adjacent)
            luma = filtered + numbers["grain"] * (luma - filtered)
            step = self.chroma_scale
            diagonal = [tap(planes, dx * step, dy * step) for dx, dy in DIAGONAL]
            weigh = np.array([numbers["luma_share"], 1, 1], np.float32)
            apart = [(np.square(p - guide) * weigh).sum(-1, keepdims=True) for p in diagonal]
            chroma = biweight(chroma, zip((p[..., 1:] for p in diagonal), apart, strict=True))
        return from_root(ycbcr_to_rgb(np.concatenate([luma, chroma], axis=-1) * ranges), offset)
