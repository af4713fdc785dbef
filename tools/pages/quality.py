"""Measure the quality of demosaicing and denoising, for docs/quality.md.

Demosaicing: CPSNR of eight Kodak pictures and of the project's own render after mosaic and
demosaic: RGGB, rounded to 8 bits, without a border of 10 pixels. The Kodak pictures are kodim01.png
and so on, in a folder that is named or next to the checkout; without them they are skipped. The
exit status is 1 if a figure is missed by more than 0.05 dB.

Denoising: CPSNR of the project's own render at several ISOs, developed to 8 bits with each method,
against the same development without noise and without denoising.
"""

import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

import clpipe
from clpipe.base.types import Array
from clpipe.chain.registry import all_stages
from clpipe.images.read import read_image
from clpipe.reference.cfa import PATTERNS
from clpipe.reference.curve import to_8_bit
from clpipe.reference.filter_array import NAMED
from clpipe.stages import DEFAULT_CHAIN
from tools import RENDER, ROOT
from tools.compare.fidelity import psnr
from tools.shared.options import parser_of
from tools.shared.tables import markdown

KODAK = ROOT.parent / "shared" / "data" / "kodak"
BORDER = 10
ISOS = (400, 1600, 6400)
Choice = Mapping[str, str | int]

KODAK_NUMBERS = (1, 5, 8, 13, 19, 20, 23, 24)
LAROCHE = {"method": "edge_directed", "classifier": "laroche_prescott"}
# The target of each method on these pictures: figures of independent implementations (the last two:
# colour-demosaicing 0.2.7).
DEMOSAIC: dict[str, tuple[Choice, float | None]] = {
    "bounded": ({"method": "bounded"}, None),
    "bilinear": ({"method": "bilinear"}, 27.76),
    "edge_directed, hibbard": ({"method": "edge_directed", "classifier": "hibbard"}, 31.00),
    "edge_directed, laroche_prescott": (LAROCHE, 32.24),
    "edge_directed, hamilton_adams": ({"method": "edge_directed"}, 35.11),
    "median, 3": ({"method": "median"}, 34.68),
    "median, 5": ({"method": "median", "size": 5}, None),
    "edge_directed_median, 3": ({"method": "edge_directed_median"}, 37.56),
    "edge_directed_median, 5": ({"method": "edge_directed_median", "size": 5}, None),
    "malvar2004": ({"method": "malvar2004"}, 33.53),
    "menon2007": ({"method": "menon2007"}, 37.47),
    "linear_mmse": ({"method": "linear_mmse"}, None),
    "directional_mmse": ({"method": "directional_mmse"}, None),
    **{
        f"{method}, {name}": ({"method": method, "array": name}, None)
        for name in NAMED
        if name not in ("mono", *PATTERNS)
        for method in ("linear_mmse", "directional_mmse")
    },
}
TOLERANCE = 0.05
BEFORE_DEMOSAIC = DEFAULT_CHAIN.index("demosaic")
DENOISE: dict[str, dict[str, Any]] = {
    "none": {"skip": ["denoise"]},
    **{name: {"denoise": {"method": name}} for name in all_stages()["denoise"].by_name},
    "mosaic_denoise": {
        "stages": [
            *DEFAULT_CHAIN[:BEFORE_DEMOSAIC],
            "mosaic_denoise",
            *DEFAULT_CHAIN[BEFORE_DEMOSAIC:],
        ],
        "skip": ["denoise"],
    },
}
NOISE = ("sensor_noise", "row_noise", "column_noise", "quantize", "normalize")


def cpsnr(one: Array, two: Array) -> float:
    """Return the colour peak signal-to-noise ratio of two uint8 RGB images, in dB."""
    inside = slice(BORDER, -BORDER)
    return psnr(one[inside, inside], two[inside, inside])


def kodak(folder: Path) -> list[Array]:
    """Return the Kodak pictures of a folder, (height, width, 3) uint8; [] if one is missing."""
    paths = [folder / f"kodim{number:02}.png" for number in KODAK_NUMBERS]
    if not all(path.is_file() for path in paths):
        return []
    return [np.asarray(Image.open(path).convert("RGB")) for path in paths]


def camera_of(choice: Choice) -> clpipe.Pipeline:
    """Return a pipeline of mosaic (an "array", or RGGB) and demosaic."""
    own = {key: value for key, value in choice.items() if key != "array"}
    laid = {"method": "array", "array": choice["array"]} if "array" in choice else {}
    return clpipe.Pipeline(stages=["mosaic", "demosaic"], demosaic=own, mosaic=laid)


def demosaicing(truths: Sequence[Array], choice: Choice) -> float:
    """Return the mean CPSNR of a method over uint8 pictures, in dB."""
    camera = camera_of(choice)
    results = camera.process_many(truth / np.float32(255) for truth in truths)
    pairs = zip(results, truths, strict=True)
    return float(np.mean([cpsnr(to_8_bit(result.image), truth) for result, truth in pairs]))


def denoising(render: Array, iso: int, method: str) -> float:
    """Return the CPSNR of the finished picture at an ISO against one without noise, in dB."""
    part = DENOISE[method]
    noisy = clpipe.Pipeline(iso=iso, **part).process(render, "quality")
    clean = clpipe.Pipeline(iso=iso, skip=[*NOISE, "denoise"]).process(render, "quality")
    return cpsnr(noisy.image, clean.image)


def measure_demosaicing(folder: Path, render: Array) -> bool:
    """Print the table of demosaicing methods; return whether each target is met."""
    photographs = kodak(folder)
    own = [clpipe.Pipeline(stages=["gamma"]).process(render, "").image]
    rows, right = [], True
    for name, (choice, expected) in DEMOSAIC.items():
        found, should = "", f"{expected:.2f}" if expected else ""
        if photographs:
            value = demosaicing(photographs, choice)
            found = f"{value:.2f}"
            if expected and abs(value - expected) > TOLERANCE:
                right, should = False, f"{should} MISSED"
        rows.append([name, found, should, f"{demosaicing(own, choice):.2f}"])
    if not photographs:
        print(f"{folder} does not contain the Kodak pictures; skipped")
    print("CPSNR in dB\n")
    print(markdown(["demosaic", "Kodak, 8", "target", "own render"], rows))
    return right


def measure_denoising(render: Array) -> None:
    """Print the table of denoising methods."""
    rows = [
        [method, *(f"{denoising(render, iso, method):.2f}" for iso in ISOS)] for method in DENOISE
    ]
    print("\nCPSNR of the finished picture in dB\n")
    print(markdown(["denoise, own render", *(f"ISO {iso}" for iso in ISOS)], rows))


def main() -> int:
    """Measure and print the tables."""
    parser = parser_of(__doc__)
    parser.add_argument("--pictures", type=Path, default=KODAK, metavar="DIR", help="[%(default)s]")
    folder = parser.parse_args().pictures
    render = read_image(RENDER).pixels
    right = measure_demosaicing(folder, render)
    measure_denoising(render)
    return 0 if right else 1


if __name__ == "__main__":
    sys.exit(main())
