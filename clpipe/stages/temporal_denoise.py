"""Denoising over time: a mean over the frames of a sequence, where nothing else has changed."""

from collections.abc import Mapping
from dataclasses import replace
from typing import ClassVar, Literal

import numpy as np

from clpipe.base.types import Array, Floats
from clpipe.reference.filter_array import LANES
from clpipe.reference.image import tap
from clpipe.stage import (
    PREVIOUS,
    Arguments,
    CompileTime,
    Context,
    ImageLayer,
    LayerMethod,
    Method,
    Noiseless,
    Pass,
    ReferenceContext,
    Stencil,
    parameter,
    rgb_stage,
    typed_arguments,
)
from clpipe.stages.denoise.strength import noise_of_colours

COLOURS = "red", "green", "blue"
PATCH = [(dx, dy) for dy in (-1, 0, 1) for dx in (-1, 0, 1)]
# What a move costs in units of the squared difference that noise explains, and what each pixel of
# it costs. Found by experiment: with less, noise chooses moves in static areas.
MOVE, MOVE_BY = 0.5, 0.05
# Squared difference of sums over that of pixels at which a pixel keeps all of its noise. Found by
# experiment: demosaicing correlates noise, so the one of sums is 3 times the other in static areas.
OF_SUMS = 5.6
SMALLEST = 1e-12  # of variances, so that images without noise have a weight, too

NOWHERE = np.float32(1e9)  # the displacement of pixels that the frame before does not show


class Recursive(Method):
    """A recursive mean: result = image + (1 - alpha) * g * (previous result - image).

    Here alpha = 2 / (frames + 1). In static areas, g is 1. White noise of the variance s then
    settles at s / ``frames``, and the results of two successive frames correlate by 1 - alpha.

    g depends on the squared difference between the image and the previous result, averaged over 3x3
    pixels and three colours. The unit of this difference is twice the variance a*y + b that
    ``denoise`` expects. Static areas have a difference of 1 in the second frame, and less later. g
    is 1 for differences up to half of ``threshold`` squared. From there to ``threshold`` squared,
    it falls to 0 like Tukey's biweight.

    The difference of the sums of 3x3 pixels limits g as well, because noise hardly changes it. At
    its former place, an edge with a contrast of 1.5 times the noise leaves about a tenth of it. An
    edge with six times the noise leaves less than 2 %.

    The stage needs a sequence. It returns a single image and a first frame unchanged.
    """

    method: ClassVar = "recursive"
    kernel: ClassVar = "temporal_denoise"
    summary: ClassVar = "recursive mean over frames where the image is static"
    tolerance: ClassVar = 1e-5

    frames: float = parameter(
        6.0,
        "Number of frames whose mean has the noise of static areas; 1 disables the stage.",
        "",
        ge=1,
        le=1000,
    )
    threshold: float = parameter(
        1.4,
        "Difference from the frame before above which a pixel keeps all of its noise, relative to "
        "the difference that noise causes.",
        gt=0,
        le=100,
    )

    @property
    def search_radius(self) -> int:
        """The radius of the search for motion, in px; 0 searches for none."""
        return 0

    def noise_free(self, context: Context) -> Method:
        return Noiseless()

    def passes(self) -> tuple[Pass, ...]:
        if self.frames == 1:
            return ()
        colours = [f"{colour}_{item}" for colour in COLOURS for item in ("slope", "offset")]
        names = ("radius", "kept", "limit", "sum_limit", *colours)
        reach = self.search_radius + 1
        return (Pass("blend", Stencil(reach), names, reads=("src", PREVIOUS)),)

    def arguments(self, context: Context) -> Arguments:
        return {
            "radius": CompileTime(str(self.search_radius)),
            "kept": (self.frames - 1) / (self.frames + 1),
            "limit": 2 / self.threshold**2,
            "sum_limit": 2 / self.threshold**2 / OF_SUMS,
            **expected_differences(context),
        }

    def compensated(self, image: Floats, previous: Floats, context: Context) -> Floats:
        """Return the previous result, moved to where the image shows the same surfaces."""
        return previous

    def reference(self, image: Floats, inputs: ReferenceContext) -> Floats:
        if inputs.previous is None or self.frames == 1:
            return image
        previous = self.compensated(image, inputs.previous, inputs.context)
        numbers = typed_arguments(self.arguments(inputs.context))
        slope, offset = (
            np.array([numbers[f"{colour}_{item}"] for colour in COLOURS])
            for item in ("slope", "offset")
        )
        level = np.zeros_like(image)
        for dx, dy in PATCH:
            level += tap(image, dx, dy)
        weights = np.float32(1) / (np.maximum(level, np.float32(0)) * slope + offset)
        of_pixels, of_sums, before = best_match(image, previous, weights, self.search_radius)
        alike = np.minimum(
            np.float32(2) - of_pixels * numbers["limit"],
            np.float32(2) - of_sums * numbers["sum_limit"],
        )
        share = numbers["kept"] * np.square(np.clip(alike, np.float32(0), np.float32(1)))
        return np.asarray(image + share[..., None] * (before - image))


class BlockMatching(Recursive):
    """The recursive mean along the motion since the frame before.

    Each pixel is compared with those of the previous result in a square around it. The one whose
    3x3 pixels differ least takes the place of the previous result. Noise alone rarely causes a
    move, because a move must reduce the difference by more than 0.5, and by 0.05 for each pixel.
    """

    method: ClassVar = "block_matching"
    summary: ClassVar = "recursive mean over frames along the motion, by whole pixels; slow"

    radius: int = parameter(
        3, "Largest motion between two frames, along each axis.", "px", structural=True, ge=1, le=7
    )

    @property
    def search_radius(self) -> int:
        return self.radius


