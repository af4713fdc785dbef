"""Simulate known noise, measure it, and print the tables of docs/validation.md.

    tools/run pages validate --real FOLDER
    tools/run pages validate --only cameras [RENDER ...]

The closed loop simulates frames with known parameters for every camera, ISO and pattern, and
calibrates them without knowing these. Poisson numbers are compared with their exact distribution,
and finished pictures with figures of real cameras. The exit status is 1 if a figure misses its
target.

FOLDER contains pictures of real cameras, which are not part of the repository, as pairs
NAME_1_real.png and NAME_1_mean.png, the mean of many pictures of the same scene. The tool measures
them, draws docs/real_cameras.svg, and writes their crops to the output directory. It always draws
docs/real_cameras_crops.png and docs/skew.svg.
"""

import argparse
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
from scipy.stats import chi2, poisson

import clpipe
from clpipe.analysis.calibration.calibrate import calibrate
from clpipe.analysis.calibration.repeats import Sensor
from clpipe.analysis.measure import measure
from clpipe.analysis.pictures import Picture
from clpipe.analysis.quality.measure import chain_quality, developed_greys, lens_figures
from clpipe.analysis.quality.report import FIGURES, table
from clpipe.analysis.quality.simulation import ChartCamera
from clpipe.analysis.spatial import LAGS
from clpipe.base.errors import ClpipeError
from clpipe.base.types import Array, Floats
from clpipe.camera.profile import load_camera
from clpipe.chain.settings import Settings, overlay
from clpipe.engine.device import open_device
from clpipe.engine.service import Service
from clpipe.images.jpeg import JpegEncoding, jpeg_round_trip
from clpipe.images.read import read_image
from clpipe.reference.cfa import PATTERNS, Pattern
from clpipe.reference.colour import luma
from clpipe.reference.poisson import poisson_of
from tools import RENDER, ROOT
from tools.pages import real_cameras, skew
from tools.shared.options import parser_of, sides_of
from tools.shared.tables import COLUMNS, markdown

DOCS = ROOT / "docs"
CAMERAS = ("sony-a7r2", "sony-a7s2", "canon-5d2")
ISOS = (100, 400, 1600, 3200, 6400, 12800)
FRAMES = 8
MEANS = (0.1, 1, 5, 9.9, 10.1, 50, 1000, 1e5)
SIDES, LENSES = (1920, 1080), 32  # px of a picture, and draws of a typical lens
# 10, 50 and 90 % of real cameras: 119 to 130 finished pictures.
FINISHED = {
    "MTF50, cycles/px": "0.12 / 0.27 / 0.40; good DSLRs 0.32 to 0.40",
    "MTF at 0.5 cycles/px": "0.04 / 0.11 / 0.31",
    "overshoot, %": "0.5 to 4 / 17; sharp ones 5 to 13",
    "chroma edge, 10 to 90 %, px": "3.8 / 5.2 / 7.1",
    "corner_red": "median 0.48; 90 % 1.3",
    "corner_blue": "median 0.61; 90 % 1.7",
    "corners": "median 72",
    "pixels with a channel at 0, %": "0.1 / 1.0 / 5.6",
    "white pixels, %": "0.03 / 0.88 / 4",
    "median level": "53 / 109 / 156",
}
NOISE = ("prnu", "defect_pixels", "sensor_noise", "dsnu", "row_noise", "column_noise")

# JPEGs of a Canon EOS 5D Mark II at ISO 3200 and 6400: 11 pairs; noise is one frame minus the mean
# of many, in flat areas. "1 right" is the autocorrelation at an offset of one pixel to the right.
REAL = {
    "luma, 1 right": 0.30,
    "luma, 1 below": 0.26,
    "luma, diagonal": 0.07,
    "chroma, 1 right": 0.85,
    "chroma, 1 below": 0.71,
    "chroma, diagonal": 0.63,
    "chroma, 2 right": 0.70,
    "luma left after 2x2": 0.40,
    "chroma left after 2x2": 0.86,
    "R-G": 0.47,
    "G-B": 0.52,
    "R-B": 0.56,
}
ALLOWED = 0.1
LAGS_SHOWN = {"1 right": (0, 1), "1 below": (1, 0), "diagonal": (1, 1), "2 right": (0, 2)}
LEVELS = ("RGGB", 0.0, 1.0)  # the pattern, which display pictures ignore, and the range


