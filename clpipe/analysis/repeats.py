"""Checks that frames are repeats: one scene from one position, with independent noise."""

from collections.abc import Sequence

import numpy as np

from clpipe.analysis.pictures import Picture
from clpipe.base.errors import RequestError
from clpipe.base.types import Floats
from clpipe.outputs.noise_areas import halved
from clpipe.reference.image import in_blocks

# A repeat counts as a ground truth if it has less than this share of the others' noise energy.
# Energies are measured against the mean of n frames. A ground truth then has the share (n - 1) /
# (n^2 - n - 1), at most 0.4.
TRUTH_SHARE = 0.6

# A repeat shows another scene if averaging BLOCK x BLOCK pixels leaves more than this share of the
# energy of its difference from the mean. Noise leaves 1 / BLOCK^2, or up to 0.02 if processing has
# correlated it. Another view leaves 0.17.
SCENE_SHARE = 0.08
BLOCK = 32  # px; the side of a block

# A repeat is shifted if more than this share of the energy of its difference from the mean follows
# the mean's gradient. Noise has at most 0.001, and a shift by a pixel has 0.2 at ISO 12800.
SHIFTED_SHARE = 0.02

MIN_SAMPLES = 1000  # samples that the checks need


def check_repeats(images: Sequence[Picture], mean: Floats, noise: Floats) -> None:
    """Check that images are repeats.

    Args:
        images: the images.
        mean: their mean.
        noise: their scaled differences from the mean, (frame, height, width[, 3]).

    Raises:
        RequestError: an image shows another scene, is shifted, or has much less noise. Frames of
            a video may have much less noise.
    """
    reject_other_scenes(images, noise)
    reject_shifted(images, mean, noise)
    if not images[0].is_coded:
        reject_truth_among_repeats(images, noise)


def reject_shifted(images: Sequence[Picture], mean: Floats, noise: Floats) -> None:
    """Check that no repeat is shifted against the others, by least squares.

    A small shift changes a picture by its gradient times the shift (Lucas and Kanade, IJCAI 1981).

    Raises:
        RequestError: one is shifted.
    """
    if mean.ndim == 2:  # neighbouring pixels of a mosaic have different colours
        mean, noise = halved(mean[None, ..., None])[0], halved(noise[..., None])
    if min(mean.shape[:2]) < 2 or mean.size < MIN_SAMPLES:
        return
    gradients = np.gradient(mean, axis=(0, 1))
    table = np.array([[(a * b).sum(dtype=np.float64) for b in gradients] for a in gradients])
    if np.linalg.det(table) <= 0:
        return  # a shift is not visible without structure
    products = np.array([[(frame * g).sum(dtype=np.float64) for g in gradients] for frame in noise])
    shifts = np.linalg.solve(table, products.T).T
    energy = np.square(noise).sum(axis=(1, 2, 3), dtype=np.float64)
    worst = int(np.square(shifts).sum(1).argmax()) if len(noise) > 2 else 1
    follows = shifts[worst] @ products[worst]
    if follows > SHIFTED_SHARE * energy[worst]:
        others = "the others" if len(noise) > 2 else images[0].path
        raise RequestError(
            f"{images[worst].path} is not aligned with {others}: {follows / energy[worst]:.0%} "
            "of the difference follows edges, but noise would give less than "
            f"{SHIFTED_SHARE:.0%}. The camera or the scene moved. Give repeats from one "
            "position, or add --truth"
        )


def reject_other_scenes(images: Sequence[Picture], noise: Floats) -> None:
    """Check that no repeat differs from the others over wide areas, like another scene.

    Images of less than 2x2 blocks are not checked.

    Raises:
        RequestError: one does.
    """
    frames, height, width = noise.shape[:3]
    if min(height, width) < 2 * BLOCK:
        return
    whole = in_blocks(noise.reshape(frames, height, width, -1), BLOCK, axis=1)
    means = whole.mean((2, 4), dtype=np.float64)
    for axis in (1, 2):  # remove noise of rows and columns, and changes of brightness
        means -= means.mean(axis, keepdims=True)
    remaining = np.square(means).mean((1, 2, 3))
    worst = int(remaining.argmax())
    energy = np.square(whole[worst]).mean(dtype=np.float64)
    if remaining[worst] > SCENE_SHARE * energy:
        others = "the others" if frames > 2 else images[1 - worst].path
        raise RequestError(
            f"{images[worst].path} does not show the same scene as {others}. Averaged over "
            f"{BLOCK}x{BLOCK} pixels, {remaining[worst] / energy:.0%} of the difference "
            f"remains, but noise would leave less than {SCENE_SHARE:.0%}. Give repeats of "
            "one scene, or add --truth."
        )


def reject_truth_among_repeats(images: Sequence[Picture], noise: Floats) -> None:
    """Check that no repeat has much less noise than the others, like a ground truth.

    Raises:
        RequestError: one has.
    """
    energy = np.square(noise).mean(axis=tuple(range(1, noise.ndim)), dtype=np.float64)
    least = int(energy.argmin())
    others = float(np.median(np.delete(energy, least)))
    if len(images) > 2 and noise[0].size >= MIN_SAMPLES and energy[least] < TRUTH_SHARE * others:
        raise RequestError(
            f"{images[least].path} has {energy[least] / others:.2g} times the noise of the "
            "other images; if this image is the clean ground truth, pass it with --truth"
        )
