"""White balance by white patch: the brightest area of a scene is white."""

from typing import ClassVar

import numpy as np

from clpipe.base.types import Floats
from clpipe.reference.cfa import Pattern, by_site
from clpipe.stage import Arguments, Context, Pass, Reduction, parameter
from clpipe.stages.white_balance.gains import LIGHTS, EstimatedGains

STEPS = 6144  # bins of each colour: 12 octaves below 1, with 512 bins each
_FIRST = int(np.float32(2.0**-12).view(np.int32))


def cell_maximum(image: Floats) -> Floats:
    """Return the largest sample of each pixel's 2x2 cell; (height, width) in and out.

    >>> cell_maximum(np.float32([[1, 2, 9], [3, 4, 0]])).tolist()
    [[4.0, 4.0, 9.0], [4.0, 4.0, 9.0]]
    """
    height, width = image.shape
    whole = np.pad(image, ((0, height % 2), (0, width % 2)), mode="edge")
    cells = whole.reshape(len(whole) // 2, 2, -1, 2).max((1, 3))
    return np.repeat(np.repeat(cells, 2, 0), 2, 1)[:height, :width]


def percentile_level(samples: Floats, millionths: int) -> np.float32:
    """Return the middle of the histogram bin that contains a percentile; 0 without samples.

    ``millionths`` is the percentile as a share of the samples, in millionths.

    >>> percentile_level(np.float32([0.1, 0.2, 0.5]), 500_000)
    np.float32(0.20007324)
    """
    if not samples.size:
        return np.float32(0)
    bins = (np.maximum(samples, np.float32(2.0**-12)).view(np.int32) - _FIRST) >> 14
    rank = -(-samples.size * millionths // 1_000_000)
    below = np.cumsum(np.bincount(bins.ravel(), minlength=STEPS))
    bin_ = int(np.argmax(below >= rank))
    return np.int32(_FIRST + (bin_ << 14) + (1 << 13)).view(np.float32)


class WhitePatch(EstimatedGains):
    """The gain of a colour c is max(G) / max(c) (Land and McCann, J. Opt. Soc. Am. 1971).

    The maximum is a percentile. A 2x2 cell with a clipped sample is excluded, because the colour of
    a clipped light is unknown. Levels are resolved in steps of 1/512 of an octave's lower end.
    """

    method: ClassVar = "white_patch"
    kernel: ClassVar = "white_patch"
    summary: ClassVar = "make the brightest unclipped samples of the three colours equal"

    percentile: float = parameter(
        99.0, "Share of a colour's samples that are darker than its white level.", "%", gt=0, le=100
    )
    clip: float = parameter(
        0.99,
        "Level from which a sample counts as clipped; its 2x2 cell is then excluded.",
        "signal",
        gt=0,
        le=1,
    )

    @property
    def _millionths(self) -> int:
        return max(1, round(self.percentile * 10_000))

    def estimation_pass(self) -> Pass:
        return Pass(
            "white_patch_bin",
            Reduction(
                "white_patch",
                ("red_gain", "blue_gain"),
                ("millionths", *LIGHTS),
                bins=3 * STEPS,
            ),
            ("pattern", "clip"),
        )

    def arguments(self, context: Context) -> Arguments:
        return {
            **super().arguments(context),
            "pattern": context.cfa,
            "clip": self.clip,
            "millionths": np.uint32(self._millionths),
        }

    def gains(self, image: Floats, pattern: Pattern) -> tuple[np.float32, np.float32]:
        return white_patch_gains(image, pattern, np.float32(self.clip), self._millionths)


def white_patch_gains(
    image: Floats, pattern: Pattern, clip: np.float32, millionths: int
) -> tuple[np.float32, np.float32]:
    """Return the gains of red and blue of a (height, width) mosaic, from the levels of its colours.

    A gain is 1 if the level of its colour or of green is not above 0.

    >>> cells = np.float32([[0.2, 0.4, 1.0, 1.0], [0.4, 0.1, 1.0, 0.3]])
    >>> [gain.item() for gain in white_patch_gains(cells, "RGGB", np.float32(0.99), 1_000_000)]
    [2.0, 4.0]
    """
    site = by_site(image.shape, pattern, np.float32(0), np.float32(1), np.float32(2))
    unclipped = cell_maximum(image) < clip
    red, green, blue = (
        percentile_level(image[unclipped & (site == colour)], millionths) for colour in range(3)
    )

    def gain(level: np.float32) -> np.float32:
        return green / level if green > 0 and level > 0 else np.float32(1)

    return gain(red), gain(blue)
