"""Compare what feature detectors find in real pictures and in pictures with modelled noise.

    sh tools/run compare matching FOLDER [--config NAME]... [--json]

FOLDER contains pairs of a camera's picture and the mean of many pictures of the same scene:
NAME_real.png and NAME_mean.png. The tool adds noise of several models to each mean:

- clpipe's noise for each configuration: the tool converts the mean to linear light and develops it
  at the ISO at which its luma noise is as strong as the picture's;
- independent Gaussian noise (iid), or with the picture's variance at each luma
  (intensity-dependent). Both are scaled to the picture's luma noise, because detectors see luma.

SIFT and ORB, with the default settings of OpenCV, detect keypoints in the mean and in each noisy
picture. The figures are:

- repeated: the share of the mean's keypoints that are detected again within 2 px;
- matched: the share of mutually nearest descriptors whose keypoints are within 2 px;
- error: the absolute difference from the same figure of the real picture, a mean over pictures. A
  good noise model has a small error.

It needs the extra "compare" (.venv/bin/pip install -e '.[compare]').
"""

import importlib.util
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from clpipe.analysis.matching.columns import Noise, figures_of
from clpipe.analysis.matching.scenes import Scene, load_scenes
from clpipe.analysis.matching.search import target_of
from clpipe.analysis.matching.simulation import Simulator
from clpipe.base.types import Array
from clpipe.chain.files import load_settings
from clpipe.chain.settings import overlay
from clpipe.engine.device import open_device
from clpipe.images.jpeg import JpegEncoding
from tools.shared.options import parser_of
from tools.shared.pairs import find_pairs

CONFIGS = ("default", "nikon-d800-jpeg", "canon-5d3-jpeg")
STEPS = 4  # iterations of the search for an ISO
RADIUS = 2.0  # px
REAL = "real"
DETECTORS = ("SIFT", "ORB")


class Matching(NamedTuple):
    """Shares of keypoints that are detected again, and of matches that are right, 0 to 1."""

    repeated: float
    matched: float


def strength(noise: Noise, scene: Scene) -> float:
    """Return the rms of luma noise in flat areas of a scene, in levels of 255."""
    return figures_of(noise, scene.places())["rms"]


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
        return simulator.noise(overlay(settings, {"iso": iso}), scene, "compared", 1)

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


def as_strong(noise_of: Callable[[Scene], Noise]) -> Callable[[Scene], Noise]:
    """Return a function whose noise is scaled to the luma strength of the real noise."""

    def scaled(scene: Scene) -> Noise:
        noise = noise_of(scene)
        return Noise(noise.rgb * strength(scene.noise, scene) / strength(noise, scene), noise.level)

    return scaled


def grey(picture: Array) -> Array:
    """Return the luma of a picture, (height, width, 3) from 0 to 255, rounded to uint8."""
    import cv2

    return cv2.cvtColor(np.rint(picture).clip(0, 255).astype(np.uint8), cv2.COLOR_RGB2GRAY)


def compared(detector: str, clean: Array, noisy: Array) -> Matching:
    """Compare the keypoints of two grey pictures of a scene, (height, width) uint8.

    Raises:
        SystemExit: the clean picture has no keypoint.
    """
    import cv2

    found, norm = {
        "SIFT": (cv2.SIFT_create(), cv2.NORM_L2),
        "ORB": (cv2.ORB_create(), cv2.NORM_HAMMING),
    }[detector]
    (first, described), (second, described_again) = (
        found.detectAndCompute(picture, None) for picture in (clean, noisy)
    )
    if not first:
        raise SystemExit(
            f"error: {detector} detects nothing in a mean; use scenes with more detail"
        )
    if not second:
        return Matching(0.0, 0.0)
    places, places_again = (cv2.KeyPoint.convert(points) for points in (first, second))
    near = np.linalg.norm(places[:, None] - places_again, axis=2) <= RADIUS
    matches = cv2.BFMatcher(norm, crossCheck=True).match(described, described_again)
    right = [near[match.queryIdx, match.trainIdx] for match in matches]
    return Matching(float(near.any(1).mean()), float(np.mean(right)))


def report(folder: Path, configs: Sequence[str]) -> dict[str, Any]:
    """Return all results as JSON values."""
    pairs = find_pairs(folder)
    scenes = [load_scenes([str(each.real)], [str(each.mean)]).each[0] for each in pairs]
    simulator = Simulator(open_device(None))
    sources: dict[str, Callable[[Scene], Noise]] = {REAL: lambda scene: scene.noise}
    sources |= {config: simulated_by(config, simulator) for config in configs}
    sources |= {"iid": as_strong(iid), "intensity-dependent": as_strong(intensity_dependent)}
    models: dict[str, Any] = {}
    real = np.empty(0)
    for source, noise_of in sources.items():
        rows, levels = [], []
        for scene in scenes:
            noise = noise_of(scene)
            noisy = scene.frames[0] if source == REAL else scene.mean + noise.rgb[0]
            both = grey(scene.mean), grey(noisy)
            rows.append([compared(detector, *both) for detector in DETECTORS])
            levels.append(strength(noise, scene))
        figures = np.array(rows)  # (picture, detector, figure)
        real = figures if source == REAL else real
        models[source] = {"luma_rms": float(np.mean(levels))}
        for d, detector in enumerate(DETECTORS):
            for k, name in enumerate(Matching._fields):
                own = figures[:, d, k]
                error = float(abs(own - real[:, d, k]).mean())
                figure = {"mean": float(own.mean()), "error": error, "each": own.tolist()}
                models[source].setdefault(detector, {})[name] = figure
    return {"pictures": [scene.name for scene in scenes], "models": models}


def table(found: Mapping[str, Any]) -> str:
    """Format the report as text."""
    columns = [(detector, name) for detector in DETECTORS for name in Matching._fields]
    headings = "".join(f"{f'{d} {name}':>15}{'error':>8}" for d, name in columns)
    lines = [f"{len(found['pictures'])} pictures", "", f"{'noise':22}{'luma rms':>8}{headings}"]
    for source, own in found["models"].items():
        cells = ""
        for detector, name in columns:
            figure = own[detector][name]
            error = "" if source == REAL else f"{figure['error']:.3f}"
            cells += f"{figure['mean']:15.3f}{error:>8}"
        lines.append(f"{source:22}{own['luma_rms']:8.2f}{cells}")
    return "\n".join(lines)


def main() -> None:
    """Compare the noise models, and print the table."""
    parser = parser_of(__doc__)
    parser.add_argument("folder", type=Path, metavar="FOLDER")
    repeated = f"a configuration to compare; may be repeated [{', '.join(CONFIGS)}]"
    parser.add_argument("--config", action="append", help=repeated)
    parser.add_argument("--json", action="store_true", help="print JSON")
    options = parser.parse_args()
    if not importlib.util.find_spec("cv2"):
        parser.error("OpenCV is missing; .venv/bin/pip install -e '.[compare]'")
    found = report(options.folder, options.config or CONFIGS)
    print(json.dumps(found, indent=2) if options.json else table(found))


if __name__ == "__main__":
    main()
