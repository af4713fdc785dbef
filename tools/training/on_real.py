"""Trains denoisers on simulated pictures, and tests them on real ones, for train_on_real.py."""

import argparse
import json
import sys
import tempfile
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

import clpipe
from clpipe.camera.profile import load_camera
from clpipe.chain.files import load_settings
from clpipe.chain.settings import Settings
from tools.shared.pairs import RealPair, find_pairs
from tools.training.figures import NOISY, Score, draw_crops, joined, scores, table
from tools.training.networks import denoised, train
from tools.training.patches import Batch, from_pairs, gaussian, read, with_noise

DRAWS = 6  # pictures of each render and look, each with its own ISO
PHOTOS = (".png", ".jpg", ".jpeg")
WIDEST = (0.0, 55.0)  # levels; sigma of awgn
USUAL_ISO = (1000.0, 6400.0)  # for a configuration without an ISO
CLPIPE = "clpipe"
IID = "iid"  # a value of --truth, and a regime
SHOWN = 3  # scenes in crops.png

Pairs = list[tuple[Tensor, Tensor]]  # pictures and their truths, (3, height, width) uint8


def run(options: argparse.Namespace, pairs: Sequence[RealPair]) -> None:
    """Train, compare, print the table, and draw crops.

    Raises:
        ClpipeError: clpipe cannot develop the pictures.
        SystemExit: there are no pictures to train on.
    """
    options.output.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=options.output) as scratch:
        made = make_pairs(options, Path(scratch))
    tests = [(read(pair.real), read(pair.mean)) for pair in pairs]
    print(f"{len(made[CLPIPE])} pictures to train on, {len(tests)} real ones to test on")
    report_levels(made[CLPIPE], tests)
    found, shown = train_all(options, batches_of(options, made, tests), tests)
    cameras = [pair.camera for pair in pairs]
    text = joined({network: table(own, by_camera(own, cameras)) for network, own in found.items()})
    print(f"\n{text}\n")
    (options.output / "table.md").write_text(f"{text}\n", "utf-8")
    for network, own in found.items():
        each = {regime: score.record() for regime, score in own.items()}
        report = {"pictures": [pair.name for pair in pairs], "steps": options.steps}
        report |= {"network": network, "regimes": each}
        file = "scores.json" if len(found) == 1 else f"scores_{network}.json"
        (options.output / file).write_text(json.dumps(report, indent=2), "utf-8")
    chosen = {camera: number for number, camera in enumerate(cameras)}.values()
    rows = []
    for number in list(chosen)[:SHOWN]:
        row = [
            (f"{name} {score.psnr[0, number]:.2f} dB", images[number])
            for name, score, images in shown
        ]
        rows.append([*row, ("mean of many", tests[number][1] / 255)])
    draw_crops(rows, options.output / "crops.png")
    print(f"{options.output}: table.md, scores of each picture (JSON), crops.png")


def train_all(
    options: argparse.Namespace, batches: Iterable[tuple[str, Batch]], tests: Pairs
) -> tuple[dict[str, dict[str, Score]], list[tuple[str, Score, list[Tensor]]]]:
    """Train each network on each regime, and denoise the test pictures.

    Returns:
        the scores by network and regime, and for each row of the table its name, its scores and the
        pictures of the first seed. The noisy pictures come first.
    """
    noisy, truths = ([one[k] / 255 for one in tests] for k in (0, 1))
    unchanged = scores([noisy], truths)
    found = {network: {NOISY: unchanged} for network in options.network}
    shown = [(NOISY, unchanged, noisy)]
    for regime, batch in batches:
        for network, own in found.items():
            start, of_seeds = time.monotonic(), []
            for seed in range(1, options.seeds + 1):
                trained = train(batch, 3, options.steps, seed, kind=network)
                of_seeds.append([denoised(trained, image) for image in noisy])
            own[regime] = scores(of_seeds, truths)
            name = regime if len(found) == 1 else f"{network}, {regime}"
            shown.append((name, own[regime], of_seeds[0]))
            seconds = time.monotonic() - start
            print(f"{name}: {own[regime].psnr.mean():.2f} dB, {seconds:.0f} s", flush=True)
    return found, shown


