"""Contexts: what a stage knows besides its image and its parameters."""

import weakref
from collections.abc import Mapping
from copy import copy
from dataclasses import dataclass, field
from typing import Any

from clpipe.camera.noise import NoiseModel
from clpipe.camera.optics import Optics
from clpipe.camera.profile import IDENTITY, Camera, Matrix
from clpipe.reference.cfa import Pattern, red_site
from clpipe.reference.companding import Knots
from clpipe.reference.defocus import Depth
from clpipe.reference.filter_array import FilterArray, parse_array
from clpipe.reference.random import Stream
from clpipe.stage.passes import CompileTime, NoiseScope


@dataclass(frozen=True)
class Context:
    """Facts about the image that a stage reads, from the steps before it."""

    camera: Camera
    iso: float
    pattern: Pattern = "RGGB"
    array: FilterArray | None = None  # of a mosaic that has no Bayer pattern
    light: tuple[float, float] | None = None  # red, blue: to be taken out; None is the camera's
    gains: tuple[float, float] = (1.0, 1.0)  # red, blue: taken out by inverse_white_balance
    applied_gains: tuple[float, float] = (1.0, 1.0)  # red, blue: put back by white_balance
    exposure_time: float | None = None  # s, where exposure knows it
    headroom: float = 0.0  # stops by which exposure darkened the scene
    colours: Matrix = IDENTITY  # linear sRGB to what red, green and blue are, white-balanced
    noise: NoiseModel | None = None  # of the sensor noise that was added
    full_scale: float = 1.0  # the signal at the white level: above 1 behind several readouts
    light_changes: bool = False  # while the picture is exposed
    knots: Knots = ()  # of companding, DN to fewer DN; () is none
    optics: Optics = field(default_factory=Optics, compare=False, repr=False)
    clean: bool = False  # the image has no noise, and nothing may follow from what it would have
    black_level: float | None = None  # DN, as quantize used them
    white_level: float | None = None
    # Of the image, which holds it: chains are kept longer. Chains of one structure are alike.
    depth: weakref.ref[Depth] | None = field(default=None, compare=False, repr=False)

    def but(self, **changes: Any) -> "Context":
        """A copy with other facts: ``dataclasses.replace``, in a fifth of its time."""
        other = copy(self)
        vars(other).update(changes)
        return other

    def with_array(self, array: FilterArray) -> "Context":
        """The context of a mosaic of another array, which may have a Bayer pattern."""
        bayer = array.bayer
        return self.but(array=None, pattern=bayer) if bayer else self.but(array=array)

    def without_view(self) -> "Context":
        """The context of a picture that is no longer in the render's perspective."""
        return self.but(optics=self.optics.without_view())

    def noise_parameters(self) -> tuple[float, float]:
        """The a and b of the noise that was added, else the camera's; of a clean image, zeros."""
        if self.clean:
            return 0.0, 0.0
        model = self.noise or self.camera.noise(self.iso)
        return model.a, model.b

    @property
    def gains_of_light(self) -> tuple[float, float]:
        """The gains of red and blue that the light lacks, which inverse_white_balance takes out."""
        return self.light or self.camera.white_balance_gains

    @property
    def filters(self) -> FilterArray:
        """The filter array of the mosaic, a Bayer pattern or any other."""
        return self.array or parse_array(self.pattern)

    @property
    def cfa(self) -> CompileTime:
        """The pattern as a compiled-in kernel argument."""
        red_x, red_y = red_site(self.pattern)
        return CompileTime(f"(cfa){{{red_x}, {red_y}}}")


@dataclass
class ReferenceContext:
    """Inputs of a reference besides the image and its parameters.

    ``stream`` has the random streams by scope. A reference stores the numbers that it estimates
    from the image, such as gains, in ``estimates``.
    """

    context: Context
    stream: Mapping[NoiseScope, Stream]
    estimates: dict[str, float]
