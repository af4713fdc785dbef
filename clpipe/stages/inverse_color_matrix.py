"""Inverse colour matrix: from linear sRGB to a camera's white-balanced RGB, for a render."""

from typing import ClassVar

from clpipe.camera.profile import IDENTITY
from clpipe.stage import Context, StageRole, camera_parameter, rgb_stage
from clpipe.stages.color_matrix import FixedMatrix, NoMatrix, OptionalMatrix, as_tuples


class SrgbToCamera(FixedMatrix):
    """Linear sRGB to white-balanced camera RGB, the colours in which a sensor sees a render.

    The matrix is :meth:`clpipe.camera.profile.Camera.srgb_to_camera`. The conversion back mixes the
    noise of the three colours, like in a camera. Without a matrix of the camera, colours do not
    change.
    """

    method: ClassVar = "camera"
    summary: ClassVar = "linear sRGB to camera RGB, if the camera's matrix is known"
    example: ClassVar = {}

    matrix: OptionalMatrix = camera_parameter(
        "Three rows of three numbers, from linear sRGB to camera RGB.", more="; else none"
    )

    def resolve(self, context: Context) -> "SrgbToCamera":
        if self.matrix is not None:
            return self
        if context.camera.xyz_to_camera is None:
            return self.with_defaults(matrix=IDENTITY)
        return self.with_defaults(matrix=as_tuples(context.camera.srgb_to_camera().tolist()))


STAGE = rgb_stage(
    "inverse_color_matrix",
    "Convert linear sRGB to the camera's colours.",
    (SrgbToCamera, FixedMatrix, NoMatrix),
    role=StageRole.COLOURS_OF_LIGHT,
)
