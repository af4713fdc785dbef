"""Develop clpipe's raws with other raw converters, and compare them with clpipe's own pictures.

    tools/run compare converters [RENDER ...] [-c CONFIG ...]

`clpipe run` writes pictures and DNGs, with and without noise. dcraw, darktable-cli and RawTherapee
develop the DNGs (Debian: apt-get install dcraw darktable rawtherapee). The tool names and skips
converters that are not installed. It prints three tables, and writes crops to the output directory.

Noise: the signature (clpipe.analysis.matching.columns) of a noisy development minus the same
development without noise, and dots caused by noise. Kurtosis is also measured on the flat patches
of a saturated chart.

Colours: the patches of a ColorChecker at ISO 100 without noise, compared with the chart in CIELAB.

Edges: at ISO 100 without noise, the middle of each render and the saturated chart. The reference is
the same converter's development of the image enlarged eight times, where interpolation never
crosses an edge. So tone and colours of a converter cancel out. Smoothing and sharpening count.

Colours are compared with each converter's default settings. dcraw brightens by histogram.
RawTherapee, with the profile that its window gives to a raw (-d), takes its tones from the preview
in the DNG. Both adapt the exposure to the picture. Noise and edges are therefore compared without
adaptation: dcraw with -W, RawTherapee with its neutral profile. These two have no tone curve, and
are darker by the headroom that clpipe's exposure leaves in the raw. Errors of dark pictures are
smaller in levels.
"""

import argparse
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image

from clpipe.analysis.matching.columns import signature
from clpipe.analysis.signature import BRIGHTEST, DARKEST, flat_mask
from clpipe.base.errors import ClpipeError
from clpipe.base.types import Array, Floats, Mask
from clpipe.images.read import read_image
from clpipe.images.write import write_exr
from clpipe.reference.colour import luma
from tools import RENDER, ROOT
from tools.compare.charts import (
    chart_image,
    chart_patches,
    patch_means,
    patch_places,
    saturated_image,
)
from tools.compare.fidelity import colour_errors, delta_e, dots, psnr
from tools.pages.comparison_page import COLUMNS, cells, markdown, sheet, significant_places

LIMIT = 600  # seconds for each development
BASE_ISO = 100
ENLARGED = 8
MIDDLE = 512  # px, side of the enlarged part of a render
BORDER = 8  # px that are excluded everywhere; RawTherapee crops 4
SMALLEST = 128, 128  # px, height and width of a render
CHART, SATURATED = "chart", "saturated"


class ComparisonError(Exception):
    """A development failed. The message names it and the reason."""


@dataclass(frozen=True)
class Converter:
    """A raw converter.

    Args:
        name: the heading in tables.
        package: Debian's package.
        command: the command, with DNG, PICTURE and HOME (a private folder) as placeholders. Without
            PICTURE, it prints the picture.
        adapts: whether tones depend on the picture. If so, only colours are compared.
    """

    name: str
    package: str
    command: str
    adapts: bool = False


CONVERTERS = (
    Converter("dcraw", "dcraw", "dcraw -w -T -c DNG", adapts=True),
    Converter("dcraw -W", "dcraw", "dcraw -w -W -T -c DNG"),
    Converter(
        "darktable",
        "darktable",
        "darktable-cli DNG PICTURE --core --disable-opencl --configdir HOME --library :memory:",
    ),
    Converter(
        "RawTherapee",
        "rawtherapee",
        "rawtherapee-cli -d -o PICTURE -n -b8 -Y -c DNG",
        adapts=True,
    ),
    Converter("RawTherapee, neutral", "rawtherapee", "rawtherapee-cli -o PICTURE -n -b8 -Y -c DNG"),
)


