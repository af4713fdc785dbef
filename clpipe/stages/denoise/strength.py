"""The strength of denoising, which follows the noise, and the parameters of all methods.

The noise of a sensor has the variance a*y + b (Foi et al., IEEE TIP 2008, eq. 2). The values of a
and b are those of ``sensor_noise``, else those of the camera at the ISO. White balance gains
amplify the noise. Luma and chroma are weighted sums of the three colours, whose noise is
independent. The variance of luma noise in a grey of level v is therefore linear in v. Its value at
mid grey sets the strength of every method, and the strength on chroma follows in the same way.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Self

import numpy as np
from pydantic import field_validator

from clpipe.reference.colour import LUMA
from clpipe.stage import (
    Arguments,
    CompileTime,
    Context,
    Kind,
    Method,
    Noiseless,
    Pass,
    Stencil,
    odd_size,
    parameter,
)

MID_GREY = 0.18  # signal units
_WEIGHTS = np.asarray(LUMA, float)
_CB, _CR = 0.564 * (np.eye(3)[2] - _WEIGHTS), 0.713 * (np.eye(3)[0] - _WEIGHTS)
# Squares of the weights of red, green and blue in luma, and in Cb and Cr together.
LUMA_SQUARES: list[float] = (_WEIGHTS**2).tolist()
CHROMA_SQUARES: list[float] = (_CB**2 + _CR**2).tolist()
PREDICTED = "the {} noise at mid grey that a, b and the gains predict"


@dataclass(frozen=True)
class Variance:
    """A variance that is linear in the level of a grey: slope * level + offset, signal squared."""

    slope: float
    offset: float

    def at(self, level: float) -> float:
        """Return the variance in a grey of this level.

        >>> Variance(2.0, 1.0).at(0.5)
        2.0
        """
        return self.slope * level + self.offset


def noise_of_colours(context: Context) -> tuple[Variance, Variance, Variance]:
    """Return the variances of red, green and blue in a grey after white balance, signal squared.

    In a colour with gain k, a grey of level v has the signal v/k and the variance a*v/k + b before
    the gain. After the gain, the variance is a*v*k + b*k^2. The reduction of noise by demosaicing
    is not included.
    """
    a, b = context.noise_parameters()
    red, blue = context.applied_gains
    red_noise, green_noise, blue_noise = (Variance(a * k, b * k * k) for k in (red, 1.0, blue))
    return red_noise, green_noise, blue_noise


def noise_of_luma_and_chroma(context: Context) -> tuple[Variance, Variance]:
    """Return the variances of luma and of Cb + Cr together in a grey, in signal units squared."""
    colours = noise_of_colours(context)

    def mixed(squares: Sequence[float]) -> Variance:
        slope = sum(w * c.slope for w, c in zip(squares, colours, strict=True))
        offset = sum(w * c.offset for w, c in zip(squares, colours, strict=True))
        return Variance(slope, offset)

    return mixed(LUMA_SQUARES), mixed(CHROMA_SQUARES)


def predicted_noise(context: Context) -> tuple[float, float]:
    """Return the standard deviations of luma and chroma noise at mid grey (0.18), signal units."""
    luma, chroma = noise_of_luma_and_chroma(context)
    return np.sqrt(luma.at(MID_GREY)), np.sqrt(chroma.at(MID_GREY))


def offset_of_roots(context: Context) -> float:
    """Return the offset for roots of the signal, see :mod:`clpipe.reference.roots`, from the noise.

    It is twice the noise of the noisiest colour at black, so that few values are clipped, plus
    0.003, a tenth of one level of 255. Found by experiment: with a larger offset, dark colours pick
    up the noise of luma, which appears as dots on saturated surfaces.

    >>> from clpipe.camera.profile import load_camera
    >>> round(float(offset_of_roots(Context(load_camera("sony-a7r2"), 25600))), 4)
    0.0134
    """
    return 0.003 + 2 * np.sqrt(max(colour.at(0) for colour in noise_of_colours(context)))


def offset_parameter() -> Any:
    """Declare the offset of a method that works on roots of the signal."""
    return parameter(
        None,
        "Offset added to the signal before the root is taken.",
        "signal",
        "0.003 plus twice the noise at black",
        gt=0,
        le=1,
    )


def explain(context: Context) -> str:
    """Return the steps from a and b to luma and chroma noise, in a few lines, with their values."""
    a, b = context.noise_parameters()
    red, blue = context.applied_gains
    sigmas = [np.sqrt(colour.at(MID_GREY)) for colour in noise_of_colours(context)]
    luma, chroma = predicted_noise(context)
    source = "as sensor_noise used them" if context.noise else "from the camera"
    lines = (
        f"The strength follows the noise predicted at mid grey (v = {MID_GREY:g}):",
        f"  {context.camera.name}, ISO {context.iso:g}: a = {a:.4g}, b = {b:.4g} ({source})",
        f"  white balance gains k: red {red:.4g}, green 1, blue {blue:.4g}",
        "  sigma of a colour after its gain = sqrt(k*a*v + k^2*b):"
        f" R {sigmas[0]:.3g}, G {sigmas[1]:.3g}, B {sigmas[2]:.3g}",
        f"  luma_noise = sqrt(sum of (0.299, 0.587, 0.114)^2 * sigma^2) = {luma:.3g}",
        f"  chroma_noise = the same for Cb and Cr together = {chroma:.3g}",
        "  Methods filter luma by luma_strength * luma_noise,"
        " and chroma by chroma_strength * chroma_noise.",
    )
    return "\n".join(lines)


def size_parameter(plane: str, default: int, largest: int) -> Any:
    """Declare the width of a plane's window; each method has its own default and limit."""
    text = f"Width of the {plane} window: odd, 1 to {largest}; 1 leaves {plane} unchanged."
    return parameter(default, text, "px", structural=True)


