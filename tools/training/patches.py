"""Where training patches come from: pictures with their truth, and noise on truth alone."""

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
    """A finished picture, (3, height, width), uint8."""
    with Image.open(path) as picture:
        pixels = np.array(picture.convert("RGB"))
    return torch.from_numpy(pixels).permute(2, 0, 1).contiguous()


def turned(patch: Tensor, number: int) -> Tensor:
    """A patch turned and mirrored in one of eight ways."""
    patch = patch.flip(-1) if number & 4 else patch
    return torch.rot90(patch, number & 3, (-2, -1))


def from_pairs(pairs: Sequence[tuple[Tensor, Tensor]]) -> Batch:
    """Batches of patches of pictures and their truths, (3, height, width) uint8 each."""

    def batch(drawn: torch.Generator) -> tuple[Tensor, Tensor]:
        both = torch.empty(2, BATCH, 3, PATCH, PATCH)
        for i in range(BATCH):
            noisy, clean = pairs[below(len(pairs), drawn)]
            y, x = (below(side - PATCH + 1, drawn) for side in clean.shape[1:])
            way = below(8, drawn)
            for to, image in zip(both[:, i], (noisy, clean), strict=True):
                to.copy_(turned(image[:, y : y + PATCH, x : x + PATCH], way))
        both /= 255
        return both[0], both[1]

    return batch


def with_noise(clean: Batch, noise: Noise) -> Batch:
    """Batches of the same truth with other noise, which is given the clean patches."""

    def batch(drawn: torch.Generator) -> tuple[Tensor, Tensor]:
        _, truth = clean(drawn)
        return noise(truth, drawn), truth

    return batch


def gaussian(low: float, high: float) -> Noise:
    """Independent Gaussian noise, of a sigma for each patch between two, in levels of 255."""

    def noise(clean: Tensor, drawn: torch.Generator) -> Tensor:
        share = torch.rand(len(clean), 1, 1, 1, generator=drawn)
        normals = torch.randn(clean.shape, generator=drawn)
        return clean + normals * (low + (high - low) * share) / 255

    return noise


def below(count: int, drawn: torch.Generator) -> int:
    """A number from 0 on, below another."""
    return int(torch.randint(count, (1,), generator=drawn))