@dataclass(frozen=True)
class Loop:
    """The result of a closed loop: relative errors, and those of a and b in standard errors."""

    a: float
    a_in_errors: float
    b: float
    b_in_errors: float
    row: float
    column: float
    hot: int  # pixels that were invented or missed

    @property
    def good(self) -> bool:
        """Whether a and b are within 1 % and 3 standard errors, lines within 3 %, pixels right."""
        sizes = max(abs(self.a), abs(self.b)) < 0.01 and max(abs(self.row), abs(self.column)) < 0.03
        return sizes and max(abs(self.a_in_errors), abs(self.b_in_errors)) < 3 and not self.hot


def close_loop(
    name: str, iso: float, pattern: Pattern, height: int, width: int, method: str = "poisson"
) -> Loop:
    """Simulate FRAMES frames of a scene and as many dark ones, and calibrate them."""
    camera = load_camera(name)
    model, row = camera.noise(iso), camera.row_noise(iso) or 0.1 * camera.noise(iso).b ** 0.5
    column, level = 0.3 * model.b**0.5, 0.1 + 20 * model.b**0.5
    pipeline = clpipe.Pipeline(
        camera=name,
        iso=iso,
        until="quantize",
        keep=["defect_pixels", "column_noise", "dsnu"],
        mosaic={"pattern": pattern},
        sensor_noise={"method": method},
        prnu={"sigma": 0.003},
        dsnu={"sigma": 0.2 * model.b**0.5},
        defect_pixels={"hot_share": 2e-4, "hot_level": level},
        row_noise={"sigma": row},
        column_noise={"sigma": column},
    )
    y, x = np.mgrid[0:height, 0:width].astype(np.float32)
    ramp = 0.002 + 0.55 * (x / width) ** 2 + 0.15 * y / height
    scene = np.repeat(ramp[..., None], 3, axis=2)
    dark = np.zeros_like(scene)

    def frames(image: Floats, key: str) -> Floats:
        keys = (f"{name} {iso} {pattern} {key} {i}" for i in range(FRAMES))
        return np.stack([pipeline.process(image, each).image for each in keys])

    black = pipeline.process(dark, "d0").kept
    hot = black["defect_pixels"] > level / 2
    columns = (black["column_noise"] - black["dsnu"]).astype(np.float64)
    columns -= columns.mean(1, keepdims=True)  # minus the row's offset
    realised = float(columns.mean(0).std())
    sensor = Sensor(pattern, camera.black_level, camera.white_level)
    found = calibrate(iso, frames(scene, "s"), frames(dark, "d"), sensor)
    unit = camera.signal_range
    gain, floor = found.pooled.gain.scaled(1 / unit), found.pooled.floor.scaled(1 / unit**2)
    assert found.row_noise and found.column_noise and found.hot
    wrong = hot.copy()
    wrong[found.hot.rows, found.hot.columns] ^= True
    return Loop(
        a=gain.value / model.a - 1,
        a_in_errors=(gain.value - model.a) / gain.error,
        b=floor.value / model.b - 1,
        b_in_errors=(floor.value - model.b) / floor.error,
        row=found.row_noise.value / (row * unit) - 1,
        column=found.column_noise.value / (realised * unit) - 1,
        hot=int(wrong.sum()),
    )


def loops(height: int, width: int) -> Iterator[tuple[str, float, list[Loop]]]:
    """Yield the loops of all patterns for each camera at each of its ISOs."""
    for name in CAMERAS:
        for iso in ISOS:
            if iso <= load_camera(name).iso_range[1]:
                yield name, iso, [close_loop(name, iso, p, height, width) for p in PATTERNS]


