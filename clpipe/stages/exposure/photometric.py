"""Exposure by physics: from a camera's settings and a scene in cd/m2."""

import math
from typing import ClassVar, Self

from clpipe.camera.optics import DEFAULT_EXPOSURE_TIME
from clpipe.stage import Context, optics_parameter, parameter
from clpipe.stages.exposure.gain import Exposing

SATURATION = 78.0  # lx s at ISO 1; the exposure that saturates the sensor
GREY = 10.0  # lx s at ISO 1; the exposure of a correctly exposed 18 % grey
WHITE = GREY / 0.18 / SATURATION  # level of a white surface, relative to the sensor's full scale


class Photometric(Exposing):
    """The focal-plane exposure H = q L t / N^2 over the saturation exposure, 78 lx s / ISO.

    L is the luminance of the scene, t the exposure time and N the f-number. q is the loss in the
    lens and its geometry: pi/4 T v cos^4 = 0.65. It assumes a transmittance T of 0.9, a vignetting
    v of 0.98 and 10 degrees off the axis (ISO 12232:2019, ISO 2720:1974). The speed is the
    saturation-based one, S_sat = 78 / H_sat (ISO 12232:2019). At H = 10 / S, an 18 % grey is at
    12.8 % of full scale and a white surface at 71 %. This half a stop is headroom, which tone_curve
    gives back. A meter with K = 12.5 (ISO 2720), N^2 / t = L S / K, exposes with q K / S = 8.1 / S.

    >>> import numpy as np
    >>> from clpipe.stage import run_reference
    >>> metered = Photometric(exposure_time=0.01, f_number=8.0)  # for L = 800 at ISO 100
    >>> round(run_reference(metered, np.full((1, 1, 3), 800, np.float32)).max().item(), 4)
    0.1042
    """

    method: ClassVar = "photometric"
    summary: ClassVar = "exposure time, f-number and ISO, for a render in cd/m2 (ISO 12232)"
    example: ClassVar = {"exposure_time": 1.0, "f_number": 1.0, "scale": 100.0}

    headroom: float = parameter(
        0.0,
        "Range of the sensor above the saturation of ISO 12232, 78 lx s / ISO. The tone curve "
        "linear restores the brightness.",
        "EV",
        ge=0,
        le=10,
    )
    exposure_time: float | None = optics_parameter(
        "Exposure time, t.", "s", more=", else 0.01", gt=0, le=86400
    )
    f_number: float | None = optics_parameter(
        "f-number of the lens, N.", more=", else 8", gt=0, le=1000
    )
    q: float = parameter(
        0.65, "Share of the light that the lens and its geometry pass.", gt=0, le=math.pi / 4
    )
    scale: float = parameter(
        1.0,
        "Luminance of a render's 1.0. Use 1 for a render in cd/m2. For a render in W/(sr m2), "
        "use 683 if its channels are weighted for the eye, or 179 for a renderer's white light "
        "(Radiance).",
        "cd/m2",
        gt=0,
        le=1e9,
    )

    def resolve(self, context: Context) -> Self:
        return self.with_optics(context).with_defaults(
            f_number=8.0, exposure_time=DEFAULT_EXPOSURE_TIME
        )

    def next_context(self, context: Context) -> Context:
        headroom = context.headroom + self.headroom - math.log2(WHITE)
        return context.replace(headroom=headroom, exposure_time=self.time(self.exposure_time))

    def factor(self, iso: float) -> float:
        assert self.f_number and self.exposure_time
        exposure = self.q * self.scale * self.exposure_time / self.f_number**2  # lx s
        return exposure * iso / SATURATION * 2.0 ** (self.ev - self.headroom)
