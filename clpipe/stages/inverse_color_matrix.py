"""Inverse colour matrix: from linear sRGB to a camera's white-balanced RGB, for a render."""

from typing import ClassVar

import numpy as np
from pydantic import PrivateAttr

from clpipe.camera.profile import IDENTITY
from clpipe.camera.spectra import Sight
from clpipe.stage import Context, StageRole, camera_parameter, rgb_stage
from clpipe.stages.color_matrix import FixedMatrix, NoMatrix, OptionalMatrix, as_tuples


class SrgbToCamera(FixedMatrix):
    """Linear sRGB to white-balanced camera RGB, the colours in which a sensor sees a render.

    The matrix is :meth:`clpipe.camera.profile.Camera.srgb_to_camera`. The conversion back mixes the
    noise of the three colours, like in a camera. Without a matrix of the camera, colours do not
    change. With ``render.illuminant``, the render is lit by this light: the matrix follows from the
    camera's spectral sensitivities, see :meth:`clpipe.camera.spectra.Sight.from_srgb`.
    """

    method: ClassVar = "camera"
    summary: ClassVar = "linear sRGB to camera RGB, if the camera's matrix is known"
    example: ClassVar = {}

    matrix: OptionalMatrix = camera_parameter(
        "Three rows of three numbers, from linear sRGB to camera RGB.", more="; else none"
    )

    _sight: Sight | None = PrivateAttr(None)

    def resolve(self, context: Context) -> "SrgbToCamera":
        if self.matrix is not None:
            return self
        if context.illuminant and not context.wavelengths and context.sight:
            lit = self.with_state(_sight=context.sight)
            return lit.with_defaults(matrix=as_tuples(context.sight.from_srgb.tolist()))
        is_seen = context.wavelengths and context.sight  # the image has the camera's colours
        if is_seen or context.camera.xyz_to_camera is None:
            return self.with_defaults(matrix=IDENTITY)
        return self.with_defaults(matrix=as_tuples(context.camera.srgb_to_camera().tolist()))

    def next_context(self, context: Context) -> Context:
        if self._sight is None:
            return super().next_context(context)
        # A camera does not know the spectra, so its matrix is the best one for all of them.
        return context.replace(colours=as_tuples(np.linalg.inv(self._sight.to_srgb).tolist()))


STAGE = rgb_stage(
    "inverse_color_matrix",
    "Convert linear sRGB to the camera's colours.",
    (SrgbToCamera, FixedMatrix, NoMatrix),
    role=StageRole.COLOURS_OF_LIGHT,
)
