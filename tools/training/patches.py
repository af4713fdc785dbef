"""Training patches: from pictures with ground truth, or from ground truth with added noise."""

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from torch import Tensor

Batch = Callable[[torch.Generator], tuple[Tensor, Tensor]]
Noise = Callable[[Tensor, torch.Generator], Tensor]

PATCH, BATCH = 64, 16  # px; patches


def read(path: Path) -> Tensor:
    """Read a finished picture, (3, height, width), uint8."""
    with Image.open(path) as picture:
        pixels = np.array(picture.convert("RGB"))
    return torch.from_numpy(pixels).permute(2, 0, 1).contiguous()


def augmented(patch: Tensor, number: int) -> Tensor:
    """Rotate and mirror a patch in one of eight ways."""
    patch = patch.flip(-1) if number & 4 else patch
    return torch.rot90(patch, number & 3, (-2, -1))


def from_pairs(pairs: Sequence[tuple[Tensor, Tensor]]) -> Batch:
    """Return a source of patches from pictures and ground truths, (3, height, width) uint8."""

    def batch(generator: torch.Generator) -> tuple[Tensor, Tensor]:
        both = torch.empty(2, BATCH, 3, PATCH, PATCH)
        for i in range(BATCH):
            noisy, clean = pairs[random_below(len(pairs), generator)]
            y, x = (random_below(side - PATCH + 1, generator) for side in clean.shape[1:])
            number = random_below(8, generator)
            for to, image in zip(both[:, i], (noisy, clean), strict=True):
                to.copy_(augmented(image[:, y : y + PATCH, x : x + PATCH], number))
        both /= 255
        return both[0], both[1]

    return batch


def with_noise(clean: Batch, noise: Noise) -> Batch:
    """Return a source of the same ground truth with other noise, a function of clean patches."""

    def batch(generator: torch.Generator) -> tuple[Tensor, Tensor]:
        _, truth = clean(generator)
        return noise(truth, generator), truth

    return batch


def gaussian(low: float, high: float) -> Noise:
    """Return independent Gaussian noise; each patch draws a sigma from a range, in levels."""

    def noise(clean: Tensor, generator: torch.Generator) -> Tensor:
        share = torch.rand(len(clean), 1, 1, 1, generator=generator)
        normals = torch.randn(clean.shape, generator=generator)
        return clean + normals * (low + (high - low) * share) / 255

    return noise


def random_below(count: int, generator: torch.Generator) -> int:
    """Draw a whole number from 0 to count - 1."""
    return int(torch.randint(count, (1,), generator=generator))
