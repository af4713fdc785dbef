"""Measure how well a classifier separates clpipe's noise from that of real cameras.

    sh tools/judge FOLDER [--config NAME]... [--json]

FOLDER contains pairs of a camera's picture and the mean of many pictures of the same scene:
NAME_real.png and NAME_mean.png. NAME without its last number is the camera. The tool converts each
mean to linear light and develops it with a configuration. It chooses the ISO so that the luma noise
is as strong as in the picture. Both therefore show the same scene.

From patches of 48x48 pixels, the tool computes 80 statistics that do not depend on the strength of
the noise. A logistic regression learns to separate real from simulated patches on all cameras but
one, and is tested on that one. The figures are:

- AUC: 0.5 is chance, 1 is perfect separation. It saturates.
- Mahalanobis distance of the mean statistics, without those of colour, with the covariance of
  patches. The distance between two cameras is a good target.
- KLD of the histograms of noise, in nats. It depends only on strength and tails.
"""

import argparse
import itertools
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from clpipe.analysis.finished import relative, text_of
from clpipe.analysis.matching.columns import (
    CHROMA_SIGMA,
    COLUMNS,
    MAX_LAG,
    SKEWS,
    WEAK,
    Noise,
    autocorrelation,
    figures_of,
)
from clpipe.analysis.matching.scenes import Scene, load_scenes
from clpipe.analysis.matching.search import target_of
from clpipe.analysis.matching.simulation import Simulator
from clpipe.base.types import Doubles
from clpipe.chain.files import load_settings
from clpipe.chain.settings import overlay
from clpipe.engine.device import open_device
from clpipe.images.jpeg import JpegEncoding
from tools.compare.classifier import (
    PATCH,
    Statistics,
    distance,
    held_out_auc,
    over_white,
    statistics,
)
from tools.shared.options import parser_of
from tools.shared.pairs import find_pairs

FEWEST = 4  # patches of a camera
COVERED = 0.6  # lowest share of a patch that is flat, and neither dark nor bright
CONFIGS = ("default", "nikon-d800-jpeg", "canon-5d3-jpeg")
SHOWN = ("sigma_12", "sigma_24", "sigma_40", "sigma_96", "sigma_128", *SKEWS, "kurtosis")
SHOWN += (*(f"{CHROMA_SIGMA}_{low}" for low in (12, 24, 40, 96, 128)), WEAK)
SHOWN += ("right", "diagonal", "two_right", "right_3", "half", "chroma_right", "chroma_two_right")
SHOWN += ("red_green", "edges")
COARSE = 16  # px, side of the blocks for means of chroma
CB_RIGHT, CR_COARSE = "Cb, 2 right", f"Cr after {COARSE}x{COARSE} means, over white noise's"
STEPS = 4  # iterations of the search for an ISO


@dataclass(frozen=True)
class Pair:
    """A scene of one camera."""

    camera: str
    scene: Scene


def read_pairs(folder: Path) -> list[Pair]:
    """Read the pairs of a folder.

    Raises:
        SystemExit: the folder has no pair, or a picture has no mean.
    """
    return [
        Pair(each.camera, load_scenes([str(each.real)], [str(each.mean)]).each[0])
        for each in find_pairs(folder)
    ]


def simulated_by(config: str, simulator: Simulator) -> Callable[[Scene], Noise]:
    """Return a function that simulates a scene's noise, as strong as the real noise."""
    settings = load_settings(config)
    low, high = settings.isos().low, settings.isos().high
    output = settings.output
    written = JpegEncoding(output.jpeg_quality, output.jpeg_subsampling)

    def noise(scene: Scene) -> Noise:
        scene = replace(scene, jpeg=scene.jpeg or written)
        target = target_of(scene)
        iso = float(np.sqrt(low * high))
        for _ in range(STEPS):
            simulated = simulator.noise(overlay(settings, {"iso": iso}), scene, "iso", 1)
            ratio = target.figures["rms"] / figures_of(simulated, target.places)["rms"]
            iso = float(np.clip(iso * ratio**2, low, high))
        return simulator.noise(overlay(settings, {"iso": iso}), scene, "judged", 1)

    return noise


