"""Colour matrix: converts a camera's white-balanced RGB to linear sRGB."""

from typing import Annotated, Any, ClassVar

import numpy as np
from pydantic import BeforeValidator, field_validator

from clpipe.base.errors import RequestError
from clpipe.base.types import Doubles, Floats
from clpipe.camera.profile import IDENTITY, Camera, Matrix
from clpipe.stage import (
    Arguments,
    Context,
    Method,
    Pass,
    ReferenceContext,
    StageRole,
    Unchanged,
    camera_parameter,
    parameter,
    rgb_stage,
)

NAMES = tuple(f"{row}_{column}" for row in "rgb" for column in "rgb")


def as_tuples(value: Any) -> Any:
    """Convert a 3x3 list, which TOML gives, to the tuples that strict validation needs."""
    if value is None:
        return None
    rows = value if isinstance(value, list | tuple) else ()
    numbers = [x for row in rows if isinstance(row, list | tuple) and len(row) == 3 for x in row]
    real = [x for x in numbers if isinstance(x, float | int) and not isinstance(x, bool)]
    if len(rows) != 3 or len(real) != 9:
        raise ValueError("expected three rows of three numbers: [[1, 0, 0], [0, 1, 0], [0, 0, 1]]")
    return tuple(tuple(float(x) for x in row) for row in rows)


OptionalMatrix = Annotated[Matrix, BeforeValidator(as_tuples)] | None
FROM_CAMERA = "Three rows of three numbers, from camera RGB to linear sRGB."


def apply_matrix(image: Floats, matrix: Floats) -> Floats:
    """Multiply the colour of each pixel by a (3, 3) matrix; (height, width, 3) in and out.

    >>> swap = np.float32([[0, 1, 0], [1, 0, 0], [1, 1, 1]])
    >>> apply_matrix(np.float32([[[1, 2, 4]]]), swap).tolist()
    [[[2.0, 1.0, 7.0]]]
    """
    red, green, blue = np.moveaxis(image, -1, 0)
    return np.stack([r * red + g * green + b * blue for r, g, b in matrix], axis=-1)


def srgb_to_camera(camera: Camera) -> Doubles:
    """Return a camera's matrix, :meth:`clpipe.camera.profile.Camera.srgb_to_camera`, (3, 3).

    Raises:
        RequestError: the camera has no matrix; the message lists what you can set.
    """
    try:
        return camera.srgb_to_camera()
    except RequestError as error:
        raise RequestError(
            f"{error}; set color_matrix.method=as_shot, add the matrix to your own profile, or "
            "choose another camera"
        ) from None


class NoMatrix(Unchanged):
    """No matrix: colours do not change."""

    summary: ClassVar = "no matrix: colours do not change"


class FixedMatrix(Method):
    """Your own 3x3 matrix: each pixel's linear RGB becomes matrix * RGB."""

    method: ClassVar = "given"
    kernel: ClassVar = "color_matrix"
    summary: ClassVar = "your own 3x3 matrix"
    example: ClassVar = {"matrix": [[1.6, -0.5, -0.1], [-0.2, 1.5, -0.3], [0.05, -0.6, 1.55]]}

    matrix: OptionalMatrix = parameter(
        IDENTITY,
        "Three rows of three numbers. Each row makes the new red, green or blue from the old "
        "three.",
    )

    @field_validator("matrix")
    @classmethod
    def _invertible(cls, matrix: Matrix | None) -> Matrix | None:
        if matrix is not None and abs(np.linalg.det(matrix)) < 1e-6:
            raise ValueError(
                "the matrix is singular, so different colours would become the "
                "same; set an invertible matrix"
            )
        return matrix

    def next_context(self, context: Context) -> Context:
        colours = np.array(self.matrix) @ context.colours
        return context.replace(colours=as_tuples(colours.tolist()))

    @property
    def _array(self) -> Floats:
        return np.array(self.matrix, np.float32)

    def passes(self) -> tuple[Pass, ...]:
        return () if self.matrix == IDENTITY else (Pass("color_matrix", arguments=NAMES),)

    def arguments(self, context: Context) -> Arguments:
        return dict(zip(NAMES, self._array.ravel(), strict=True))

    def reference(self, image: Floats, inputs: ReferenceContext) -> Floats:
        return apply_matrix(image, self._array)


class AsShot(FixedMatrix):
    """The inverse of the matrix that converted the render from linear sRGB to camera RGB.

    If the render was not converted, colours do not change.
    """

    method: ClassVar = "as_shot"
    summary: ClassVar = "undo inverse_color_matrix: a render's colours become linear sRGB again"
    example: ClassVar = {}
    other_examples: ClassVar = ({"matrix": [[1.2, -0.2, 0.0], [0.0, 1.0, 0.0], [0.0, -0.5, 1.5]]},)

    matrix: OptionalMatrix = parameter(
        None, FROM_CAMERA, auto="the inverse of the matrix that inverse_color_matrix used"
    )

    def resolve(self, context: Context) -> "AsShot":
        if context.colours == IDENTITY:
            return self.with_defaults(matrix=IDENTITY)
        return self.with_defaults(matrix=as_tuples(np.linalg.inv(context.colours).tolist()))


class CameraToSrgb(FixedMatrix):
    """White-balanced camera RGB to linear sRGB, with the inverse of the camera's matrix.

    The camera's matrix is :meth:`clpipe.camera.profile.Camera.srgb_to_camera`.
    """

    method: ClassVar = "camera"
    summary: ClassVar = "camera RGB to linear sRGB, for raw files of a camera"
    example: ClassVar = {}

    matrix: OptionalMatrix = camera_parameter(FROM_CAMERA)

    def resolve(self, context: Context) -> "CameraToSrgb":
        """Return the method with a matrix.

        Raises:
            RequestError: the camera has no matrix, or the mosaic's channels are not colours.
        """
        if context.array and context.array.is_polarised:
            raise RequestError(
                "color_matrix.method=camera needs channels that are colours, and the channels of "
                f"mosaic {context.array.name} are not; remove color_matrix.method, or skip "
                "color_matrix"
            )
        if self.matrix is not None:
            return self
        inverse = np.linalg.inv(srgb_to_camera(context.camera))
        return self.with_defaults(matrix=as_tuples(inverse.tolist()))


STAGE = rgb_stage(
    "color_matrix",
    "Convert the camera's colours to linear sRGB.",
    (AsShot, CameraToSrgb, FixedMatrix, NoMatrix),
    role=StageRole.COLOURS,
)
