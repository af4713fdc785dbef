"""Make the figures of the paper.

    tools/run pages figures [-o FOLDER] [--render FILE.exr] [--raw FILE]

The paper is Bielova, Haensch, Ley and Hellwich, "A Digital Image Processing Pipeline for Modelling
of Realistic Noise in Synthetic Images" (CVPR Workshops 2019). The tool prints each command of
clpipe before it runs. It writes each figure as PDF and PNG:

- demosaicing: methods of demosaicing on one noisy mosaic (the paper's figure 3).
- iso100, iso1600: camera noise, independent noise, intensity-dependent noise, and no noise
  (figures 4 and 5).
- statistics: noise by intensity in the raw and in the picture, autocorrelation, power spectrum.

With --raw, a camera's raw is developed by the same pipeline. The tool then also writes
raw_demosaicing, and adds the raw's picture as a column to the figure with the nearest ISO
(raw_iso100 or raw_iso1600). docs/paper.md explains the figures.
"""

import json
import math
import shlex
import subprocess
import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from clpipe.analysis.comparison import Comparison, Row, compare
from clpipe.analysis.comparison_plot import draw
from clpipe.analysis.measure import measure
from clpipe.analysis.pictures import WHOLE, load_picture
from clpipe.analysis.spatial import LAGS
from clpipe.analysis.statistics import Channel
from clpipe.base.errors import ClpipeError
from tools import RENDER
from tools.shared.options import parser_of
from tools.shared.plots import caption, caption_spectrum, save, spectrum

SUFFIXES = (".pdf", ".png")
LEVELS = 255

ISOS = (100, 1600)
# The paper's methods, and the method of the default chain.
METHODS = ("bilinear", "edge_directed", "median", "edge_directed_median", "bounded")
# Labels of a picture and its baselines by the end of the file name, and their ground truths.
PICTURES = {
    ".png": "camera noise",
    ".iid.png": "independent",
    ".intensity.png": "by intensity (SyB3R)",
    ".truth_clean.png": "no noise",
}
TRUTHS = {ending: ".truth.png" if ending == ".png" else ".truth_clean.png" for ending in PICTURES}


PLACES = ("textured", "saturated", "flat")


def clpipe(*words: str | Path | int) -> None:
    """Print and run a command of clpipe. If it fails, exit with its status."""
    texts = list(map(str, words))
    print(f"$ clpipe {shlex.join(texts)}", flush=True)
    done = subprocess.run([sys.executable, "-m", "clpipe", *texts], check=False)
    if done.returncode:
        sys.exit(done.returncode)


def options(name: str, values: Iterable[str | Path]) -> list[str]:
    """Repeat an option with each of several values.

    >>> options("--crop", ["flat", "dark"])
    ['--crop', 'flat', '--crop', 'dark']
    """
    return [word for value in values for word in (name, str(value))]


def outputs(figure: Path) -> list[str]:
    """Return the options for a figure in both formats.

    >>> outputs(Path("figures/iso100"))
    ['-o', 'figures/iso100.pdf', '-o', 'figures/iso100.png']
    """
    return options("-o", (figure.with_suffix(suffix) for suffix in SUFFIXES))


def develop(render: Path, out: Path) -> dict[int, Path]:
    """Develop a render by ISO, with baselines, ground truths and normalised mosaics next to it."""
    isos = ",".join(map(str, ISOS))
    several = [*options("--keep", ["normalize"]), *options("--truth", ["iid", "intensity"])]
    clpipe("run", render, "-o", out, "-c", "paper", "--iso", isos, "--format", "png", *several)
    return {iso: out / f"iso{iso}" / render.with_suffix(".png").name for iso in ISOS}


def demosaicing(sources: Sequence[Path], out: Path) -> dict[str, list[Path]]:
    """Develop mosaics with each method of demosaicing, without denoising.

    Args:
        sources: raws, or mosaics that were kept after normalize.
        out: the output directory, with a folder for each method.

    Returns:
        The pictures by the method's name.
    """
    start = () if sources[0].suffix != ".exr" else ("--start-at", "white_balance")
    made = {}
    for method in METHODS:
        folder = out / method
        how = ["--set", f"demosaic.method={method}", "--skip", "denoise", "--format", "png"]
        clpipe("run", *sources, "-o", folder, "-c", "paper", *start, *how, "--quiet")
        made[method] = [folder / source.with_suffix(".png").name for source in sources]
    return made


def compare_methods(made: Mapping[str, Sequence[Path]], figure: Path) -> None:
    """Draw the figure of the pictures of :func:`demosaicing`.

    Args:
        made: the picture by method, with its ground truth if there is one.
        figure: the file, without extension.
    """
    pictures = [paths[0] for paths in made.values()]
    truths = options("--truth", (paths[1] for paths in made.values() if len(paths) > 1))
    rows = options("--crop", PLACES[:2])
    labels = options("--label", made)
    clpipe("compare", *pictures, *truths, *rows, *labels, *outputs(figure))


def compare_noise(picture: Path, figure: Path) -> None:
    """Draw the figure that compares a picture with its baselines.

    Args:
        picture: NAME.png, with the baselines in the same folder.
        figure: the file, without extension.
    """
    pictures = [picture.with_suffix(ending) for ending in PICTURES]
    truths = options("--truth", (picture.with_suffix(ending) for ending in TRUTHS.values()))
    labels = options("--label", PICTURES.values())
    rows = [*options("--crop", PLACES), "--difference"]
    clpipe("compare", *pictures, *truths, *rows, *labels, *outputs(figure))