class Denoiser(Method):
    """The base of all methods: luma and chroma, each with a strength and its noise."""

    luma_strength: float = parameter(
        1.0, "Strength on luma, relative to luma_noise; 0 disables it.", ge=0, le=100
    )
    chroma_strength: float = parameter(
        2.0, "Strength on chroma, relative to chroma_noise; 0 disables it.", ge=0, le=100
    )
    luma_noise: float | None = parameter(
        None,
        "Standard deviation of the luma noise at mid grey.",
        "signal",
        PREDICTED.format("luma"),
        ge=0,
    )
    chroma_noise: float | None = parameter(
        None,
        "Standard deviation of the chroma noise (Cb and Cr together) at mid grey.",
        "signal",
        PREDICTED.format("chroma"),
        ge=0,
    )

    def resolve(self, context: Context) -> Self:
        luma, chroma = predicted_noise(context)
        return self.with_defaults(luma_noise=luma, chroma_noise=chroma)

    def noise_free(self, context: Context) -> Method:
        return Noiseless()

    @property
    def amounts(self) -> tuple[float, float]:
        """strength * noise of luma and of chroma, in signal units."""
        assert self.luma_noise is not None and self.chroma_noise is not None
        return self.luma_strength * self.luma_noise, self.chroma_strength * self.chroma_noise

    @property
    def effect(self) -> str:
        """Return the effect of the (resolved) strengths and noises, in a few words."""
        raise NotImplementedError(type(self).__name__)


class WindowDenoiser(Denoiser):
    """The base of the methods with windows of any size.

    Subclasses name the stencil in their kernel file. They share the passes to and from YCbCr.
    """

    largest_size: ClassVar[int] = 15
    function: ClassVar[str]  # the stencil in the kernel file
    names: ClassVar[tuple[str, ...]]  # the stencil's run-time arguments, after the two reaches
    first_pass: ClassVar[Pass] = Pass("to_luma_chroma", writes="planes", kind=Kind.YCBCR)
    last_pass: ClassVar[Pass] = Pass("from_luma_chroma", reads=("filtered",))
    extra_reach: ClassVar[int] = 0  # px that the stencil reads outside its window
    vectors_per_row: ClassVar[int] = 0  # see Stencil

    luma_size: int = size_parameter("luma", 5, 15)
    chroma_size: int = size_parameter("chroma", 5, 15)

    @field_validator("luma_size", "chroma_size")
    @classmethod
    def _check_odd(cls, size: int) -> int:
        return odd_size(size, cls.largest_size)

    @property
    def reaches(self) -> tuple[int, int]:
        """The largest offsets in the windows of luma and chroma, px."""
        return self.luma_size // 2, self.chroma_size // 2

    def passes(self) -> tuple[Pass, ...]:
        return (
            self.first_pass,
            Pass(
                self.function,
                Stencil(max(self.reaches) + self.extra_reach, self.vectors_per_row),
                ("luma_reach", "chroma_reach", *self.names),
                reads=("planes",),
                writes="filtered",
                kind=Kind.YCBCR,
            ),
            self.last_pass,
        )

    def arguments(self, context: Context) -> Arguments:
        luma, chroma = self.reaches
        return {"luma_reach": CompileTime(str(luma)), "chroma_reach": CompileTime(str(chroma))}
