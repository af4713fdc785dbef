"""Patches: their places in a picture, their orientations, and their metadata."""

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
from clpipe.chain.drawing import uniform_numbers
from clpipe.chain.options import DEFAULT_PATCHES
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
        size: the length of its sides in px.
        orientation: how it is flipped and rotated after the crop: one of EXIF's eight values, of
            which 1 changes nothing.
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
        """Return the patch of an image, (height, width[, channel]), in its orientation."""
        box = self.box
        return self.turned(image[box.top : box.bottom, box.left : box.right])

    def turned(self, part: Array) -> Array:
        """Return a part of an image in the patch's orientation, as a C-contiguous array."""
        return upright(part, self.orientation)


@lru_cache(maxsize=64)
def first_place(pattern: str, orientation: int, size: int) -> tuple[int, int] | None:
    """Return the first column and row of a patch that has the pattern after it is reoriented.

    Return None if there is no such place. ``pattern`` is a Bayer pattern, such as "RGGB", or rows
    of letters.

    The mosaic keeps its pattern, and no pixel is interpolated or discarded. This is the
    CFA-preserving augmentation of Liu et al., "Learning Raw Image Denoising with Bayer Pattern
    Unification and Bayer Preserving Augmentation" (CVPR workshops 2019). They crop a pixel after
    the flip instead.

    >>> first_place("RGGB", 2, 128), first_place("GRBG", 5, 128)  # left to right; transposed
    ((1, 0), (1, 1))
    """
    cell = parse_array(pattern).letters
    rows, columns = cell.shape
    around = math.lcm(rows, columns)  # on both axes, because a rotation may swap them
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
    per_image: int | Literal["grid"] = DEFAULT_PATCHES
    augment: bool = False

    def __post_init__(self) -> None:
        least = {"patch": self.size, "per_image": 1 if self.per_image == "grid" else self.per_image}
        for name, number in least.items():
            if not isinstance(number, int) or number < 1:
                or_grid = ", or 'grid'" if name == "per_image" else ""
                raise RequestError(
                    f"{name}: found {number!r}; expected a whole number of 1 or more{or_grid}"
                )

    @property
    def least(self) -> int:
        """The number of patches that every picture has at least."""
        return 1 if self.per_image == "grid" else self.per_image

    def cutting(self, chain: Chain, width: int, height: int) -> "Cutting":
        """Return how patches are cut from the picture of an image.

        Args:
            chain: the chain that makes the picture.
            width, height: size of the image in px.

        Raises:
            ImageError: the picture is smaller than a patch.
        """
        width, height = chain.size(width, height)
        if self.size > min(width, height):
            raise ImageError(
                f"its picture has {width}x{height} pixels, but patches need "
                f"{self.size}x{self.size}; choose smaller patches, or exclude this image"
            )
        return Cutting(self, width, height, chain.filter_array.pattern, chain.seed)


@dataclass(frozen=True)
class Cutting:
    """How patches are cut from pictures of one size and CFA pattern.

    After it is reoriented, each patch has the camera's pattern.

    Args:
        patches: the number and size of patches.
        width, height: size of the picture in px, at least that of a patch.
        pattern: the pattern of its mosaic, such as "RGGB", or rows of letters.
        seed: the seed of random draws.
    """

    patches: Patches
    width: int
    height: int
    pattern: str
    seed: int

    @property
    def count(self) -> int:
        """The number of patches. A grid covers the picture, except for a last odd row or column."""
        size, count = self.patches.size, self.patches.per_image
        return -(-self.width // size) * -(-self.height // size) if count == "grid" else count

    def cut(self, numbers: Sequence[int], key: str, epoch: int = 0) -> list[Patch]:
        """Return patches by their numbers: at random places, or in a grid, row by row.

        The last patches of a grid's row or column end where the picture does. To fit the pattern, a
        patch of a grid may move by less than the pattern's period.

        Args:
            numbers: the numbers of the patches.
            key: the key of the image.
            epoch: the epoch of a training.
        """
        size, is_grid = self.patches.size, self.patches.per_image == "grid"
        names = ("turn",) if is_grid else ("turn", "left", "top")
        drawn = uniform_numbers(
            f"patch:{self.seed}:{key}:{epoch}",
            [f"{number}.{name}" for number in numbers for name in names],
        )
        last_left, last_top = self.width - size, self.height - size
        down, across = parse_array(self.pattern).period
        patches = []
        for number in numbers:
            orientation = self._orientation(drawn[f"{number}.turn"])
            place = first_place(self.pattern, orientation, size)
            assert place  # _orientation returns only orientations that have one
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
        """Return the orientation that a number from 0 to 1 selects among the possible ones."""
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
    """Return what follows the image's name in that of a patch, by its number; "" for None.

    It contains no dot, so that WebDataset reads each patch as a sample.

    >>> patch_name(7), patch_name(None)
    ('_0007', '')
    """
    return "" if number is None else f"_{number:04}"


def without_patch(name: str) -> str:
    """Return a name without the part that :func:`patch_name` adds.

    >>> without_patch("frame_12_0007"), without_patch("frame_12")
    ('frame_12', 'frame_12')
    """
    return re.sub(r"_\d{4,}$", "", name)


def every_patch(patches: Patches, chain: Chain, width: int, height: int, key: str) -> list[Patch]:
    """Return all patches of the picture of an image.

    Args:
        patches: the number and size of patches.
        chain: the chain that makes the picture.
        width, height: size of the image in px.
        key: the key of the image.

    Raises:
        ImageError: the picture is smaller than a patch.
    """
    cutting = patches.cutting(chain, width, height)
    return cutting.cut(range(cutting.count), key)


def variance_steps(chain: Chain) -> tuple[Chain, tuple[Step, ...]]:
    """Return :func:`signal_and_noise`, if its steps work on single pixels, which patches need.

    Raises:
        RequestError: as for :func:`signal_and_noise`, or a step reads neighbouring pixels.
    """
    signal, noise = signal_and_noise(chain)
    for step in noise:
        if any(isinstance(pass_.access, Stencil) for pass_ in step.passes):
            raise RequestError(
                f"variance: {step.name} mixes the noise of neighbouring pixels, so patches have no "
                "variance map; move it before the noise or after the raw"
            )
    return signal, noise


def variance_at(noise: Sequence[Step], signal: Array, patch: Patch | None) -> Array:
    """Return :func:`variance_of` for an image, or for a patch of it.

    Args:
        noise: the steps that add noise.
        signal: the image that enters them, or the patch of it.
        patch: the patch; None for the whole image.
    """
    if patch is None:
        return variance_of(noise, signal)
    # Padding aligns the patch with the pattern, so that its first pixel has the right colour.
    down, across = noise[0].context.filter_array.period
    x, y = patch.left % across, patch.top % down
    padded = np.pad(signal, ((y, 0), (x, 0), (0, 0))[: signal.ndim], mode="edge")
    return variance_of(noise, padded)[y:, x:]


def facts_of(chain: Chain) -> dict[str, Any]:
    """Return the metadata of a patch or sample: its camera, seed, pattern, levels and colours."""
    facts: dict[str, Any] = {"camera": chain.camera.name, "seed": chain.seed}
    try:
        raw = negative_of(chain)
    except RequestError:  # there is no raw
        return facts
    return facts | {
        "cfa": chain.filter_array.pattern,
        "black_level": float(raw.black_level),
        "white_level": float(raw.white_level),
        "gains": np.array([raw.array.gains[0], 1, raw.array.gains[1]], np.float32),
        "xyz_to_camera": raw.xyz_to_camera.astype(np.float32),
    }
