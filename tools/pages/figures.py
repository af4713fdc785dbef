"""Make the figures of the paper.

    tools/run pages figures [-o FOLDER] [--render FILE.exr] [--raw FILE]

The paper is Bielova, Haensch, Ley and Hellwich, "A Digital Image Processing Pipeline for Modelling
of Realistic Noise in Synthetic Images" (CVPR Workshops 2019). Every command of clpipe is printed as
it runs. Each figure is written as PDF and PNG:

demosaicing     methods of demosaicing on one noisy mosaic (the paper's figure 3)
iso100, iso1600 camera noise beside independent noise, intensity-dependent noise and none (4 and 5)
statistics      noise by intensity in the raw and in the picture, autocorrelation, power spectrum

--raw names a camera's raw. It goes through the same pipeline; then there are raw_demosaicing, and
the raw's picture in one more column of the figure whose ISO is nearer to its own (raw_iso100 or
raw_iso1600). docs/paper.md says what is seen.
"""

import argparse
import json
import math
import shlex
import subprocess
import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from clpipe.analysis.comparison import Comparison, Row, compare
from clpipe.analysis.comparison_plot import METADATA, STYLE, draw
from clpipe.analysis.matching.columns import MAX_LAG, spectrum_of
from clpipe.analysis.measure import measure
from clpipe.analysis.pictures import WHOLE, load_picture
from clpipe.analysis.spatial import LAGS
from clpipe.analysis.statistics import Channel
from clpipe.base.errors import ClpipeError
from tools import RENDER

SUFFIXES = (".pdf", ".png")
LEVELS = 255

ISOS = (100, 1600)
# The paper's methods, and the default chain's.
METHODS = ("bilinear", "edge_directed", "median", "edge_directed_median", "bounded")
# What a picture and its baselines are called, by the ending of their names; and their truths.
PICTURES = {
    ".png": "camera noise",
    ".iid.png": "independent",
    ".intensity.png": "by intensity (SyB3R)",
    ".truth_clean.png": "no noise",
}
TRUTHS = {ending: ".truth.png" if ending == ".png" else ".truth_clean.png" for ending in PICTURES}


PLACES = ("textured", "saturated", "flat")


def clpipe(*words: str | Path | int) -> None:
    """Run a command of clpipe, printed as it would be typed; end with its status where it fails."""
    texts = list(map(str, words))
    print(f"$ clpipe {shlex.join(texts)}", flush=True)
    done = subprocess.run([sys.executable, "-m", "clpipe", *texts], check=False)
    if done.returncode:
        sys.exit(done.returncode)


def options(name: str, values: Iterable[str | Path]) -> list[str]:
    """An option with each of some values.

    >>> options("--crop", ["flat", "dark"])
    ['--crop', 'flat', '--crop', 'dark']
    """
    return [word for value in values for word in (name, str(value))]


def outputs(figure: Path) -> list[str]:
    """The options for a figure in both formats.

    >>> outputs(Path("figures/iso100"))
    ['-o', 'figures/iso100.pdf', '-o', 'figures/iso100.png']
    """
    return options("-o", (figure.with_suffix(suffix) for suffix in SUFFIXES))


def develop(render: Path, out: Path) -> dict[int, Path]:
    """The pictures of a render by ISO; beside each its baselines, truths and normalised mosaics."""
    isos = ",".join(map(str, ISOS))
    several = [*options("--keep", ["normalize"]), *options("--truth", ["iid", "intensity"])]
    clpipe("run", render, "-o", out, "-c", "paper", "--iso", isos, "--format", "png", *several)
    return {iso: out / f"iso{iso}" / render.with_suffix(".png").name for iso in ISOS}


