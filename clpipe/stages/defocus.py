"""Depth of field: points in front of or beyond the focus distance become discs."""

from collections.abc import Mapping
from typing import ClassVar, Literal, Self

import numpy as np
from pydantic import field_validator, model_validator

from clpipe.base.errors import RequestError
from clpipe.base.types import Array, Floats
from clpipe.reference.defocus import aperture_taps, defocus, disc_reach, parse_depth
from clpipe.reference.filter_array import LANES
from clpipe.stage import (
    Arguments,
    Context,
    FocalLengthMethod,
    ImageLayer,
    LayerMethod,
    Pass,
    ReferenceContext,
    StageRole,
    Stencil,
    Unchanged,
    optics_parameter,
    parameter,
    rgb_stage,
)

MAX_RADIUS = 31  # px, radius of a disc
NO_SURFACE = ImageLayer("depth", np.full((1, 1), np.inf, np.float32))


class InFocus(Unchanged):
    """No depth of field: everything is in focus."""

    summary: ClassVar = "everything is in focus"


class ThinLens(FocalLengthMethod, LayerMethod):
    """A thin lens: a point at distance z becomes a disc of diameter c.

    c = f^2 |z - zf| / (N z (zf - f)), with focal length f, f-number N and focus distance zf
    (Potmesil and Chakravarty, SIGGRAPH 1981). Depth is measured along the optical axis. Each pixel
    gathers light from the discs that cover it; see :func:`clpipe.reference.defocus.defocus`.

    >>> lens = ThinLens(focal_length=50.0, f_number=2.0, focus_distance=2.0, pixel_pitch=10.0)
    >>> lens.radii(np.float32([[1.0, 2.0, 4.0, np.inf]])).astype(int).tolist()
    [[-32, 0, 16, 32]]
    """

    method: ClassVar = "thin_lens"
    kernel: ClassVar = "defocus"
    overscan: ClassVar = True
    summary: ClassVar = "thin lens; needs a depth channel"
    tolerance: ClassVar = 1e-5
    example: ClassVar = {"max_radius": 3}
    alternatives: ClassVar = frozenset({"sensor_width", "pixel_pitch"})
    layer_kind: ClassVar[Literal["depth"]] = "depth"
    usual_layers: ClassVar = ("Depth", "Z", "ZDepth", "Distance")
    no_layer: ClassVar = NO_SURFACE

    focal_length: float | None = optics_parameter(
        "Focal length.", "mm", more=", else from fx and the pixel pitch, else 50", gt=0, le=2000
    )
    f_number: float | None = optics_parameter(
        "f-number of the aperture.", more=", else 2.8", ge=0.5, le=64
    )
    focus_distance: float | None = parameter(
        None,
        "Focus distance, in the unit of the depth.",
        "",
        "the camera's, converted from m, else 3",
        gt=0,
        le=1e9,
    )
    depth_scale: float = parameter(1.0, "Length of the depth's unit.", "m", gt=0, le=1e6)
    pixel_pitch: float | None = parameter(
        None,
        "Distance between pixels on the sensor; set it instead of sensor_width.",
        "um",
        "from sensor_width or the focal lengths, else the camera",
        optics=True,
        gt=0,
        le=1000,
    )
    blades: int = parameter(
        0, "Number of aperture blades, 5 to 9. With 0 the aperture is round.", ge=0, le=9
    )
    max_radius: int = parameter(
        16,
        "Largest radius of a disc; larger discs are reduced to it.",
        "px",
        structural=True,
        ge=1,
        le=MAX_RADIUS,
    )

    @field_validator("blades")
    @classmethod
    def _check_blades(cls, blades: int) -> int:
        if blades in range(1, 5):
            raise ValueError("expected 5 to 9 blades, or 0 for a round aperture")
        return blades

    @model_validator(mode="after")
    def _check_pixel_size(self) -> "ThinLens":
        if self.sensor_width and self.pixel_pitch:
            raise ValueError(
                "set either sensor_width or pixel_pitch: both define the size of a pixel"
            )
        return self

    def optics(self) -> Mapping[str, float]:
        in_metres = {"focus_distance": (self.focus_distance or 0.0) * self.depth_scale}
        return {**super().optics(), **(in_metres if self.focus_distance else {})}

    def resolve(self, context: Context) -> Self:
        """Return the method with a pixel size, and a focal length in mm or, with a sensor, in px.

        Raises:
            RequestError: one of them is not known, or the focus distance is too short.
        """
        metres = context.optics.focus_distance
        distance = 3.0 if metres is None else metres / self.depth_scale
        resolved = self.with_optics(context).with_defaults(f_number=2.8, focus_distance=distance)
        if not resolved.sensor_width:
            if resolved.fx and resolved.focal_length:
                resolved = resolved.with_defaults(
                    pixel_pitch=resolved.focal_length / resolved.fx * 1000
                )
            elif resolved.fx and not resolved.pixel_pitch:
                raise RequestError(
                    f"defocus: the focal length is {resolved.fx:g} px, but this stage needs it "
                    "in mm; set focal_length, sensor_width (mm) or pixel_pitch (um), here or "
                    "in render"
                )
            resolved = resolved.with_defaults(pixel_pitch=context.camera.pixel_pitch)
            if not resolved.pixel_pitch:
                raise RequestError(
                    "defocus.sensor_width: this stage needs the pixel size, but the profile "
                    f"of camera {context.camera.name} does not contain it; set sensor_width in "
                    "mm, or pixel_pitch in um"
                )
            if resolved.fx:
                resolved = resolved.with_defaults(
                    focal_length=resolved.fx * resolved.pixel_pitch / 1000
                )
        if not resolved.fx:
            resolved = resolved.with_defaults(focal_length=50.0)
        if resolved.focal_length:
            resolved.check_focus(resolved.focal_length)
        return resolved

    @property
    def focus(self) -> float:
        """The focus distance, in mm."""
        return (self.focus_distance or 0.0) * self.depth_scale * 1000

    def check_focus(self, focal_length: float) -> None:
        """Check that the focus distance is more than a focal length, in mm.

        Raises:
            RequestError: it is not.
        """
        if self.focus <= focal_length:
            raise RequestError(
                f"defocus: focus_distance {self.focus_distance:g} is {self.focus:g} mm; it must "
                f"be more than the focal length of {focal_length:g} mm. Check depth_scale"
            )

    def parse_layer(self, pixels: Array) -> Floats:
        return parse_depth(pixels[..., 0])

    def check_layer(self, layer: ImageLayer) -> str:
        """Return a warning with the number of discs that exceed the largest radius, or "".

        Raises:
            RequestError: the focus distance is less than the focal length.
        """
        height, width = layer.pixels.shape
        self.check_focus(self.camera(width, height)[0])
        radii = abs(self.radii(layer.pixels))
        if not (count := np.count_nonzero(radii > self.max_radius)):
            return ""
        return (
            f"{count} of {radii.size} pixels have discs with radii up to {radii.max():.1f} px; "
            f"max_radius reduces them to {self.max_radius} px"
        )

    def camera(self, width: int, height: int) -> tuple[float, float]:
        """Return the focal length and the pixel pitch, in mm, for an image of this size."""
        side = max(self.margins.frame_size(width, height))
        pitch = self.sensor_width / side if self.sensor_width else (self.pixel_pitch or 0.0) / 1000
        return self.focal_length or (self.fx or 0.0) * pitch, pitch

    def passes(self) -> tuple[Pass, ...]:
        names = ("radii", "columns", "rows", "reach", "taps", "count")
        return (Pass("defocus", Stencil(self.max_radius), names),)

    def radii(self, depth: Floats) -> Floats:
        """Return the radii of the discs in px, without the limit; negative for near points.

        Args:
            depth: (height, width) of the whole image, above 0; infinity is allowed.
        """
        assert self.f_number
        length, pitch = self.camera(depth.shape[1], depth.shape[0])
        widest = length**2 / (self.f_number * (self.focus - length)) / pitch / 2
        nearness = np.float32(self.focus / (self.depth_scale * 1000.0)) / depth
        return np.asarray(np.float32(widest) * (1 - nearness))

    def limited_radii(self, depth: Floats) -> Floats:
        """Return the radii that are used, see :meth:`radii`, limited to ``max_radius``."""
        return np.clip(self.radii(depth), -self.max_radius, self.max_radius)

    def arguments(self, context: Context) -> Arguments:
        layer = self.layer_in(context)
        radii, reach, taps = layer.derived.get(self, lambda: self._tables(layer.pixels))
        return {
            "radii": radii,
            "columns": radii.shape[1],
            "rows": radii.shape[0],
            "reach": reach,
            "taps": taps,
            "count": len(taps),
        }

    def _tables(self, depth: Floats) -> tuple[Floats, int, Floats]:
        """Return the radii with a border, the border's width, and the taps of the largest disc."""
        radii = self.limited_radii(depth)
        # Rounded, so that many images share a few tables.
        largest = float(np.ceil(abs(radii).max() * 4)) / 4
        reach = disc_reach(largest)
        border = ((reach, reach), (reach, reach + LANES))
        return np.pad(radii, border, "reflect"), reach, aperture_taps(self.blades, largest)

    def reference(self, image: Floats, inputs: ReferenceContext) -> Floats:
        taps = self.arguments(inputs.context)["taps"]
        depth = np.broadcast_to(self.layer_in(inputs.context).pixels, image.shape[:2])
        radii = self.limited_radii(depth)
        assert isinstance(taps, np.ndarray)
        return defocus(image, radii, taps)


STAGE = rgb_stage(
    "defocus", "Blur surfaces that are out of focus.", (InFocus, ThinLens), role=StageRole.LENS
)