class OpticalFlow(Recursive, LayerMethod):
    """The recursive mean along a flow that the render states, by fractions of a pixel.

    The flow leads from each pixel to the place of its surface in the frame before, in px to the
    right and down. The previous result is interpolated there, bilinearly. A pixel keeps its noise
    if its place is outside the image, or not known.

    If earlier stages move pixels, the flow is warped like ``--carry`` does.
    """

    method: ClassVar = "flow"
    kernel: ClassVar = "temporal_denoise_flow"
    summary: ClassVar = "recursive mean over frames along the render's optical flow"
    layer_kind: ClassVar[Literal["flow"]] = "flow"
    usual_layers: ClassVar = ("Vector", "Flow")
    no_layer: ClassVar = ImageLayer("flow", np.zeros((2, 1, 1 + LANES), np.float32))

    def passes(self) -> tuple[Pass, ...]:
        follow = Pass(
            "follow", Stencil(0), ("flow", "columns", "rows"), ("src", PREVIOUS), writes="moved"
        )
        blends = (replace(each, reads=("src", "moved")) for each in super().passes())
        return tuple(each for blend in blends for each in (follow, blend))

    def parse_layer(self, pixels: Array) -> Floats:
        """Return the displacements, (2, height, width), with padding at the right."""
        height, width = pixels.shape[:2]
        across, down = np.float32(pixels[..., 0]), np.float32(pixels[..., 1])
        x, y = np.arange(width) + across, np.arange(height)[:, None] + down
        known = (abs(2 * x + 1 - width) <= width) & (abs(2 * y + 1 - height) <= height)
        table = np.where(known, (across, down), NOWHERE)
        return np.pad(table, ((0, 0), (0, 0), (0, LANES)))

    def arguments(self, context: Context) -> Arguments:
        table = self.layer_in(context).pixels
        rows, columns = table.shape[1:]
        return {**super().arguments(context), "flow": table, "columns": columns, "rows": rows}

    def compensated(self, image: Floats, previous: Floats, context: Context) -> Floats:
        height, width = image.shape[:2]
        table = self.layer_in(context).pixels[..., :-LANES]
        displacements = np.broadcast_to(table, (2, height, width))
        known = (displacements[0] < NOWHERE)[..., None]
        places = np.where(known[..., 0], displacements, np.float32(0))
        whole = np.floor(places)
        u, v = (places - whole)[..., None]
        column, row = whole.astype(np.intp) + np.mgrid[0:height, 0:width][::-1] + 1
        padded = np.pad(previous, ((1, 1), (1, 1), (0, 0)), "reflect")
        a, b = padded[row, column], padded[row, column + 1]
        c, d = padded[row + 1, column], padded[row + 1, column + 1]
        upper, lower = a + u * (b - a), c + u * (d - c)
        return np.where(known, upper + v * (lower - upper), image)


def expected_differences(context: Context) -> Mapping[str, float]:
    """Return the squared difference that noise explains, summed over 3x3 pixels and three colours.

    It is linear in the sum of 3x3 pixels of a colour, so each colour has a slope and an offset.
    """
    found: dict[str, float] = {}
    for colour, variance in zip(COLOURS, noise_of_colours(context), strict=True):
        # Twice the variance, because both images have it.
        found[f"{colour}_slope"] = variance.slope * (2 * len(COLOURS))
        found[f"{colour}_offset"] = (variance.offset + SMALLEST) * (2 * len(COLOURS) * len(PATCH))
    return found


def best_match(
    image: Floats, previous: Floats, weights: Floats, radius: int
) -> tuple[Floats, Floats, Floats]:
    """Return the pixels of the previous result that fit an image best, and their differences.

    >>> before, now = (np.float32(np.arange(9) >= edge) for edge in (3, 5))
    >>> before, now = (np.broadcast_to(row[:, None], (4, 9, 3)) for row in (before, now))
    >>> difference, _, found = best_match(now, before, np.ones_like(now), 2)
    >>> bool((found == now).all()), float(difference.max())
    (True, 0.0)

    Args:
        image: (height, width, colour).
        previous: the previous result, of that shape.
        weights: the inverse of the squared difference that noise explains, of that shape.
        radius: the largest move along each axis, px.

    Returns:
        The squared differences of pixels, and those of sums, over what noise explains, (height,
        width), and the pixels.
    """

    def weighed(squares: Floats) -> Floats:
        parts = squares * weights
        return np.asarray(parts[..., 0] + parts[..., 1] + parts[..., 2])

    def difference(x: int, y: int) -> tuple[Floats, Floats]:
        squares, total = np.zeros_like(image), np.zeros_like(image)
        for dx, dy in PATCH:
            apart = tap(image, dx, dy) - tap(previous, x + dx, y + dy)
            squares += np.square(apart)
            total += apart
        return weighed(squares), weighed(np.square(total))

    before, (best, sums) = previous, difference(0, 0)
    least = best
    offsets = range(-radius, radius + 1)
    for x, y in ((x, y) for y in offsets for x in offsets if (x, y) != (0, 0)):
        other, other_sums = difference(x, y)
        cost = other + np.float32(MOVE + MOVE_BY * (abs(x) + abs(y)))
        is_better = cost < least
        before = np.where(is_better[..., None], tap(previous, x, y), before)
        best, least = np.where(is_better, other, best), np.minimum(cost, least)
        sums = np.where(is_better, other_sums, sums)
    return best, sums, before


STAGE = rgb_stage(
    "temporal_denoise",
    "Reduce noise with the frames before, in a sequence.",
    (Recursive, BlockMatching, OpticalFlow),
)
