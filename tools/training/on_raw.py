"""Trains raw denoisers with three noise models, and tests them, for train_on_raw.py."""

import argparse
import json
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
from tools.training.networks import denoised, train
from tools.training.patches import BATCH, PATCH, Batch, augmented, random_below

REGIMES = ("full", "poisson-gaussian", "iid")
PLAIN = ("prnu", "defect_pixels", "dark_current", "random_telegraph", "dsnu")
PLAIN += ("dark_shading", "row_noise", "column_noise", "banding")
OFFSETS = ["black_level_error"]  # dark frames remove it, and pictures do not show it
DIMMED = (1 / 100, 1 / 10)  # range of light, relative to a normal exposure
LIGHTS = (1 / 80, 1 / 30, 1 / 12)  # light of test raws
TEST_SEED = 77  # for noise that training does not use
BINS = np.linspace(-8, 8, 129)  # in sigma of the full model's dark noise
NORMAL = {"method": "gaussian", "tukey_lambda": 0.14}  # this Tukey lambda is nearly Gaussian


def clean_raws(paths: Sequence[Path], camera: str) -> list[Tensor]:
    """Return the planes of noise-free mosaics, (4, height, width), as signal."""
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
    """Return a function for each regime that adds noise to a batch of planes."""
    drawn = {"log_uniform": list(iso)}
    full = RawNoise(camera, drawn, seed=seed, skip=OFFSETS)
    plain = RawNoise(camera, drawn, seed=seed, skip=[*OFFSETS, *PLAIN], sensor_noise=NORMAL)
    random = torch.Generator().manual_seed(seed)

    def iid(clean: Tensor) -> Tensor:
        sigma = (full(clean) - clean).square().mean((1, 2, 3), keepdim=True).sqrt()
        return clean + sigma * torch.randn(clean.shape, generator=random)

    return {"full": full, "poisson-gaussian": plain, "iid": iid}


def divergence(noise: Tensor, of_full: Tensor) -> float:
    """Return the KLD of a histogram of noise from the full model's, in nats."""
    sigma = float(of_full.std())
    counts = [
        np.histogram((values / sigma).clamp(-7.99, 7.99).numpy(), BINS)[0] + 0.5
        for values in (of_full, noise)
    ]
    p, q = (count / count.sum() for count in counts)
    return float((p * np.log(p / q)).sum())


def run(options: argparse.Namespace) -> None:
    """Train, compare, and print the table.

    Raises:
        ClpipeError: a render cannot be read.
    """
    clean, held_out = (clean_raws(each, options.camera) for each in (options.renders, options.test))
    tests, truths = [], [raw for raw in held_out for _ in LIGHTS]
    drawn = {"log_uniform": list(options.iso)}
    test_noise = RawNoise(options.camera, drawn, seed=TEST_SEED, skip=OFFSETS)
    for number, raw in enumerate(held_out):
        for light in LIGHTS:
            tests.append(test_noise(raw * light, f"{number} {light:.4f}") / light)
    dark = torch.zeros(64, 4, PATCH, PATCH)
    kept = models(options.camera, options.iso, TEST_SEED)
    of_full = kept["full"](dark)
    found = {NOISY: scores([[noisy.clamp(0, 1) for noisy in tests]], truths)}
    for regime in REGIMES:
        start, of_seeds = time.monotonic(), []
        for seed in range(1, options.seeds + 1):
            batch = batches(clean, models(options.camera, options.iso, seed)[regime])
            network = train(batch, len(clean[0]), options.steps, seed)
            of_seeds.append([denoised(network, noisy) for noisy in tests])
        found[regime] = scores(of_seeds, truths)
        seconds = time.monotonic() - start
        print(f"{regime}: {found[regime].psnr.mean():.2f} dB, {seconds:.0f} s", flush=True)
    klds = {regime: f"{divergence(noise(dark), of_full):.4f}" for regime, noise in kept.items()}
    print(f"\n{table(found, {'KLD': klds})}")
    report = {regime: score.record() for regime, score in found.items()}
    options.output.write_text(json.dumps(report, indent=2), "utf-8")


def batches(clean: Sequence[Tensor], noise: Callable[[Tensor], Tensor]) -> Batch:
    """Return a source of patches in dim light, brightened again, and their ground truth."""
    low, high = np.log(DIMMED)

    def batch(generator: torch.Generator) -> tuple[Tensor, Tensor]:
        patches = torch.empty(BATCH, 4, PATCH, PATCH)
        for patch in patches:
            raw = clean[random_below(len(clean), generator)]
            y, x = (random_below(side - PATCH + 1, generator) for side in raw.shape[1:])
            patch.copy_(augmented(raw[:, y : y + PATCH, x : x + PATCH], random_below(8, generator)))
        light = torch.exp(low + (high - low) * torch.rand(BATCH, 1, 1, 1, generator=generator))
        return noise(patches * light) / light, patches

    return batch
