"""Means weighted by Tukey's biweight, which leave grain like a camera's."""

from collections.abc import Mapping
from typing import ClassVar, Self

import numpy as np

from clpipe.base.tracing import hypot
from clpipe.base.types import Floats
from clpipe.reference.colour import rgb_to_ycbcr, ycbcr_to_rgb
from clpipe.reference.image import tap
from clpipe.reference.roots import from_root, in_steps, noise_in_roots, root_of
from clpipe.stage import (
    Arguments,
    CompileTime,
    Context,
    Kind,
    Pass,
    Pointwise,
    ReferenceContext,
    Stencil,
    parameter,
)
from clpipe.stages.denoise.strength import MID_GREY, Denoiser, offset_of_roots, offset_parameter

# The difference that gets weight 0, in multiples of strength * noise. Found by experiment. At 6 in
# luma, isolated large noise values remain, so noise has longer tails than a camera's. Above 16,
# edges become softer. Below 7 in chroma, the weak channel of saturated colours is noisier than in
# cameras. Above 7, colours bleed.
RANGE_LUMA, RANGE_CHROMA = 16.0, 7.0
# The difference of luma that excludes a pixel from the mean of chroma, in multiples of the noise.
# Without it, small coloured patterns fade.
RANGE_GUIDE = 15.0
# Roots of the signal; the smallest noise for which luma is filtered, less than one level of 255.
# Found by experiment: at 0.006, an image at ISO 100 is further from the ground truth than without
# denoising.
MIN_NOISE = 0.0025

GRAIN = 0.35  # share of luma's noise that remains at strength 1, at low noise

# Weights by squared distance in px. Luma has a binomial window. Chroma has a wider window of equal
# weights, with pixels that demosaicing interpolated from samples other than the centre's.
LUMA_WINDOW = {1: 0.5, 2: 0.25}
CHROMA_WINDOW = {2: 1.0, 4: 1.0}


def window_offsets(
    window: Mapping[int, float], scale: int = 1
) -> list[tuple[int, int, np.float32]]:
    """Return the offsets (right, down) in px and weights of a window's pixels but its centre.

    At a larger scale, a pixel at a distance of (1, 1) moves to (scale, scale), and one at (2, 0) to
    (scale + 1, 0). The eight pixels of chroma stay on a ring.

    >>> len(window_offsets(LUMA_WINDOW)), len(window_offsets(CHROMA_WINDOW))
    (8, 8)
    >>> [(dx, dy) for dx, dy, _ in window_offsets(CHROMA_WINDOW, scale=3)][:3]
    [(0, -4), (-3, -3), (3, -3)]
    """
    steps, at = range(-2, 3), (0, scale, scale + 1)
    squares = [(dx, dy, dx * dx + dy * dy) for dy in steps for dx in steps]
    near = [(dx, dy, window[r2]) for dx, dy, r2 in squares if r2 in window]
    return [
        (at[abs(dx)] * (1 if dx > 0 else -1), at[abs(dy)] * (1 if dy > 0 else -1), np.float32(w))
        for dx, dy, w in near
    ]


def biweight(
    planes: Floats,
    window: Mapping[int, float],
    reach: np.float32,
    scale: int = 1,
    guide: Floats | None = None,
) -> Floats:
    """Return the weighted mean around each pixel, (height, width, plane) in and out.

    The weight of a pixel is Tukey's biweight times the window's weight (Mosteller and Tukey 1977).
    The biweight is (1 - d^2 / reach^2)^2, or 0 if d is above the reach. d is the pixel's difference
    from the centre in all planes. The difference in ``guide``, (height, width, 1) in units of the
    reach, also counts: it keeps the mean on one side of an edge.

    >>> step = np.float32([[[0], [0], [1], [1]]])
    >>> biweight(step, LUMA_WINDOW, np.float32(1))[0, :, 0].tolist()
    [0.0, 0.0, 1.0, 1.0]
    """
    scaled = planes * (np.float32(1) / reach)
    total, weights = scaled.copy(), np.ones_like(planes[..., :1])
    for dx, dy, near in window_offsets(window, scale):
        other = tap(scaled, dx, dy)
        squared = np.square(other - scaled).sum(-1, keepdims=True)
        if guide is not None:
            squared += np.square(tap(guide, dx, dy) - guide)
        weight = np.square(np.maximum(np.float32(1) - squared, np.float32(0))) * near
        total += weight * other
        weights += weight
    return np.asarray(total / weights * reach)