@dataclass(frozen=True)
class Comparison:
    """The developments in OUT/DEVELOPER/isoISO: NAME.png, and NAME.truth.png without noise.

    A developer is a configuration of clpipe or a converter. The first configuration also writes the
    DNGs.
    """

    out: Path
    configs: tuple[str, ...]
    converters: tuple[Converter, ...]

    @property
    def developers(self) -> dict[str, str]:
        """Names of the developers in tables, with their folders."""
        ours = {f"clpipe, {Path(c).stem}": f"clpipe-{Path(c).stem}" for c in self.configs}
        return ours | {c.name: c.name for c in self.converters}

    @property
    def steady(self) -> list[str]:
        """The developers whose tones do not depend on the picture."""
        adapting = {c.name for c in self.converters if c.adapts}
        return [developer for developer in self.developers if developer not in adapting]

    def folder(self, developer: str, iso: float) -> Path:
        """Return the folder of a developer's pictures at an ISO."""
        return self.out / self.developers[developer] / f"iso{iso:g}"

    def develop(self, images: Sequence[Path], iso: float, noisy: bool = True) -> None:
        """Develop renders: with and without noise by ``steady``, or only without noise by all.

        Raises:
            ComparisonError: a program fails.
        """
        ours = list(self.developers)[: len(self.configs)]
        for config, developer in zip(self.configs, ours, strict=True):
            dng = ["--format", "dng"] if developer == ours[0] else []
            command = [sys.executable, "-m", "clpipe", "run", *images]
            command += [
                "-o",
                self.folder(developer, iso),
                "-c",
                config,
                "--iso",
                iso,
                "--truth",
                "development",
                "--format",
                "png",
            ]
            run([*map(str, command), *dng, "--quiet", "--redo", "all"], os.environ.copy())
        for converter in self.converters:
            for image in images if not (noisy and converter.adapts) else ():
                for name in (image.stem, f"{image.stem}.truth")[not noisy :]:
                    negative = self.folder(ours[0], iso) / f"{name}.dng"
                    picture = self.folder(converter.name, iso) / f"{name}.png"
                    self.convert(converter, negative, picture)

    def convert(self, converter: Converter, negative: Path, picture: Path) -> None:
        """Develop a DNG with a converter in a private home folder, so without a user's settings.

        Raises:
            ComparisonError: the converter fails.
        """
        home = self.out / converter.name / "home"
        words = {"DNG": negative, "PICTURE": picture, "HOME": home}
        for folder in (home, picture.parent):
            folder.mkdir(parents=True, exist_ok=True)
        picture.unlink(missing_ok=True)
        command = [str(words.get(word, word)) for word in converter.command.split()]
        homes = {"HOME": str(home), "XDG_CONFIG_HOME": str(home), "XDG_CACHE_HOME": str(home)}
        printed = run(command, os.environ | homes)
        if "PICTURE" not in converter.command:
            picture.write_bytes(printed)
        if not picture.exists():
            raise ComparisonError(f"{converter.name} wrote no picture of {negative}")

    def picture(self, developer: str, iso: float, name: str, noisy: bool = True) -> Array:
        """Read a development, (height, width, 3) uint8, in the size of clpipe's picture.

        If a converter crops the borders, its outermost pixels are repeated.

        Raises:
            ComparisonError: the picture has another size.
        """
        file = f"{name}.png" if noisy else f"{name}.truth.png"
        with Image.open(self.folder(next(iter(self.developers)), iso) / file) as own:
            expected = own.size[::-1]
        with Image.open(self.folder(developer, iso) / file) as image:
            pixels = np.asarray(image.convert("RGB"))
        cropped = [(full - side) for full, side in zip(expected, pixels.shape, strict=False)]
        if not all(count in range(0, 2 * BORDER + 1, 2) for count in cropped):
            raise ComparisonError(
                f"{self.folder(developer, iso) / file} is {pixels.shape[1]}x{pixels.shape[0]}; "
                f"expected {expected[1]}x{expected[0]}, the size of clpipe's picture"
            )
        down, right = (count // 2 for count in cropped)
        return np.pad(pixels, ((down, down), (right, right), (0, 0)), "edge")


def run(command: Sequence[str], environment: dict[str, str]) -> bytes:
    """Run a program, and return its standard output.

    Raises:
        ComparisonError: the program fails, or takes more than ten minutes.
    """
    try:
        done = subprocess.run(
            command, capture_output=True, env=environment, timeout=LIMIT, check=False
        )
    except subprocess.TimeoutExpired:
        raise ComparisonError(f"{command[0]} did not end within {LIMIT} s") from None
    if done.returncode:
        lines = done.stderr.decode(errors="replace").strip().splitlines() or ["it printed nothing"]
        raise ComparisonError(f"{Path(command[0]).name} failed: {lines[-1]}")
    return done.stdout


def inside(shape: Sequence[int]) -> Mask:
    """Return the mask, (height, width), of pixels inside the border."""
    mask = np.zeros(shape[:2], bool)
    mask[BORDER:-BORDER, BORDER:-BORDER] = True
    return mask


def noise_rows(
    comparison: Comparison, names: Sequence[str], isos: Sequence[float]
) -> Iterator[list[str]]:
    """Yield the rows of the table of noise."""
    for iso in isos:
        for developer in comparison.steady:
            chart = [
                comparison.picture(developer, iso, SATURATED, noisy) for noisy in (True, False)
            ]
            y = luma(chart[1])
            patches = patch_places(len(y)) & (y >= DARKEST) & (y <= BRIGHTEST)
            saturated = signature(*chart, patches)["kurtosis"]
            for name in names:
                noisy, clean = (comparison.picture(developer, iso, name, n) for n in (True, False))
                found = signature(noisy, clean, flat_mask(clean) & inside(clean.shape))
                made = dots(noisy, clean)
                yield [
                    name,
                    f"{iso:g}",
                    developer,
                    *cells(found),
                    f"{saturated:.1f}",
                    f"{made:.1f}",
                ]


def colour_rows(comparison: Comparison) -> Iterator[list[str]]:
    """Yield the rows of the table of colours."""
    for developer in comparison.developers:
        means = patch_means(comparison.picture(developer, BASE_ISO, CHART, noisy=False))
        of = colour_errors(means, chart_patches())
        hue = f"{of.hue:.1f} / {of.largest_hue:.1f}"
        yield [developer, f"{of.grey:.0f}", f"{of.lightness:+.1f}", hue, f"{of.chroma:.2f}"]


def edge_rows(comparison: Comparison, names: Sequence[str]) -> Iterator[list[str]]:
    """Yield the rows of the table of edges."""
    for name in names:
        for developer in comparison.steady:
            small = comparison.picture(developer, BASE_ISO, name, noisy=False)
            large = comparison.picture(developer, BASE_ISO, f"{name}-enlarged", noisy=False)
            reference, picture = (
                x[BORDER:-BORDER, BORDER:-BORDER] for x in (reduced(large), small)
            )
            differing = (delta_e(picture, reference) > 20).mean()
            ratio, isolated = psnr(picture, reference), dots(picture, reference)
            yield [name, developer, f"{ratio:.1f}", f"{differing:.2%}", f"{isolated:.1f}"]


def enlarged(image: Floats) -> Floats:
    """Enlarge an image eight times; each pixel becomes a block."""
    return image.repeat(ENLARGED, 0).repeat(ENLARGED, 1)


def reduced(picture: Array) -> Array:
    """Return the middle of each block of 8x8, the mean of four pixels, (height, width, 3)."""
    height, width = (side // ENLARGED for side in picture.shape[:2])
    middle = slice(ENLARGED // 2 - 1, ENLARGED // 2 + 1)
    blocks = picture.reshape(height, ENLARGED, width, ENLARGED, 3)
    return blocks[:, middle, :, middle].mean((1, 3))


def middle_of(image: Floats) -> Floats:
    """Crop the middle of an image, at most 512 pixels a side."""
    height, width = (min(side, MIDDLE) for side in image.shape[:2])
    top, left = (image.shape[0] - height) // 2, (image.shape[1] - width) // 2
    return image[top : top + height, left : left + width]


def crops(comparison: Comparison, names: Sequence[str], isos: Sequence[float]) -> Image.Image:
    """Return a sheet with two crops of each image, in a column for each developer."""
    developers = comparison.steady
    rows = {}
    for name in names:
        places = significant_places(comparison.picture(developers[0], isos[0], name, noisy=False))
        for place in places:
            for iso in isos:
                pictures = [comparison.picture(developer, iso, name) for developer in developers]
                rows[f"{name}, {place.name}, ISO {iso:g}"] = [place.of(each) for each in pictures]
    return sheet(developers, rows)


def compare(comparison: Comparison, renders: Sequence[Path], isos: Sequence[float]) -> None:
    """Develop the renders, print the tables, and write the crops.

    Raises:
        ComparisonError: a program fails.
        ClpipeError: a render cannot be read.
    """
    images = {}
    for path in renders:
        image = images[path.stem] = middle_of(read_image(path).pixels.astype(np.float32))
        if image.shape[0] < SMALLEST[0] or image.shape[1] < SMALLEST[1]:
            raise ComparisonError(
                f"{path} is {image.shape[1]}x{image.shape[0]}; choose a render of at least "
                f"{SMALLEST[1]}x{SMALLEST[0]}"
            )
    edges = {f"{name}-middle": image for name, image in images.items()}
    edges[SATURATED] = saturated_image()
    made = {CHART: chart_image(), **edges}
    made |= {f"{name}-enlarged": enlarged(image) for name, image in edges.items()}
    folder = comparison.out / "renders"
    folder.mkdir(parents=True, exist_ok=True)
    paths = {name: folder / f"{name}.exr" for name in made}
    for name, image in made.items():
        write_exr(paths[name], image, "RGB", {})
    for iso in isos:
        print(f"ISO {iso:g} ...", file=sys.stderr, flush=True)
        comparison.develop([*renders, paths[SATURATED]], iso)
    print(
        f"## Noise\n\n{markdown(NOISE_HEADS, noise_rows(comparison, [*images], isos))}", flush=True
    )
    written = comparison.out / "crops.png"
    crops(comparison, [*images, SATURATED], isos).save(written)
    print("charts and edges ...", file=sys.stderr, flush=True)
    comparison.develop(list(paths.values()), BASE_ISO, noisy=False)
    print(f"\n## Colours\n\n{markdown(COLOUR_HEADS, colour_rows(comparison))}", flush=True)
    print(f"\n## Edges\n\n{markdown(EDGE_HEADS, edge_rows(comparison, [*edges]))}")
    print(f"crops at 400 %: {written}", file=sys.stderr)


NOISE_HEADS = ["render", "ISO", "", *(head for head, *_ in COLUMNS), "kurtosis, saturated", "dots"]
COLOUR_HEADS = ["", "grey patch (122)", "mean L*", "hue, degrees: median / largest", "chroma"]
EDGE_HEADS = ["image", "", "PSNR", "dE > 20", "dots in 10,000"]


def main() -> int:
    """Compare the installed converters."""
    parser = argparse.ArgumentParser(description=str(__doc__).partition("\n")[0])
    parser.add_argument("renders", nargs="*", type=Path, metavar="RENDER", help="[the still life]")
    parser.add_argument(
        "-c",
        "--config",
        action="append",
        default=[],
        help="in addition to the default; may be repeated",
    )
    parser.add_argument("--iso", action="append", type=float, help="may be repeated [1600, 6400]")
    parser.add_argument(
        "-o", "--output", type=Path, default=ROOT / "build/converters", metavar="OUT"
    )
    options = parser.parse_args()
    configs = ("default", *options.config)
    if len({Path(config).stem for config in configs}) < len(configs):
        parser.error(f"two configurations have the same name: {', '.join(configs)}")
    installed = [c for c in CONVERTERS if shutil.which(c.command.split()[0])]
    for missing in (c for c in CONVERTERS if c not in installed):
        print(f"{missing.name} is skipped: apt-get install {missing.package}", file=sys.stderr)
    comparison = Comparison(options.output.resolve(), configs, tuple(installed))
    try:
        compare(comparison, options.renders or [RENDER], options.iso or [1600.0, 6400.0])
    except (ComparisonError, ClpipeError) as error:
        print(f"compare_converters: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
