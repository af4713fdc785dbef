"""A small denoising network, and its training."""

from collections.abc import Callable
from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn import functional

WIDTHS = (16, 32, 64)  # channels at each level
MULTIPLE = 2 ** (len(WIDTHS) - 1)
SCALE = 16  # noise is a few hundredths; networks learn faster from numbers near 1
RATE = 2e-3  # Adam's highest learning rate


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


def train(
    batch: Callable[[torch.Generator], tuple[Tensor, Tensor]],
    channels: int,
    steps: int,
    seed: int,
    loss_of: Callable[[Tensor, Tensor], Tensor] = functional.l1_loss,
) -> UNet:
    """Train a network.

    Args:
        batch: returns noisy and clean images, (n, channels, h, w), from a random generator.
        channels: the channels of an image.
        steps: the number of batches.
        seed: the seed of the initial weights and the batches.
        loss_of: the loss, from denoised and clean images.
    """
    torch.manual_seed(seed)
    generator = torch.Generator().manual_seed(seed)
    network = UNet(channels)
    optimizer = torch.optim.Adam(network.parameters())
    rate = torch.optim.lr_scheduler.OneCycleLR(optimizer, RATE, steps)
    for _ in range(steps):
        noisy, clean = batch(generator)
        loss = loss_of(network(noisy), clean)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        rate.step()
    return network


@torch.no_grad()
def denoised(network: nn.Module, noisy: Tensor) -> Tensor:
    """Denoise an image, (channels, height, width), of any size."""
    height, width = noisy.shape[-2:]
    edge = (0, -width % MULTIPLE, 0, -height % MULTIPLE)
    result: Tensor = network(functional.pad(noisy[None], edge, mode="replicate"))
    return result[0, :, :height, :width].clamp(0, 1)
