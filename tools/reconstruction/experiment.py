"""Reconstruct a scene from six views, with the noise of a camera and with simpler noise, by ISO.

    tools/run reconstruction experiment -o OUT [--iso ISO ...] [--seeds N] [-c CONFIG] [--pmvs PATH]
        [--data FOLDER] [--render BLENDER]

It needs pip install '.[calibrate,compare]' in the checkout. It repeats the experiment of section
3.2 of the paper on a scene with known depth. The paper is by Bielova, Haensch, Ley and Hellwich
(CVPR Workshops 2019). See docs/reconstruction.md for the results.

clpipe develops each view in these ways (pictures.py):

- clean, and clean and denoised
- with the camera's noise, and with the camera's noise without denoising
- with independent noise of the same variance, uniform or by intensity, added to the clean picture
- with independent noise that has the camera's variance after averaging 2x2

OpenCV's semi-global matching finds the depth of neighbouring views at full and half resolution
(stereo.py). With --pmvs, PMVS2 also finds points in all views (multiview.py).

The tool prints tables, and writes them with the figures and pictures to OUT, as Markdown and CSV.
"""

import csv
import importlib.util
import itertools
import subprocess
import sys
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from functools import partial
from operator import attrgetter
from pathlib import Path

import numpy as np

from clpipe.base.errors import ClpipeError
from clpipe.base.processors import available_processors
from tools.reconstruction.multiview import THRESHOLDS, ProgramError, run_pmvs, true_of
from tools.reconstruction.pictures import CAMERA, CLEAN, HALF, IID, KINDS, Pictures, energy_left
from tools.reconstruction.report import (
    as_markdown,
    cloud_picture,
    costs_of,
    depth_picture,
    draw,
    points_of,
    table_of,
)
from tools.reconstruction.stereo import Pair, halved, pairs, score
from tools.reconstruction.views import TEXTURES, View, read_views, render_views
from tools.shared.options import count_of, parser_of
from tools.shared.pictures import sheet
from tools.shared.tables import markdown

DATA = Path(__file__).with_name("data")
NEEDED = ("cv2", "matplotlib")
ISOS = (100, 400, 1600, 3200, 6400, 12800)
SEEDS = 3
SHOWN = 6400  # the ISO of the pictures in figures, or the nearest
RESOLUTIONS = {"full": False, "half": True}
ALL = "all"
Job = tuple[str, int, int]  # kind, ISO, seed


@dataclass(frozen=True)
class StereoRow:
    """Results of matching for a kind of picture; see :class:`stereo.Score`."""

    resolution: str
    kind: str
    iso: int
    seed: int
    texture: str
    places: int
    found: float
    complete: float
    median_mm: float
    rms_mm: float


@dataclass(frozen=True)
class PointsRow:
    """The number of points that PMVS2 found for a kind of picture, and how many are true."""

    resolution: str
    threshold: float
    kind: str
    iso: int
    seed: int
    texture: str
    points: int
    true: int


def compare_stereo(views: Sequence[View], pictures: Pictures) -> Iterator[StereoRow]:
    """Match neighbouring views for all kinds of picture."""
    import cv2

    cv2.setNumThreads(1)
    neighbours = pairs(views)
    made = {
        name: [Pair(views[a], views[b], half) for a, b in neighbours]
        for name, half in RESOLUTIONS.items()
    }

    def rows(job: Job) -> list[StereoRow]:
        images = pictures.read(*job)
        found = []
        for resolution, of_resolution in made.items():
            depths = [
                pair.find(images[a], images[b])[pair.seen]
                for pair, (a, b) in zip(of_resolution, neighbours, strict=True)
            ]
            depth = np.concatenate(depths)
            truth = np.concatenate([pair.depth[pair.seen] for pair in of_resolution])
            texture = np.concatenate([pair.texture[pair.seen] for pair in of_resolution])
            for name, number in {ALL: 0, **TEXTURES}.items():
                one = score(depth, truth, (texture == number) | (number == 0))
                errors = one.median * 1000, one.rms * 1000
                shares = one.places, one.found, one.complete
                found.append(StereoRow(resolution, *job, name, *shares, *errors))
        return found

    with ThreadPoolExecutor(available_processors()) as threads:
        for each in threads.map(rows, pictures.all()):
            yield from each


