"""Denoising before demosaicing, while the noise of the samples is still independent."""

from typing import ClassVar

import numpy as np
from pydantic import field_validator

from clpipe.base.types import Floats
from clpipe.reference.cfa import by_site
from clpipe.reference.image import tap
from clpipe.reference.math import square_root
from clpipe.reference.patch import bias_of, decay_of, patch_distances
from clpipe.stage import (
    Arguments,
    CompileTime,
    Context,
    Kind,
    Method,
    Noiseless,
    Pass,
    ReferenceContext,
    Stage,
    Stencil,
    odd_size,
    parameter,
    typed_arguments,
)
from clpipe.stages.sensor_noise.model import read_noise_parameter, shot_noise_parameter

# h = FACTOR * strength * noise. Found by experiment: at strength 1 it is within 0.1 dB of the
# highest PSNR for the image in tests/data, ISO 1600 to 12800. tools/pages/quality.py measures that
# PSNR.
FACTOR = 1.3
MAX_SIZE = 15  # px, of the window


class NonLocalMeans(Method):
    """Non-local means (Buades, Coll and Morel, CVPR 2005; IPOL 2011) on 3x3 patches of the mosaic.

    Offsets inside the window are even, so that samples of one colour are compared with each other.
    Patches are compared after :func:`stabilized`, which gives noise of variance a*y + b the same
    variance at all levels. The samples themselves are averaged, and may stay below black. White
    balance gains that were already applied are divided out before and multiplied back after. Gains
    that gray_world and white_patch estimate are not known in advance, so the as-shot gains are used
    instead.
    """

    method: ClassVar = "non_local_means"
    kernel: ClassVar = "mosaic_denoise_non_local_means"
    summary: ClassVar = "mean of samples of one colour with similar surroundings"
    tolerance: ClassVar = 2e-4  # the kernel's exp is a short polynomial

    size: int = parameter(
        13,
        f"Width of the window: odd, 1 to {MAX_SIZE}; 1 leaves the mosaic unchanged.",
        "px",
        structural=True,
    )
    strength: float = parameter(
        1.0, "Strength relative to the expected noise; 0 disables it.", ge=0, le=100
    )
    a: float | None = shot_noise_parameter("the a of sensor_noise, else from the camera and ISO")
    b: float | None = read_noise_parameter("the b of sensor_noise, else from the camera and ISO")

    @field_validator("size")
    @classmethod
    def _check_odd(cls, size: int) -> int:
        return odd_size(size, MAX_SIZE)

    def resolve(self, context: Context) -> "NonLocalMeans":
        if self.a is not None and self.b is not None:
            return self
        a, b = context.noise_parameters()
        return self.with_defaults(a=a, b=b)

    def noise_free(self, context: Context) -> Method:
        return Noiseless()

    @property
    def reach(self) -> int:
        """The largest even offset inside the window, px."""
        return self.size // 2 // 2 * 2

    def passes(self) -> tuple[Pass, ...]:
        return (
            Pass(
                "stabilize",
                arguments=(
                    "pattern",
                    "red_inverse",
                    "blue_inverse",
                    "a",
                    "offset",
                    "root_of_offset",
                ),
                writes="samples",
                kind=Kind.PAIR,
            ),
            Pass(
                "mosaic_non_local_means",
                Stencil(self.reach + 1, vectors_per_row=4),
                ("reach", "bias", "scale"),
                reads=("samples",),
                writes="filtered",
            ),
            Pass("with_gains", arguments=("pattern", "red_gain", "blue_gain"), reads=("filtered",)),
        )

    def arguments(self, context: Context) -> Arguments:
        assert self.a is not None and self.b is not None
        red, blue = context.applied_gains
        offset = max(0.375 * self.a**2 + self.b, 1e-12)
        return {
            **super().arguments(context),
            "reach": CompileTime(str(self.reach)),
            "red_inverse": 1 / red,
            "blue_inverse": 1 / blue,
            "red_gain": red,
            "blue_gain": blue,
            "offset": offset,
            "root_of_offset": np.sqrt(offset),
            "bias": bias_of(self.strength),
            "scale": decay_of(FACTOR * self.strength),
        }

    def reference(self, image: Floats, inputs: ReferenceContext) -> Floats:
        n = typed_arguments(self.arguments(inputs.context))
        shape, pattern = image.shape, inputs.context.pattern
        one = np.float32(1)
        sensor = image * by_site(shape, pattern, n["red_inverse"], one, n["blue_inverse"])
        stable = stabilized(sensor, n["a"], n["offset"], n["root_of_offset"])
        filtered = mosaic_non_local_means(sensor, stable, self.reach, n["bias"], n["scale"])
        return filtered * by_site(shape, pattern, n["red_gain"], one, n["blue_gain"])


def mosaic_non_local_means(
    samples: Floats, stable: Floats, reach: int, bias: np.float32, scale: np.float32
) -> Floats:
    """Filter a (height, width) mosaic by non-local means over even offsets (IPOL 2011, eq. 1 to 3).

    The weight is 2^(scale * max(d^2 - bias, 0)). d^2 is the squared distance of the 3x3 patches of
    ``stable``.

    >>> noisy = np.float32([[0, 5, 1, 5, 0, 5, 1]])  # two colours
    >>> filtered = mosaic_non_local_means(noisy, noisy / 9, 2, np.float32(2), np.float32(-1))
    >>> (100 * filtered).round().astype(int).tolist()
    [[67, 500, 33, 500, 67, 500, 33]]
    """
    total, weights = np.zeros_like(samples), np.zeros_like(samples)
    for dx, dy, distance in patch_distances(stable[..., None], reach, step=2):
        excess = np.maximum(distance - bias, np.float32(0))
        weight = np.exp2(np.maximum(excess * scale, np.float32(-30)))
        total += weight * tap(samples, dx, dy)
        weights += weight
    return total / weights


def stabilized(y: Floats, a: np.float32, offset: np.float32, root_of_offset: np.float32) -> Floats:
    """Return a third of the generalized Anscombe transform (Murtagh et al., A&AS 1995).

    The transform is 2/a * (sqrt(a*y + c) - sqrt(c)), with the ``offset`` c = 3/8 a^2 + b. It is
    written as 2*y / (sqrt(a*y + c) + sqrt(c)), which is also valid for a = 0. Noise of variance a*y
    + b gets the variance 1, and a third of the transform has 1/9. The 9 squares of a patch
    therefore add up to their mean.

    >>> a, c = np.float32(0.01), np.float32(1e-3)
    >>> below, above = 3 * stabilized(np.float32([0.1, 0.11]), a, c, c ** np.float32(0.5))
    >>> round(float((above - below) / 0.01) ** -2, 5)  # a*y + c halfway
    0.00205
    """
    root = square_root(np.maximum(a * y + offset, np.float32(0)))
    return y * np.float32(0.6666667) / (root + root_of_offset)


STAGE = Stage(
    "mosaic_denoise",
    "Reduce noise before demosaicing.",
    Kind.MOSAIC,
    Kind.MOSAIC,
    (NonLocalMeans,),
)
