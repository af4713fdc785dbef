"""Contexts: the inputs of a stage besides its image and its parameters."""

import weakref
from collections.abc import Mapping
from copy import copy
from dataclasses import dataclass, field
from typing import Any, Literal

from clpipe.base.cache import BoundedCache
from clpipe.base.types import Floats
from clpipe.camera.noise import NoiseModel
from clpipe.camera.optics import Optics
from clpipe.camera.profile import IDENTITY, Camera, Matrix
from clpipe.camera.spectra import Sight
from clpipe.reference.cfa import Pattern, red_site
from clpipe.reference.companding import Knots
from clpipe.reference.filter_array import FilterArray, parse_array
from clpipe.reference.random import Stream
from clpipe.stage.passes import CompileTime, NoiseScope


@dataclass(frozen=True, eq=False)
class ImageLayer:
    """A layer of an image that a step reads, such as its depth.

    Args:
        kind: the kind of its values.
        pixels: its values, as :meth:`LayerMethod.parse_layer` returns them.
        record: its source, for a sidecar.
        derived: values derived from it, by their parameters; renditions share them.
    """

    kind: Literal["depth", "flow"]
    pixels: Floats
    record: Mapping[str, Any] = field(default_factory=dict)
    derived: BoundedCache[Any] = field(default_factory=lambda: BoundedCache(2))


@dataclass(frozen=True)
class Context:
    """Facts about the image that a stage reads, from the earlier steps."""

    camera: Camera
    iso: float
    pattern: Pattern = "RGGB"
    array: FilterArray | None = None  # the filter array of a mosaic without a Bayer pattern
    # Gains of red and blue to divide out; None means the camera's.
    light: tuple[float, float] | None = None
    # Gains of red and blue that inverse_white_balance divided out.
    gains: tuple[float, float] = (1.0, 1.0)
    # Gains of red and blue that white_balance applies again.
    applied_gains: tuple[float, float] = (1.0, 1.0)
    wavelengths: tuple[float, ...] = ()  # of the source's bands, nm; () is RGB
    illuminant: str = ""  # the light of a render; "" is not stated, and means D65
    sight: Sight | None = field(default=None, repr=False)  # the sensor in this light, if needed
    # The array of the mosaic, for stages before it.
    array_ahead: FilterArray = field(default_factory=lambda: parse_array("RGGB"))
    # The channels of the image's three planes. "": each pixel has the light of its own filter.
    planes: str = "RGB"
    exposure_time: float | None = None  # s; None if exposure does not state it
    headroom: float = 0.0  # stops by which exposure darkened the scene
    colours: Matrix = IDENTITY  # linear sRGB to the image's red, green and blue, white-balanced
    noise: NoiseModel | None = None  # the sensor noise that was added
    full_scale: float = 1.0  # the signal at the white level: above 1 after several readouts
    light_changes: bool = False  # whether the light changes during the exposure
    knots: Knots = ()  # the companding curve, DN to fewer DN; () is none
    optics: Optics = field(default_factory=Optics, compare=False, repr=False)
    # Whether the image has no noise. If so, parameters that depend on noise must assume none.
    clean: bool = False
    black_level: float | None = None  # DN, used by quantize
    white_level: float | None = None
    # A weak reference, because the image holds the layer and chains live longer. It is not
    # compared, so that chains of the same structure are equal.
    layer: weakref.ref[ImageLayer] | None = field(default=None, compare=False, repr=False)

    def replace(self, **changes: Any) -> "Context":
        """Return a copy with other facts: ``dataclasses.replace`` in a fifth of its time."""
        other = copy(self)
        vars(other).update(changes)
        return other

    def with_array(self, array: FilterArray) -> "Context":
        """Return the context of a mosaic of another array, which may have a Bayer pattern."""
        bayer = array.bayer
        return self.replace(array=None, pattern=bayer) if bayer else self.replace(array=array)

    def without_view(self) -> "Context":
        """Return the context of an image that is no longer in the render's perspective."""
        return self.replace(optics=self.optics.without_view())

    def noise_parameters(self) -> tuple[float, float]:
        """Return a and b of the noise that was added, else the camera's; zeros if it is clean."""
        if self.clean:
            return 0.0, 0.0
        model = self.noise or self.camera.noise(self.iso)
        return model.a, model.b

    @property
    def illuminant_gains(self) -> tuple[float, float]:
        """The gains of red and blue that inverse_white_balance divides out."""
        return self.light or self.camera.white_balance_gains

    @property
    def filter_array(self) -> FilterArray:
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

    ``stream`` contains the random streams by scope. A reference stores the numbers that it
    estimates from the image, for example gains, in ``estimates``. ``previous`` is the stage's
    result for the frame before, of the image's shape; None if there is none.
    """

    context: Context
    stream: Mapping[NoiseScope, Stream]
    estimates: dict[str, float]
    previous: Floats | None = None
