"""The position of an image or a tile, and the size of its planes on a device. Pure."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

from clpipe.engine.ir import Plan
from clpipe.engine.work_items import round_up, summed_together


@dataclass(frozen=True)
class Box:
    """A part of an image: columns ``left`` to ``right - 1``, and rows ``top`` to ``bottom - 1``."""

    left: int
    top: int
    right: int
    bottom: int

    @property
    def width(self) -> int:
        """The number of columns."""
        return self.right - self.left

    @property
    def height(self) -> int:
        """The number of rows."""
        return self.bottom - self.top

    @property
    def is_empty(self) -> bool:
        """Whether the box has no pixels."""
        return self.width <= 0 or self.height <= 0


EMPTY = Box(0, 0, 0, 0)


@dataclass(frozen=True)
class Extent:
    """An image, or a tile with its halo, and the size of its planes on a device."""

    width: int  # of the image
    height: int
    lanes: int
    border: int
    core: Box
    stored: Box  # core and halo

    @classmethod
    def whole(cls, width: int, height: int, lanes: int, border: int) -> "Extent":
        """Return the extent of a whole image."""
        box = Box(0, 0, width, height)
        return cls(width, height, lanes, border, box, box)

    @cached_property
    def pitch(self) -> int:
        """Floats from one row of a plane to the next."""
        pitch = self.padded_width + 2 * round_up(self.border, self.lanes)
        # Rows that are a multiple of 4 KiB apart would map to the same cache sets.
        return pitch + self.lanes * (pitch % 1024 == 0)

    @property
    def is_empty(self) -> bool:
        """Whether no pixels are stored, because none are needed."""
        return self.stored.is_empty

    @property
    def is_small(self) -> bool:
        """Whether stores leave a part of the border unfilled; see ``kernels/lib/image.h``."""
        return min(self.stored.width, self.stored.height) <= 2 * self.border + 1

    @property
    def padded_width(self) -> int:
        """The width of the planes, in whole blocks."""
        return round_up(self.stored.width, self.lanes)

    @property
    def padded_height(self) -> int:
        """The height of the planes, in whole blocks of four rows."""
        return round_up(self.stored.height, 4)

    @property
    def blocks(self) -> int:
        """The number of blocks with separate sums. Each is four rows high."""
        across = -(-self.padded_width // (self.lanes * summed_together(self.lanes)))
        return across * (self.padded_height // 4)

    @property
    def plane_bytes(self) -> int:
        """The bytes of a plane, its border, and a margin for the loads of the last block."""
        return ((self.padded_height + 2 * self.border) * self.pitch + 5 * self.lanes) * 4

    @cached_property
    def numbers(self) -> dict[str, int]:
        """The values of the kernel parameters that describe the extent, by name."""
        core = self.core
        return {
            "width": self.width,
            "height": self.height,
            "pitch": self.pitch,
            "left": self.stored.left // self.lanes,
            "top": self.stored.top // 4,
            "columns": self.stored.width,
            "rows": self.stored.height,
            "border": self.border,
            "blocks": self.blocks,
            "core_left": core.left,
            "core_top": core.top,
            "core_right": core.right,
            "core_bottom": core.bottom,
        }


# The extents of an image or a tile on each level of a plan.
Extents = tuple[Extent, ...]


def enclosing(parts: Sequence[Extents]) -> Extents:
    """Return, for each level, an extent with the largest image size and tile size of all places."""
    return tuple(
        Extent(
            max(extent.width for extent in extents),
            max(extent.height for extent in extents),
            extents[0].lanes,
            extents[0].border,
            EMPTY,
            Box(
                0,
                0,
                max(extent.stored.width for extent in extents),
                max(extent.stored.height for extent in extents),
            ),
        )
        for extents in zip(*parts, strict=True)
    )


def whole_image(plan: Plan, width: int, height: int, lanes: int) -> Extents:
    """Return the extents of a whole image, from the width and height of the source in pixels."""
    return tuple(Extent.whole(*size, lanes, plan.border) for size in plan.sizes(width, height))