def make_pairs(options: argparse.Namespace, folder: Path) -> Mapping[str, Pairs]:
    """Develop pictures and their ground truth with clpipe, by regime."""
    photos = [str(p) for p in options.inputs if p.suffix.lower() in PHOTOS]
    renders = [str(p) for p in options.inputs if p.suffix.lower() not in PHOTOS]
    truths = ["development", *(r for r in options.regimes if r == IID)]
    for number, look in enumerate(options.config or ["training"]):
        iso = iso_of(look, options.iso)
        for kind, inputs, config in (("r", renders, [look]), ("p", photos, ["unprocess", look])):
            for seed in range(DRAWS if inputs else 0):
                out = folder / f"{number}{kind}{seed}"
                both = ("jpg", "npy")  # a camera's picture is a JPEG; its truth is not
                run = clpipe.run(inputs, out, config, iso=iso, seed=seed, truth=truths, format=both)
                for outcome in run:
                    if outcome.error:
                        print(f"skipped: {outcome.error}", file=sys.stderr)
    found: dict[str, Pairs] = {CLPIPE: [], **{regime: [] for regime in truths[1:]}}
    for path in sorted(folder.rglob("*.truth.npy")):
        name, clean = path.name.removesuffix(".truth.npy"), truth_in(path)
        found[CLPIPE].append((read(path.with_name(f"{name}.jpg")), clean))
        for regime in truths[1:]:
            noisy = read(path.with_name(f"{name}.{regime}.jpg"))
            found[regime].append((noisy, truth_in(path.with_name(f"{name}.truth_clean.npy"))))
    if not found[CLPIPE]:
        raise SystemExit("error: clpipe developed no training pictures")
    return found


def truth_in(path: Path) -> Tensor:
    """Read a .npy file of display values, 0 to 1, as a picture, (3, height, width) uint8."""
    levels = np.rint(np.load(path).astype(np.float32) * 255)
    return torch.from_numpy(levels.astype(np.uint8)).permute(2, 0, 1).contiguous()


def iso_of(look: str, limits: Sequence[float] | None) -> Mapping[str, Any]:
    """Return the distribution of a look's ISO."""
    settings = load_settings(look)
    if limits:
        return {"log_uniform": list(limits)}
    if "iso" in settings.draws:
        return settings.draws["iso"].record()
    if settings.iso == Settings().iso:
        return {"log_uniform": list(USUAL_ISO)}
    lowest, highest = load_camera(settings.camera).iso_range
    low, high = max(settings.iso / 2, lowest), min(settings.iso * 2, highest)
    return {"log_uniform": [low, high]}


def levels(pairs: Pairs) -> np.ndarray:
    """Return the sigma of each picture's luma noise, in levels of 255."""
    weights = torch.tensor([0.299, 0.587, 0.114])[:, None, None]
    return np.array([float(((n.float() - c) * weights).sum(0).std()) for n, c in pairs])


def batches_of(
    options: argparse.Namespace, made: Mapping[str, Pairs], tests: Pairs
) -> Iterator[tuple[str, Batch]]:
    """Yield each regime with its source of batches."""
    clean = from_pairs(made[CLPIPE])
    for regime in options.regimes:
        if regime == "awgn":
            yield regime, with_noise(clean, gaussian(*WIDEST))
        elif regime == "real":
            real = [pair for folder in options.pairs for pair in find_pairs(folder)]
            yield regime, from_pairs([(read(pair.real), read(pair.mean)) for pair in real])
        else:
            yield regime, from_pairs(made[regime])


def report_levels(made: Pairs, tests: Pairs) -> None:
    """Print the strength of the noise, and warn if training does not cover the test pictures."""
    low, high = np.percentile(levels(made), [5, 95])
    tested = levels(tests)
    print(
        f"luma noise, levels: {low:.1f} to {high:.1f} in training, "
        f"{tested.min():.1f} to {tested.max():.1f} in the real pictures"
    )
    missed = int(((tested < 0.8 * low) | (tested > 1.25 * high)).sum())
    if missed:
        print(
            f"warning: {missed} of {len(tested)} real pictures have less or more noise than the "
            "training pictures; set --iso LOW HIGH. Noise grows with the square root of the ISO.",
            file=sys.stderr,
        )


def by_camera(found: Mapping[str, Score], cameras: Sequence[str]) -> dict[str, dict[str, str]]:
    """Return the mean PSNR of each camera's pictures, by regime."""
    columns = {}
    for camera in dict.fromkeys(cameras):
        own = np.array([each == camera for each in cameras])
        columns[f"{camera} ({own.sum()})"] = {
            regime: f"{score.psnr[:, own].mean():.2f}" for regime, score in found.items()
        }
    return columns
