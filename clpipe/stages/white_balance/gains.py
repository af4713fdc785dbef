"""White balance with fixed gains, and the base of the methods that estimate gains."""

from dataclasses import replace
from typing import Any, ClassVar, Self

import numpy as np
from pydantic import PrivateAttr

from clpipe.base.types import Floats
from clpipe.camera.lights import TOLERANCE, limited_to_lights, plausible_gains
from clpipe.reference.cfa import Pattern, by_site
from clpipe.reference.filter_array import FilterArray, parse_array, tiled
from clpipe.stage import (
    PERIOD,
    Arguments,
    Context,
    Method,
    Pass,
    Pointwise,
    ReferenceContext,
    Unchanged,
    levels_table,
    parameter,
    period_of,
)

UNIFORM_ARRAY = parse_array("G")  # a filter array whose pixels all have the same level


def apply_gains(image: Floats, context: Context, red: np.float32, blue: np.float32) -> Floats:
    """min(y * gain, 1), with the gain of each site's colour (green = 1); (height, width)."""
    gains = by_site(image.shape, context.pattern, red, np.float32(1), blue)
    return np.minimum(image * gains, np.float32(1))


LIGHTS = ("lights", "light_count", "light_tolerance")  # arguments that limit estimated gains
APPLY = Pass("white_balance", Pointwise(inline_at_taps=True), ("pattern", "red_gain", "blue_gain"))


class EstimatedGains(Method):
    """Gains that are estimated from the image; subclasses define how.

    The colours of a scene can mislead an estimate: among leaves, a grey card becomes magenta. The
    gains are therefore moved to within 8 % of those for the nearest daylight or incandescent light,
    like in cameras; see :mod:`clpipe.camera.lights`.
    """

    tolerance: ClassVar = 1e-6  # division is not exact on every device

    limit: bool = parameter(
        True, "Whether gains stay near those for daylight and incandescent light."
    )

    def next_context(self, context: Context) -> Context:
        # The estimates are known only when the image is processed; the as-shot gains replace them
        # here.
        return context.replace(applied_gains=context.gains, full_scale=1.0)

    def estimation_pass(self) -> Pass:
        """The pass that estimates "red_gain" and "blue_gain"."""
        raise NotImplementedError(type(self).__name__)

    def arguments(self, context: Context) -> Arguments:
        lights = plausible_gains(context.camera, context.gains)
        return {
            "lights": lights,
            "light_count": len(lights) if self.limit else 0,
            "light_tolerance": TOLERANCE,
        }

    def gains(self, image: Floats, pattern: Pattern) -> tuple[np.float32, np.float32]:
        """Return the gains of red and blue (green = 1) for a (height, width) mosaic."""
        raise NotImplementedError(type(self).__name__)

    def passes(self) -> tuple[Pass, ...]:
        estimation_pass = self.estimation_pass()
        return estimation_pass, APPLY

    def reference(self, image: Floats, inputs: ReferenceContext) -> Floats:
        estimated = np.array(self.gains(image, inputs.context.pattern), np.float32)
        context = inputs.context
        lights = plausible_gains(context.camera, context.gains)[: None if self.limit else 0]
        red, blue = limited_to_lights(estimated, lights, np.float32(TOLERANCE))
        inputs.estimates["red_gain"], inputs.estimates["blue_gain"] = float(red), float(blue)
        return apply_gains(image, inputs.context, red, blue)


def gain_parameter(colour: str, text: str = "Gain", auto: str = "from the camera") -> Any:
    """Declare the gain of red or blue."""
    return parameter(None, f"{text} of {colour}, green = 1.", auto=auto, gt=0, le=64)


class CameraGains(Method):
    """Gains of red and blue, from the camera if they are not set; subclasses define their use."""

    red_gain: float | None = gain_parameter("red", "White balance gain")
    blue_gain: float | None = gain_parameter("blue", "White balance gain")

    def resolve(self, context: Context) -> "CameraGains":
        red, blue = context.camera.white_balance_gains
        return self.with_defaults(red_gain=red, blue_gain=blue)

    @property
    def gains(self) -> tuple[float, float]:
        """The (resolved) gains of red and blue."""
        assert self.red_gain is not None and self.blue_gain is not None
        return self.red_gain, self.blue_gain


