"""The camera that a render was made with: the ``[render]`` table of a configuration."""

import math
from collections.abc import Mapping
from itertools import pairwise
from typing import Annotated, Any, Self

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, model_validator

from clpipe.camera.sensitivities import Wavelength
from clpipe.reference.pose import rotation

Length = Annotated[float, Field(gt=0, le=10000, allow_inf_nan=False)]
Pixels = Annotated[float, Field(gt=0, le=1e7, allow_inf_nan=False)]
Finite = Annotated[float, Field(allow_inf_nan=False)]
Vector = Annotated[tuple[Finite, Finite, Finite], Field(strict=False)]  # accepts lists as well
Matrix = Annotated[tuple[Vector, Vector, Vector], Field(strict=False), AfterValidator(rotation)]
Pose = Annotated[tuple[Matrix, Vector], Field(strict=False)]


class RenderCamera(BaseModel):
    """The camera of a render, as far as it is known: intrinsics, pose and exposure.

    Its optics are part of :class:`clpipe.camera.optics.Optics`.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    exposure_time: Annotated[float, Field(gt=0, le=86400, allow_inf_nan=False)] | None = None  # s
    focal_length: Length | None = None  # mm
    sensor_width: Length | None = None  # mm, along the longer side of the image
    # px; the centre of the first pixel is at 0.5. If None, the value follows from the lengths in mm
    # and the centre of the image.
    fx: Pixels | None = None
    fy: Pixels | None = None
    cx: Finite | None = None
    cy: Finite | None = None
    # The horizontal field of view in radians, as in transforms.json.
    camera_angle_x: Annotated[float, Field(gt=0, lt=math.pi)] | None = None
    # The centres of the bands of a spectral render, nm. A file states its own.
    wavelengths: Annotated[tuple[Wavelength, ...], Field(strict=False, max_length=2000)] = ()
    # The light of the scene, to which the camera is balanced. An RGB render is lit by it.
    illuminant: Annotated[str, Field(max_length=4096)] = ""
    # From world to camera, in OpenCV's axes: x_cam = rotation x + translation.
    rotation: Matrix | None = None
    translation: Vector | None = None

    # Poses of the same form while the shutter is open, in equal steps from its opening to its
    # closing.
    motion: Annotated[tuple[Pose, ...] | None, Field(strict=False, min_length=2)] = None

    @model_validator(mode="after")
    def _check_pose(self) -> Self:
        if (self.rotation is None) != (self.translation is None):
            raise ValueError("only one of rotation and translation is set; set both or neither")
        if len(self.wavelengths) == 1 or any(a >= b for a, b in pairwise(self.wavelengths)):
            raise ValueError("wavelengths must be two or more, and ascend")
        return self

    @property
    def pose(self) -> dict[str, Any] | None:
        """R and t of x_cam = R X + t; None if they are unknown."""
        if self.rotation is None or self.translation is None:
            return None
        return {"R": [list(row) for row in self.rotation], "t": list(self.translation)}

    @property
    def optics(self) -> dict[str, float]:
        """The optics that are set, by field name."""
        found = {name: getattr(self, name) for name in type(self).model_fields}
        return {k: v for k, v in found.items() if v is not None and k not in POSE | SPECTRA}

    def with_defaults(self, shot: Mapping[str, float]) -> "RenderCamera":
        """Return a copy whose fields that are None are filled from ``shot``, an image's own values.

        >>> camera = RenderCamera(focal_length=24.0)
        >>> camera.with_defaults({"focal_length": 50.0, "exposure_time": 0.5}).focal_length
        24.0
        """
        set_fields = self.model_dump(exclude_none=True)
        return self.model_copy(update={k: v for k, v in shot.items() if k not in set_fields})


POSE = {"rotation", "translation", "motion"}
SPECTRA = {"wavelengths", "illuminant"}
