"""From the camera's colours to those of linear sRGB."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Annotated, Any, ClassVar

import numpy as np
from pydantic import BeforeValidator, field_validator

from clpipe.base.types import Floats
from clpipe.camera.profile import IDENTITY, Matrix
from clpipe.stage import Argument, Context, Frame, Kind, Method, Pass, Stage, Unchanged, parameter

NAMES = tuple(f"{row}_{column}" for row in "rgb" for column in "rgb")


def _as_tuples(value: Any) -> Any:
    """Lists, as TOML has them, as the tuples that strict validation wants."""
    if value is None:
        return None
    rows = value if isinstance(value, list | tuple) else ()
    numbers = [x for row in rows if isinstance(row, list | tuple) and len(row) == 3 for x in row]
    real = [x for x in numbers if isinstance(x, float | int) and not isinstance(x, bool)]
    if len(rows) != 3 or len(real) != 9:
        raise ValueError("expected three rows of three numbers: [[1, 0, 0], [0, 1, 0], [0, 0, 1]]")
    return tuple(tuple(float(x) for x in row) for row in rows)


def mixed(image: Floats, matrix: Floats) -> Floats:
    """A (height, width, 3) image, each pixel times a (3, 3) matrix.

    >>> mixed(np.float32([[[1, 2, 4]]]), np.float32([[0, 1, 0], [1, 0, 0], [1, 1, 1]])).tolist()
    [[[2.0, 1.0, 7.0]]]
    """
    red, green, blue = np.moveaxis(image, -1, 0)
    return np.stack([r * red + g * green + b * blue for r, g, b in matrix], axis=-1)


class Rendered(Unchanged):
    """A render's colours never were a camera's."""

    method: ClassVar = "none"
    summary: ClassVar = "a render is in linear sRGB already"


class Given(Method):
    """A 3x3 matrix on each pixel's linear RGB."""

    method: ClassVar = "given"
    kernel: ClassVar = "color_matrix"
    summary: ClassVar = "a matrix of one's own"
    example: ClassVar = {"matrix": [[1.6, -0.5, -0.1], [-0.2, 1.5, -0.3], [0.05, -0.6, 1.55]]}

    matrix: Annotated[Matrix, BeforeValidator(_as_tuples)] | None = parameter(
        IDENTITY, "Three rows of three: what red, green and blue are made of."
    )

    @field_validator("matrix")
    @classmethod
    def _invertible(cls, matrix: Matrix | None) -> Matrix | None:
        if matrix is not None and abs(np.linalg.det(matrix)) < 1e-6:
            raise ValueError("the matrix is singular: different colours would become the same")
        return matrix

    def after(self, context: Context) -> Context:
        colours = np.array(self.matrix) @ context.colours
        return replace(context, colours=_as_tuples(colours.tolist()))

    @property
    def _rows(self) -> Floats:
        return np.array(self.matrix, np.float32)

    def passes(self) -> tuple[Pass, ...]:
        return (Pass("color_matrix", arguments=NAMES),)

    def arguments(self, context: Context) -> Mapping[str, Argument]:
        return dict(zip(NAMES, self._rows.ravel(), strict=True))

    def reference(self, image: Floats, frame: Frame) -> Floats:
        return mixed(image, self._rows)


class Camera(Given):
    """The inverse of the camera's matrix: white-balanced camera RGB to linear sRGB."""

    method: ClassVar = "camera"
    summary: ClassVar = "camera RGB to linear sRGB, for a camera's own raws"
    example: ClassVar = {}

    matrix: Annotated[Matrix, BeforeValidator(_as_tuples)] | None = parameter(
        None, "Three rows of three, camera RGB to linear sRGB.", auto="from the camera"
    )

    def resolve(self, context: Context) -> "Camera":
        if self.matrix is not None:
            return self
        inverse = np.linalg.inv(context.camera.srgb_to_camera())
        return self.filled(matrix=_as_tuples(inverse.tolist()))


class InverseCamera(Given):
    """The camera's matrix, to stand before the mosaic of a render."""

    method: ClassVar = "inverse_camera"
    summary: ClassVar = "linear sRGB to camera RGB, for a render, before mosaic"
    example: ClassVar = {}

    matrix: Annotated[Matrix, BeforeValidator(_as_tuples)] | None = parameter(
        None, "Three rows of three, linear sRGB to camera RGB.", auto="from the camera"
    )

    def resolve(self, context: Context) -> "InverseCamera":
        if self.matrix is not None:
            return self
        return self.filled(matrix=_as_tuples(context.camera.srgb_to_camera().tolist()))


STAGE = Stage(
    "color_matrix",
    "Mix colours: from what the camera's filters see to linear sRGB.",
    Kind.RGB,
    Kind.RGB,
    (Rendered, Camera, InverseCamera, Given),
)
