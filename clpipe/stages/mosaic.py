"""The colour filter array."""

from dataclasses import replace
from functools import lru_cache
from typing import ClassVar

import numpy as np

from clpipe.base.errors import KeyedError
from clpipe.base.types import Floats
from clpipe.camera.profile import IDENTITY
from clpipe.reference.cfa import Pattern, by_site
from clpipe.reference.filter_array import (
    LETTERS,
    NAMED,
    FilterArray,
    kernel_table,
    parse_array,
    tiled,
)
from clpipe.stage import (
    PERIOD,
    Arguments,
    Context,
    Kind,
    Method,
    Pass,
    ReferenceContext,
    Stage,
    StageRole,
    parameter,
    period_of,
)


class Bayer(Method):
    """A Bayer pattern (US patent 3,971,065, 1976): each pixel keeps one of its three colours.

    >>> from clpipe.stage import run_reference
    >>> image = np.float32([1, 2, 3]) * np.ones((2, 2, 1), np.float32)
    >>> run_reference(Bayer(pattern="GRBG"), image).tolist()
    [[2.0, 1.0], [3.0, 2.0]]
    """

    method: ClassVar = "bayer"
    kernel: ClassVar = "mosaic"
    summary: ClassVar = "keep one colour per pixel, by a Bayer pattern"

    pattern: Pattern = parameter(
        "RGGB", "Colours of the 2x2 pixels in the upper left corner, row by row.", structural=True
    )

    def next_context(self, context: Context) -> Context:
        return context.replace(pattern=self.pattern, array=None)

    def passes(self) -> tuple[Pass, ...]:
        return (Pass("mosaic", arguments=("pattern",)),)

    def arguments(self, context: Context) -> Arguments:
        return {"pattern": context.replace(pattern=self.pattern).cfa}

    def reference(self, image: Floats, inputs: ReferenceContext) -> Floats:
        red, green, blue = np.moveaxis(image, -1, 0)
        return by_site(image.shape, self.pattern, red, green, blue)


class AnyArray(Method):
    """A filter array of any period to 8x8: mono, RCCB, Quad Bayer, X-Trans, or rows of letters.

    Channels are R, G, B, W (clear), Y, C, M, I (near infrared) and L (no filter at all). H, D, V
    and A are polarisers at 0, 45, 90 and 135 degrees. For polarisers, the render's red, green and
    blue are the light after polarisers at 0, 60 and 120 degrees. The response of each channel to
    white-balanced red, green and blue follows from the gains of inverse_white_balance, or else from
    the camera's. White is 1 in all channels. After inverse_white_balance, white fills the most
    sensitive channel, because a camera exposes for that one.

    >>> from clpipe.stage import run_reference
    >>> image = np.float32([1, 2, 3]) * np.ones((1, 4, 1), np.float32)
    >>> run_reference(AnyArray(array="RRGG/GGBB"), image).tolist()
    [[1.0, 1.0, 2.0, 2.0]]
    """

    method: ClassVar = "array"
    kernel: ClassVar = "filter_array"
    summary: ClassVar = "a filter array of any period: by name, or rows of letters"
    other_examples: ClassVar = ({"array": "RGBW"},)
    any_array: ClassVar = True

    array: str = parameter(
        "x-trans",
        "The filter array: "
        + ", ".join(NAMED)
        + "; or its rows, with letters of "
        + f"{LETTERS} and / between, such as RG/GB.",
        structural=True,
    )

    def resolve(self, context: Context) -> "Method":
        array = self._parsed(context)  # raises an error if the array is invalid
        if array.is_polarised and context.colours != IDENTITY:
            raise KeyedError(
                "mosaic.array",
                f"mosaic.array: the channels of {array.name} are polarisers, but the render was "
                "converted to a camera's colours; skip inverse_color_matrix",
            )
        return self

    def _parsed(self, context: Context) -> FilterArray:
        array = parse_array(self.array).with_gains(context.illuminant_gains)
        if context.planes == "RGB" or context.sight is None:
            return array
        return replace(array, whites=tuple(map(context.sight.white, array.channels)))

    def next_context(self, context: Context) -> Context:
        return context.with_array(self._parsed(context))

    def passes(self) -> tuple[Pass, ...]:
        return (Pass("filter_array", arguments=("responses", *PERIOD)),)

    def arguments(self, context: Context) -> Arguments:
        array = self._parsed(context)
        return {"responses": responses_table(array, context.planes), **period_of(array.period)}

    def reference(self, image: Floats, inputs: ReferenceContext) -> Floats:
        table = responses_of(self._parsed(inputs.context), inputs.context.planes)
        red, green, blue = (tiled(table[:, c], image.shape) for c in range(3))
        return (image[..., 0] * red + image[..., 1] * green) + image[..., 2] * blue


def responses_of(array: FilterArray, planes: str = "RGB") -> Floats:
    """Return the transmission of the filter at each position: (row, plane, column).

    Args:
        array: the filter array.
        planes: the channels of the image's planes; see :class:`~clpipe.stage.Context`.
    """
    responses = {k: [float(x) for x in v] for k, v in array.responses.items()}
    if planes != "RGB":
        own = {k: max(planes.find(k), 0) for k in responses}
        responses = {k: [float(c == place) for c in range(3)] for k, place in own.items()}
    colours = [{k: v[c] for k, v in responses.items()} for c in range(3)]
    return np.stack([array.by_position(each) for each in colours], axis=1)


@lru_cache(maxsize=64)  # equal arrays share one object, so that it is uploaded once
def responses_table(array: FilterArray, planes: str) -> Floats:
    """Return :func:`responses_of` an array in the layout of kernels."""
    return kernel_table(responses_of(array, planes))


def _camera_default(context: Context) -> Method | None:
    if not (name := context.camera.filter_array):
        return None
    array = parse_array(name)
    return Bayer(pattern=array.bayer) if array.bayer else AnyArray(array=name)


STAGE = Stage(
    "mosaic",
    "Apply a colour filter array to the image.",
    Kind.RGB,
    Kind.MOSAIC,
    (Bayer, AnyArray),
    role=StageRole.PATTERN,
    default_method=_camera_default,
)
