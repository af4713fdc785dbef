"""Denoising before demosaicing, where noise is still independent from sample to sample."""

from collections.abc import Mapping
from typing import ClassVar

import numpy as np
from pydantic import field_validator

from clpipe.reference.cfa import by_site
from clpipe.reference.image import tap
from clpipe.reference.patch import bias_of, decay_of, patch_distances, patch_sum
from clpipe.stage import (
    Access,
    Argument,
    Context,
    Frame,
    Kind,
    Literal,
    Method,
    Pass,
    Stage,
    parameter,
)
from clpipe.types import Floats

FACTOR = 1.4  # of h; the best in PSNR on our picture, ISO 1600 to 12800
LARGEST = 15


class NonLocalMeans(Method):
    """Non-local means (Buades, Coll and Morel, CVPR 2005; IPOL 2011) on raw patches of 3x3.

    The window is gone over in steps of two, so that like stands on like. Distances are divided by
    the variance a*y + b of the patch's samples, as the sensor saw them: gains that white balance
    has already applied are taken out before and put back after (those of gray_world are not known
    in advance; the camera's stand for them). Samples below black stay below it.
    """

    method: ClassVar = "non_local_means"
    kernel: ClassVar = "mosaic_denoise_non_local_means"
    summary: ClassVar = "mean of the samples of a colour whose surroundings look alike"
    tolerance: ClassVar = 2e-4  # the kernel's exp is a short polynomial

    size: int = parameter(
        13,
        f"Width of the window: odd, 1 to {LARGEST}; 1 leaves the mosaic alone.",
        "px",
        structural=True,
    )
    strength: float = parameter(
        1.0, "Filtering, in multiples of what the noise asks for; 0 is off.", ge=0, le=100
    )
    a: float | None = parameter(
        None,
        "Shot noise: variance a unit of signal.",
        "signal",
        "as sensor_noise used it, else from the camera and ISO",
        ge=0,
        le=1,
    )
    b: float | None = parameter(
        None,
        "Read noise: variance without light.",
        "signal^2",
        "as sensor_noise used it, else from the camera and ISO",
        ge=0,
        le=1,
    )

    @field_validator("size")
    @classmethod
    def _odd(cls, size: int) -> int:
        if size % 2 == 0 or not 1 <= size <= LARGEST:
            raise ValueError(f"it must be odd, 1 to {LARGEST}")
        return size

    def resolve(self, context: Context) -> "NonLocalMeans":
        if self.a is not None and self.b is not None:
            return self
        a, b = context.noise or context.camera.noise(context.iso)
        return self.filled(a=a, b=b)

    @property
    def reach(self) -> int:
        """The farthest even offset inside the window, px."""
        return self.size // 2 // 2 * 2

    def passes(self) -> tuple[Pass, ...]:
        return (
            Pass(
                "without_gains",
                arguments=("pattern", "red_inverse", "blue_inverse"),
                writes="mosaic",
            ),
            Pass(
                "mosaic_non_local_means",
                Access.STENCIL,
                ("reach", "a", "b", "bias", "scale"),
                reads=("mosaic",),
                writes="filtered",
                radius=self.reach + 1,
                block=4,
            ),
            Pass("with_gains", arguments=("pattern", "red_gain", "blue_gain"), reads=("filtered",)),
        )

    def numbers(self, context: Context) -> dict[str, np.float32]:
        """The run-time arguments of all passes, by name."""
        assert self.a is not None and self.b is not None
        red, blue = context.applied_gains
        return {
            "red_inverse": np.float32(1 / red),
            "blue_inverse": np.float32(1 / blue),
            "red_gain": np.float32(red),
            "blue_gain": np.float32(blue),
            "a": np.float32(self.a),
            "b": np.float32(max(self.b, 1e-12)),
            "bias": bias_of(self.strength),
            "scale": decay_of(FACTOR * self.strength),
        }

    def arguments(self, context: Context) -> Mapping[str, Argument]:
        return {
            "pattern": context.cfa,
            "reach": Literal(str(self.reach)),
            **self.numbers(context),
        }

    def reference(self, image: Floats, frame: Frame) -> Floats:
        n = self.numbers(frame.context)
        shape, pattern = image.shape, frame.context.pattern
        one = np.float32(1)
        sensor = image * by_site(shape, pattern, n["red_inverse"], one, n["blue_inverse"])
        variance = patch_sum(np.maximum(sensor, np.float32(0))) * n["a"] + np.float32(9) * n["b"]
        total, weights = np.zeros_like(image), np.zeros_like(image)
        for dx, dy, distance in patch_distances(sensor[..., None], self.reach, step=2):
            excess = np.maximum(distance / variance - n["bias"], np.float32(0))
            weight = np.exp2(np.maximum(excess * n["scale"], np.float32(-30)))
            total += weight * tap(sensor, dx, dy)
            weights += weight
        filtered: Floats = total / weights
        return filtered * by_site(shape, pattern, n["red_gain"], one, n["blue_gain"])


STAGE = Stage(
    "mosaic_denoise",
    "Take noise away before demosaicing.",
    Kind.MOSAIC,
    Kind.MOSAIC,
    (NonLocalMeans,),
)
