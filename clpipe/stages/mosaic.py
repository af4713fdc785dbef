"""The colour filter array."""

from dataclasses import replace
from typing import ClassVar

import numpy as np

from clpipe.base.types import Floats
from clpipe.reference.cfa import Pattern, by_site
from clpipe.stage import (
    Arguments,
    Context,
    Kind,
    Method,
    Pass,
    ReferenceContext,
    Stage,
    StageRole,
    parameter,
)


class Bayer(Method):
    """A Bayer pattern (US patent 3,971,065, 1976): each pixel keeps one of its three colours.

    >>> from clpipe.stage import run_reference
    >>> image = np.float32([1, 2, 3]) * np.ones((2, 2, 1), np.float32)
    >>> run_reference(Bayer(pattern="GRBG"), image).tolist()
    [[2.0, 1.0], [3.0, 2.0]]
    """

    method: ClassVar = "bayer"
    kernel: ClassVar = "mosaic"
    summary: ClassVar = "keep one colour of each pixel, by a Bayer pattern"

    pattern: Pattern = parameter(
        "RGGB", "Colours of the 2x2 pixels in the upper left corner, row by row.", structural=True
    )

    def next_context(self, context: Context) -> Context:
        return replace(context, pattern=self.pattern)

    def passes(self) -> tuple[Pass, ...]:
        return (Pass("mosaic", arguments=("pattern",)),)

    def arguments(self, context: Context) -> Arguments:
        return {"pattern": replace(context, pattern=self.pattern).cfa}

    def reference(self, image: Floats, given: ReferenceContext) -> Floats:
        red, green, blue = np.moveaxis(image, -1, 0)
        return by_site(image.shape, self.pattern, red, green, blue)


STAGE = Stage(
    "mosaic",
    "Lay a colour filter array over the image.",
    Kind.RGB,
    Kind.MOSAIC,
    (Bayer,),
    role=StageRole.PATTERN,
)
