"""Train small denoisers on made pictures, and see how well they denoise a real camera's.

    sh tools/train_on_real RENDER|PHOTO... --real FOLDER [-c LOOK]... [--iso LOW HIGH] [-o OUT]

Every regime gets the same network (a U-Net of 118,000 parameters, Ronneberger et al. 2015), steps,
batches (16 patches of 64x64) and content; what differs is the noise:

    clpipe     pictures that clpipe develops, and their development without noise
    awgn       Gaussian noise with a sigma of 0 to 55 levels on that development
    iid        Gaussian noise, for each picture as strong as clpipe's
    intensity  Gaussian noise, as strong as that of clpipe at each intensity
    test       Gaussian noise with a sigma of the test pictures' own: no one can know it
    real       the pictures of --pairs: another camera's real noise

FOLDER has pictures of a real camera and means of many of the same scene, NAME_real.png and
NAME_mean.png (or JPEG). RENDERs are linear (EXR); a PHOTO (PNG, JPEG) is first taken back to its
raw. A LOOK is a configuration, such as one of clpipe match; of several, each makes its share. --iso
draws the ISO between two; without it, a look has its own, halved to doubled where it is one number.
"""

import argparse
import json
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

import clpipe
from clpipe.camera.profile import load_camera
from clpipe.chain.files import load_settings
from clpipe.chain.settings import Settings
from tools.training.figures import NOISY, Score, draw_crops, scores, table
from tools.training.patches import Batch, from_pairs, gaussian, read, with_noise
from tools.training.real_pairs import find_pairs
from tools.training.unet import denoised, train

DRAWS = 6  # pictures of each render and look, each with another ISO
PHOTOS = (".png", ".jpg", ".jpeg")
WIDEST = (0.0, 55.0)  # levels, of awgn
USUAL_ISO = (1000.0, 6400.0)  # of a configuration that says none
CLPIPE = "clpipe"
REGIMES = ("clpipe", "awgn", "iid", "intensity", "test", "real")
USUAL = ("clpipe", "awgn", "iid")
BASELINES = ("iid", "intensity")  # as of --truth
SHOWN = 3  # scenes in the picture

Pairs = list[tuple[Tensor, Tensor]]  # pictures and their truths, (3, height, width) uint8


