"""Exposure by physics: from a spectral render in W/(m2 sr nm) to electrons."""

import math
from typing import ClassVar, Self

from pydantic import PrivateAttr

from clpipe.base.errors import RequestError
from clpipe.camera.optics import DEFAULT_EXPOSURE_TIME
from clpipe.camera.profile import Camera
from clpipe.stage import Context, camera_parameter, optics_parameter, parameter
from clpipe.stages.exposure.gain import Exposing
from clpipe.stages.exposure.photometric import WHITE


class Radiometric(Exposing):
    """The charge of a pixel, over the charge at which its ADC reads white.

    A pixel of the pitch p gets t p^2 pi / (4 N^2) times the integral of L QE wavelength / (h c)
    electrons. L is the radiance, and t the exposure time. N is the f-number of a lens that is
    focused far away. QE, the quantum efficiency, follows from the sensitivities of the profile:
    relative ones are scaled to ``quantum_efficiency``. Lens and infrared cut are those of the
    profile, else the curves contain them. The charge at which the ADC reads white follows from the
    camera's system gain at the ISO (EMVA 1288, release 4.0 (2021), sections 2.1 and 2.2).

    >>> from clpipe.camera.profile import load_camera
    >>> from clpipe.camera.spectra import sight_of
    >>> camera = load_camera("sony-a7r2")
    >>> context = Context(camera, 100, wavelengths=(400, 500, 600), sight=sight_of(camera, "D65"))
    >>> method = Radiometric(f_number=8.0, quantum_efficiency=0.5).resolve(context)
    >>> round(method.factor(100), 2)  # of white with a mean radiance of 1 W/(m2 sr nm)
    7.23
    """

    method: ClassVar = "radiometric"
    summary: ClassVar = "exposure time, f-number and ISO, for a spectral render in W/(m2 sr nm)"

    headroom: float = parameter(
        0.0, "Range for highlights that the tone curve linear gives back.", "EV", ge=0, le=10
    )
    exposure_time: float | None = optics_parameter(
        "Exposure time, t.", "s", more=", else 0.01", gt=0, le=86400
    )
    f_number: float | None = optics_parameter(
        "f-number of the lens, N.", more=", else 8", gt=0, le=1000
    )
    pixel_pitch: float | None = optics_parameter(
        "Distance of the image's pixels on the sensor, p.", "um", more=", else the profile's", gt=0
    )
    quantum_efficiency: float | None = camera_parameter(
        "Electrons per photon of the most sensitive colour at its peak.", gt=0, le=1
    )

    _camera: Camera | None = PrivateAttr(None)
    _electrons: float = PrivateAttr(0.0)  # per second and m2 sr, from white

    def resolve(self, context: Context) -> Self:
        """Return the method with all numbers.

        Raises:
            RequestError: the profile lacks a value.
        """
        camera = context.camera
        found = self.with_optics(context).with_defaults(
            f_number=8.0,
            exposure_time=DEFAULT_EXPOSURE_TIME,
            pixel_pitch=camera.pixel_pitch,
            quantum_efficiency=camera.quantum_efficiency,
        )
        if found.pixel_pitch is None:
            raise RequestError(
                f"exposure.method=radiometric: the profile of camera {camera.name} has no "
                "pixel_pitch; set exposure.pixel_pitch in um"
            )
        if context.sight is None or not context.wavelengths:
            return found  # the chain of an image without bands is rejected when the image enters
        channels = context.array_ahead.channels
        whites = {channel: context.sight.white(channel) for channel in channels}
        # White is 1 in green, or in the channel of another array that saturates first.
        first = "G" if context.array_ahead.bayer else max(channels, key=lambda c: whites[c])
        electrons = context.sight.electrons(first, found.quantum_efficiency)
        return found.with_state(_camera=camera, _electrons=electrons)

    def next_context(self, context: Context) -> Context:
        headroom = context.headroom + self.headroom - math.log2(WHITE)
        return context.replace(headroom=headroom, exposure_time=self.time(self.exposure_time))

    def factor(self, iso: float) -> float:
        if self._camera is None:
            return 1.0
        assert self.f_number and self.exposure_time and self.pixel_pitch
        etendue = (self.pixel_pitch * 1e-6) ** 2 * math.pi / (4 * self.f_number**2)  # m2 sr
        charge = self._electrons * etendue * self.exposure_time * 2.0**self.ev
        return charge * self._camera.noise(iso).a / 2.0**self.headroom
