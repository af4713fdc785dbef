"""The denoising networks, and their training."""

from collections.abc import Callable, Mapping

import torch
from torch import Tensor, nn
from torch.nn import functional

from tools.training.resnet import ResNet
from tools.training.unet import MULTIPLE, UNet

NETWORKS: Mapping[str, Callable[[int], nn.Module]] = {"unet": UNet, "resnet": ResNet}
RATE = 2e-3  # Adam's highest learning rate


def train(
    batch: Callable[[torch.Generator], tuple[Tensor, Tensor]],
    channels: int,
    steps: int,
    seed: int,
    loss_of: Callable[[Tensor, Tensor], Tensor] = functional.l1_loss,
    kind: str = "unet",
) -> nn.Module:
    """Train a network.

    Args:
        batch: returns noisy and clean images, (n, channels, h, w), from a random generator.
        channels: the channels of an image.
        steps: the number of batches.
        seed: the seed of the initial weights and the batches.
        loss_of: the loss, from denoised and clean images.
        kind: the network, one of NETWORKS.
    """
    torch.manual_seed(seed)
    generator = torch.Generator().manual_seed(seed)
    network = NETWORKS[kind](channels)
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
