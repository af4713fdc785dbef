"""Train small denoisers of raws with three noise models, and test them on raws of the fullest one.

    sh tools/run training train_on_raw RENDER... --test RENDER... [--camera NAME] [--iso LOW HIGH]

Renders become clean raws of a camera in dim light, noise is added while the network trains
(clpipe.torch.RawNoise), and both are brightened again. The same network (a U-Net of 118,000
parameters), steps and patches see

    full             all that the camera's profile knows: shot noise, tails of the read noise, rows,
                     rounding, clipping; but errors of the black level, which dark frames take off
    poisson-gaussian shot noise and Gaussian read noise, of the same variance
    iid              Gaussian noise, as strong in each patch

and then raws of renders that were held out, with the full noise. Real raw pairs are no part of it:
the table says what the parts are worth where a sensor has them. KLD is the divergence of the
histogram of noise in the dark from the full model's, in nats.
"""

import argparse
import json
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

import clpipe
from clpipe.dataset.arrays import packed
from clpipe.images.read import ReadOptions, read_source
from clpipe.stage import Kind
from clpipe.torch import RawNoise
from tools.training.figures import NOISY, scores, table
from tools.training.patches import BATCH, PATCH, Batch, below, turned
from tools.training.unet import denoised, train

REGIMES = ("full", "poisson-gaussian", "iid")
PLAIN = ("prnu", "defect_pixels", "dark_current", "random_telegraph", "dsnu")
PLAIN += ("dark_shading", "row_noise", "column_noise", "banding")
OFFSETS = ["black_level_error"]  # what dark frames take off, and no picture tells
DIMMED = (1 / 100, 1 / 10)  # share of the light of a good exposure
LIGHTS = (1 / 80, 1 / 30, 1 / 12)  # of test raws
TEST_SEED = 77  # of noise that no network has seen
BINS = np.linspace(-8, 8, 129)  # sigma of the full model's noise in the dark
NORMAL = {"method": "gaussian", "tukey_lambda": 0.14}  # the Tukey lambda that is nearly Gaussian


def clean_raws(paths: Sequence[Path], camera: str) -> list[Tensor]:
    """The planes of renders' mosaics without noise, (4, height, width), signal."""
    pipeline = clpipe.Pipeline(
        camera=camera, iso=1600, until="normalize", skip=["noise"], quantize={"bits": 16}
    )
    pattern = pipeline.chain.filter_array.pattern
    found = []
    for path in paths:
        pixels = read_source(path, Kind.RGB, ReadOptions()).pixels.astype(np.float32)
        mosaic = pipeline.process(pixels, path.name).image
        height, width = (side // 2 * 2 for side in mosaic.shape)
        found.append(torch.from_numpy(packed(mosaic[:height, :width], pattern)).clamp(0, 1))
    return found


def models(camera: str, iso: Sequence[float], seed: int) -> dict[str, Callable[[Tensor], Tensor]]:
    """The noise of each regime, to be put on a batch of planes."""
    drawn = {"log_uniform": list(iso)}
    full = RawNoise(camera, drawn, seed=seed, skip=OFFSETS)
    plain = RawNoise(camera, drawn, seed=seed, skip=[*OFFSETS, *PLAIN], sensor_noise=NORMAL)
    random = torch.Generator().manual_seed(seed)

    def iid(clean: Tensor) -> Tensor:
        sigma = (full(clean) - clean).square().mean((1, 2, 3), keepdim=True).sqrt()
        return clean + sigma * torch.randn(clean.shape, generator=random)

    return {"full": full, "poisson-gaussian": plain, "iid": iid}


def divergence(noise: Tensor, of_full: Tensor) -> float:
    """The KLD of a histogram of noise from the full model's, nats."""
    sigma = float(of_full.std())
    counts = [
        np.histogram((values / sigma).clamp(-7.99, 7.99).numpy(), BINS)[0] + 0.5
        for values in (of_full, noise)
    ]
    p, q = (count / count.sum() for count in counts)
    return float((p * np.log(p / q)).sum())


def main() -> None:
    """Train, compare, and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("renders", nargs="+", type=Path, metavar="RENDER")
    parser.add_argument("--test", nargs="+", type=Path, required=True, metavar="RENDER")
    parser.add_argument("--camera", default="sony-a7s2", help="[sony-a7s2]")
    parser.add_argument(
        "--iso", nargs=2, type=float, default=(1600, 25600), metavar=("LOW", "HIGH")
    )
    parser.add_argument("--steps", type=int, default=2000, help="of training [2000]")
    parser.add_argument("--seeds", type=int, default=2, help="how often it is trained [2]")
    parser.add_argument("-o", "--output", type=Path, default=Path("raw.json"), help="[raw.json]")
    given = parser.parse_args()
    for path in given.test:
        if path.resolve() in [each.resolve() for each in given.renders]:
            parser.error(f"--test: {path} is trained on; hold it out")
    clean, held_out = (clean_raws(each, given.camera) for each in (given.renders, given.test))
    tests, truths = [], [raw for raw in held_out for _ in LIGHTS]
    drawn = {"log_uniform": list(given.iso)}
    test_noise = RawNoise(given.camera, drawn, seed=TEST_SEED, skip=OFFSETS)
    for number, raw in enumerate(held_out):
        for light in LIGHTS:
            tests.append(test_noise(raw * light, f"{number} {light:.4f}") / light)
    dark = torch.zeros(64, 4, PATCH, PATCH)
    kept = models(given.camera, given.iso, TEST_SEED)
    of_full = kept["full"](dark)
    found = {NOISY: scores([[noisy.clamp(0, 1) for noisy in tests]], truths)}
    for regime in REGIMES:
        began, of_seeds = time.monotonic(), []
        for seed in range(1, given.seeds + 1):
            batch = batches(clean, models(given.camera, given.iso, seed)[regime])
            network = train(batch, len(clean[0]), given.steps, seed)
            of_seeds.append([denoised(network, noisy) for noisy in tests])
        found[regime] = scores(of_seeds, truths)
        told = f"{found[regime].psnr.mean():.2f} dB, {time.monotonic() - began:.0f} s"
        print(f"{regime}: {told}", flush=True)
    klds = {regime: f"{divergence(noise(dark), of_full):.4f}" for regime, noise in kept.items()}
    print(f"\n{table(found, {'KLD': klds})}")
    report = {regime: score.record() for regime, score in found.items()}
    given.output.write_text(json.dumps(report, indent=2), "utf-8")


def batches(clean: Sequence[Tensor], noise: Callable[[Tensor], Tensor]) -> Batch:
    """Batches of patches in dim light, brightened again, and their truth."""
    low, high = np.log(DIMMED)

    def batch(drawn: torch.Generator) -> tuple[Tensor, Tensor]:
        patches = torch.empty(BATCH, 4, PATCH, PATCH)
        for patch in patches:
            raw = clean[below(len(clean), drawn)]
            y, x = (below(side - PATCH + 1, drawn) for side in raw.shape[1:])
            patch.copy_(turned(raw[:, y : y + PATCH, x : x + PATCH], below(8, drawn)))
        light = torch.exp(low + (high - low) * torch.rand(BATCH, 1, 1, 1, generator=drawn))
        return noise(patches * light) / light, patches

    return batch


if __name__ == "__main__":
    try:
        main()
    except (clpipe.ClpipeError, OSError) as error:
        sys.exit(f"error: {error}")
