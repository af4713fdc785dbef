"""The camera that a render was made with: the ``[render]`` table of a configuration."""

import math
from collections.abc import Mapping
from typing import Annotated, Any, Self

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, model_validator

from clpipe.reference.pose import rotation

Length = Annotated[float, Field(gt=0, le=10000, allow_inf_nan=False)]
Pixels = Annotated[float, Field(gt=0, le=1e7, allow_inf_nan=False)]
Finite = Annotated[float, Field(allow_inf_nan=False)]
Vector = Annotated[tuple[Finite, Finite, Finite], Field(strict=False)]  # or a list
Matrix = Annotated[tuple[Vector, Vector, Vector], Field(strict=False), AfterValidator(rotation)]
Pose = Annotated[tuple[Matrix, Vector], Field(strict=False)]


class RenderCamera(BaseModel):
    """The camera of a render: what its pixels are of, as far as it is known.

    Its optics are a part of :class:`clpipe.camera.optics.Optics`.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    exposure_time: Annotated[float, Field(gt=0, le=86400, allow_inf_nan=False)] | None = None  # s
    focal_length: Length | None = None  # mm
    sensor_width: Length | None = None  # mm, along the longer side of the image
    # In px, the first pixel's centre at 0.5; None follows from the lengths in mm and the middle of
    # the image.
    fx: Pixels | None = None
    fy: Pixels | None = None
    cx: Finite | None = None
    cy: Finite | None = None
    # Radians, across the width of the render, as transforms.json has it.
    camera_angle_x: Annotated[float, Field(gt=0, lt=math.pi)] | None = None
    # From the world to the camera, in OpenCV's axes: x_cam = rotation x + translation.
    rotation: Matrix | None = None
    translation: Vector | None = None

    # While the shutter is open, from its opening to its end, in equal steps of time: poses alike.
    motion: Annotated[tuple[Pose, ...] | None, Field(strict=False, min_length=2)] = None

    @model_validator(mode="after")
    def _check_pose(self) -> Self:
        if (self.rotation is None) != (self.translation is None):
            raise ValueError("rotation and translation belong together; give both, or neither")
        return self

    @property
    def pose(self) -> dict[str, Any] | None:
        """R and t of x_cam = R X + t; None where they are not known."""
        if self.rotation is None or self.translation is None:
            return None
        return {"R": [list(row) for row in self.rotation], "t": list(self.translation)}

    @property
    def optics(self) -> dict[str, float]:
        """The optics that are set, by the names of the fields."""
        return self.model_dump(exclude=POSE, exclude_none=True)

    def with_defaults(self, shot: Mapping[str, float]) -> "RenderCamera":
        """A copy in which ``shot``, what a source says of itself, fills the fields that are None.

        >>> camera = RenderCamera(focal_length=24.0)
        >>> camera.with_defaults({"focal_length": 50.0, "exposure_time": 0.5}).focal_length
        24.0
        """
        own = self.model_dump(exclude_none=True)
        return self.model_copy(update={k: v for k, v in shot.items() if k not in own})


POSE = {"rotation", "translation", "motion"}