def poisson_p(mean: float, count: int) -> float:
    """Return the p-value of a chi-square test of ``count`` Poisson numbers."""
    random = np.random.default_rng(1)
    least, most = int(poisson.ppf(1e-6, mean)), int(poisson.isf(1e-6, mean))
    observed = np.zeros(most - least + 2)
    for _ in range(10):
        words = random.integers(0, 1 << 32, count // 10, dtype=np.uint32)
        numbers = poisson_of(np.full(count // 10, mean, np.float32), words).astype(np.int64)
        cells = np.clip(numbers, least, most + 1) - least
        observed += np.bincount(cells, minlength=len(observed))
    inner = np.arange(least + 1, most + 1)
    exact = float(np.float32(mean))
    law = np.r_[poisson.cdf(least, exact), poisson.pmf(inner, exact), poisson.sf(most, exact)]
    expected = law * count
    cell = (np.cumsum(expected) - 1e-9) // 10  # cells with few numbers are merged
    e, o = (np.bincount(np.unique(cell, return_inverse=True)[1], v) for v in (expected, observed))
    return float(chi2.sf(np.sum((o - e) ** 2 / e), len(e) - 1))


def finished(config: str, iso: float) -> dict[str, float]:
    """Return the figures of REAL for the render's JPEG with a configuration."""
    render = read_image(RENDER).pixels
    whole = clpipe.Pipeline(config, iso=iso)

    def decoded(pixels: Array) -> Floats:
        return jpeg_round_trip(pixels, JpegEncoding(97, "4:2:2")).astype(np.float32) / 255

    clean = clpipe.Pipeline(config, iso=iso, skip=[*NOISE])
    noisy, truth = (
        Picture(Path("render"), "display", decoded(pipeline.process(render, "k").image), *LEVELS)
        for pipeline in (whole, clean)
    )
    report = measure([noisy], truth)
    of = {one.name: one for one in report.channels}

    found = {pair: report.correlation[pair] for pair in ("R-G", "G-B", "R-B")}
    for kind, names in {"luma": ("Y",), "chroma": ("Cb", "Cr")}.items():
        left = [of[name].energy_left_2x2 for name in names]
        found[f"{kind} left after 2x2"] = float(np.mean(left))
        for where, (down, right) in LAGS_SHOWN.items():
            lags = [of[name].autocorrelation[LAGS + down, LAGS + right] for name in names]
            found[f"{kind}, {where}"] = float(np.mean(lags))
    return {what: found[what] for what in REAL}


def closed_loop(options: argparse.Namespace) -> bool:
    """Print the table of the closed loop; return whether all targets are met."""
    width, height = options.size
    rows, missed = [], []
    for name, iso, found in loops(height, width):
        if not all(loop.good for loop in found):
            missed.append(f"{name} at ISO {iso}")
        worst = [max((getattr(loop, f.name) for loop in found), key=abs) for f in fields(Loop)]
        a, a_errors, b, b_errors, row, column, hot = worst
        cells = [f"{100 * a:+.2f}", f"{a_errors:+.1f}", f"{100 * b:+.2f}", f"{b_errors:+.1f}"]
        rows.append([name, iso, *cells, f"{100 * row:+.2f}", f"{100 * column:+.2f}", hot])
    heads = ["a, %", "in s.e.", "b, %", "in s.e.", "rows, %", "columns, %", "hot wrong"]
    print(markdown(["camera", "ISO", *heads], rows))
    if missed:
        print(f"\nRows that miss a target: {', '.join(missed)}.")
    return not missed


def photo_electrons(options: argparse.Namespace) -> bool:
    """Print the table of Poisson numbers; return whether the target is met."""
    values = [poisson_p(mean, options.draws) for mean in MEANS]
    heads = ["mean, e-", *(f"{mean:g}" for mean in MEANS)]
    print(markdown(heads, [["p", *(f"{p:.3f}" for p in values)]]))
    return min(values) > 0.001


def canon(options: argparse.Namespace) -> bool:
    """Print the table of canon-5d2-jpeg; return whether all targets are met."""
    low, high = finished("canon-5d2-jpeg", 3200), finished("canon-5d2-jpeg", 6400)
    every = (REAL, low, high, finished("default", 3200))
    heads = ["", "real camera", "canon-5d2-jpeg, ISO 3200", "ISO 6400", "default chain, sony-a7r2"]
    print(markdown(heads, [[what, *(f"{of[what]:.2f}" for of in every)] for what in REAL]))
    return all(abs(low[what] - real) < ALLOWED for what, real in REAL.items())


def cameras(options: argparse.Namespace) -> bool:
    """Print the section of real cameras; return whether the default chain meets the targets."""
    renders = [read_image(path).pixels for path in (RENDER, *options.renders)]
    real = real_cameras.read_pairs(options.real) if options.real else {}
    ours = {
        f"clpipe, ISO {iso}": [real_cameras.develop(render, iso) for render in renders]
        for iso in real_cameras.ISOS
    }
    rows = [real_cameras.row(name, record) for name, record in real_cameras.MEASURED.items()]
    for name, pairs in real.items():
        measured = f"{name}, {len(pairs)} measured here"
        rows.append(real_cameras.row(measured, real_cameras.medians(pairs)))
    rows.append(real_cameras.range_row())
    good = True
    for name, pairs in ours.items():
        record = real_cameras.medians(pairs)
        missed = real_cameras.outside(record)
        good &= not missed
        rows.append(real_cameras.row(name, record, missed))
    print(markdown(["", *(head for head, *_ in COLUMNS)], rows))
    first_ours, first_real = ({k: pairs[0] for k, pairs in group.items()} for group in (ours, real))
    real_cameras.crops(first_ours).save(DOCS / "real_cameras_crops.png", optimize=True)
    if real:
        real_cameras.draw(real, ours, DOCS / "real_cameras.svg")
        options.output.mkdir(parents=True, exist_ok=True)
        written = options.output / "real_cameras_crops.png"
        real_cameras.crops(first_real | first_ours).save(written)
        print(f"crops next to the real ones: {written}", file=sys.stderr)
    return good


def edges(options: argparse.Namespace) -> bool:
    """Print the tables of edges, which have ranges, but no targets."""
    service = Service([open_device(None)])
    reports = [
        chain_quality(f"ISO {iso}", overlay(Settings(), {"iso": iso}), service, *SIDES)
        for iso in (100, 400, 1600, 6400, 25600)
    ]
    heading = ["", *(report.name for report in reports), "real cameras"]
    found = [(text, cells) for section, text, cells in table(reports) if section == "Sharpness"]
    print(
        markdown(
            heading, ([t, *cells, FINISHED.get(t.split(", contrast")[0], "")] for t, cells in found)
        )
    )
    lenses = [
        overlay(Settings(), {"lens": "typical", "iso": 100, "seed": n}) for n in range(LENSES)
    ]
    cameras = [ChartCamera(lens, service) for lens in lenses]
    greys = developed_greys(cameras[0])
    figures = [lens_figures(camera, greys, *SIDES) for camera in cameras]
    rows = []
    for name in ("corner_red", "corner_blue", "corners"):
        sizes = np.abs([each[name] for each in figures])
        text = f"median {np.median(sizes):.2g}; 90 % {np.percentile(sizes, 90):.2g}"
        rows.append([FIGURES[name].text, text, FINISHED[name]])
    pictures = [
        clpipe.Pipeline().process(read_image(path).pixels[..., :3], "look").image
        for path in (RENDER, *options.renders)
    ]
    shares = [
        (100 * (p == 0).any(-1).mean(), 100 * (p == 255).all(-1).mean(), np.median(luma(p)))
        for p in pictures
    ]
    for text, value in zip(list(FINISHED)[-3:], np.mean(shares, axis=0), strict=True):
        rows.append([text, f"{value:.2g}", FINISHED[text]])
    print(f"\n{markdown(['', 'clpipe', 'real cameras'], rows)}")
    return True


# The sections by their words for --only, with their headings on the page.
SECTIONS: dict[str, tuple[str, Callable[[argparse.Namespace], bool]]] = {
    "loop": ("Calibration of known noise", closed_loop),
    "poisson": ("Photo-electrons", photo_electrons),
    "canon": ("A real camera's finished pictures", canon),
    "cameras": ("Comparison with real cameras", cameras),
    "skew": ("What skews noise", lambda _: skew.section(DOCS / "skew.svg")),
    "edges": ("Edges, chroma, lens and tone", edges),
}


def main() -> int:
    """Print the tables of the page, or of some of its sections."""
    parser = parser_of(__doc__)
    add = parser.add_argument
    further = "for cameras, in addition to the still life"
    add("renders", nargs="*", type=Path, metavar="RENDER", help=further)
    add("--only", action="append", choices=SECTIONS, help="only this section; may be repeated")
    add("--size", type=sides_of, default=(2400, 1600), help="of the frames [2400x1600]")
    add("--draws", type=int, default=10_000_000, help="Poisson numbers per mean [%(default)s]")
    add("--real", type=Path, metavar="FOLDER", help="pairs of real cameras")
    folder = ROOT / "build/validate"
    add("-o", "--output", type=Path, default=folder, metavar="OUT", help="for crops of the pairs")
    options = parser.parse_args()
    good = []
    try:
        for name in options.only or SECTIONS:
            heading, section = SECTIONS[name]
            print(f"## {heading}\n", flush=True)
            good.append(section(options))
            print(flush=True)
    except ClpipeError as error:
        print(f"validate: {error}", file=sys.stderr)
        return 1
    return 0 if all(good) else 1


if __name__ == "__main__":
    sys.exit(main())
