"""Reads, checks, crops and masks the pictures of a camera to match."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from clpipe.analysis.colours import saturated_of
from clpipe.analysis.edges import slopes_of
from clpipe.analysis.matching.columns import (
    LEVELS,
    MIN_FRAMES,
    TAILS,
    Noise,
    ValidPixels,
    block_numbers,
    noise_of_frames,
)
from clpipe.analysis.pictures import finished_picture
from clpipe.analysis.signature import BRIGHTEST, DARK, DRIFT, flat_mask
from clpipe.base.errors import ImageError, RequestError
from clpipe.base.reading import check_input
from clpipe.base.types import Doubles, Floats, Mask
from clpipe.base.url_text import local
from clpipe.images.jpeg import JpegEncoding, jpeg_encoding
from clpipe.inputs.find import glob_files
from clpipe.reference.colour import luma
from clpipe.reference.image import in_blocks

MAX_UNCROPPED = 640  # px; larger pictures are reduced to their flattest crops of CROP x CROP
CROP = 512  # px; crops begin at multiples of 16, to align with the blocks of a JPEG
CROPS = 4
MIN_FLAT = 4000  # px; pixels in all scenes that are neither clipped nor near an edge
MIN_OF_EACH = 1000  # px; such pixels in each scene
# Squared levels of 255; the energy from rounding in a mean, which noise exceeds.
ROUNDING_ENERGY = 1e-9
HOLDOUT = 3  # one of this many crops or blocks is held out of the search
MANY = 6  # crops; with fewer, blocks are held out instead of whole crops, which might be unusual
SMOOTH = 1.5  # px; sigma that smooths the mean of a burst before it is developed again

SHIFT = 0.5  # px, by which a frame may be shifted against its mean
# Standard errors for a significant shift, for white noise; equal to three for a camera's noise.
SURE = 15.0
SCENE_SHARE, SCENE_BLOCK = 0.05, 64  # see clpipe.analysis.repeats
MOVED, MOVED_BLOCK = 1.0, 16  # sigma, px: a mean of a block that noise does not reach
MAX_MOVED = 0.1  # the largest share of moved blocks


@dataclass(frozen=True, eq=False)
class Scene:
    """Frames of one scene, (height, width, 3) from 0 to 255, and their mean.

    The mean is that of many pictures, or of the frames themselves if ``own_mean`` is set. Masks are
    (height, width). ``counted`` has the pixels that are not clipped, dark or moving. ``flat`` has
    the flat ones among them. ``holdout`` is held out of the search. Columns in ``left_out`` cannot
    be compared.
    """

    name: str
    frames: tuple[Floats, ...]
    mean: Doubles
    own_mean: bool
    counted: Mask
    flat: Mask
    holdout: Mask
    jpeg: JpegEncoding | None = None

    @property
    def mask(self) -> Mask:
        """The flat pixels that the search uses."""
        return np.asarray(self.flat & ~self.holdout)

    def places(self, part: Mask | None = None) -> ValidPixels:
        """Return the pixels in which noise is compared, in a part of the picture or everywhere."""
        slopes = slopes_of(luma(self.mean), self.counted)
        saturated = saturated_of(self.mean, self.flat)
        places = ValidPixels(self.flat, self.noise.level, slopes, saturated)
        return places if part is None else places.without(~part)

    @cached_property
    def noise(self) -> Noise:
        """The noise of the frames."""
        return noise_of_frames(self.frames, None if self.own_mean else self.mean)

    @property
    def left_out(self) -> tuple[str, ...]:
        """The columns that cannot be computed from few frames without a mean."""
        return TAILS if self.own_mean and len(self.frames) < MIN_FRAMES else ()

    @property
    def clean(self) -> Doubles:
        """The scene without noise, to be developed again, (height, width, 3), 0 to 255.

        The mean of a burst has noise, so it is smoothed. This is possible because only flat areas
        are compared.
        """
        if not self.own_mean:
            return self.mean
        from scipy import ndimage

        return np.asarray(ndimage.gaussian_filter(self.mean, (SMOOTH, SMOOTH, 0)))


@dataclass(frozen=True)
class Scenes:
    """The scenes of one camera, and notes about them for the report."""

    each: tuple[Scene, ...]
    jpeg: JpegEncoding | None
    notes: tuple[str, ...]


def expand(patterns: Sequence[str]) -> list[Path]:
    """Return the files of names and globs, in order. An existing file is never read as a glob.

    Raises:
        RequestError: a glob matches no file, or a file is missing.
    """
    found: list[Path] = []
    for pattern in map(local, patterns):
        names = glob_files(pattern)
        if names is None:
            check_input(Path(pattern))
        found += map(Path, names or [pattern])
    return found


def load_scenes(frames: Sequence[str], means: Sequence[str]) -> Scenes:
    """Read pictures of a camera, and choose where their noise is compared.

    Args:
        frames: files or globs; without ``means``, a burst of one scene.
        means: the mean of many pictures of each frame's scene, in the order of the frames; or one
            for all.

    Raises:
        RequestError: there are too few frames, or the pictures do not belong together.
        ImageError: a file cannot be read, or has too few flat places.
    """
    paths, mean_paths = expand(frames), expand(means)
    pictures = [read_picture(path) for path in paths]
    if not mean_paths and len(paths) == 1:
        raise RequestError(
            f"{paths[0]}: one frame alone cannot separate noise from the scene; give more "
            "frames of the same scene, or their mean (--mean)"
        )
    if mean_paths and len(mean_paths) not in (1, len(paths)):
        raise RequestError(
            f"--mean: found {len(mean_paths)} for {len(paths)} frames; give one for each frame, in "
            "the same order, or one for all"
        )
    encodings = [jpeg_encoding(path) for path in paths]
    if len(set(encodings)) > 1:
        different = next(i for i, e in enumerate(encodings) if e != encodings[0])
        raise RequestError(
            f"{paths[different]} is {encoding_text(encodings[different])}, but {paths[0]} is "
            f"{encoding_text(encodings[0])}; give pictures taken with the same camera settings"
        )
    notes: list[str] = []
    if len(mean_paths) > 1:
        groups = [([path], [p]) for path, p in zip(paths, pictures, strict=True)]
    else:
        groups = [(paths, pictures)]
    whole = [
        checked_scene(*group, mean_path, encodings[0], notes)
        for group, mean_path in zip(groups, mean_paths or (None,), strict=True)
    ]
    if whole[0].left_out:
        notes.append(
            f"{len(paths)} frames without a mean: kurtosis and tails are not compared; "
            f"they need {MIN_FRAMES} frames"
        )
    pieces = [
        crop
        for scene in whole
        for crop in ([scene] if max(scene.mask.shape) <= MAX_UNCROPPED else crops_of(scene))
    ]
    flat = sum(int(piece.mask.sum()) for piece in pieces)
    if flat < MIN_FLAT:
        names, cleans = [scene.name for scene in whole], [scene.mean for scene in whole]
        raise ImageError(too_few(names, cleans, flat, MIN_FLAT))
    return Scenes(with_holdout(pieces), encodings[0], tuple(notes))


def read_picture(path: Path) -> Floats:
    """Return a finished picture, (height, width, 3), 0 to 255.

    Raises:
        ImageError: the file cannot be read, or is not a finished picture.
    """
    return finished_picture(path).pixels * np.float32(255)


def encoding_text(encoding: JpegEncoding | None) -> str:
    """Return an encoding as text."""
    if encoding is None:
        return "no JPEG that clpipe can write"
    return f"a JPEG of quality {encoding.quality}, {encoding.subsampling}"


def checked_scene(
    paths: Sequence[Path],
    frames: Sequence[Floats],
    mean_path: Path | None,
    jpeg: JpegEncoding | None,
    notes: list[str],
) -> Scene:
    """Return a scene, after checking its frames. Small moving parts are masked.

    Raises:
        RequestError: sizes or scenes differ, or large parts move.
    """
    mean = read_picture(mean_path) if mean_path else None
    own = mean is None
    named = list(zip(paths, frames, strict=True))
    if mean_path and mean is not None:
        named.append((mean_path, mean))
    for path, frame in named:
        if frame.shape != frames[0].shape:
            (height, width), (first_height, first_width) = frame.shape[:2], frames[0].shape[:2]
            raise RequestError(
                f"{path} is {width}x{height}, but {paths[0]} is {first_width}x{first_height}; "
                "give pictures of one size"
            )
    if min(frames[0].shape[:2]) < 2 * SCENE_BLOCK:
        raise ImageError(
            f"{paths[0]}: this picture is too small; each side needs {2 * SCENE_BLOCK} px"
        )
    clean = np.asarray(np.mean(frames, axis=0) if mean is None else mean, np.float64)
    against = str(mean_path) if mean_path else "the mean of the frames"
    mask = flat_mask(clean, DARK)
    if mask.sum() < MIN_OF_EACH:
        raise ImageError(too_few([str(paths[0])], [clean], int(mask.sum()), MIN_OF_EACH))
    still = np.ones_like(mask)
    for path, frame in zip(paths, frames, strict=True):
        still &= static_mask(path, frame, clean, against, mask)
    if not still.all():
        notes.append(f"{paths[0]}: {(~still).mean():.1%} of the picture moves and is excluded")
    if mean is not None:
        reject_noisy_mean(paths[0], frames[0], mean, against)
    level, holdout = luma(clean), np.zeros_like(mask)
    counted = still & (level >= LEVELS[0]) & (level <= BRIGHTEST)
    return Scene(paths[0].stem, tuple(frames), clean, own, counted, mask & still, holdout, jpeg)


def static_mask(path: Path, frame: Floats, clean: Doubles, against: str, flat: Mask) -> Mask:
    """Return the pixels in which a frame shows the same as its mean, (height, width).

    Raises:
        RequestError: the frame shows another scene, is shifted, moves in large parts, or equals the
            mean.
    """
    from scipy import ndimage

    difference = luma(frame) - luma(clean)
    difference -= difference.mean()
    energy = float((difference**2).mean())
    if energy < ROUNDING_ENERGY:
        raise RequestError(
            f"{path} has the same pixels as {against}, so no noise can be measured; give "
            "pictures that were taken separately"
        )
    sharp = difference - ndimage.gaussian_filter(difference, DRIFT)
    slopes = np.gradient(ndimage.gaussian_filter(luma(clean), 1.0))
    design = np.stack([slope.ravel() for slope in slopes], axis=1)
    shift = -np.linalg.lstsq(design, sharp.ravel(), rcond=None)[0]
    # These are the standard errors for white noise.
    errors = np.sqrt((sharp**2).mean() / np.maximum((design**2).sum(0), 1e-9))
    if (np.abs(shift) > np.maximum(SHIFT, SURE * errors)).any():
        down, right = shift
        raise RequestError(
            f"{path} is shifted against {against} by {right:+.1f} px to the right and {down:+.1f} "
            "px down, so the difference is not only noise; use a tripod"
        )
    wide = block_means(difference, SCENE_BLOCK)
    if (share := float((wide**2).mean()) / energy) > SCENE_SHARE:
        raise RequestError(
            f"{path} does not show the same scene as {against}: averaged over "
            f"{SCENE_BLOCK}x{SCENE_BLOCK} pixels, {share:.0%} of the difference remains, but "
            f"noise would leave less than {SCENE_SHARE:.0%}; give pictures of one scene"
        )
    sigma = float(sharp[flat].std())
    moved = np.abs(block_means(sharp, MOVED_BLOCK)) > MOVED * sigma
    if moved.mean() > MAX_MOVED:
        raise RequestError(
            f"{path}: {moved.mean():.0%} of the picture differs from {against} by more than noise; "
            "give pictures of a scene in which nothing moves"
        )
    wide_moved = ndimage.binary_dilation(moved, np.ones((3, 3)))
    still = np.ones(flat.shape, bool)
    rows, columns = (n * MOVED_BLOCK for n in moved.shape)
    still[:rows, :columns] = ~wide_moved.repeat(MOVED_BLOCK, 0).repeat(MOVED_BLOCK, 1)
    return still


def block_means(plane: Doubles, block: int) -> Doubles:
    """Return the means of whole blocks, (rows, columns)."""
    return np.asarray(in_blocks(plane, block).mean((1, 3)))


def reject_noisy_mean(path: Path, frame: Floats, mean: Floats, against: str) -> None:
    """Check that a mean has less noise than its frame.

    Raises:
        RequestError: it has more.
    """
    rough = [float((np.diff(luma(p), 2) ** 2).mean()) for p in (frame, mean)]
    if rough[1] > rough[0]:
        raise RequestError(
            f"--mean: {against} has more noise than {path}; check that frame and mean are not "
            "swapped"
        )


def too_few(names: Sequence[str], cleans: Sequence[Doubles], flat: int, needed: int) -> str:
    """Return why scenes have too few pixels to measure noise, as a sentence."""
    y = np.concatenate([luma(clean).ravel() for clean in cleans])
    out = float(((y < 30) | (y > 225)).mean())
    why = (
        f"{out:.0%} of the picture is clipped, dark or nearly white (luma below 30 or above 225)"
        if out > 0.5
        else "too little of it is flat"
    )
    return (
        f"{', '.join(names)}: noise can be measured in {flat} pixels, but {needed} are needed: "
        f"{why}; give pictures of a scene with smooth areas of middle brightness, or more pictures"
    )


def crops_of(scene: Scene, size: int = CROP, count: int = CROPS) -> list[Scene]:
    """Return the flattest crops of a scene, at most ``count``, up to ``size`` wide and high."""
    height, width = scene.mask.shape
    down, right = min(size, height), min(size, width)
    step = min(CROP, size // 2)
    places = [
        (top, left)
        for top in range(0, height - down + 1, step)
        for left in range(0, width - right + 1, step)
    ]
    flattest: list[tuple[int, int]] = []
    for top, left in sorted(places, key=lambda at: -int(scene.mask[window(at, down, right)].sum())):
        apart = [abs(top - y) >= down or abs(left - x) >= right for y, x in flattest]
        if all(apart) and len(flattest) < count:
            flattest.append((top, left))
    return [cut(scene, window(place, down, right), place) for place in flattest]


def window(place: tuple[int, int], height: int, width: int) -> tuple[slice, slice]:
    """Return the rows and columns of a crop with this upper left corner, (row, column)."""
    return np.s_[place[0] : place[0] + height, place[1] : place[1] + width]


def cut(scene: Scene, at: tuple[slice, slice], place: tuple[int, int]) -> Scene:
    """Return a crop of a scene."""
    return replace(
        scene,
        name=f"{scene.name} at {place[1]},{place[0]}",
        frames=tuple(frame[at] for frame in scene.frames),
        mean=scene.mean[at],
        counted=scene.counted[at],
        flat=scene.flat[at],
        holdout=scene.holdout[at],
    )


def with_holdout(pieces: Sequence[Scene]) -> tuple[Scene, ...]:
    """Return the crops with one third held out: whole crops if there are six, otherwise blocks."""
    if len(pieces) >= MANY:
        return tuple(
            replace(piece, holdout=np.full_like(piece.flat, number % HOLDOUT == HOLDOUT - 1))
            for number, piece in enumerate(pieces)
        )
    return tuple(
        replace(piece, holdout=block_numbers(piece.flat.shape) % HOLDOUT == HOLDOUT - 1)
        for piece in pieces
    )
