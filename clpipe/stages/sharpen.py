"""Sharpening, like in cameras: an unsharp mask on luma."""

from functools import lru_cache
from typing import ClassVar, Self

import numpy as np

from clpipe.base.types import Floats
from clpipe.reference.colour import rgb_to_ycbcr
from clpipe.reference.image import tap
from clpipe.reference.roots import noise_in_roots
from clpipe.stage import (
    Arguments,
    CompileTime,
    Context,
    Kind,
    Method,
    Pass,
    ReferenceContext,
    Stencil,
    Unchanged,
    parameter,
    pure,
    rgb_stage,
)
from clpipe.stages.denoise.strength import (
    MID_GREY,
    offset_of_roots,
    offset_parameter,
    predicted_noise,
)

# Found by experiment, with the optics and the denoising of the default chain: edges as sharp as
# those of cameras, and never sharper at a higher ISO. These are the amount without noise, and the
# luma noise that halves it, in roots of the signal.
AMOUNT, HALVING_NOISE = 0.8, 0.015
THRESHOLD = 0.2  # relative to the luma noise


def blur_step(radius: float) -> int:
    """Return the step between the pixels of a blur: wide blurs use every second one."""
    return 1 if radius < 2 else 2


@pure
@lru_cache(maxsize=64)
def blur_weights(radius: float) -> Floats:
    """Return the weights of a Gaussian blur 0, 1, 2... steps away, to twice the radius, rounded.

    Both sides together sum to 1. Cached, so that they are uploaded once.

    >>> blur_weights(0.5).round(2).tolist(), len(blur_weights(2.2))
    ([0.7900000214576721, 0.10999999940395355], 3)
    """
    step = blur_step(radius)
    distances = step * np.arange(max(round(2 * radius / step), 1) + 1)
    weights = np.exp(-(distances**2) / (2 * radius**2))
    return np.asarray(weights / (2 * weights.sum() - 1), np.float32)


class Unsharp(Method):
    """Unsharp mask on the root of luma: the difference from a Gaussian blur is added again.

    All three colours are scaled equally, so hues do not change. The default amount falls with the
    noise, which is sharpened as well.
    """

    method: ClassVar = "unsharp"
    kernel: ClassVar = "sharpen"
    summary: ClassVar = "unsharp mask on luma, with a limit for halos"
    tolerance: ClassVar = 1e-4  # the kernel's root is a short iteration
    example: ClassVar = {"amount": 0.8, "threshold": 0.002, "limit": 0.03}

    radius: float = parameter(1.2, "Sigma of the blur.", "px", structural=True, ge=0.3, le=8)
    amount: float | None = parameter(
        None,
        "Share of the difference from the blurred image that is added; 0 disables it.",
        "",
        "0.8; less if there is much noise",
        ge=0,
        le=10,
    )
    threshold: float | None = parameter(
        None,
        "Smallest difference that is sharpened.",
        "root of signal",
        "a fifth of the noise",
        ge=0,
        le=1,
    )
    limit: float = parameter(
        0.03,
        "Largest change of the root of luma, which limits halos.",
        "root of signal",
        ge=0,
        le=1,
    )
    offset: float | None = offset_parameter()

    def resolve(self, context: Context) -> Self:
        offset = offset_of_roots(context) if self.offset is None else self.offset
        noise = noise_in_roots(predicted_noise(context)[0], MID_GREY, offset)
        amount = AMOUNT / (1 + (noise / HALVING_NOISE) ** 2)
        return self.with_defaults(amount=amount, offset=offset, threshold=THRESHOLD * noise)

    def noise_free(self, context: Context) -> Method:
        quiet = self.with_defaults(threshold=0.0, offset=offset_of_roots(context))
        return quiet.resolve(context.replace(clean=False))  # as sharp as the picture with noise

    @property
    def reach(self) -> int:
        """The largest number of steps that the blur reaches."""
        return len(blur_weights(self.radius)) - 1

    def passes(self) -> tuple[Pass, ...]:
        if not self.amount:
            return ()
        return (
            Pass("to_root_and_ratios", arguments=("offset",), writes="planes", kind=Kind.YCBCR),
            Pass(
                "unsharp",
                Stencil(self.reach * blur_step(self.radius), vectors_per_row=1),
                ("reach", "step", "weights", "amount", "threshold", "limit"),
                reads=("planes",),
                writes="sharp",
                kind=Kind.YCBCR,
            ),
            Pass("from_root_and_ratios", arguments=("offset",), reads=("sharp",)),
        )

    def arguments(self, context: Context) -> Arguments:
        reach, step = (CompileTime(str(n)) for n in (self.reach, blur_step(self.radius)))
        weights = blur_weights(self.radius)
        return {**super().arguments(context), "reach": reach, "step": step, "weights": weights}

    def reference(self, image: Floats, inputs: ReferenceContext) -> Floats:
        if not self.amount:
            return image
        offset = np.float32(self.offset)
        luma = np.maximum(rgb_to_ycbcr(image)[..., 0] + offset, np.float32(1e-6))
        root = np.sqrt(luma)
        step = blur_step(self.radius)
        across = _blurred_along(root, self.radius, (step, 0))
        detail = root - _blurred_along(across, self.radius, (0, step))
        size = np.maximum(abs(detail) - np.float32(self.threshold), 0) * np.float32(self.amount)
        change = np.copysign(np.minimum(size, np.float32(self.limit)), detail)
        scale = np.square(np.maximum(root + change, np.float32(0))) / luma
        return np.asarray((image + offset) * scale[..., None] - offset, np.float32)


def _blurred_along(plane: Floats, radius: float, step: tuple[int, int]) -> Floats:
    first, *others = blur_weights(radius)
    total = first * plane
    for k, weight in enumerate(others, 1):
        dx, dy = k * step[0], k * step[1]
        total += weight * (tap(plane, dx, dy) + tap(plane, -dx, -dy))
    return total


class NoSharpening(Unchanged):
    """No sharpening."""

    summary: ClassVar = "no sharpening"


STAGE = rgb_stage("sharpen", "Sharpen luma, like a camera.", (Unsharp, NoSharpening))