def demosaicing(sources: Sequence[Path], out: Path) -> dict[str, list[Path]]:
    """What each method makes of mosaics, developed without denoising, by the method's name.

    Args:
        sources: raws, or mosaics that were kept after normalize.
        out: the folder; each method has one within.
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
    """The figure of what :func:`demosaicing` made.

    Args:
        made: by method its picture, and its truth where there is one.
        figure: the file, without ending.
    """
    pictures = [paths[0] for paths in made.values()]
    truths = options("--truth", (paths[1] for paths in made.values() if len(paths) > 1))
    rows = options("--crop", PLACES[:2])
    labels = options("--label", made)
    clpipe("compare", *pictures, *truths, *rows, *labels, *outputs(figure))


def compare_noise(picture: Path, figure: Path) -> None:
    """The figure of a picture beside its baselines.

    Args:
        picture: NAME.png; the others are beside it.
        figure: the file, without ending.
    """
    pictures = [picture.with_suffix(ending) for ending in PICTURES]
    truths = options("--truth", (picture.with_suffix(ending) for ending in TRUTHS.values()))
    labels = options("--label", PICTURES.values())
    rows = [*options("--crop", PLACES), "--difference"]
    clpipe("compare", *pictures, *truths, *rows, *labels, *outputs(figure))


def with_raw(picture: Path, developed: Path) -> Comparison:
    """What :func:`compare_noise` shows, and one more column: a raw's picture, at its own places.

    Args:
        picture: NAME.png, as before.
        developed: the raw's picture.

    Raises:
        ClpipeError: a picture cannot be read, or the raw's is smaller than a place.
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
    """The figures of a camera's raw.

    Args:
        raw: the file.
        pictures: of a render by ISO, as :func:`compare_noise` takes them.
        out: the folder.

    Raises:
        ClpipeError: its picture cannot be used.
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
    """Draw the noise of a raw by intensity; of pictures by intensity, its correlation and spectrum.

    Args:
        picture: NAME.png, with its baselines, truths and normalised mosaics beside it.
        figure: the file, without ending.
        title: above it.

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
    (of_raw, of_picture), (lags, spectrum) = sheet.subplots(2, 2)
    of_raw.plot(raw.curve.mean, raw.curve.sigma, "o", color="black", markersize=4, label="measured")
    if raw.law:
        y = np.linspace(0, raw.curve.mean[-1], 200)
        law = f"√(a y + b), a = {raw.law.a:.3g}, b = {raw.law.b:.2g}"
        of_raw.plot(y, np.sqrt(np.maximum(raw.law.a * y + raw.law.b, 0)), color="black", label=law)
    caption(of_raw, "Raw: noise by intensity", "signal, 1 = white level", "sigma")
    for label, one in found.items():
        curve, table = one.curve, one.autocorrelation
        of_picture.plot(curve.mean * LEVELS, curve.sigma * LEVELS, "o-", markersize=3, label=label)
        lags.plot(range(LAGS + 1), table[LAGS, LAGS:], "o-", markersize=3, label=label)
        near = slice(LAGS - MAX_LAG, LAGS + MAX_LAG + 1)
        power, radius = spectrum_of(table[near, near])
        rings = np.digitize(radius, edges := np.linspace(0, 0.5, 17))
        middles = (edges[1:] + edges[:-1]) / 2
        spectrum.plot(
            middles, [power[rings == k].mean() for k in range(1, edges.size)], label=label
        )
    caption(of_picture, "Picture: noise by intensity", "luma, levels", "sigma of luma, levels")
    caption(lags, "Picture: autocorrelation of luma", "px to the right", "correlation")
    caption(
        spectrum, "Picture: power spectrum of luma", "cycles per pixel", "power; independent: 1"
    )
    spectrum.set_yscale("log")
    spectrum.yaxis.set_minor_formatter("")
    spectrum.set_yticks(ticks := (0.2, 0.5, 1, 2, 5, 10), [f"{tick:g}" for tick in ticks])
    for axes in (of_raw, of_picture):
        axes.set_ylim(bottom=0)
    with rc_context(STYLE):
        for suffix in SUFFIXES:
            sheet.savefig(figure.with_suffix(suffix), dpi=110, metadata=METADATA[suffix])


def caption(axes: Axes, title: str, below: str, beside: str) -> None:
    """What a plot shows."""
    axes.set_title(title, fontsize=9)
    axes.set_xlabel(below, fontsize=8)
    axes.set_ylabel(beside, fontsize=8)
    axes.tick_params(labelsize=7)
    axes.grid(alpha=0.3)
    axes.legend(fontsize=7)


def main() -> int:
    """Make the figures; the exit status."""
    parser = argparse.ArgumentParser(description=str(__doc__).partition("\n")[0])
    parser.add_argument("-o", "--output", type=Path, default=Path("figures"), metavar="FOLDER")
    parser.add_argument("--render", type=Path, default=RENDER, metavar="FILE.exr")
    parser.add_argument("--raw", type=Path, metavar="FILE", help="a camera's raw, for comparison")
    given = parser.parse_args()
    out: Path = given.output
    try:
        pictures = develop(given.render, out / "pictures")
        if given.raw:
            raw_figures(given.raw, pictures, out)
        high = pictures[ISOS[-1]]
        mosaics = [high.with_suffix(end) for end in (".normalize.exr", ".truth.normalize.exr")]
        compare_methods(demosaicing(mosaics, out / "demosaicing"), out / "demosaicing")
        for iso, picture in pictures.items():
            compare_noise(picture, out / f"iso{iso}")
        statistics(high, out / "statistics", f"Noise at ISO {ISOS[-1]}, {given.render.name}")
    except ClpipeError as error:
        print(f"figures: {error}", file=sys.stderr)
        return error.exit_status
    print(f"wrote {', '.join(sorted(path.name for path in out.glob('*.*')))} in {out}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
