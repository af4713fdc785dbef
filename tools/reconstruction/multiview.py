"""Points from all views at once, by PMVS2, a program that you build.

PMVS2 implements Furukawa and Ponce 2010 ("Accurate, dense, and robust multiview stereopsis"). Small
patches grow from features. PMVS2 keeps patches whose textures correlate by more than a threshold in
enough views. For its file formats, see https://www.di.ens.fr/pmvs/documentation.html.
"""

import re
import subprocess
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image

from clpipe.base.types import Array, Doubles, Mask
from tools.reconstruction.views import SAME, View

THRESHOLDS = (0.7, 0.9)  # of PMVS2's correlation: the default, and one for fewer, safer points
# The other values are PMVS2's defaults: a patch per 2x2 pixels, windows of 7x7, at least 3 views.
OPTIONS = """\
level {level}
csize 2
threshold {threshold}
wsize 7
minImageNum 3
CPU {threads}
setEdge 0
useBound 0
useVisData 0
sequence -1
maxAngle 10
quad 2.5
timages -1 0 {count}
oimages 0
"""
LIMIT = 3600  # s for each run


class ProgramError(Exception):
    """A program failed. The message names it and the reason."""


def run_pmvs(
    program: Path, folder: Path, views: Sequence[View], pictures: Sequence[Array], **options: float
) -> tuple[Doubles, Array]:
    """Run PMVS2 on all views.

    Args:
        program: the path of pmvs2.
        folder: a folder for its files, which is created.
        views: the cameras.
        pictures: the picture of each view, (height, width, 3) uint8.
        options: level (0 is full resolution, 1 is half), threshold, threads.

    Returns:
        The points, (n, 3) in m, and their colours, (n, 3) uint8.

    Raises:
        ProgramError: it fails.
    """
    for name in ("visualize", "txt", "models"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    middle = np.array(
        [[1, 0, -0.5], [0, 1, -0.5], [0, 0, 1]]
    )  # PMVS2's first pixel centre is (0, 0)
    for number, (view, picture) in enumerate(zip(views, pictures, strict=True)):
        Image.fromarray(picture).save(folder / "visualize" / f"{number:08d}.ppm")
        matrix = middle @ view.k @ np.column_stack([view.r, view.t])
        rows = "\n".join(" ".join(f"{value:.12g}" for value in row) for row in matrix)
        text = f"CONTOUR\n{rows}\n"
        (folder / "txt" / f"{number:08d}.txt").write_text(text, encoding="utf-8")
    text = OPTIONS.format(count=len(views), **options)
    (folder / "option").write_text(text, encoding="utf-8")
    run([str(program), f"{folder}/", "option"], folder)
    return read_ply(folder / "models" / "option.ply")


def run(command: list[str], folder: Path) -> None:
    """Run a program, and write its output to log.txt in the folder.

    Raises:
        ProgramError: the program cannot be started, fails, or takes too long.
    """
    log = folder / "log.txt"
    try:
        with log.open("w", encoding="utf-8") as file:
            status = subprocess.run(
                command, stdout=file, stderr=subprocess.STDOUT, check=False, timeout=LIMIT
            ).returncode
    except OSError as error:
        raise ProgramError(
            f"{command[0]}: {error.strerror}; give the path of the program"
        ) from None
    except subprocess.TimeoutExpired:
        raise ProgramError(f"{command[0]}: took more than {LIMIT} s; see {log}") from None
    if status:
        raise ProgramError(f"{command[0]}: ended with status {status}; see {log}")


def read_ply(path: Path) -> tuple[Doubles, Array]:
    """Read the points of PMVS2's PLY, (n, 3), and their colours, (n, 3) uint8.

    Raises:
        ProgramError: the file cannot be read, or has no coloured points.
    """
    try:
        head, _, body = path.read_text("utf-8").partition("end_header\n")
        fields = re.findall(r"^property \w+ (\w+)$", head, re.MULTILINE)
        table = np.array(body.split(), np.float64).reshape(-1, len(fields)).T
        columns = dict(zip(fields, table, strict=True))
        points = np.stack([columns[name] for name in "xyz"], axis=1)
        colours = [columns[f"diffuse_{name}"] for name in ("red", "green", "blue")]
        return points, np.stack(colours, axis=1).astype(np.uint8)
    except (OSError, ValueError, KeyError) as error:
        raise ProgramError(f"{path}: expected coloured points, found {error!r}") from None


def true_of(points: Doubles, views: Sequence[View]) -> tuple[Mask, Array]:
    """Check which points lie on a surface, with the best-matching view of each point.

    Args:
        points: (n, 3), m.
        views: views with known depth.

    Returns:
        For each point, whether its error is below :data:`views.SAME` of its
        depth, and the texture at its pixel (0 if no view sees it).
    """
    error, texture = np.full(len(points), np.inf), np.zeros(len(points), np.uint8)
    for view in views:
        projected = (points @ view.r.T + view.t) @ view.k.T
        depth = projected[:, 2]
        height, width = view.depth.shape
        with np.errstate(divide="ignore", invalid="ignore"):
            x, y = np.floor(projected[:, :2] / depth[:, None]).T
        inside = (depth > 0) & (x >= 0) & (x < width) & (y >= 0) & (y < height)
        at = np.where(inside, y, 0).astype(np.intp), np.where(inside, x, 0).astype(np.intp)
        own = np.where(inside, np.abs(view.depth[at] / np.where(inside, depth, 1) - 1), np.inf)
        texture = np.where(own < error, view.texture[at], texture)
        error = np.minimum(own, error)
    return error < SAME, texture