def points_of_picture(
    program: Path, views: Sequence[View], pictures: Pictures, setting: tuple[str, float], job: Job
) -> list[PointsRow]:
    """Find points with PMVS2 at a resolution and a threshold in the pictures of a job.

    PMVS2 uses one thread, because its points are then the same in each run.
    """
    resolution, threshold = setting
    kind, iso, seed = job
    place = f"PMVS2-{resolution}-{threshold:g}-{kind}-iso{iso}-seed{seed}"
    folder = pictures.out / "points" / place.replace(", ", "-").replace(" ", "-")
    options = {"level": int(RESOLUTIONS[resolution]), "threshold": threshold, "threads": 1}
    points, _ = run_pmvs(program, folder, views, pictures.read(*job), **options)
    is_true, texture = true_of(points, views)
    rows = []
    for label, number in {ALL: 0, **TEXTURES}.items():
        these = (texture == number) | (number == 0)
        counts = int(these.sum()), int((these & is_true).sum())
        rows.append(PointsRow(resolution, threshold, *job, label, *counts))
    print(f"{place}: {len(points)} points", file=sys.stderr, flush=True)
    return rows


def compare_points(program: Path, views: Sequence[View], pictures: Pictures) -> list[PointsRow]:
    """Find points in all pictures at each resolution and threshold, half resolution first.

    After Ctrl-C, it returns the rows of finished settings.

    Raises:
        KeyboardInterrupt: no setting is finished.
    """
    found: list[PointsRow] = []
    with ThreadPoolExecutor(available_processors()) as threads:
        for setting in itertools.product(reversed(RESOLUTIONS), THRESHOLDS):
            rows = partial(points_of_picture, program, views, pictures, setting)
            try:
                made = list(threads.map(rows, pictures.all()))
            except KeyboardInterrupt:
                threads.shutdown(cancel_futures=True)
                if not found:
                    raise
                print("stopped; the report covers what is finished", file=sys.stderr)
                break
            found += itertools.chain.from_iterable(made)
    return found


def write_csv(path: Path, rows: Sequence[StereoRow | PointsRow]) -> None:
    """Write rows as CSV, numbers with six digits."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(asdict(rows[0]))
        for row in rows:
            values = asdict(row).values()
            writer.writerow([f"{v:.6g}" if isinstance(v, float) else v for v in values])


def stereo_pictures(
    views: Sequence[View], pictures: Pictures, kinds: Sequence[str], iso: int
) -> None:
    """Write depth maps and points of the first pair, for some kinds of picture at an ISO."""
    a, b = pairs(views)[0]
    view, seed = views[a], pictures.seeds[0]
    span = view.depth.min(), view.depth.max()
    at_full, at_half = (Pair(view, views[b], half) for half in RESOLUTIONS.values())
    maps, clouds = [], []
    for kind in kinds:
        own = iso if KINDS[kind].each_iso else pictures.isos[0]
        title = f"{kind}, ISO {iso}" if KINDS[kind].each_iso else kind
        images = pictures.read(kind, own, seed)
        small = halved(images[a])
        full, half = (pair.find(images[a], images[b]) for pair in (at_full, at_half))
        at_full_size = "depth", depth_picture(full, *span)[::2, ::2]
        at_half_size = "depth at half resolution", depth_picture(half, *span)
        maps.append([(title, small), at_full_size, at_half_size])
        cloud = cloud_picture(*points_of(view, half, small), view)
        clouds.append((title, cloud))
    sheet(maps).save(pictures.out / "depth.png")
    sheet([clouds[i : i + 2] for i in range(0, len(clouds), 2)]).save(pictures.out / "points.png")


def report_stereo(out: Path, rows: Sequence[StereoRow], text: list[str]) -> None:
    """Write the CSV and the figure of matching, and append tables to the text."""
    write_csv(out / "stereo.csv", rows)
    panels, weak = [], {}
    for resolution in RESOLUTIONS:
        tables = {
            name: table_of(rows, lambda r: 100 * r.complete, resolution=resolution, texture=name)
            for name in (*TEXTURES, ALL)
        }
        text.append(as_markdown(f"Completeness, {resolution} resolution, %", tables, ".1f"))
        panels += [
            (f"texture: {name}, {resolution} resolution", "completeness, %", tables[name])
            for name in TEXTURES
        ]
        weak[f"{resolution} resolution, weak texture"] = tables["weak"]
        for value, label in (("median_mm", "Median"), ("rms_mm", "RMS")):
            errors = {
                name: table_of(rows, attrgetter(value), resolution=resolution, texture=name)
                for name in (*TEXTURES, ALL)
            }
            text.append(as_markdown(f"{label} error, {resolution} resolution, mm", errors, ".1f"))
    text.append(costs_of(weak))
    draw(out / "stereo.svg", panels, columns=len(TEXTURES), factor=1)


def report_points(out: Path, rows: Sequence[PointsRow], text: list[str]) -> None:
    """Write the CSV and the figure of points, and append tables to the text."""
    write_csv(out / "points.csv", rows)
    panels, counts = [], {}
    for resolution, threshold in dict.fromkeys((row.resolution, row.threshold) for row in rows):
        name = f"PMVS2, {resolution} resolution, threshold {threshold:g}"
        own = {"resolution": resolution, "threshold": threshold}
        tables = {
            texture: table_of(rows, lambda r: r.points, texture=texture, **own)
            for texture in (*TEXTURES, ALL)
        }
        text.append(as_markdown(f"Points: {name}", tables, ".0f"))
        share = table_of(rows, lambda r: 100 * r.true / max(r.points, 1), texture=ALL, **own)
        text.append(as_markdown(f"On a surface: {name}, %", {ALL: share}, ".1f"))
        counts[name] = tables[ALL]
        panels.append((name, "points / 1000", tables[ALL]))
    text.append(costs_of(counts))
    draw(out / "points.svg", panels, columns=2, factor=1e-3)


def energies(pictures: Pictures) -> str:
    """Format the share of the noise's variance after averaging 2x2 as a table."""
    seed = pictures.seeds[0]
    rows = [
        [name, *(f"{energy_left(pictures.noise(name, iso, seed)):.2f}" for iso in pictures.isos)]
        for name in (CAMERA, IID)
    ]
    heads = ["noise", *(f"ISO {iso}" for iso in pictures.isos)]
    return f"### Variance that survives averaging 2x2\n\n{markdown(heads, rows)}\n"