def with_raw(picture: Path, developed: Path) -> Comparison:
    """Add a column with a raw's picture to the figure of :func:`compare_noise`.

    Args:
        picture: NAME.png, as for :func:`compare_noise`.
        developed: the raw's picture.

    Raises:
        ClpipeError: a picture cannot be read, or the raw's picture is smaller than a crop.
    """
    pictures, truths = (
        [picture.with_suffix(ending) for ending in endings]
        for endings in (PICTURES, TRUTHS.values())
    )
    renders = compare(pictures, PLACES, list(PICTURES.values()), truths)
    raw = compare([developed, developed], PLACES)
    rows = zip(renders.rows, raw.rows, strict=True)
    return replace(
        renders,
        labels=(*renders.labels, developed.stem),
        rows=tuple(Row(one.name, (*one.crops, other.crops[0])) for one, other in rows),
        noise=(*renders.noise, raw.noise[0]),
        notes=(*renders.notes, f"{developed.stem}: a camera's raw; sigma: of its flat place"),
    )


def raw_figures(raw: Path, pictures: Mapping[int, Path], out: Path) -> None:
    """Draw the figures of a camera's raw.

    Args:
        raw: the file.
        pictures: pictures of a render by ISO, for :func:`compare_noise`.
        out: the output directory.

    Raises:
        ClpipeError: the raw's picture cannot be used.
    """
    compare_methods(demosaicing([raw], out / "raw"), out / "raw_demosaicing")
    clpipe("run", raw, "-o", out / "raw", "-c", "paper", "--format", "png", "--quiet")
    developed = out / "raw" / raw.with_suffix(".png").name
    iso = json.loads(developed.with_suffix(".json").read_text("utf-8"))["iso"]
    nearest = min(ISOS, key=lambda each: abs(math.log(each / iso)))
    found = with_raw(pictures[nearest], developed)
    for suffix in SUFFIXES:
        draw(found, out / f"raw_iso{nearest}{suffix}")


def statistics(picture: Path, figure: Path, title: str) -> None:
    """Draw noise by intensity in raw and picture, and autocorrelation and spectrum in the picture.

    Args:
        picture: NAME.png, with its baselines, ground truths and mosaics in the same folder.
        figure: the file, without extension.
        title: the title of the figure.

    Raises:
        ClpipeError: a file cannot be read.
    """

    def channel(noisy: str, clean: str, name: str) -> Channel:
        pair = [load_picture(picture.with_suffix(ending)) for ending in (noisy, clean)]
        return next(one for one in measure(pair[:1], pair[1]).channels if one.name == name)

    raw = channel(".normalize.exr", ".truth.normalize.exr", WHOLE)
    found = {
        label: channel(ending, TRUTHS[ending], "Y")
        for ending, label in PICTURES.items()
        if ending != TRUTHS[ending]
    }
    sheet = Figure(figsize=(7.5, 6), layout="constrained")
    sheet.suptitle(title, fontsize=10)
    (of_raw, of_picture), (lags, power) = sheet.subplots(2, 2)
    of_raw.plot(
        raw.intensity.mean, raw.intensity.sigma, "o", color="black", markersize=4, label="measured"
    )
    if raw.law:
        y = np.linspace(0, raw.intensity.mean[-1], 200)
        law = f"√(a y + b), a = {raw.law.a:.3g}, b = {raw.law.b:.2g}"
        of_raw.plot(y, np.sqrt(np.maximum(raw.law.a * y + raw.law.b, 0)), color="black", label=law)
    caption(of_raw, "Raw: noise by intensity", "signal, 1 = white level", "sigma")
    for label, one in found.items():
        curve, table = one.intensity, one.autocorrelation
        of_picture.plot(curve.mean * LEVELS, curve.sigma * LEVELS, "o-", markersize=3, label=label)
        lags.plot(range(LAGS + 1), table[LAGS, LAGS:], "o-", markersize=3, label=label)
        power.plot(*spectrum(table), label=label)
    caption(of_picture, "Picture: noise by intensity", "luma, levels", "sigma of luma, levels")
    caption(lags, "Picture: autocorrelation of luma", "px to the right", "correlation")
    caption_spectrum(power, "Picture: power spectrum of luma")
    for axes in (of_raw, of_picture):
        axes.set_ylim(bottom=0)
    for axes in sheet.axes:
        axes.legend(fontsize=7)
    for suffix in SUFFIXES:
        save(sheet, figure.with_suffix(suffix))


def main() -> int:
    """Make the figures, and return the exit status."""
    parser = parser_of(__doc__)
    parser.add_argument("-o", "--output", type=Path, default=Path("figures"), metavar="FOLDER")
    parser.add_argument("--render", type=Path, default=RENDER, metavar="FILE.exr")
    parser.add_argument("--raw", type=Path, metavar="FILE", help="a camera's raw, for comparison")
    arguments = parser.parse_args()
    out: Path = arguments.output
    try:
        pictures = develop(arguments.render, out / "pictures")
        if arguments.raw:
            raw_figures(arguments.raw, pictures, out)
        high = pictures[ISOS[-1]]
        mosaics = [high.with_suffix(end) for end in (".normalize.exr", ".truth.normalize.exr")]
        compare_methods(demosaicing(mosaics, out / "demosaicing"), out / "demosaicing")
        for iso, picture in pictures.items():
            compare_noise(picture, out / f"iso{iso}")
        statistics(high, out / "statistics", f"Noise at ISO {ISOS[-1]}, {arguments.render.name}")
    except ClpipeError as error:
        print(f"figures: {error}", file=sys.stderr)
        return error.exit_status
    print(f"wrote {', '.join(sorted(path.name for path in out.glob('*.*')))} in {out}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
