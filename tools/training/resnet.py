"""A small denoising network of residual blocks, with one level of resolution."""

import torch
from torch import Tensor, nn
from torch.nn import functional

from tools.training.unet import SCALE

WIDTH, BLOCKS = 44, 3  # channels, residual blocks: nearly as many parameters as the U-Net
FOLD = 2  # px; blocks of 2x2 become channels, which takes a quarter of the time


class ResNet(nn.Module):
    """A chain of residual blocks that predicts noise and subtracts it.

    It folds pixels into channels like FFDNet (Zhang et al., 2018). Its blocks have no batch
    normalization, like those of EDSR (Lim et al., 2017).
    """

    def __init__(self, channels: int):
        super().__init__()
        folded = channels * FOLD**2
        self.first = nn.Conv2d(folded, WIDTH, 3, padding=1)
        self.blocks = nn.ModuleList(_block() for _ in range(BLOCKS))
        self.last = nn.Conv2d(WIDTH, folded, 3, padding=1)
        nn.init.zeros_(self.last.weight)  # initially the identity
        assert self.last.bias is not None
        nn.init.zeros_(self.last.bias)
        self.to(memory_format=torch.channels_last)

    def forward(self, noisy: Tensor) -> Tensor:
        """Denoise images, (n, channels, h, w); h and w are multiples of FOLD."""
        x = functional.pixel_unshuffle((noisy - 0.5) * SCALE, FOLD)
        x = self.first(x.contiguous(memory_format=torch.channels_last))
        for block in self.blocks:
            x = x + block(x)
        return noisy - functional.pixel_shuffle(self.last(x), FOLD) / SCALE


def _block() -> nn.Module:
    first, second = (nn.Conv2d(WIDTH, WIDTH, 3, padding=1) for _ in range(2))
    return nn.Sequential(first, nn.ReLU(), second)