def main() -> None:
    """Train, compare, print, and draw."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("inputs", nargs="+", type=Path, metavar="RENDER|PHOTO")
    parser.add_argument("--real", nargs="+", type=Path, required=True, metavar="FOLDER")
    parser.add_argument("-c", "--config", action="append", metavar="LOOK", help="[training]")
    parser.add_argument("--iso", nargs=2, type=float, metavar=("LOW", "HIGH"))
    parser.add_argument("--pairs", nargs="+", type=Path, metavar="FOLDER", help="of regime real")
    parser.add_argument("--regimes", nargs="+", choices=REGIMES, default=list(USUAL))
    parser.add_argument("--steps", type=int, default=2000, help="of training [2000]")
    parser.add_argument("--seeds", type=int, default=2, help="how often it is trained [2]")
    parser.add_argument("-o", "--output", type=Path, default=Path("trained"), help="[trained]")
    given = parser.parse_args()
    if given.steps < 1 or given.seeds < 1:
        parser.error("--steps, --seeds: expected 1 or more")
    if ("real" in given.regimes) != bool(given.pairs):
        parser.error("--pairs FOLDER is what the regime real is trained on")
    pairs = [pair for folder in given.real for pair in find_pairs(folder)]
    trained_on = [path for folder in given.pairs or () for path in folder.glob("*")]
    for path in (*given.inputs, *trained_on):
        inside = [
            p for p in pairs if path.resolve() in (p.mean.resolve(), *p.mean.resolve().parents)
        ]
        if inside:
            parser.error(f"{path} is tested on ({inside[0].name}), so it cannot be trained on")
    given.output.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=given.output) as scratch:
        made = make_pairs(given, Path(scratch))
    tests = [(read(pair.real), read(pair.mean)) for pair in pairs]
    print(f"{len(made[CLPIPE])} pictures to train on, {len(tests)} real ones to test on")
    say_levels(made[CLPIPE], tests)
    noisy, truths = ([one[k] / 255 for one in tests] for k in (0, 1))
    found = {NOISY: scores([noisy], truths)}
    shown = {NOISY: noisy}
    for regime, batch in batches_of(given, made, tests):
        began, of_seeds = time.monotonic(), []
        for seed in range(1, given.seeds + 1):
            network = train(batch, 3, given.steps, seed)
            of_seeds.append([denoised(network, image) for image in noisy])
        found[regime], shown[regime] = scores(of_seeds, truths), of_seeds[0]
        told = f"{found[regime].psnr.mean():.2f} dB, {time.monotonic() - began:.0f} s"
        print(f"{regime}: {told}", flush=True)
    text = table(found, by_camera(found, [pair.camera for pair in pairs]))
    print(f"\n{text}\n")
    (given.output / "table.md").write_text(f"{text}\n", "utf-8")
    each = {regime: score.record() for regime, score in found.items()}
    report = {"pictures": [pair.name for pair in pairs], "steps": given.steps, "regimes": each}
    (given.output / "scores.json").write_text(json.dumps(report, indent=2), "utf-8")
    chosen = {pair.camera: number for number, pair in enumerate(pairs)}.values()
    rows = []
    for number in list(chosen)[:SHOWN]:
        row = [
            (f"{regime} {found[regime].psnr[0, number]:.2f} dB", images[number])
            for regime, images in shown.items()
        ]
        rows.append([*row, ("mean of many", truths[number])])
    draw_crops(rows, given.output / "crops.png")
    print(f"{given.output}: table.md, scores.json, crops.png")


def make_pairs(given: argparse.Namespace, folder: Path) -> Mapping[str, Pairs]:
    """Pictures and their truth, by regime, developed by clpipe as a user would."""
    photos = [str(p) for p in given.inputs if p.suffix.lower() in PHOTOS]
    renders = [str(p) for p in given.inputs if p.suffix.lower() not in PHOTOS]
    truths = ["development", *(r for r in BASELINES if r in given.regimes)]
    for number, look in enumerate(given.config or ["training"]):
        iso = iso_of(look, given.iso)
        for kind, inputs, config in (("r", renders, [look]), ("p", photos, ["unprocess", look])):
            for seed in range(DRAWS if inputs else 0):
                out = folder / f"{number}{kind}{seed}"
                both = ("jpg", "npy")  # a camera's picture is a JPEG; its truth is not
                run = clpipe.run(inputs, out, config, iso=iso, seed=seed, truth=truths, format=both)
                for outcome in run:
                    if outcome.error:
                        print(f"left out: {outcome.error}", file=sys.stderr)
    found: dict[str, Pairs] = {CLPIPE: [], **{regime: [] for regime in truths[1:]}}
    for path in sorted(folder.rglob("*.truth.npy")):
        name, clean = path.name.removesuffix(".truth.npy"), truth_in(path)
        found[CLPIPE].append((read(path.with_name(f"{name}.jpg")), clean))
        for regime in truths[1:]:
            noisy = read(path.with_name(f"{name}.{regime}.jpg"))
            found[regime].append((noisy, truth_in(path.with_name(f"{name}.truth_clean.npy"))))
    if not found[CLPIPE]:
        raise SystemExit("error: nothing to train on")
    return found


def truth_in(path: Path) -> Tensor:
    """A picture, (3, height, width) uint8, from a .npy file of display values from 0 to 1."""
    levels = np.rint(np.load(path).astype(np.float32) * 255)
    return torch.from_numpy(levels.astype(np.uint8)).permute(2, 0, 1).contiguous()


def iso_of(look: str, given: Sequence[float] | None) -> Mapping[str, Any]:
    """The law that the ISO of a look is drawn by."""
    settings = load_settings(look)
    if given:
        return {"log_uniform": list(given)}
    if "iso" in settings.draws:
        return settings.draws["iso"].record()
    if settings.iso == Settings().iso:
        return {"log_uniform": list(USUAL_ISO)}
    lowest, highest = load_camera(settings.camera).iso_range
    low, high = max(settings.iso / 2, lowest), min(settings.iso * 2, highest)
    return {"log_uniform": [low, high]}


def levels(pairs: Pairs) -> np.ndarray:
    """The sigma of the luma noise of each picture, in levels of 255."""
    weights = torch.tensor([0.299, 0.587, 0.114])[:, None, None]
    return np.array([float(((n.float() - c) * weights).sum(0).std()) for n, c in pairs])


def batches_of(
    given: argparse.Namespace, made: Mapping[str, Pairs], tests: Pairs
) -> Iterator[tuple[str, Batch]]:
    """The batches of each regime."""
    clean = from_pairs(made[CLPIPE])
    for regime in given.regimes:
        if regime == "awgn":
            yield regime, with_noise(clean, gaussian(*WIDEST))
        elif regime == "test":
            sigmas = [float((n.float() - c).std()) for n, c in tests]
            yield regime, with_noise(clean, gaussian(min(sigmas), max(sigmas)))
        elif regime == "real":
            real = [pair for folder in given.pairs for pair in find_pairs(folder)]
            yield regime, from_pairs([(read(pair.real), read(pair.mean)) for pair in real])
        else:
            yield regime, from_pairs(made[regime])


def say_levels(made: Pairs, tests: Pairs) -> None:
    """Print how strong the noise is, and warn where what is drawn misses what is tested."""
    low, high = np.percentile(levels(made), [5, 95])
    own = levels(tests)
    print(
        f"luma noise, levels: {low:.1f} to {high:.1f} in training, "
        f"{own.min():.1f} to {own.max():.1f} in the real pictures"
    )
    missed = int(((own < 0.8 * low) | (own > 1.25 * high)).sum())
    if missed:
        print(
            f"warning: {missed} of {len(own)} real pictures have less or more noise than what is "
            "trained on; set --iso LOW HIGH: noise grows with the root of the ISO",
            file=sys.stderr,
        )


def by_camera(found: Mapping[str, Score], cameras: Sequence[str]) -> dict[str, dict[str, str]]:
    """The mean PSNR of each camera's pictures, by regime."""
    columns = {}
    for camera in dict.fromkeys(cameras):
        own = np.array([each == camera for each in cameras])
        columns[f"{camera} ({own.sum()})"] = {
            regime: f"{score.psnr[:, own].mean():.2f}" for regime, score in found.items()
        }
    return columns


if __name__ == "__main__":
    try:
        main()
    except (clpipe.ClpipeError, OSError) as error:
        sys.exit(f"error: {error}")