def iid(scene: Scene) -> Noise:
    """Return independent Gaussian noise with the real noise's variance in each channel."""
    real = scene.noise
    sigma = real.rgb[:, scene.flat].std((0, 1))
    normals = np.random.default_rng(0).normal(size=real.rgb[:1].shape)
    return Noise(normals * sigma, real.level)


def intensity_dependent(scene: Scene) -> Noise:
    """Return independent Gaussian noise with the real noise's variance at each luma."""
    real, mask = scene.noise, scene.flat
    bins = (real.level // 16).astype(int)
    sigma = np.zeros((17, 3))
    for number in range(17):
        at = mask & (bins == number)
        sigma[number] = real.rgb[:, at].std((0, 1)) if at.sum() > 200 else np.nan
    for channel in sigma.T:
        known = ~np.isnan(channel)
        channel[:] = np.interp(np.arange(17), np.flatnonzero(known), channel[known])
    normals = np.random.default_rng(0).normal(size=real.rgb[:1].shape)
    return Noise(normals * sigma[bins], real.level)


def patches_of(noise: Noise, scene: Scene) -> Iterator[tuple[Doubles, Doubles]]:
    """Yield the noise, (48, 48, 3), and luma, (48, 48), of flat patches."""
    bright = scene.flat & (noise.level >= 30)
    height, width = bright.shape
    for y in range(0, height - PATCH + 1, PATCH):
        for x in range(0, width - PATCH + 1, PATCH):
            at = np.s_[y : y + PATCH, x : x + PATCH]
            if bright[at].mean() >= COVERED:
                yield noise.rgb[0][at], noise.level[at]


def patch_statistics(
    pairs: Sequence[Pair], noise_of: Callable[[Scene], Noise]
) -> tuple[Statistics, dict[str, list[Noise]], list[str]]:
    """Return the statistics of all patches by camera, the noise by camera, and their names."""
    rows: dict[str, list[list[float]]] = {}
    noises: dict[str, list[Noise]] = {}
    names: list[str] = []
    for pair in pairs:
        noise = noise_of(pair.scene)
        noises.setdefault(pair.camera, []).append(noise)
        for patch, level in patches_of(noise, pair.scene):
            found = statistics(patch, level)
            names = list(found)
            rows.setdefault(pair.camera, []).append(list(found.values()))
    return {camera: np.array(table) for camera, table in rows.items()}, noises, names


def divergence(real: Sequence[Noise], made: Sequence[Noise], pairs: Sequence[Pair]) -> float:
    """Return the KLD of the histograms of noise, red, green and blue together, in nats."""
    edges = np.arange(-60.5, 61.5)
    counts = []
    for noises in (real, made):
        masks = [p.scene.flat for p in pairs]
        values = np.concatenate([n.rgb[0][m].ravel() for n, m in zip(noises, masks, strict=True)])
        counts.append(np.histogram(np.clip(values, -60, 60), edges)[0] + 0.5)
    p, q = (count / count.sum() for count in counts)
    return float((p * np.log(p / q)).sum())


def median_figures(noises: Sequence[Noise], pairs: Sequence[Pair]) -> dict[str, float]:
    """Return medians over pictures; noise by luma is relative to that at luma 64 to 95."""
    rows = []
    for noise, pair in zip(noises, pairs, strict=True):
        places = pair.scene.places()
        figures = relative(figures_of(noise, places))
        rows.append([figures[name] for name in SHOWN])
        _, cb, cr = noise.planes
        rows[-1].append(float(autocorrelation(cb, places)[MAX_LAG, MAX_LAG + 2]))
        rows[-1].append(over_white(cr, places.bright, COARSE))
    with np.errstate(all="ignore"):
        medians = [
            np.nan if np.isnan(c).all() else float(np.nanmedian(c)) for c in np.array(rows).T
        ]
    return dict(zip((*SHOWN, CB_RIGHT, CR_COARSE), medians, strict=True))


def report(folder: Path, configs: Sequence[str]) -> dict[str, Any]:
    """Return all results as JSON values."""
    pairs = read_pairs(folder)
    cameras = {name: [p for p in pairs if p.camera == name] for name in (p.camera for p in pairs)}
    simulator = Simulator(open_device(None))
    sources = {config: simulated_by(config, simulator) for config in configs}
    sources |= {"iid": iid, "intensity-dependent": intensity_dependent}
    real, of_real, names = patch_statistics(pairs, lambda scene: scene.noise)
    if lacking := [name for name in cameras if len(real.get(name, ())) < FEWEST]:
        raise SystemExit(f"{lacking[0]} has fewer than {FEWEST} flat patches of {PATCH} px")
    kept = [k for k, name in enumerate(names) if not name.startswith("colour")]
    figures = {f"real {name}": median_figures(of_real[name], p) for name, p in cameras.items()}
    found: dict[str, dict[str, Any]] = {}
    for source, noise_of in sources.items():
        made, of_made, _ = patch_statistics(pairs, noise_of)
        for camera, own_pairs in cameras.items():
            gap = (made[camera].mean(0) - real[camera].mean(0)) / (real[camera].std(0) + 1e-9)
            found.setdefault(source, {})[camera] = {
                "auc": held_out_auc(real, made, camera),
                "distance": distance(real[camera], made[camera], kept),
                "kld": divergence(of_real[camera], of_made[camera], own_pairs),
                "most_different": {names[k]: float(gap[k]) for k in np.argsort(-abs(gap))[:5]},
            }
            figures[f"{source}, as {camera}"] = median_figures(of_made[camera], own_pairs)
    distances = {
        f"{one} and {two}": distance(real[one], real[two], kept)
        for one, two in itertools.combinations(cameras, 2)
    }
    return {
        "pictures": {name: len(p) for name, p in cameras.items()},
        "patches": {name: len(real[name]) for name in cameras},
        "statistics": len(names),
        "between_cameras": distances,
        "judged": found,
        "figures": figures,
    }


def table(found: Mapping[str, Any]) -> str:
    """Format the report as text."""
    counts = zip(found["pictures"].items(), found["patches"].values(), strict=True)
    lines = [f"{name}: {n} pictures, {patches} patches" for (name, n), patches in counts]
    lines += [f"{cameras}: distance {d:.1f}" for cameras, d in found["between_cameras"].items()]
    lines += [
        "",
        f"{'':24}{'camera':18}{'AUC':>6}{'distance':>10}{'KLD':>7}  most different, sigmas",
    ]
    for name, scores in found["judged"].items():
        for camera, one in scores.items():
            gaps = ", ".join(f"{key} {gap:+.1f}" for key, gap in one["most_different"].items())
            numbers = f"{one['auc']:6.2f}{one['distance']:10.1f}{one['kld']:7.3f}"
            lines.append(f"{name:24}{camera:18}{numbers}  {gaps}")
    lines.append("")
    for key in (*SHOWN, CB_RIGHT, CR_COARSE):
        lines.append(text_of(key) if key in COLUMNS else key)
        lines += [f"    {name:40}{values[key]:8.2f}" for name, values in found["figures"].items()]
    return "\n".join(lines)


def options_of(documentation: str | None) -> argparse.Namespace:
    """Return the options of a tool that compares configurations with a folder of pairs."""
    parser = parser_of(documentation)
    parser.add_argument("folder", type=Path, metavar="FOLDER")
    repeated = f"a configuration to compare; may be repeated [{', '.join(CONFIGS)}]"
    parser.add_argument("--config", action="append", help=repeated)
    parser.add_argument("--json", action="store_true", help="print JSON")
    options = parser.parse_args()
    options.config = options.config or CONFIGS
    return options


def print_report(found: Any, text: Callable[[Any], str], options: argparse.Namespace) -> None:
    """Print results as JSON or as text."""
    print(json.dumps(found, indent=2) if options.json else text(found))


def main() -> None:
    """Compare the noise, and print the report."""
    options = options_of(__doc__)
    print_report(report(options.folder, options.config), table, options)


if __name__ == "__main__":
    main()
