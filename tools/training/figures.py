"""Compares denoised pictures with their ground truth, in figures and crops."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from tools.shared.pictures import enlarged, sheet
from tools.shared.tables import markdown

CROP = 160  # px, side of a crop
SCALE = 2  # its enlargement
NOISY = "noisy"  # the pictures before denoising


@dataclass(frozen=True)
class Score:
    """PSNR in dB and SSIM of pictures, (seed, picture) each."""

    psnr: np.ndarray
    ssim: np.ndarray

    def record(self) -> dict[str, list[list[float]]]:
        """Return the scores as JSON values."""
        return {"psnr": self.psnr.tolist(), "ssim": self.ssim.tolist()}


def scores(images: Sequence[Sequence[Tensor]], truths: Sequence[Tensor]) -> Score:
    """Compute the scores of pictures for each seed."""
    each = [[(psnr(i, t), ssim(i, t)) for i, t in zip(own, truths, strict=True)] for own in images]
    return Score(*np.moveaxis(np.array(each), 2, 0))


def table(found: Mapping[str, Score], more: Mapping[str, Mapping[str, str]]) -> str:
    """Format scores as Markdown: means over pictures, by seed, and wins of the first regime.

    Args:
        found: scores by regime.
        more: further columns by heading, each by regime.
    """
    first = next(name for name in found if name != NOISY)
    headings = ["trained on", "PSNR, dB", "of each seed", "SSIM", f"{first} wins", *more]
    rows = []
    for regime, score in found.items():
        means = score.psnr.mean(0)
        wins = f"{(found[first].psnr.mean(0) > means).sum()} of {means.size}"
        seeds = "" if regime == NOISY else " ".join(f"{seed:.2f}" for seed in score.psnr.mean(1))
        cells = [regime, f"{means.mean():.2f}", seeds, f"{score.ssim.mean():.4f}"]
        cells.append("" if regime == first else wins)
        rows.append([*cells, *(column.get(regime, "") for column in more.values())])
    return markdown(headings, rows)


def joined(tables: Mapping[str, str]) -> str:
    """Join the tables of several networks, by name, into one with a column for the network."""
    if len(tables) == 1:
        return next(iter(tables.values()))
    lines: list[str] = []
    for network, text in tables.items():
        heading, rule, *rows = text.splitlines()
        lines = lines or [f"| network {heading}", f"|---{rule}"]
        lines += [f"| {network} {row}" for row in rows]
    return "\n".join(lines)


def psnr(image: Tensor, truth: Tensor) -> float:
    """Return the peak signal-to-noise ratio in dB, with a peak of 1."""
    return -10 * torch.log10((image - truth).square().mean()).item()


def ssim(image: Tensor, truth: Tensor) -> float:
    """Return the structural similarity (Wang et al., 2004; Gaussian window of 11 px), a mean."""
    offsets = torch.arange(-5, 6)
    row = torch.exp(-(offsets**2) / (2 * 1.5**2))
    window = (row[:, None] * row / row.sum() ** 2)[None, None]
    x, y = image[:, None], truth[:, None]
    mean_x, mean_y, xx, yy, xy = (functional.conv2d(v, window) for v in (x, y, x * x, y * y, x * y))
    xx, yy, xy = xx - mean_x**2, yy - mean_y**2, xy - mean_x * mean_y
    c1, c2 = 0.01**2, 0.03**2
    ratio = (2 * mean_x * mean_y + c1) * (2 * xy + c2)
    return (ratio / ((mean_x**2 + mean_y**2 + c1) * (xx + yy + c2))).mean().item()


def corner(truth: Tensor) -> tuple[int, int]:
    """Return row and column of the crop with the most detail."""
    luma = truth.mean(0)
    step = CROP // 2
    rows, columns = (range(0, max(side - CROP, 0) + 1, step) for side in luma.shape)
    places = [(y, x) for y in rows for x in columns]
    return max(places, key=lambda at: float(luma[at[0] : at[0] + CROP, at[1] : at[1] + CROP].std()))


def draw_crops(rows: Sequence[Sequence[tuple[str, Tensor]]], path: Path) -> None:
    """Write labelled crops of pictures side by side, with a row for each scene.

    Args:
        rows: labels and pictures of each scene, (3, height, width), 0 to 1. The last picture is the
            ground truth.
        path: the PNG.
    """
    cells = []
    for scene in rows:
        top, left = corner(scene[-1][1])
        row = []
        for label, image in scene:
            crop = image[:, top : top + CROP, left : left + CROP].clamp(0, 1)
            pixels = (crop * 255).round().byte().permute(1, 2, 0).numpy()
            row.append((label, enlarged(pixels, SCALE)))
        cells.append(row)
    sheet(cells).save(path)
