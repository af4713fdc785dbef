"""Develop clpipe's raws with other raw converters, and put them beside clpipe's own pictures.

    tools/run compare converters [RENDER ...] [-c CONFIG ...]

`clpipe run` writes pictures and DNGs, with and without noise; dcraw, darktable-cli and RawTherapee
develop the DNGs (Debian: apt-get install dcraw darktable rawtherapee). Those that are missing are
named and left out. Three tables are printed, and crops written to the output folder:

Noise: the signature (clpipe.analysis.matching.columns) of a noisy development less the same without
noise, and dots that noise makes. Kurtosis also on the flat patches of a saturated chart.

Colours: the patches of a ColorChecker at ISO 100 without noise, against the chart, in CIELAB.

Edges: at ISO 100 without noise, the middle of each render and the saturated chart against what
their own development makes of the same enlarged eight times, where no pixel is interpolated
across an edge. So each is compared with its own tone and colours, whatever they are; what
smoothing and sharpening change counts.

Converters run as they come, and so their colours are compared: dcraw brightens by histogram, and
RawTherapee, with the profile that its window gives to a raw (-d), takes its tones from the preview
in the DNG. Both would make two exposures of one, so noise and edges are compared without: dcraw
with -W, RawTherapee with its neutral profile. These two have no tone curve, and are darker by the
headroom that clpipe's exposure leaves in the raw; what is darker errs by fewer levels.
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
from clpipe.analysis.signature import BRIGHTEST, DARKEST, flat_mask, luma
from clpipe.base.errors import ClpipeError
from clpipe.base.types import Array, Floats, Mask
from clpipe.images.read import read_image
from clpipe.images.write import write_exr
from tools import RENDER, ROOT
from tools.compare.charts import (
    chart_image,
    chart_patches,
    patch_means,
    patch_places,
    saturated_image,
)
from tools.compare.fidelity import colour_errors, delta_e, dots, psnr
from tools.pages.side_by_side import COLUMNS, cells, markdown, sheet, telling_places

LIMIT = 600  # seconds a development
BASE_ISO = 100
ENLARGED = 8
MIDDLE = 512  # px, the side of the part of a render that is enlarged
BORDER = 8  # px that count nowhere; RawTherapee cuts off 4
SMALLEST = 128, 128  # px, of a render: height, width
CHART, SATURATED = "chart", "saturated"


class ComparisonError(Exception):
    """A development failed; the message says which, and how."""


@dataclass(frozen=True)
class Converter:
    """A raw converter: its command, with words for the DNG, the picture and a folder of its own.

    It prints the picture where PICTURE is no word of the command. One that ``adapts`` chooses its
    tones by the picture: of that one colours are compared, and nothing else.
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
    """The developments: OUT/MAKER/isoISO/NAME.png, without noise NAME.truth.png.

    A maker is a converter or a configuration of clpipe, the first of which makes the DNGs, too.
    """

    out: Path
    configs: tuple[str, ...]
    converters: tuple[Converter, ...]

    @property
    def makers(self) -> dict[str, str]:
        """What each maker is called in tables, and its folder."""
        ours = {f"clpipe, {Path(c).stem}": f"clpipe-{Path(c).stem}" for c in self.configs}
        return ours | {c.name: c.name for c in self.converters}

    @property
    def steady(self) -> list[str]:
        """The makers that develop each picture alike."""
        adapting = {c.name for c in self.converters if c.adapts}
        return [maker for maker in self.makers if maker not in adapting]

    def folder(self, maker: str, iso: float) -> Path:
        """Where a maker's pictures of an ISO are."""
        return self.out / self.makers[maker] / f"iso{iso:g}"

    def develop(self, images: Sequence[Path], iso: float, noisy: bool = True) -> None:
        """Develop renders, with and without noise by the steady makers; else, without, by all.

        Raises:
            ComparisonError: a program fails.
        """
        ours = list(self.makers)[: len(self.configs)]
        for config, maker in zip(self.configs, ours, strict=True):
            dng = ["--format", "dng"] if maker == ours[0] else []
            command = [sys.executable, "-m", "clpipe", "run", *images]
            command += [
                "-o",
                self.folder(maker, iso),
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
        """Develop a DNG with a converter whose settings are nobody's: its folders are its own.

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
            raise ComparisonError(f"{converter.name} made nothing of {negative}")

    def picture(self, maker: str, iso: float, name: str, noisy: bool = True) -> Array:
        """A development, (height, width, 3) uint8, of the size of clpipe's own.

        What a converter cuts off at its borders is filled with its outermost pixels.

        Raises:
            ComparisonError: it has another size.
        """
        file = f"{name}.png" if noisy else f"{name}.truth.png"
        with Image.open(self.folder(next(iter(self.makers)), iso) / file) as own:
            wanted = own.size[::-1]
        with Image.open(self.folder(maker, iso) / file) as image:
            pixels = np.asarray(image.convert("RGB"))
        lacking = [(want - have) for want, have in zip(wanted, pixels.shape, strict=False)]
        if not all(lack in range(0, 2 * BORDER + 1, 2) for lack in lacking):
            raise ComparisonError(
                f"{self.folder(maker, iso) / file} is {pixels.shape[1]}x{pixels.shape[0]}; "
                f"expected {wanted[1]}x{wanted[0]}, as clpipe makes it"
            )
        down, right = (lack // 2 for lack in lacking)
        return np.pad(pixels, ((down, down), (right, right), (0, 0)), "edge")


def run(command: Sequence[str], environment: dict[str, str]) -> bytes:
    """What a program prints.

    Raises:
        ComparisonError: it fails, or takes more than ten minutes.
    """
    try:
        done = subprocess.run(
            command, capture_output=True, env=environment, timeout=LIMIT, check=False
        )
    except subprocess.TimeoutExpired:
        raise ComparisonError(f"{command[0]}: not done after {LIMIT} s") from None
    if done.returncode:
        lines = done.stderr.decode(errors="replace").strip().splitlines() or ["it said nothing"]
        raise ComparisonError(f"{Path(command[0]).name} failed: {lines[-1]}")
    return done.stdout


def inside(shape: Sequence[int]) -> Mask:
    """The pixels that are not of the border, (height, width)."""
    mask = np.zeros(shape[:2], bool)
    mask[BORDER:-BORDER, BORDER:-BORDER] = True
    return mask


def noise_rows(
    comparison: Comparison, names: Sequence[str], isos: Sequence[float]
) -> Iterator[list[str]]:
    """The rows of the table of noise."""
    for iso in isos:
        for maker in comparison.steady:
            chart = [comparison.picture(maker, iso, SATURATED, noisy) for noisy in (True, False)]
            y = luma(chart[1])
            patches = patch_places(len(y)) & (y >= DARKEST) & (y <= BRIGHTEST)
            saturated = signature(*chart, patches)["kurtosis"]
            for name in names:
                noisy, clean = (comparison.picture(maker, iso, name, n) for n in (True, False))
                found = signature(noisy, clean, flat_mask(clean) & inside(clean.shape))
                made = dots(noisy, clean)
                yield [name, f"{iso:g}", maker, *cells(found), f"{saturated:.1f}", f"{made:.1f}"]


def colour_rows(comparison: Comparison) -> Iterator[list[str]]:
    """The rows of the table of colours."""
    for maker in comparison.makers:
        means = patch_means(comparison.picture(maker, BASE_ISO, CHART, noisy=False))
        of = colour_errors(means, chart_patches())
        turned = f"{of.hue:.1f} / {of.largest_hue:.1f}"
        yield [maker, f"{of.grey:.0f}", f"{of.lightness:+.1f}", turned, f"{of.chroma:.2f}"]


def edge_rows(comparison: Comparison, names: Sequence[str]) -> Iterator[list[str]]:
    """The rows of the table of edges."""
    for name in names:
        for maker in comparison.steady:
            small = comparison.picture(maker, BASE_ISO, name, noisy=False)
            large = comparison.picture(maker, BASE_ISO, f"{name}-enlarged", noisy=False)
            reference, picture = (
                x[BORDER:-BORDER, BORDER:-BORDER] for x in (reduced(large), small)
            )
            far = (delta_e(picture, reference) > 20).mean()
            near, lone = psnr(picture, reference), dots(picture, reference)
            yield [name, maker, f"{near:.1f}", f"{far:.2%}", f"{lone:.1f}"]


def enlarged(image: Floats) -> Floats:
    """An image of which each pixel is a block of eight by eight."""
    return image.repeat(ENLARGED, 0).repeat(ENLARGED, 1)


def reduced(picture: Array) -> Array:
    """The middle of each block of eight by eight, the mean of four pixels, (height, width, 3)."""
    height, width = (side // ENLARGED for side in picture.shape[:2])
    middle = slice(ENLARGED // 2 - 1, ENLARGED // 2 + 1)
    blocks = picture.reshape(height, ENLARGED, width, ENLARGED, 3)
    return blocks[:, middle, :, middle].mean((1, 3))


def middle_of(image: Floats) -> Floats:
    """The middle of an image, at most 512 pixels a side."""
    height, width = (min(side, MIDDLE) for side in image.shape[:2])
    top, left = (image.shape[0] - height) // 2, (image.shape[1] - width) // 2
    return image[top : top + height, left : left + width]


def crops(comparison: Comparison, names: Sequence[str], isos: Sequence[float]) -> Image.Image:
    """The sheet: two places of each image, a column a maker."""
    makers = comparison.steady
    rows = {}
    for name in names:
        places = telling_places(comparison.picture(makers[0], isos[0], name, noisy=False))
        for place in places:
            for iso in isos:
                pictures = [comparison.picture(maker, iso, name) for maker in makers]
                rows[f"{name}, {place.name}, ISO {iso:g}"] = [place.of(each) for each in pictures]
    return sheet(makers, rows)


def compare(comparison: Comparison, renders: Sequence[Path], isos: Sequence[float]) -> None:
    """Develop, print the tables, write the crops.

    Raises:
        ComparisonError: a program fails.
        ClpipeError: a render cannot be read.
    """
    images = {}
    for path in renders:
        image = images[path.stem] = middle_of(read_image(path).pixels.astype(np.float32))
        if image.shape[0] < SMALLEST[0] or image.shape[1] < SMALLEST[1]:
            raise ComparisonError(
                f"{path} is {image.shape[1]}x{image.shape[0]}; give a render of at least "
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
    """Compare what is there."""
    parser = argparse.ArgumentParser(description=str(__doc__).partition("\n")[0])
    parser.add_argument("renders", nargs="*", type=Path, metavar="RENDER", help="[the still life]")
    parser.add_argument(
        "-c", "--config", action="append", default=[], help="beside the default; may be repeated"
    )
    parser.add_argument("--iso", action="append", type=float, help="may be repeated [1600, 6400]")
    parser.add_argument(
        "-o", "--output", type=Path, default=ROOT / "build/converters", metavar="OUT"
    )
    given = parser.parse_args()
    configs = ("default", *given.config)
    if len({Path(config).stem for config in configs}) < len(configs):
        parser.error(f"two configurations have one name: {', '.join(configs)}")
    there = [c for c in CONVERTERS if shutil.which(c.command.split()[0])]
    for missing in (c for c in CONVERTERS if c not in there):
        print(f"{missing.name} is left out: apt-get install {missing.package}", file=sys.stderr)
    comparison = Comparison(given.output.resolve(), configs, tuple(there))
    try:
        compare(comparison, given.renders or [RENDER], given.iso or [1600.0, 6400.0])
    except (ComparisonError, ClpipeError) as error:
        print(f"compare_converters: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