class ArrayMethod(CameraGains):
    """Gains on a filter array that is no Bayer pattern: one for each of its channels."""

    kernel: ClassVar = "filter_array"
    function: ClassVar = "level_to_white"
    inverse: ClassVar = True  # whether white becomes 1, or is 1

    _array: FilterArray = PrivateAttr()

    @classmethod
    def for_array(cls, array: FilterArray, gains: CameraGains) -> Self:
        """The (resolved) gains on a filter array."""
        return cls(**dict(gains)).with_state(_array=replace(array, gains=gains.gains))

    def next_context(self, context: Context) -> Context:
        array = self._array.with_gains(self.gains, self.inverse)
        return super().next_context(context).replace(array=array)

    def passes(self) -> tuple[Pass, ...]:
        return (Pass(self.function, arguments=("factors", *PERIOD)),)

    def arguments(self, context: Context) -> Arguments:
        table = levels_table(self._array, self.inverse)
        return {"factors": table, **period_of(self._array.period)}

    def factors_at(self, shape: tuple[int, ...]) -> Floats:
        """Return the factor of each pixel of a mosaic, (height, width)."""
        rows, columns = self._array.period
        return tiled(levels_table(self._array, self.inverse)[:rows, :columns], shape)

    def reference(self, image: Floats, inputs: ReferenceContext) -> Floats:
        return np.minimum(image * self.factors_at(image.shape), np.float32(1))


class Gains(CameraGains):
    """min(y * gain, 1), with fixed gains: yours, else the camera's.

    >>> from clpipe.stage import run_reference
    >>> gains = Gains(red_gain=2.0, blue_gain=4.0)
    >>> run_reference(gains, np.full((2, 2), 0.375, np.float32)).tolist()
    [[0.75, 0.375], [0.375, 1.0]]
    """

    method: ClassVar = "gains"
    kernel: ClassVar = "site_gains"
    summary: ClassVar = "fixed gains, by default the camera's"
    any_array: ClassVar = True

    def resolve(self, context: Context) -> CameraGains:
        resolved = super().resolve(context)
        return ArrayGains.for_array(context.array, resolved) if context.array else resolved

    def next_context(self, context: Context) -> Context:
        return context.replace(applied_gains=self.gains, full_scale=1.0)

    def passes(self) -> tuple[Pass, ...]:
        return (APPLY,)

    def reference(self, image: Floats, inputs: ReferenceContext) -> Floats:
        return apply_gains(image, inputs.context, *map(np.float32, self.gains))


class ArrayGains(ArrayMethod, Gains):
    """Fixed gains on any filter array."""


class AsShot(Gains):
    """min(y * gain, 1), with the gains that ``inverse_white_balance`` divided by, else 1."""

    method: ClassVar = "as_shot"
    summary: ClassVar = "the gains that inverse_white_balance divided by"

    red_gain: float | None = gain_parameter("red", auto="the gain of inverse_white_balance")
    blue_gain: float | None = gain_parameter("blue", auto="the gain of inverse_white_balance")

    def resolve(self, context: Context) -> CameraGains:
        red, blue = context.gains
        resolved = self.with_defaults(red_gain=red, blue_gain=blue)
        if context.array is None:
            return resolved
        is_white = context.array.is_balanced and resolved.gains == (1.0, 1.0)
        return ArrayAsShot.for_array(UNIFORM_ARRAY if is_white else context.array, resolved)


class ArrayAsShot(ArrayMethod, AsShot):
    """As-shot gains for any filter array. No channel changes if white is already 1 in all."""

    def next_context(self, context: Context) -> Context:
        after = super().next_context(context)
        return after.replace(array=context.array) if self._array == UNIFORM_ARRAY else after


class Unbalanced(Unchanged):
    """No gains: after ``inverse_white_balance`` the mosaic keeps the sensor's own colours."""

    summary: ClassVar = "no gains"
    any_array: ClassVar = True
