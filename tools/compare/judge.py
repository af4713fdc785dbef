"""Whether noise can be told from a real camera's: a linear judge, distances, and the figures.

    sh tools/judge FOLDER [--config NAME]... [--json]

FOLDER has pairs of one camera picture and the mean of many of the same scene: NAME_real.png and
NAME_mean.png, where NAME without its last number is the camera. Each mean is put back into linear
light and developed again by a configuration, at the ISO at which its luma noise is as strong as the
picture's, so that both show the same scenes and places. In patches of 48x48 pixels 80 statistics
are taken that do not depend on how strong the noise is. A logistic regression is trained to tell
real from made on all cameras but one, and tested on that one.

- AUC: 0.5 cannot tell, 1 always can. It saturates.
- Mahalanobis distance of the mean statistics, with the covariance of patches, without those of
  colour: as far as two cameras are apart is near enough.
- KLD of the histograms of noise, in nats: it is told by strength and tails alone.
"""

import argparse
import itertools
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from clpipe.analysis.matching.columns import (
    COLUMNS,
    MAX_LAG,
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
from tools.compare.telling import PATCH, Judged, distance, over_white, statistics, told

FEWEST = 4  # patches of a camera
COVERED = 0.6  # share of a patch that is flat, neither dark nor bright
CONFIGS = ("default", "nikon-d800-jpeg", "canon-5d3-jpeg")
SHOWN = ("sigma_12", "sigma_24", "sigma_40", "sigma_96", "sigma_128", "skew_shadows", "kurtosis")
SHOWN += ("right", "diagonal", "two_right", "right_3", "half", "chroma_right", "chroma_two_right")
SHOWN += ("red_green", "edges")
COARSE = 16  # px, of the means of chroma
CB_RIGHT, CR_COARSE = "Cb, 2 right", f"Cr after {COARSE}x{COARSE} means, over white noise's"
RELATIVE_TO = "sigma_64"
STEPS = 4  # of the search for an ISO


@dataclass(frozen=True)
class Pair:
    """A scene of one camera."""

    camera: str
    scene: Scene


def read_pairs(folder: Path) -> list[Pair]:
    """The pairs of a folder.

    Raises:
        SystemExit: there is none, or a picture has no mean.
    """
    found = []
    for real in sorted(folder.glob("*_real.png")):
        name = real.name.removesuffix("_real.png")
        mean = real.with_name(f"{name}_mean.png")
        if not mean.exists():
            raise SystemExit(f"{real} has no {mean.name} beside it")
        scenes = load_scenes([str(real)], [str(mean)])
        found += [Pair(name.rstrip("0123456789").rstrip("_"), scene) for scene in scenes.each]
    if not found:
        raise SystemExit(f"{folder}: no NAME_real.png with its NAME_mean.png")
    return found


def made_by(config: str, simulator: Simulator) -> Callable[[Scene], Noise]:
    """What a configuration makes of a scene, as strong as the real noise."""
    settings = load_settings(config)
    low, high = settings.isos().low, settings.isos().high
    output = settings.output
    written = JpegEncoding(output.jpeg_quality, output.jpeg_subsampling)

    def noise(scene: Scene) -> Noise:
        scene = replace(scene, jpeg=scene.jpeg or written)
        target = target_of(scene)
        iso = float(np.sqrt(low * high))
        for _ in range(STEPS):
            own = simulator.noise(overlay(settings, {"iso": iso}), scene, "iso", 1)
            ratio = target.figures["rms"] / figures_of(own, target.places)["rms"]
            iso = float(np.clip(iso * ratio**2, low, high))
        return simulator.noise(overlay(settings, {"iso": iso}), scene, "judged", 1)

    return noise


def iid(scene: Scene) -> Noise:
    """Independent Gaussian noise of the real noise's variance in each channel."""
    own = scene.noise
    mask = scene.flat
    sigma = own.rgb[:, mask].std((0, 1))
    normals = np.random.default_rng(0).normal(size=own.rgb[:1].shape)
    return Noise(normals * sigma, own.level)


def intensity_dependent(scene: Scene) -> Noise:
    """The same, of its variance at each luma."""
    own, mask = scene.noise, scene.flat
    bins = (own.level // 16).astype(int)
    sigma = np.zeros((17, 3))
    for number in range(17):
        at = mask & (bins == number)
        sigma[number] = own.rgb[:, at].std((0, 1)) if at.sum() > 200 else np.nan
    for channel in sigma.T:
        known = ~np.isnan(channel)
        channel[:] = np.interp(np.arange(17), np.flatnonzero(known), channel[known])
    normals = np.random.default_rng(0).normal(size=own.rgb[:1].shape)
    return Noise(normals * sigma[bins], own.level)


def patches_of(noise: Noise, scene: Scene) -> Iterator[tuple[Doubles, Doubles]]:
    """The patches that are flat: noise (48, 48, 3) and luma (48, 48)."""
    bright = scene.flat & (noise.level >= 30)
    height, width = bright.shape
    for y in range(0, height - PATCH + 1, PATCH):
        for x in range(0, width - PATCH + 1, PATCH):
            at = np.s_[y : y + PATCH, x : x + PATCH]
            if bright[at].mean() >= COVERED:
                yield noise.rgb[0][at], noise.level[at]


def judged(
    pairs: Sequence[Pair], noise_of: Callable[[Scene], Noise]
) -> tuple[Judged, dict[str, list[Noise]], list[str]]:
    """The statistics of all patches by camera, the noise that they are of, and their names."""
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
    return {camera: np.array(own) for camera, own in rows.items()}, noises, names


def divergence(real: Sequence[Noise], made: Sequence[Noise], pairs: Sequence[Pair]) -> float:
    """The KLD of the histograms of noise in levels, of red, green and blue together, in nats."""
    edges = np.arange(-60.5, 61.5)
    counts = []
    for noises in (real, made):
        masks = [p.scene.flat for p in pairs]
        values = np.concatenate([n.rgb[0][m].ravel() for n, m in zip(noises, masks, strict=True)])
        counts.append(np.histogram(np.clip(values, -60, 60), edges)[0] + 0.5)
    p, q = (count / count.sum() for count in counts)
    return float((p * np.log(p / q)).sum())


def shown(noises: Sequence[Noise], pairs: Sequence[Pair]) -> dict[str, float]:
    """The plain figures of noise: medians over pictures; sigma by luma is over that at 64 to 95."""
    rows = []
    for noise, pair in zip(noises, pairs, strict=True):
        places = pair.scene.places()
        figures = figures_of(noise, places)
        middle = figures[RELATIVE_TO]
        rows.append([figures[n] / middle if n.startswith("sigma") else figures[n] for n in SHOWN])
        _, cb, cr = noise.planes
        rows[-1].append(float(autocorrelation(cb, places)[MAX_LAG, MAX_LAG + 2]))
        rows[-1].append(over_white(cr, places.bright, COARSE))
    with np.errstate(all="ignore"):
        medians = [
            np.nan if np.isnan(c).all() else float(np.nanmedian(c)) for c in np.array(rows).T
        ]
    return dict(zip((*SHOWN, CB_RIGHT, CR_COARSE), medians, strict=True))


def report(folder: Path, configs: Sequence[str]) -> dict[str, Any]:
    """All that is found, as JSON values."""
    pairs = read_pairs(folder)
    cameras = {name: [p for p in pairs if p.camera == name] for name in (p.camera for p in pairs)}
    simulator = Simulator(open_device(None))
    ways = {config: made_by(config, simulator) for config in configs}
    ways |= {"iid": iid, "intensity-dependent": intensity_dependent}
    real, of_real, names = judged(pairs, lambda scene: scene.noise)
    if bare := [name for name in cameras if len(real.get(name, ())) < FEWEST]:
        raise SystemExit(f"{bare[0]}: fewer than {FEWEST} patches of {PATCH} px that are flat")
    kept = [k for k, name in enumerate(names) if not name.startswith("colour")]
    figures = {f"real {name}": shown(of_real[name], own) for name, own in cameras.items()}
    found: dict[str, dict[str, Any]] = {}
    for way, noise_of in ways.items():
        made, of_made, _ = judged(pairs, noise_of)
        for camera, own in cameras.items():
            gap = (made[camera].mean(0) - real[camera].mean(0)) / (real[camera].std(0) + 1e-9)
            found.setdefault(way, {})[camera] = {
                "auc": told(real, made, camera),
                "distance": distance(real[camera], made[camera], kept),
                "kld": divergence(of_real[camera], of_made[camera], own),
                "telling": {names[k]: float(gap[k]) for k in np.argsort(-abs(gap))[:5]},
            }
            figures[f"{way}, as {camera}"] = shown(of_made[camera], own)
    apart = {
        f"{one} and {two}": distance(real[one], real[two], kept)
        for one, two in itertools.combinations(cameras, 2)
    }
    return {
        "pictures": {name: len(own) for name, own in cameras.items()},
        "patches": {name: len(real[name]) for name in cameras},
        "statistics": len(names),
        "between_cameras": apart,
        "judged": found,
        "figures": figures,
    }


def table(found: Mapping[str, Any]) -> str:
    """The report for people."""
    counts = zip(found["pictures"].items(), found["patches"].values(), strict=True)
    lines = [f"{name}: {n} pictures, {patches} patches" for (name, n), patches in counts]
    lines += [f"{between}: {d:.1f} apart" for between, d in found["between_cameras"].items()]
    lines += ["", f"{'':24}{'camera':18}{'AUC':>6}{'distance':>10}{'KLD':>7}  tells most, sigmas"]
    for name, own in found["judged"].items():
        for camera, one in own.items():
            telling = ", ".join(f"{key} {gap:+.1f}" for key, gap in one["telling"].items())
            numbers = f"{one['auc']:6.2f}{one['distance']:10.1f}{one['kld']:7.3f}"
            lines.append(f"{name:24}{camera:18}{numbers}  {telling}")
    lines.append("")
    for key in (*SHOWN, CB_RIGHT, CR_COARSE):
        over = f", over that at {RELATIVE_TO[6:]}" if key.startswith("sigma") else ""
        text = COLUMNS[key].text.removesuffix(", levels") if key in COLUMNS else key
        lines.append(f"{text}{over}")
        lines += [f"    {name:40}{own[key]:8.2f}" for name, own in found["figures"].items()]
    return "\n".join(lines)


def main() -> None:
    """Read the command line, judge, print."""
    formatter = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=formatter)
    parser.add_argument("folder", type=Path, metavar="FOLDER")
    text = "A configuration to judge; may be repeated."
    parser.add_argument("--config", action="append", help=text)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    found = report(options.folder, options.config or CONFIGS)
    print(json.dumps(found, indent=2) if options.json else table(found))


if __name__ == "__main__":
    main()
