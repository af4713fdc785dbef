"""Points from all views at once, by programs that you build: PMVS2 and COLMAP's dense stereo.

PMVS2 implements Furukawa and Ponce 2010 ("Accurate, dense, and robust multiview stereopsis"). Small
patches grow from features. PMVS2 keeps patches whose textures correlate by more than a threshold in
enough views. For its file formats, see https://www.di.ens.fr/pmvs/documentation.html.
"""

import subprocess
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image

from clpipe.base.types import Array, Doubles, Mask
from clpipe.chain.rendition import NOISY
from clpipe.outputs.camera_formats import COLMAP, colmap
from clpipe.outputs.output_pictures import OutputPicture
from clpipe.reference.intrinsics import PINHOLE, Intrinsics
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
LIMIT = 3600  # s for each program
SOURCES = 3  # nearest other views for COLMAP's stereo


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


def write_colmap(folder: Path, views: Sequence[View], pictures: Sequence[Array]) -> None:
    """Write the inputs of COLMAP's dense stereo into a folder: images/ and sparse/0.

    Args:
        folder: a folder, which is created.
        views: the cameras.
        pictures: the picture of each view, (height, width, 3) uint8.
    """
    (folder / "images").mkdir(parents=True, exist_ok=True)
    (folder / COLMAP).mkdir(parents=True, exist_ok=True)
    output_pictures = []
    for view, picture in zip(views, pictures, strict=True):
        name = f"{view.name}.png"
        Image.fromarray(picture).save(folder / "images" / name)
        height, width = view.depth.shape
        fx, fy, cx, cy = view.k[0, 0], view.k[1, 1], view.k[0, 2], view.k[1, 2]
        camera = Intrinsics(width, height, fx, fy, cx, cy, PINHOLE, {})
        pose = tuple(map(tuple, view.r.tolist())), tuple(view.t.tolist())
        output_pictures.append(OutputPicture(name, NOISY, camera, pose))
    for name, text in colmap(output_pictures, output_pictures, {}).items():
        (folder / name).write_text(text, encoding="utf-8")


def run_colmap(
    program: Path, folder: Path, views: Sequence[View], pictures: Sequence[Array], half: bool
) -> tuple[Doubles, Array]:
    """Run COLMAP's dense stereo, which needs CUDA, on all views.

    COLMAP usually chooses partners and depth ranges from sparse points. There are none here, so
    the function sets both.

    Args:
        program: the path of colmap.
        folder: a folder for its files, which is created.
        views: the cameras, with depth.
        pictures: the picture of each view, (height, width, 3) uint8.
        half: whether to use half resolution.

    Returns:
        The fused points, (n, 3) in m, and their colours, (n, 3) uint8.

    Raises:
        ProgramError: it fails.
    """
    write_colmap(folder, views, pictures)
    dense = folder / "dense"
    size = str(max(views[0].depth.shape) // (1 + half))
    places = {"--image_path": folder / "images", "--input_path": folder / COLMAP}
    undistorted = {**places, "--output_path": dense, "--max_image_size": size}
    nearest = min(view.depth.min() for view in views)
    farthest = max(view.depth.max() for view in views)
    stereo = {
        "--workspace_path": dense,
        "--PatchMatchStereo.depth_min": nearest * (1 - SAME),
        "--PatchMatchStereo.depth_max": farthest * (1 + SAME),
    }
    fusion = {"--workspace_path": dense, "--output_path": dense / "fused.ply"}
    run([str(program), "image_undistorter", *words(undistorted)], folder)
    (dense / "stereo" / "patch-match.cfg").write_text(partners(views), encoding="utf-8")
    run([str(program), "patch_match_stereo", *words(stereo)], folder)
    run([str(program), "stereo_fusion", *words(fusion)], folder)
    return read_ply(dense / "fused.ply")


def words(options: dict[str, object]) -> list[str]:
    """Return options as words of a command."""
    return [str(word) for option in options.items() for word in option]


def partners(views: Sequence[View]) -> str:
    """Return COLMAP's patch-match.cfg with the nearest other views of each view."""
    places = np.array([-view.r.T @ view.t for view in views])
    lines = []
    for number, view in enumerate(views):
        near = np.argsort(np.linalg.norm(places - places[number], axis=1), kind="stable")
        names = ", ".join(f"{views[n].name}.png" for n in near[1 : SOURCES + 1])
        lines += [f"{view.name}.png", names]
    return "\n".join(lines) + "\n"


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
    """Read the points of a text or binary PLY, (n, 3), and their colours, (n, 3) uint8.

    Raises:
        ProgramError: the file cannot be read, or has no coloured points.
    """
    types = {"float": "<f4", "uchar": "u1", "double": "<f8", "int": "<i4"}
    try:
        head, _, body = path.read_bytes().partition(b"end_header\n")
        lines = [line.split() for line in head.decode().splitlines()]
        count = next(int(line[2]) for line in lines if line[:2] == ["element", "vertex"])
        fields = [(line[2], types[line[1]]) for line in lines if line[0] == "property"]
        if ["format", "ascii", "1.0"] in lines:
            table = np.array(body.split(), np.float64).reshape(count, len(fields))
            columns = dict(zip([name for name, _ in fields], table.T, strict=True))
        else:
            columns = np.frombuffer(body, fields, count)
        points = np.stack([columns[name] for name in "xyz"], axis=1).astype(np.float64)
        names = ["diffuse_red", "diffuse_green", "diffuse_blue"]
        names = names if names[0] in dict(fields) else ["red", "green", "blue"]
        return points, np.stack([columns[name] for name in names], axis=1).astype(np.uint8)
    except (OSError, ValueError, KeyError, StopIteration) as error:
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
