"""Train two small denoisers, one on a camera's noise and one on IID noise, and compare them.

    pip install torch
    python tools/examples/train_denoiser.py renders/ --test held_out.exr --iso 12800
    python tools/examples/train_denoiser.py renders/ -c canon-5d3-jpeg --real noisy.png mean.png

Both networks are the same U-Net (Ronneberger et al., 2015), begin with the same weights and see the
same patches. One gets them with the noise of clpipe's camera, the other with IID Gaussian noise of
the same variance over each batch. With --test they denoise raws, and are judged on that of a render
that was held out. With --real they denoise finished pictures, and are judged on one of a real
camera, whose truth is the mean of many of the same scene. A table and a picture of crops come out.
"""

import argparse
import copy
import sys
import time
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from torch import nn
from torch.nn import functional
from torch.utils.data import DataLoader

import clpipe

BATCH = 4  # small, for as many steps as there is time for
WIDTHS = (16, 32, 64)  # channels of the levels
MULTIPLE = 2 ** (len(WIDTHS) - 1)
SCALE = 16  # noise is a few hundredths, and networks learn faster from numbers near 1
CROP = 160  # px


class UNet(nn.Module):
    """A U-Net of three levels that finds noise in images of some channels, and takes it away."""

    def __init__(self, channels):
        super().__init__()
        self.down = nn.ModuleList(block(*ends) for ends in pairwise([channels, *WIDTHS]))
        self.up = nn.ModuleList(block(fine + coarse, fine) for fine, coarse in pairwise(WIDTHS))
        self.last = nn.Conv2d(WIDTHS[0], channels, 1)
        nn.init.zeros_(self.last.weight)  # it begins as the identity
        nn.init.zeros_(self.last.bias)
        self.to(memory_format=torch.channels_last)  # twice as fast on a CPU

    def forward(self, noisy):
        """Images without noise, (n, channels, h, w); h and w are multiples of MULTIPLE."""
        x = (noisy * SCALE).contiguous(memory_format=torch.channels_last)
        levels = [self.down[0](x)]
        for down in self.down[1:]:
            levels.append(down(functional.max_pool2d(levels[-1], 2)))
        x = levels.pop()
        for up in reversed(self.up):
            x = up(torch.cat([functional.interpolate(x, scale_factor=2), levels.pop()], 1))
        return noisy - self.last(x) / SCALE


def block(inputs, outputs):
    """Two convolutions."""
    first = nn.Conv2d(inputs, outputs, 3, padding=1)
    second = nn.Conv2d(outputs, outputs, 3, padding=1)
    return nn.Sequential(first, nn.ReLU(), second, nn.ReLU())


def iid(noisy, clean):
    """Clean patches with IID Gaussian noise, as much as there is in the noisy ones."""
    return clean + (noisy - clean).square().mean().sqrt() * torch.randn(clean.shape)


class Learner:
    """A network and what trains it for some steps."""

    def __init__(self, network, steps):
        self.network = network
        self.optimizer = torch.optim.Adam(network.parameters())
        self.rate = torch.optim.lr_scheduler.OneCycleLR(self.optimizer, 2e-3, steps)

    def learn(self, noisy, clean):
        """One step; the loss."""
        loss = functional.l1_loss(self.network(noisy), clean)
        self.optimizer.zero_grad()
        loss.backward()
        self.optimizer.step()
        self.rate.step()
        return loss.item()


def train(patches, names, channels, steps):
    """Two networks: trained on the noise that samples have, and on as much IID noise."""
    first = UNet(channels)
    camera, gaussian = (Learner(network, steps) for network in (first, copy.deepcopy(first)))
    loader = DataLoader(patches, batch_size=BATCH, shuffle=True, drop_last=True)
    began = time.monotonic()
    for step, sample in zip(range(1, steps + 1), loader, strict=False):
        noisy, clean = (sample[name] for name in names)
        losses = camera.learn(noisy, clean), gaussian.learn(iid(noisy, clean), clean)
        if step % 200 == 0 or step == steps:
            told = "clpipe {:.5f}, IID {:.5f}".format(*losses)
            print(f"step {step}, {time.monotonic() - began:.0f} s, loss: {told}", flush=True)
    return camera.network, gaussian.network


def denoised(network, image):
    """An image, (channel, height, width), as a network returns it."""
    height, width = image.shape[1:]
    padding = (0, -width % MULTIPLE, 0, -height % MULTIPLE)
    with torch.no_grad():
        made = network(functional.pad(image[None], padding, mode="replicate"))
    return made[0, :, :height, :width].clamp(0, 1)


def psnr(image, truth):
    """Peak signal-to-noise ratio in dB; 1 is the peak."""
    return -10 * torch.log10((image - truth).square().mean()).item()


