"""Patches: their positions in a picture, their orientations, and their metadata."""

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

    def crop(self, image: Array) -> Array:
        """Return the patch of an image, (height, width[, channel]), in its orientation."""
        box = self.box
        return self.orient(image[box.top : box.bottom, box.left : box.right])

    def orient(self, part: Array) -> Array:
        """Return a part of an image in the patch's orientation, as a C-contiguous array."""
        return upright(part, self.orientation)


@lru_cache(maxsize=64)
def first_aligned_position(pattern: str, orientation: int, size: int) -> tuple[int, int] | None:
    """Return the smallest column and row at which a patch has the CFA pattern once reoriented.

    Return None if there is no such position. ``pattern`` is a Bayer pattern, such as "RGGB", or
    rows of letters.

    The mosaic keeps its pattern, and no pixel is interpolated or discarded. This is the
    CFA-preserving augmentation of Liu et al., "Learning Raw Image Denoising with Bayer Pattern
    Unification and Bayer Preserving Augmentation" (CVPR workshops 2019). They crop a pixel after
    the flip instead.

    >>> first_aligned_position("RGGB", 2, 128)  # mirrored left to right
    (1, 0)
    >>> first_aligned_position("GRBG", 5, 128)  # transposed
    (1, 1)
    """
    cell = parse_array(pattern).letters
    rows, columns = cell.shape
    period = math.lcm(rows, columns)  # the same on both axes, because a rotation may swap them
    side = period + size % period
    mosaic = np.tile(cell, (4 * period // rows, 4 * period // columns))
    for y in range(rows):
        for x in range(columns):
            reoriented = upright(mosaic[y:, x:][:side, :side], orientation)
            if (reoriented[:rows, :columns] == cell).all():
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
        min_count = {
            "patch": self.size,
            "per_image": 1 if self.per_image == "grid" else self.per_image,
        }
        for name, number in min_count.items():
            if not isinstance(number, int) or number < 1:
                alternative = ", or 'grid'" if name == "per_image" else ""
                raise RequestError(
                    f"{name}: found {number!r}; expected a whole number of 1 or more{alternative}"
                )

    @property
    def min_count(self) -> int:
        """The smallest number of patches that a picture can have."""
        return 1 if self.per_image == "grid" else self.per_image

    def layout(self, chain: Chain, width: int, height: int) -> "PatchLayout":
        """Return the layout of the patches of an image's picture.

        Args:
            chain: the chain that makes the picture.
            width: the width of the image in px.
            height: its height in px.

        Raises:
            ImageError: the picture is smaller than a patch.
        """
        width, height = chain.size(width, height)
        if self.size > min(width, height):
            raise ImageError(
                f"the picture of this image has {width}x{height} pixels, but patches need "
                f"{self.size}x{self.size}; choose smaller patches, or exclude this image"
            )
        return PatchLayout(self, width, height, chain.filter_array.pattern, chain.seed)


@dataclass(frozen=True)
class PatchLayout:
    """The layout of patches in pictures of one size and CFA pattern.

    Each patch has the camera's pattern after it is reoriented.

    Args:
        patches: the number and size of patches.
        width, height: size of the picture in px, at least the size of a patch.
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

    def patches_for(self, numbers: Sequence[int], key: str, epoch: int = 0) -> list[Patch]:
        """Return patches by their numbers: at random positions, or in a grid, row by row.

        The last patch of a grid's row or column ends at the picture's edge. To fit the pattern, a
        patch of a grid may move by less than the pattern's period.

        Args:
            numbers: the numbers of the patches.
            key: the key of the image.
            epoch: the training epoch.
        """
        size, is_grid = self.patches.size, self.patches.per_image == "grid"
        names = ("turn",) if is_grid else ("turn", "left", "top")
        drawn = uniform_numbers(
            f"patch:{self.seed}:{key}:{epoch}",
            [f"{number}.{name}" for number in numbers for name in names],
        )
        last_left, last_top = self.width - size, self.height - size
        y_period, x_period = parse_array(self.pattern).period
        patches = []
        for number in numbers:
            orientation = self._orientation(drawn[f"{number}.turn"])
            position = first_aligned_position(self.pattern, orientation, size)
            assert position  # _orientation returns only orientations that have a position
            x, y = position
            if is_grid:
                row, column = divmod(number, -(-self.width // size))
                left, top = min(column * size, last_left), min(row * size, last_top)
                left, top = max(left - (left - x) % x_period, x), max(top - (top - y) % y_period, y)
            else:
                left = x + x_period * int(
                    drawn[f"{number}.left"] * ((last_left - x) // x_period + 1)
                )
                top = y + y_period * int(drawn[f"{number}.top"] * ((last_top - y) // y_period + 1))
            patches.append(Patch(left, top, size, orientation))
        return patches

    def _orientation(self, number: float) -> int:
        """Return the orientation that a number from 0 to 1 selects among the possible ones."""
        size = self.patches.size
        if not self.patches.augment:
            return 1
        margin = self.width - size, self.height - size
        positions = {turn: first_aligned_position(self.pattern, turn, size) for turn in FLIPS}
        possible = [
            turn
            for turn, position in positions.items()
            if position and all(np.less_equal(position, margin))
        ]
        return possible[int(number * len(possible))]


def patch_name(number: int | None) -> str:
    """Return the suffix of the image's name for a patch number, or "" for None.

    The suffix contains no dot, so that WebDataset reads each patch as a sample.

    >>> patch_name(7), patch_name(None)
    ('_0007', '')
    """
    return "" if number is None else f"_{number:04}"


def without_patch(name: str) -> str:
    """Return a name without the suffix that :func:`patch_name` returns.

    >>> without_patch("frame_12_0007"), without_patch("frame_12")
    ('frame_12', 'frame_12')
    """
    return re.sub(r"_\d{4,}$", "", name)


def all_patches(patches: Patches, chain: Chain, width: int, height: int, key: str) -> list[Patch]:
    """Return all patches of the picture of an image.

    Args:
        patches: the number and size of patches.
        chain: the chain that makes the picture.
        width: the width of the image in px.
        height: its height in px.
        key: the key of the image.

    Raises:
        ImageError: the picture is smaller than a patch.
    """
    layout = patches.layout(chain, width, height)
    return layout.patches_for(range(layout.count), key)


def variance_steps(chain: Chain) -> tuple[Chain, tuple[Step, ...]]:
    """Return the result of :func:`signal_and_noise` after checking its steps.

    Patches need steps that work on single pixels.

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
        signal: the input of these steps, or the patch of it.
        patch: the patch; None for the whole image.
    """
    if patch is None:
        return variance_of(noise, signal)
    # Padding aligns the patch with the pattern, so that its first pixel has the right colour.
    y_period, x_period = noise[0].context.filter_array.period
    x, y = patch.left % x_period, patch.top % y_period
    padded = np.pad(signal, ((y, 0), (x, 0), (0, 0))[: signal.ndim], mode="edge")
    return variance_of(noise, padded)[y:, x:]


def metadata_of(chain: Chain) -> dict[str, Any]:
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
