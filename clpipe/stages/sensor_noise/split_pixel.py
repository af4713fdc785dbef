"""Split pixels: each has a large and a small photodiode."""

from typing import ClassVar, Self

from clpipe.base.errors import RequestError
from clpipe.camera.profile import Camera
from clpipe.stage import camera_parameter
from clpipe.stages.sensor_noise.readouts import Readout, Readouts

DEFAULT_LIGHT_RATIO = 100.0  # for sensors whose profile does not state a ratio


class SplitPhotodiode(Readouts):
    """Pixels with a large and a small photodiode, side by side.

    A share ``crosstalk`` of the light under the large photodiode makes charge in the small one. The
    small one then collects 1/ratio + crosstalk of the large one's charge. Merging multiplies by the
    ratio regardless, so a ramp of light steps up by the factor 1 + crosstalk * ratio where the
    small one takes over. The figures of the large one already include its loss.
    """

    crosstalk: float | None = camera_parameter(
        "Charge that leaks into the small photodiode, over that of the large one.",
        more="; else 0",
        ge=0,
        le=0.5,
    )

    def with_camera(self, camera: Camera) -> Self:
        filled = super().with_camera(camera)
        return filled.with_defaults(crosstalk=camera.photodiode_crosstalk).with_defaults(
            crosstalk=0.0
        )


class SplitPixel(SplitPhotodiode):
    """Split pixels: a large and a small photodiode; the small one sees 1/``ratio`` of the light.

    >>> import numpy as np
    >>> from clpipe.stage import run_reference
    >>> leaky = SplitPixel(a=0.0, b=0.0, ratio=10.0, crosstalk=0.01)
    >>> run_reference(leaky, np.float32([[0.5, 2.0]])).astype(float).round(2).tolist()
    [[0.5, 2.2]]
    """

    method: ClassVar = "split_pixel"
    summary: ClassVar = "a large and a small photodiode in each pixel, merged"
    other_examples: ClassVar = ({"crosstalk": 0.01},)

    @property
    def readouts(self) -> tuple[Readout, ...]:
        assert self.ratio is not None
        return Readout(0, 1, 1), Readout(1, 1 / self.ratio, 1, self.crosstalk or 0.0)


class SplitDualGain(SplitPhotodiode):
    """Split pixels whose photodiodes are both read at two gains, ``ratio`` apart: four readouts.

    The least sensitive readout of the large photodiode must extend beyond the most sensitive one of
    the small photodiode, so ``light_ratio`` is above ``ratio``.
    """

    method: ClassVar = "split_dual_gain"
    summary: ClassVar = "a large and a small photodiode, each read at two gains, merged"

    light_ratio: float | None = camera_parameter(
        "Light that the large photodiode sees over that of the small one.",
        more="; else 100",
        gt=1,
        le=10_000,
    )

    def with_camera(self, camera: Camera) -> Self:
        filled = super().with_camera(camera).with_defaults(light_ratio=camera.photodiode_ratio)
        filled = filled.with_defaults(light_ratio=DEFAULT_LIGHT_RATIO)
        assert filled.light_ratio is not None and filled.ratio is not None
        if filled.light_ratio <= filled.ratio:
            raise RequestError(
                f"sensor_noise.light_ratio must be above the ratio of the gains, {filled.ratio:g}; "
                f"it is {filled.light_ratio:g}"
            )
        return filled

    @property
    def readouts(self) -> tuple[Readout, ...]:
        assert self.ratio is not None and self.light_ratio is not None
        gains, leak = (1, 1 / self.ratio), self.crosstalk or 0.0
        large = (Readout(0, 1, gain) for gain in gains)
        return *large, *(Readout(1, 1 / self.light_ratio, gain, leak) for gain in gains)