def main() -> int:
    """Run the experiment."""
    parser = parser_of(__doc__)
    add = parser.add_argument
    add("-o", "--output", type=Path, required=True, metavar="OUT", help="output directory")
    add("--iso", type=count_of, nargs="+", default=ISOS, help="the ISOs [%(default)s]")
    add("--seeds", type=count_of, default=SEEDS, help="number of seeds of the noise [%(default)s]")
    add("-c", "--config", default="paper", help="configuration of clpipe [%(default)s]")
    add("--pmvs", type=Path, metavar="PATH", help="the program pmvs2")
    add("--data", type=Path, default=DATA, help="folder of the views [%(default)s]")
    text = "render the views into --data, with Blender or a Python with bpy"
    add("--render", metavar="BLENDER", help=text)
    options = parser.parse_args()
    if options.pmvs and not options.pmvs.is_file():
        parser.error(f"--pmvs: {options.pmvs} does not exist; give the path of the program")
    for module in NEEDED:
        if importlib.util.find_spec(module) is None:
            print(f"{module}: missing; .venv/bin/pip install -e '.[compare]'", file=sys.stderr)
            return 1
    try:
        if options.render:
            render_views(options.data, options.render)
        views = read_views(options.data)
        names = [view.name for view in views]
        isos = sorted(set(options.iso))
        pictures = Pictures(options.output, names, isos, range(options.seeds))
        pictures.develop(options.data, options.config)
        text = [energies(pictures)]
        report_stereo(options.output, list(compare_stereo(views, pictures)), text)
        shown = min(isos, key=lambda iso: abs(iso - SHOWN))
        stereo_pictures(views, pictures, (CLEAN, CAMERA, IID, HALF), shown)
        if options.pmvs:
            found = compare_points(options.pmvs.absolute(), views, pictures)
            report_points(options.output, found, text)
    except subprocess.CalledProcessError:
        return 1  # clpipe printed the reason
    except (ClpipeError, ProgramError, ValueError, OSError) as error:
        print(error, file=sys.stderr)
        return 1
    report = "\n".join(text)
    (options.output / "tables.md").write_text(report, encoding="utf-8")
    print(report)
    return 0


if __name__ == "__main__":
    sys.exit(main())
