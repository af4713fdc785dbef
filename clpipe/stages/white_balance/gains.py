"""White balance with gains that do not depend on the image, and the base of those that do."""

from collections.abc import Mapping
from dataclasses import replace
from typing import ClassVar

import numpy as np

from clpipe.base.types import Floats
from clpipe.reference.cfa import Pattern, by_site
from clpipe.stage import (
    Argument,
    Context,
    Method,
    Pass,
    Pointwise,
    ReferenceContext,
    Unchanged,
    parameter,
)


def apply_gains(image: Floats, context: Context, red: np.float32, blue: np.float32) -> Floats:
    """min(y * gain, 1), with the gain of each site's colour (green = 1); (height, width)."""
    gains = by_site(image.shape, context.pattern, red, np.float32(1), blue)
    return np.minimum(image * gains, np.float32(1))


APPLY = Pass("white_balance", Pointwise(inline_at_taps=True), ("pattern", "red_gain", "blue_gain"))


class EstimatedGains(Method):
    """Gains that are estimated from the image itself. Subclasses say how."""

    tolerance: ClassVar = 1e-6  # division is not exact on every device

    def next_context(self, context: Context) -> Context:
        # The estimates are known only when the image is processed; the as-shot gains stand in.
        return replace(context, applied_gains=context.gains)

    def search(self) -> Pass:
        """The pass that estimates "red_gain" and "blue_gain"."""
        raise NotImplementedError(type(self).__name__)

    def gains(self, image: Floats, pattern: Pattern) -> tuple[np.float32, np.float32]:
        """The gains of red and blue (green = 1) for a (height, width) mosaic."""
        raise NotImplementedError(type(self).__name__)

    def passes(self) -> tuple[Pass, ...]:
        search = self.search()
        return search, APPLY

    def reference(self, image: Floats, given: ReferenceContext) -> Floats:
        red, blue = self.gains(image, given.context.pattern)
        given.estimates["red_gain"], given.estimates["blue_gain"] = float(red), float(blue)
        return apply_gains(image, given.context, red, blue)


class AsShot(Method):
    """min(y * gain, 1), with the gains that ``inverse_white_balance`` divided by, else 1.

    >>> from clpipe.stage import run_reference
    >>> as_shot = AsShot(red_gain=2.0, blue_gain=4.0)
    >>> run_reference(as_shot, np.full((2, 2), 0.375, np.float32)).tolist()
    [[0.75, 0.375], [0.375, 1.0]]
    """

    method: ClassVar = "as_shot"
    kernel: ClassVar = "site_gains"
    summary: ClassVar = "the gains that inverse_white_balance divided by"

    red_gain: float | None = parameter(
        None, "Gain of red, green = 1.", auto="as inverse_white_balance used it", gt=0, le=64
    )
    blue_gain: float | None = parameter(
        None, "Gain of blue, green = 1.", auto="as inverse_white_balance used it", gt=0, le=64
    )

    def resolve(self, context: Context) -> "AsShot":
        red, blue = context.gains
        return self.with_defaults(red_gain=red, blue_gain=blue)

    def next_context(self, context: Context) -> Context:
        assert self.red_gain is not None and self.blue_gain is not None
        return replace(context, applied_gains=(self.red_gain, self.blue_gain))

    def passes(self) -> tuple[Pass, ...]:
        return (APPLY,)

    def arguments(self, context: Context) -> Mapping[str, Argument]:
        red, blue = np.float32(self.red_gain), np.float32(self.blue_gain)
        return {"pattern": context.cfa, "red_gain": red, "blue_gain": blue}

    def reference(self, image: Floats, given: ReferenceContext) -> Floats:
        return apply_gains(
            image, given.context, np.float32(self.red_gain), np.float32(self.blue_gain)
        )


class Gains(AsShot):
    """min(y * gain, 1), with fixed gains: the user's, else the camera's."""

    method: ClassVar = "gains"
    summary: ClassVar = "fixed gains, by default the camera's"

    red_gain: float | None = parameter(
        None, "Gain of red, green = 1.", auto="from the camera", gt=0, le=64
    )
    blue_gain: float | None = parameter(
        None, "Gain of blue, green = 1.", auto="from the camera", gt=0, le=64
    )

    def resolve(self, context: Context) -> "Gains":
        red, blue = context.camera.white_balance_gains
        return self.with_defaults(red_gain=red, blue_gain=blue)


class Unbalanced(Unchanged):
    """No gains: after ``inverse_white_balance`` the mosaic keeps the sensor's own colours."""

    method: ClassVar = "none"
    summary: ClassVar = "no gains"