def ssim(image, truth):
    """Structural similarity (Wang et al., 2004), Gaussian window of 11 px, mean over channels."""
    offsets = torch.arange(-5, 6)
    row = torch.exp(-(offsets**2) / (2 * 1.5**2))
    window = (row[:, None] * row / row.sum() ** 2)[None, None]
    x, y = image[:, None], truth[:, None]
    mean_x, mean_y, xx, yy, xy = (functional.conv2d(v, window) for v in (x, y, x * x, y * y, x * y))
    xx, yy, xy = xx - mean_x**2, yy - mean_y**2, xy - mean_x * mean_y
    c1, c2 = 0.01**2, 0.03**2
    ratio = (2 * mean_x * mean_y + c1) * (2 * xy + c2)
    return (ratio / ((mean_x**2 + mean_y**2 + c1) * (xx + yy + c2))).mean().item()


def for_display(image, gains):
    """A picture, or a raw as one of half the size and balanced; (3, height, width), 0 to 1."""
    if len(image) == 4:
        red, green, blue = image[0] * gains[0], (image[1] + image[2]) / 2, image[3] * gains[2]
        image = (torch.stack([red, green, blue]) / image.quantile(0.999)).clamp(0, 1) ** (1 / 2.2)
    return image.clamp(0, 1)


def read(path):
    """A finished picture, (3, height, width), 0 to 1."""
    with Image.open(path) as picture:
        return torch.from_numpy(np.array(picture.convert("RGB"))).permute(2, 0, 1) / 255


def held_in(picture, renders):
    """The file or folder of some that is a picture or has it, by what links lead to; or None."""
    real = picture.resolve()
    return next((each for each in renders if each.resolve() in (real, *real.parents)), None)


def main():
    """Train, compare, print, and draw."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("renders", nargs="+", help="files or folders to train on")
    judge = parser.add_mutually_exclusive_group(required=True)
    judge.add_argument("--test", metavar="RENDER", help="judge on a raw of it")
    judge.add_argument("--real", nargs=2, metavar=("NOISY", "MEAN"), help="judge on a picture")
    parser.add_argument("-c", "--config", help="configuration of clpipe")
    parser.add_argument("--camera")
    parser.add_argument("--iso", type=float)
    parser.add_argument("--steps", type=int, default=2000, help="of training [2000]")
    parser.add_argument("--size", type=int, default=96, help="of patches in px [96]")
    parser.add_argument("-o", "--output", default="denoised.png", help="[denoised.png]")
    given = parser.parse_args()
    if given.steps < 1:
        parser.error(f"--steps: found {given.steps}; expected 1 or more")
    if given.test and (place := held_in(Path(given.test), map(Path, given.renders))):
        parser.error(f"--test: {given.test} is in {place}, which is trained on; hold it out")

    torch.manual_seed(1)
    settings = {name: v for name in ("camera", "iso") if (v := getattr(given, name)) is not None}
    settings |= {"config": given.config, "dtype": "float32", "channels_first": True}
    if given.test:
        names, settings["truth"] = ("raw", "truth.raw"), "clean"
        settings |= {"raw": "packed", "until": "normalize"}
        (held_out,) = clpipe.Dataset(given.test, **settings)
        noisy, clean = (torch.from_numpy(held_out[name]) for name in names)
    else:
        # The mean of many pictures is as soft as each of them.
        names, settings["truth"] = ("image", "truth"), "development"
        held_out, (noisy, clean) = {"gains": None}, map(read, given.real)
        if noisy.shape != clean.shape:
            parser.error(f"--real: {' and '.join(given.real)} are not of one size")
    patches = clpipe.Dataset(
        given.renders,
        patch=clpipe.Patches(given.size, per_image=64, augment=True),
        epochs=given.steps,  # more than are needed
        **settings,
    )
    camera, gaussian = train(patches, names, len(clean), given.steps)
    images = {
        "noisy": noisy,
        "IID": denoised(gaussian, noisy),
        "clpipe": denoised(camera, noisy),
        "truth": clean,
    }
    print("        PSNR, dB    SSIM")
    for name in ("noisy", "IID", "clpipe"):
        print(f"{name:8}{psnr(images[name], clean):8.2f}{ssim(images[name], clean):8.4f}")
    top, left = (max(side - CROP, 0) // 2 for side in clean.shape[1:])
    crops = [i[:, top : top + CROP, left : left + CROP] for i in images.values()]
    shown = torch.cat([for_display(crop, held_out["gains"]) for crop in crops], 2)
    pixels = (shown * 255).round().byte().permute(1, 2, 0).numpy().repeat(2, 0).repeat(2, 1)
    Image.fromarray(pixels).save(given.output)
    print(f"{given.output}: crops of {', '.join(images)}")


if __name__ == "__main__":
    try:
        main()
    except (clpipe.ClpipeError, OSError) as error:
        sys.exit(f"error: {error}")
