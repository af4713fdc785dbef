"""Veiling glare: light that a lens scatters over the whole image, and that lifts its shadows."""

from typing import ClassVar

import numpy as np

from clpipe.base.types import Floats
from clpipe.stage import (
    Arguments,
    Context,
    Method,
    Pass,
    Pointwise,
    Reduction,
    ReferenceContext,
    StageRole,
    Unchanged,
    parameter,
    rgb_stage,
)

STEPS, MOST = np.float32(4096), np.float32(256)  # of a sample that is summed; per unit of light


class NoGlare(Unchanged):
    """No glare."""

    summary: ClassVar = "no glare"


class Veil(Method):
    """(1 - share) * v + share * mean: a share of all light, spread evenly.

    A black spot on a white field then has the level ``share``. This is the veiling glare index of
    ISO 9358, which ISO 18844 calls flare. Real glare is stronger near a light; that part is not
    modelled. The mean of red, and that of blue, is of a quarter of the pixels. Light above 256
    times white counts as 256.

    >>> from clpipe.stage import run_reference
    >>> field = np.ones((8, 8, 3), np.float32)
    >>> field[4, 4] = 0
    >>> run_reference(Veil(share=0.25), field)[4, 4].round(2).tolist()
    [0.23000000417232513, 0.25, 0.25]
    """

    method: ClassVar = "veil"
    kernel: ClassVar = "glare"
    summary: ClassVar = "a share of all light, spread evenly over the image"
    tolerance: ClassVar = 1e-5  # division is not exact on every device

    share: float = parameter(0.01, "Share of the light that is scattered.", ge=0, le=0.5)

    def passes(self) -> tuple[Pass, ...]:
        if not self.share:
            return ()
        means = Reduction("glare_mean", ("red", "green", "blue"), ("share",))
        at_taps = Pointwise(inline_at_taps=True)
        spread = Pass("glare", at_taps, ("kept", "red", "green", "blue"))
        return Pass("glare_sample", means), spread

    def arguments(self, context: Context) -> Arguments:
        return {"share": self.share, "kept": 1 - self.share}

    def reference(self, image: Floats, inputs: ReferenceContext) -> Floats:
        if not self.share:
            return image
        veil = np.float32(self.share) / STEPS * mean_light(image)
        inputs.estimates |= dict(zip(("red", "green", "blue"), map(float, veil), strict=True))
        return np.asarray(image * np.float32(1 - self.share) + veil)


def mean_light(image: Floats) -> Floats:
    """Return the means of red, green and blue in steps of 1/4096, (3,), as the stage samples them.

    >>> mean_light(np.float32([[[1, 2, 3], [1, 2, 3]], [[1, 2, 3], [1, 2, 3]]])).tolist()
    [4096.0, 8192.0, 12288.0]
    """
    steps = np.rint(np.clip(image, np.float32(0), MOST) * STEPS).astype(np.int64)
    red, blue = steps[::2, ::2, 0], steps[1::2, 1::2, 2]
    greens = steps[::2, 1::2, 1], steps[1::2, ::2, 1]
    sums = red.sum(), sum(each.sum() for each in greens), blue.sum()
    counts = red.size, sum(each.size for each in greens), blue.size
    means: list[np.float32] = []
    for total, count in zip(sums, counts, strict=True):
        means.append(np.float32(total) / np.float32(count) if count else means[-1])
    return np.array(means, np.float32)


STAGE = rgb_stage(
    "glare", "Scatter light over the image, like a lens.", (NoGlare, Veil), role=StageRole.LENS
)
