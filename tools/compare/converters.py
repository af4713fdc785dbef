"""Develop clpipe's DNG of a chart with other raw converters, for the table in docs/outputs.md.

    tools/run compare converters [-c CONFIG ...] [-o OUT]

`clpipe run` develops a ColorChecker at ISO 100 without noise, and writes its DNG. dcraw,
darktable-cli and RawTherapee develop the DNG (Debian: apt-get install dcraw darktable rawtherapee).
The tool names and skips converters that are not installed. It prints the levels of the grey and the
white patch, and the errors of hue.

dcraw brightens by histogram, except with -W. RawTherapee takes its tones from the preview in the
DNG with -d, the profile that its window gives to a raw. Its neutral profile has no tone curve.
"""

import os
import shutil
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image

from clpipe.analysis.quality.charts import CHECKER, checker, patch_image, patches_of
from clpipe.analysis.quality.colour import checker_errors
from clpipe.base.types import Array
from clpipe.images.write import write_exr
from tools import ROOT
from tools.shared.options import parser_of
from tools.shared.pictures import enlarged
from tools.shared.tables import markdown

LIMIT = 600  # seconds for each development
CHART = patch_image(checker())
SCALE = 2  # enlargement of the chart
BORDER = 8  # px that a converter may crop on each side; RawTherapee crops 4
WHITE = 18  # the number of the white patch


class ComparisonError(Exception):
    """A development failed. The message names it and the reason."""


@dataclass(frozen=True)
class Converter:
    """A raw converter.

    Args:
        name: its name in the table.
        package: Debian's package.
        command: the command, with DNG, PICTURE and HOME (a private folder) as placeholders. Without
            PICTURE, it prints the picture.
    """

    name: str
    package: str
    command: str


DARKTABLE = "darktable-cli DNG PICTURE --core --disable-opencl --configdir HOME --library :memory:"
CONVERTERS = (
    Converter("RawTherapee", "rawtherapee", "rawtherapee-cli -d -o PICTURE -n -b8 -Y -c DNG"),
    Converter("dcraw", "dcraw", "dcraw -w -T -c DNG"),
    Converter("darktable", "darktable", DARKTABLE),
    Converter("dcraw -W -b 2", "dcraw", "dcraw -w -W -b 2 -T -c DNG"),
    Converter("RawTherapee, neutral", "rawtherapee", "rawtherapee-cli -o PICTURE -n -b8 -Y -c DNG"),
    Converter("dcraw -W", "dcraw", "dcraw -w -W -T -c DNG"),
)


def convert(converter: Converter, negative: Path, picture: Path) -> None:
    """Develop a DNG with a converter in a private home folder, so without a user's settings.

    Raises:
        ComparisonError: the converter fails.
    """
    home = picture.parent / "home"
    home.mkdir(parents=True, exist_ok=True)
    picture.unlink(missing_ok=True)
    words = {"DNG": negative, "PICTURE": picture, "HOME": home}
    command = [str(words.get(word, word)) for word in converter.command.split()]
    homes = {"HOME": str(home), "XDG_CONFIG_HOME": str(home), "XDG_CACHE_HOME": str(home)}
    printed = run(command, **homes)
    if "PICTURE" not in converter.command:
        picture.write_bytes(printed)
    if not picture.exists():
        raise ComparisonError(f"{converter.name} wrote no picture of {negative}")


def read_picture(path: Path, height: int, width: int) -> Array:
    """Read a development, (height, width, 3) uint8.

    If the converter cropped the borders, its outermost pixels are repeated.

    Raises:
        ComparisonError: the picture has another size.
    """
    with Image.open(path) as image:
        pixels = np.asarray(image.convert("RGB"))
    cropped = height - pixels.shape[0], width - pixels.shape[1]
    if not all(count in range(0, 2 * BORDER + 1, 2) for count in cropped):
        size = f"{pixels.shape[1]}x{pixels.shape[0]}"
        raise ComparisonError(f"{path} is {size}; expected {width}x{height}, the render's size")
    down, right = (count // 2 for count in cropped)
    return np.pad(pixels, ((down, down), (right, right), (0, 0)), "edge")


def run(command: Sequence[str], **variables: str) -> bytes:
    """Run a program, and return its standard output.

    Raises:
        ComparisonError: the program fails, or takes more than ten minutes.
    """
    environment = os.environ | variables
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


def row(name: str, picture: Path) -> list[str]:
    """Return the table's row of a development of the chart."""
    height, width = (side * SCALE for side in CHART.shape[:2])
    small = read_picture(picture, height, width)[None, ::SCALE, ::SCALE]
    means = patches_of(small).mean((1, 2, 3))
    of = checker_errors(means, np.array(CHECKER))
    hue = f"{of.hue:.1f} / {of.most_hue:.1f}"
    return [name, f"{of.grey_level:.0f}", f"{means[WHITE, 1]:.0f}", hue]


def compare(out: Path, configs: Sequence[str], converters: Sequence[Converter]) -> list[list[str]]:
    """Develop the chart, and return the rows of the table.

    Raises:
        ComparisonError: a program fails.
    """
    out.mkdir(parents=True, exist_ok=True)
    write_exr(out / "chart.exr", enlarged(CHART, SCALE), "RGB", {})
    rows = []
    for number, config in enumerate(configs):
        command = [sys.executable, "-m", "clpipe", "run", str(out / "chart.exr"), "--iso", "100"]
        command += ["-o", str(out / str(number)), "-c", config, "--truth", "development"]
        formats = ["--format", "png", "--format", "dng", "--quiet", "--redo", "all"]
        run([*command, *formats])
        rows.append(row(f"clpipe, {Path(config).stem}", out / str(number) / "chart.truth.png"))
    for converter in converters:
        picture = out / converter.name / "chart.png"
        convert(converter, out / "0" / "chart.truth.dng", picture)
        rows.append(row(converter.name, picture))
    return rows


def main() -> int:
    """Compare the installed converters."""
    parser = parser_of(__doc__)
    further = "in addition to the default; may be repeated"
    parser.add_argument("-c", "--config", action="append", default=[], help=further)
    folder = ROOT / "build/converters"
    parser.add_argument("-o", "--output", type=Path, default=folder, metavar="OUT")
    options = parser.parse_args()
    installed = [c for c in CONVERTERS if shutil.which(c.command.split()[0])]
    for missing in (c for c in CONVERTERS if c not in installed):
        print(f"{missing.name} is skipped: apt-get install {missing.package}", file=sys.stderr)
    try:
        rows = compare(options.output.resolve(), ("default", *options.config), installed)
    except ComparisonError as error:
        print(f"compare_converters: {error}", file=sys.stderr)
        return 1
    print(markdown(["", "grey patch (122)", "white patch", "hue, degrees: median / largest"], rows))
    return 0


if __name__ == "__main__":
    sys.exit(main())
