"""Where in a picture patches are cut, and how they are turned; what is said of them. Pure."""

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Literal

import numpy as np

from clpipe.base.errors import ImageError, RequestError
from clpipe.base.types import Array
from clpipe.chain.chain import Chain, Step
from clpipe.chain.drawing import uniforms
from clpipe.chain.options import PER_IMAGE
from clpipe.chain.truth import signal_and_noise, variance_of
from clpipe.engine.extents import Box
from clpipe.images.tags import FLIPS, upright
from clpipe.outputs.negative import negative_of
from clpipe.reference.filter_array import parse_array
from clpipe.stage import Stencil


@dataclass(frozen=True)
class Patch:
    """A square part of a picture.

    Args:
        left, top: its first column and row in the picture.
        size: of its sides, in px.
        orientation: how it is turned when it has been cut out, one of EXIF's eight: each is a flip,
            a turn by a multiple of 90 degrees, or both; 1 is none.
    """

    left: int
    top: int
    size: int
    orientation: int = 1

    @property
    def box(self) -> Box:
        """The part of the picture."""
        return Box(self.left, self.top, self.left + self.size, self.top + self.size)

    def cut_out(self, image: Array) -> Array:
        """The patch, turned, of a whole image, (height, width[, channel])."""
        box = self.box
        return self.turned(image[box.top : box.bottom, box.left : box.right])

    def turned(self, part: Array) -> Array:
        """A part of an image, turned; C-contiguous."""
        return upright(part, self.orientation)


