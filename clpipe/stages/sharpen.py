"""Sharpening, as cameras do it: an unsharp mask on luma."""

from functools import lru_cache
from typing import ClassVar, Self

import numpy as np

from clpipe.base.tracing import traceable
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
    Stage,
    Stencil,
    Unchanged,
    parameter,
)
from clpipe.stages.denoise.strength import (
    MID_GREY,
    offset_of_roots,
    offset_parameter,
    predicted_noise,
)

# Found by trying, with the denoising of the default chain, against the noise of real cameras'
# pictures: the amount without noise; what is added where denoising softens most; and the luma
# noise, in roots of the signal, at which that is.
LEAST_AMOUNT, MORE_AMOUNT, SOFTEST = 0.2, 0.55, 0.009
THRESHOLD = 0.2  # of the luma noise; without one, small noise is sharpened and large is not
LEAST_LIMIT = 0.008  # without noise; two levels of 255


def blur_step(radius: float) -> int:
    """The distance of the pixels that a blur looks at: every second one is enough for wide ones."""
    return 1 if radius < 2 else 2


@traceable
@lru_cache(maxsize=64)
def blur_weights(radius: float) -> Floats:
    """The weights of a Gaussian blur 0, 1, 2... steps away, to twice the radius, rounded.

    Their sum over both sides is 1. Cached, so that they are uploaded once.

    >>> blur_weights(0.5).round(2).tolist(), len(blur_weights(2.2))
    ([0.7900000214576721, 0.10999999940395355], 3)
    """
    step = blur_step(radius)
    away = step * np.arange(max(round(2 * radius / step), 1) + 1)
    weights = np.exp(-(away**2) / (2 * radius**2))
    return np.asarray(weights / (2 * weights.sum() - 1), np.float32)


class Unsharp(Method):
    """Unsharp mask on the root of luma: what a Gaussian blur takes away is added once more.

    All three colours are scaled alike, so hues stay. The default amount follows the noise, as the
    denoising does that softens the picture: most at middle ISOs; less where there is little noise
    and so little softened, and where noise would be sharpened.
    """

    method: ClassVar = "unsharp"
    kernel: ClassVar = "sharpen"
    summary: ClassVar = "unsharp mask on luma, with a limit to halos"
    tolerance: ClassVar = 1e-4  # the kernel's root is a short iteration
    example: ClassVar = {"amount": 0.8, "threshold": 0.002, "limit": 0.03}

    radius: float = parameter(1.2, "Sigma of the blur.", "px", structural=True, ge=0.3, le=8)
    amount: float | None = parameter(
        None,
        "How much of the difference from the blurred picture is added; 0 is off.",
        "",
        "0.2 to 0.75, from the noise",
        ge=0,
        le=10,
    )
    threshold: float | None = parameter(
        None,
        "Differences up to this are not sharpened.",
        "root of signal",
        "a fifth of the noise",
        ge=0,
        le=1,
    )
    limit: float | None = parameter(
        None,
        "The largest change of the root of luma, which bounds halos.",
        "root of signal",
        "0.008 plus the noise",
        ge=0,
        le=1,
    )
    offset: float | None = offset_parameter()

    def resolve(self, context: Context) -> Self:
        offset = offset_of_roots(context) if self.offset is None else self.offset
        noise = noise_in_roots(predicted_noise(context)[0], MID_GREY, offset)
        x = (noise / SOFTEST) ** 2
        amount = LEAST_AMOUNT + MORE_AMOUNT * 4 * x / (1 + x) ** 2
        limits = {"threshold": THRESHOLD * noise, "limit": LEAST_LIMIT + noise}
        return self.with_defaults(amount=amount, offset=offset, **limits)

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
        return {
            "reach": CompileTime(str(self.reach)),
            "step": CompileTime(str(blur_step(self.radius))),
            "weights": blur_weights(self.radius),
            "amount": self.amount,
            "threshold": self.threshold,
            "limit": self.limit,
            "offset": self.offset,
        }

    def reference(self, image: Floats, given: ReferenceContext) -> Floats:
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

    method: ClassVar = "none"
    summary: ClassVar = "no sharpening"


STAGE = Stage(
    "sharpen",
    "Sharpen luma, as cameras do.",
    Kind.RGB,
    Kind.RGB,
    (Unsharp, NoSharpening),
)
