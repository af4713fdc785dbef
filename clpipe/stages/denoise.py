"""Denoising in luma and chroma, chroma stronger, as strong as the ISO asks for."""

from collections.abc import Mapping
from math import e, log2, sqrt
from typing import ClassVar

import numpy as np

from clpipe.reference.colour import LUMA, rgb_to_ycbcr, ycbcr_to_rgb
from clpipe.reference.image import tap
from clpipe.stage import (
    Access,
    Argument,
    Context,
    Frame,
    Kind,
    Literal,
    Method,
    Pass,
    Stage,
    parameter,
)
from clpipe.types import Floats

MID_GREY = 0.18
LUMA_STRENGTH, CHROMA_STRENGTH = 3.0, 6.0


def predicted_noise(context: Context) -> tuple[float, float]:
    """Standard deviations of luma and chroma noise at mid grey, in signal units.

    A grey of 0.18 is 0.18/k at a colour with white balance gain k; its noise there,
    sqrt(a*0.18/k + b), comes out k times as large. Luma and chroma are sums of the three colours,
    whose noise is independent. Noise that demosaicing takes away is not counted.
    """
    a, b = context.noise or context.camera.noise(context.iso)
    red, blue = context.gains
    gains = np.array([red, 1.0, blue])
    variance = gains**2 * (a * MID_GREY / gains + b)
    luma = np.asarray(LUMA, float)
    cb, cr = 0.564 * (np.eye(3)[2] - luma), 0.713 * (np.eye(3)[0] - luma)
    chroma = sqrt((cb**2 + cr**2) @ variance)
    return sqrt(luma**2 @ variance), chroma


class Bilateral(Method):
    """Bilateral filter (Tomasi and Manduchi, ICCV 1998) in YCbCr.

    Luma weights by luma distance; both chroma planes by their common distance.
    """

    method: ClassVar = "bilateral"
    kernel: ClassVar = "denoise_bilateral"
    summary: ClassVar = "bilateral filter on luma and, stronger, on chroma"
    tolerance: ClassVar = 2e-4  # the kernel's exp is a short polynomial

    radius: int = parameter(
        2, "Reach in pixels: the window is 2*radius+1 wide.", "px", structural=True, ge=1, le=7
    )
    spatial_sigma: float = parameter(
        1.5, "Falloff of the weights with distance.", "px", gt=0, le=100
    )
    luma_sigma: float | None = parameter(
        None,
        "Luma difference at which the weight has dropped to 0.61.",
        "signal",
        f"{LUMA_STRENGTH:g} times the luma noise at mid grey, from a, b and the gains",
        ge=0,
    )
    chroma_sigma: float | None = parameter(
        None,
        "Chroma difference at which the weight has dropped to 0.61.",
        "signal",
        f"{CHROMA_STRENGTH:g} times the chroma noise at mid grey, from a, b and the gains",
        ge=0,
    )

    def resolve(self, context: Context) -> "Bilateral":
        luma, chroma = predicted_noise(context)
        return self.filled(luma_sigma=LUMA_STRENGTH * luma, chroma_sigma=CHROMA_STRENGTH * chroma)

    def passes(self) -> tuple[Pass, ...]:
        scales = ("spatial_scale", "luma_scale", "chroma_scale")
        return (
            Pass("to_luma_chroma", writes="planes", kind=Kind.YCBCR),
            Pass(
                "bilateral",
                Access.STENCIL,
                ("radius", *scales),
                reads=("planes",),
                writes="filtered",
                kind=Kind.YCBCR,
                radius=self.radius,
            ),
            Pass("from_luma_chroma", reads=("filtered",)),
        )

    def arguments(self, context: Context) -> Mapping[str, Argument]:
        assert self.luma_sigma is not None and self.chroma_sigma is not None
        return {
            "radius": Literal(str(self.radius)),
            "spatial_scale": scale_of(self.spatial_sigma),
            "luma_scale": scale_of(self.luma_sigma),
            "chroma_scale": scale_of(self.chroma_sigma),
        }

    def reference(self, image: Floats, frame: Frame) -> Floats:
        assert self.luma_sigma is not None and self.chroma_sigma is not None
        planes = rgb_to_ycbcr(image)
        total = planes.copy()
        weights = np.ones_like(planes)
        reach = range(-self.radius, self.radius + 1)
        for dx, dy in ((dx, dy) for dy in reach for dx in reach if (dx, dy) != (0, 0)):
            other = tap(planes, dx, dy)
            squared = (other - planes) ** 2
            near = np.float32(dx * dx + dy * dy) * scale_of(self.spatial_sigma)
            luma = near + squared[..., :1] * scale_of(self.luma_sigma)
            chroma = near + squared[..., 1:].sum(-1, keepdims=True) * scale_of(self.chroma_sigma)
            weight = np.exp2(np.maximum(np.concatenate([luma, chroma, chroma], -1), -30))
            total += weight * other
            weights += weight
        return ycbcr_to_rgb(total / weights)


def scale_of(sigma: float) -> np.float32:
    """What a squared difference is multiplied by to get the log2 of a Gaussian weight."""
    return np.float32(-log2(e) / (2 * max(sigma, 1e-6) ** 2))


STAGE = Stage("denoise", "Take noise away, as a camera does.", Kind.RGB, Kind.RGB, (Bilateral,))
