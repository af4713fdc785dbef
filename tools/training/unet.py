"""A small denoising network with three levels of resolution."""

from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn import functional

WIDTHS = (16, 32, 64)  # channels at each level
MULTIPLE = 2 ** (len(WIDTHS) - 1)
SCALE = 16  # noise is a few hundredths; networks learn faster from numbers near 1


class UNet(nn.Module):
    """A U-Net (Ronneberger et al., 2015) of three levels that predicts noise and subtracts it."""

    def __init__(self, channels: int):
        super().__init__()
        self.down = nn.ModuleList(_block(*ends) for ends in pairwise([channels, *WIDTHS]))
        self.up = nn.ModuleList(_block(fine + coarse, fine) for fine, coarse in pairwise(WIDTHS))
        self.last = nn.Conv2d(WIDTHS[0], channels, 1)
        nn.init.zeros_(self.last.weight)  # initially the identity
        assert self.last.bias is not None
        nn.init.zeros_(self.last.bias)
        self.to(memory_format=torch.channels_last)  # twice as fast on a CPU

    def forward(self, noisy: Tensor) -> Tensor:
        """Denoise images, (n, channels, h, w); h and w are multiples of MULTIPLE."""
        x = ((noisy - 0.5) * SCALE).contiguous(memory_format=torch.channels_last)
        levels = [self.down[0](x)]
        for down in self.down[1:]:
            levels.append(down(functional.max_pool2d(levels[-1], 2)))
        x = levels.pop()
        for up in reversed(self.up):
            x = up(torch.cat([functional.interpolate(x, scale_factor=2), levels.pop()], 1))
        return noisy - self.last(x) / SCALE


def _block(inputs: int, outputs: int) -> nn.Module:
    first = nn.Conv2d(inputs, outputs, 3, padding=1)
    second = nn.Conv2d(outputs, outputs, 3, padding=1)
    return nn.Sequential(first, nn.ReLU(), second, nn.ReLU())
