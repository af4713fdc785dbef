"""The kinds of picture in the experiment, and the commands of clpipe that make them."""

import os
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from PIL import Image

from clpipe.base.types import Array, Doubles
from tools.reconstruction.stereo import halved


class Kind(NamedTuple):
    """A kind of picture.

    Args:
        run: the run of clpipe that makes it, a key of :data:`RUNS`.
        ending: the end of the file's name, after the view's name.
        each_iso, each_seed: whether pictures differ by ISO and by seed.
    """

    run: str
    ending: str = ""
    each_iso: bool = True
    each_seed: bool = True


DEVELOPED, UNDENOISED = "developed", "undenoised"
RUNS = {
    DEVELOPED: ("--truth", "iid", "--truth", "intensity"),
    UNDENOISED: ("--skip", "denoise"),
}
CLEAN, DENOISED, CAMERA, IID = "clean", "clean, denoised", "camera", "IID"
HALF = "IID, equal after 2x2"
KINDS = {
    CLEAN: Kind(DEVELOPED, ".truth_clean", each_iso=False, each_seed=False),
    DENOISED: Kind(DEVELOPED, ".truth", each_seed=False),
    CAMERA: Kind(DEVELOPED),
    IID: Kind(DEVELOPED, ".iid"),
    "intensity": Kind(DEVELOPED, ".intensity"),
    HALF: Kind(DEVELOPED, ".truth_clean"),
    "camera, not denoised": Kind(UNDENOISED),
}


@dataclass(frozen=True)
class Pictures:
    """Pictures that clpipe develops of some views, with noise of several seeds.

    Args:
        out: the output directory, with files RUN/seedSEED/isoISO/NAME.png.
        names: the names of the views.
        isos: the ISOs in ascending order.
        seeds: the seeds of the noise.
    """

    out: Path
    names: Sequence[str]
    isos: Sequence[int]
    seeds: Sequence[int]

    def develop(self, data: Path, config: str) -> None:
        """Make all pictures, and keep those that are up to date.

        Args:
            data: the folder of the views.
            config: a configuration of clpipe.

        Raises:
            subprocess.CalledProcessError: clpipe failed, and printed the reason.
        """
        inputs = [str(data / f"{name}.exr") for name in self.names]
        for run, options in RUNS.items():
            for seed in self.seeds:
                folder = self.out / run / f"seed{seed}"
                command = [sys.executable, "-m", "clpipe", "run", *inputs, "-o", str(folder)]
                command += ["-c", config, "--iso", ",".join(map(str, self.isos)), *options]
                command += ["--seed", str(seed), "--format", "png", "--quiet"]
                command += ["--set", "output.png_compression=1"]
                subprocess.run(command, check=True, env=os.environ)

    def all(self) -> list[tuple[str, int, int]]:
        """Return each distinct combination of kind, ISO and seed, in the order of the kinds."""
        return [
            (name, iso, seed)
            for name, kind in KINDS.items()
            for iso in (self.isos if kind.each_iso else self.isos[:1])
            for seed in (self.seeds if kind.each_seed else self.seeds[:1])
        ]

    def read(self, name: str, iso: int, seed: int) -> list[Array]:
        """Read the pictures of all views, (height, width, 3) uint8.

        Raises:
            OSError: a picture cannot be read.
        """
        pictures = [self._read(KINDS[name], iso, seed, view) for view in self.names]
        if name != HALF:
            return pictures
        rng = np.random.default_rng((seed, iso))
        return [
            with_noise(picture, 2 * halved(noise).std((0, 1)), rng)
            for picture, noise in zip(pictures, self.noise(CAMERA, iso, seed), strict=True)
        ]

    def noise(self, name: str, iso: int, seed: int) -> list[Doubles]:
        """Return the noise of all views: pictures of a kind minus the same without noise."""
        basis = {CAMERA: DENOISED, IID: CLEAN}[name]
        noisy, clean = ([p.astype(float) for p in self.read(n, iso, seed)] for n in (name, basis))
        return [a - b for a, b in zip(noisy, clean, strict=True)]

    def _read(self, kind: Kind, iso: int, seed: int, view: str) -> Array:
        folder = self.out / kind.run / f"seed{seed}"
        if len(self.isos) > 1:  # clpipe makes a folder for each of several ISOs
            folder /= f"iso{iso}"
        with Image.open(folder / f"{view}{kind.ending}.png") as image:
            return np.asarray(image.convert("RGB"))


def with_noise(picture: Array, sigma: Doubles, rng: np.random.Generator) -> Array:
    """Add independent Gaussian noise to a uint8 picture, with a sigma in levels per channel."""
    noisy = picture + sigma * rng.standard_normal(picture.shape)
    return np.clip(np.rint(noisy), 0, 255).astype(np.uint8)


def energy_left(noise: Sequence[Doubles]) -> float:
    """Return the share of variance that averaging 2x2 leaves; 0.25 for independent noise."""
    left = np.mean([halved(each).var((0, 1)) for each in noise])
    return float(left / np.mean([each.var((0, 1)) for each in noise]))