class Biweight(Denoiser):
    """Means weighted by Tukey's biweight of the difference, on roots of luma and chroma.

    In roots of the signal, noise has the same size at all levels, and a dark colour does not pick
    up the noise of a bright one. The mean extends over one pixel in luma and four in chroma. A
    share of luma's grain remains, like in cameras. The noise of a finished image is therefore
    fine-grained in luma, and coarser in chroma.
    """

    method: ClassVar = "biweight"
    kernel: ClassVar = "denoise_biweight"
    summary: ClassVar = "weighted mean of near pixels, as light as in cameras; keeps grain"
    tolerance: ClassVar = 5e-5  # the kernel's root is a short iteration

    luma_strength: float = parameter(
        0.5, "Strength on luma, relative to luma_noise; 0 disables it.", ge=0, le=100
    )
    chroma_strength: float = parameter(
        2.3, "Strength on chroma, relative to chroma_noise; 0 disables it.", ge=0, le=100
    )
    grain: float | None = parameter(
        None,
        "Share of luma's noise that is kept.",
        "",
        "0.35 of the strength, at most 0.35; less if there is much noise",
        ge=0,
        le=1,
    )
    chroma_scale: int = parameter(
        3,
        "Scale at which chroma is filtered: distance of the averaged pixels along both axes.",
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
        share = GRAIN * min(resolved.luma_strength, 1.0)
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
            RANGE_LUMA * self.luma_strength * hypot(luma, MIN_NOISE),
            RANGE_CHROMA * self.chroma_strength * chroma,
        )
        return max(ranges[0], 1e-6), max(ranges[1], 1e-6)

    @property
    def guide_scale(self) -> float:
        """The inverse of the difference of luma that excludes a pixel from the mean of chroma."""
        return 1 / (RANGE_GUIDE * hypot(self.roots[0], MIN_NOISE))

    @property
    def is_off(self) -> bool:
        """Whether the image stays unchanged, even below -offset."""
        return not (self.luma_strength or self.chroma_strength)

    def passes(self) -> tuple[Pass, ...]:
        if self.is_off:
            return ()
        units = ("luma_range", "chroma_range")
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
            Pass(
                "biweight",
                Stencil(self.chroma_scale + 1),
                ("grain", "guide", "chroma_scale"),
                reads=("planes",),
                writes="filtered",
                kind=Kind.YCBCR,
            ),
            Pass("luma_chroma_to_light", arguments=("offset", *units), reads=("filtered",)),
        )

    def arguments(self, context: Context) -> Arguments:
        luma, chroma = self.ranges
        return {
            "luma_range": luma,
            "chroma_range": chroma,
            "grain": self.grain,
            "guide": (luma * self.guide_scale) ** 2,
            "chroma_scale": CompileTime(str(self.chroma_scale)),
            "offset": self.offset,
        }

    def reference(self, image: Floats, inputs: ReferenceContext) -> Floats:
        if self.is_off:
            return image
        luma_range, chroma_range = (np.float32(each) for each in self.ranges)
        grain, offset = np.float32(self.grain), np.float32(self.offset)
        planes = rgb_to_ycbcr(in_steps(root_of(image, offset)))
        y, c = planes[..., :1], planes[..., 1:]
        filtered = biweight(y, LUMA_WINDOW, luma_range)
        guide = y * np.float32(self.guide_scale)
        c = biweight(c, CHROMA_WINDOW, chroma_range, self.chroma_scale, guide)
        y = filtered + grain * (y - filtered)
        return from_root(ycbcr_to_rgb(np.concatenate([y, c], axis=-1)), offset)