@lru_cache(maxsize=64)
def first_place(pattern: str, orientation: int, size: int) -> tuple[int, int] | None:
    """The first column and row of a patch that has the pattern when it is turned.

    None where there is none. ``pattern`` is a Bayer pattern, such as "RGGB", or rows of letters.

    So a mosaic keeps its pattern, and no pixel is interpolated or thrown away: the CFA-preserving
    augmentation of Liu et al., "Learning Raw Image Denoising with Bayer Pattern Unification and
    Bayer Preserving Augmentation" (CVPR workshops 2019), who crop a pixel after the flip instead.

    >>> first_place("RGGB", 2, 128), first_place("GRBG", 5, 128)  # left to right; transposed
    ((1, 0), (1, 1))
    """
    cell = parse_array(pattern).letters
    rows, columns = cell.shape
    around = math.lcm(rows, columns)  # both ways, since a turn may swap them
    side = around + size % around
    field = np.tile(cell, (4 * around // rows, 4 * around // columns))
    for y in range(rows):
        for x in range(columns):
            turned = upright(field[y:, x:][:side, :side], orientation)
            if (turned[:rows, :columns] == cell).all():
                return x, y
    return None


@dataclass(frozen=True)
class Patches:
    """The patches to cut from each picture.

    >>> from clpipe import Patches
    >>> Patches(128, per_image=4, augment=True)
    Patches(size=128, per_image=4, augment=True)

    Args:
        size: the side of a patch, in px.
        per_image: the number of patches, at random places. "grid" is the smallest grid that covers
            the picture, except an odd last column or row. Its last patches overlap.
        augment: whether patches are flipped and rotated by 90 degrees at random.

    Raises:
        RequestError: a number is below 1.
    """

    size: int
    per_image: int | Literal["grid"] = PER_IMAGE
    augment: bool = False

    def __post_init__(self) -> None:
        least = {"patch": self.size, "per_image": 1 if self.per_image == "grid" else self.per_image}
        for name, number in least.items():
            if not isinstance(number, int) or number < 1:
                or_grid = ", or 'grid'" if name == "per_image" else ""
                raise RequestError(f"found {name} {number!r}; expected 1 or more{or_grid}")

    @property
    def least(self) -> int:
        """How many there are of any picture."""
        return 1 if self.per_image == "grid" else self.per_image

    def cutting(self, chain: Chain, width: int, height: int) -> "Cutting":
        """Return how they are cut from the picture that a chain makes of an image of a size.

        Raises:
            ImageError: it is smaller than a patch.
        """
        width, height = chain.size(width, height)
        if self.size > min(width, height):
            raise ImageError(
                f"its picture has {width}x{height} pixels, and patches are to have "
                f"{self.size}x{self.size}; make them smaller, or leave the image out"
            )
        return Cutting(self, width, height, chain.filters.pattern, chain.seed)


@dataclass(frozen=True)
class Cutting:
    """How patches are cut from the pictures of one size and CFA pattern.

    Each begins so that, turned, it has the pattern of the camera.

    Args:
        patches: which.
        width, height: of the picture, at least as large as a patch.
        pattern: of its mosaic, such as "RGGB", or rows of letters.
        seed: of the draws.
    """

    patches: Patches
    width: int
    height: int
    pattern: str
    seed: int

    @property
    def count(self) -> int:
        """How many there are. A grid covers the picture, except for a last odd column and row."""
        size, count = self.patches.size, self.patches.per_image
        return -(-self.width // size) * -(-self.height // size) if count == "grid" else count

    def cut(self, numbers: Sequence[int], key: str, epoch: int = 0) -> list[Patch]:
        """Return patches by their numbers: at random places, or side by side, row by row.

        The last patches of a row or column end where the picture does. The pattern may move any
        patch of a grid by less than its period.

        Args:
            numbers: of the patches.
            key: of the image.
            epoch: of a training.
        """
        size, is_grid = self.patches.size, self.patches.per_image == "grid"
        names = ("turn",) if is_grid else ("turn", "left", "top")
        drawn = uniforms(
            f"patch:{self.seed}:{key}:{epoch}",
            [f"{number}.{name}" for number in numbers for name in names],
        )
        last_left, last_top = self.width - size, self.height - size
        down, across = parse_array(self.pattern).period
        patches = []
        for number in numbers:
            orientation = self._orientation(drawn[f"{number}.turn"])
            place = first_place(self.pattern, orientation, size)
            assert place  # or the orientation would not be taken
            x, y = place
            if is_grid:
                row, column = divmod(number, -(-self.width // size))
                left, top = min(column * size, last_left), min(row * size, last_top)
                left, top = max(left - (left - x) % across, x), max(top - (top - y) % down, y)
            else:
                left = x + across * int(drawn[f"{number}.left"] * ((last_left - x) // across + 1))
                top = y + down * int(drawn[f"{number}.top"] * ((last_top - y) // down + 1))
            patches.append(Patch(left, top, size, orientation))
        return patches

    def _orientation(self, number: float) -> int:
        """Return the orientation of a number from 0 to 1, of those for which there is a place."""
        size = self.patches.size
        if not self.patches.augment:
            return 1
        spare = self.width - size, self.height - size
        places = {turn: first_place(self.pattern, turn, size) for turn in FLIPS}
        fits = [
            turn for turn, place in places.items() if place and all(np.less_equal(place, spare))
        ]
        return fits[int(number * len(fits))]


def patch_name(number: int | None) -> str:
    """What is put behind the image's name for a patch, by its number; None is none.

    It has no dot, so that each is a sample of WebDataset.

    >>> patch_name(7), patch_name(None)
    ('_0007', '')
    """
    return "" if number is None else f"_{number:04}"


def without_patch(name: str) -> str:
    """A name without what :func:`patch_name` put behind it.

    >>> without_patch("frame_12_0007"), without_patch("frame_12")
    ('frame_12', 'frame_12')
    """
    return re.sub(r"_\d{4,}$", "", name)


def every_patch(patches: Patches, chain: Chain, width: int, height: int, key: str) -> list[Patch]:
    """Return all patches of the picture that a chain makes of an image of a size.

    Raises:
        ImageError: it is smaller than a patch.
    """
    cutting = patches.cutting(chain, width, height)
    return cutting.cut(range(cutting.count), key)


def variance_steps(chain: Chain) -> tuple[Chain, tuple[Step, ...]]:
    """See :func:`signal_and_noise`; the steps are of single pixels, so that patches have it, too.

    Raises:
        RequestError: as there, or a step reads the pixels around each.
    """
    signal, noise = signal_and_noise(chain)
    for step in noise:
        if any(isinstance(pass_.access, Stencil) for pass_ in step.passes):
            raise RequestError(
                f"variance: {step.name} mixes the noise of neighbours; move it before the noise or "
                "behind the raw"
            )
    return signal, noise


def variance_at(noise: Sequence[Step], signal: Array, patch: Patch | None) -> Array:
    """See :func:`variance_of`, of a patch of an image.

    Args:
        noise: the steps.
        signal: what enters them, of the patch or of the whole image.
        patch: where it is.
    """
    if patch is None:
        return variance_of(noise, signal)
    # Rows and columns more, so that the first pixel has the colour of an image's first one.
    down, across = noise[0].context.filters.period
    x, y = patch.left % across, patch.top % down
    padded = np.pad(signal, ((y, 0), (x, 0), (0, 0))[: signal.ndim], mode="edge")
    return variance_of(noise, padded)[y:, x:]


def facts_of(chain: Chain) -> dict[str, Any]:
    """What a patch or a sample says of its camera and its raw."""
    facts: dict[str, Any] = {"camera": chain.camera.name, "seed": chain.seed}
    try:
        raw = negative_of(chain)
    except RequestError:  # there is no raw
        return facts
    return facts | {
        "cfa": chain.filters.pattern,
        "black_level": float(raw.black_level),
        "white_level": float(raw.white_level),
        "gains": np.array([raw.array.gains[0], 1, raw.array.gains[1]], np.float32),
        "xyz_to_camera": raw.xyz_to_camera.astype(np.float32),
    }
