"""Measure edges, chroma, lens and tone of developed pictures, next to the ranges of real cameras.

    sh tools/run compare look [-c CONFIG]... [RENDER]...

Edges are slanted, grey, and at four angles. They are measured in means of many frames, because
noise displaces those of single ones. Texture is the share of a dead leaves image's contrast, at 0.3
cycles/px, that correlates with the image. A chroma edge has the same luma on both sides, and is
measured in the JPEG. The faults of a lens are those of 32 draws of lens=typical. Tone is that of
RENDERs, by default the project's own.
"""

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from clpipe.analysis.quality.charts import slanted_edge
from clpipe.analysis.sharpness import Edge, edges_in, median_edge, sharpest
from clpipe.base.types import Array, Doubles, Floats
from clpipe.chain.files import load_configs
from clpipe.chain.making import make_chain
from clpipe.chain.settings import Settings, overlay
from clpipe.chain.truth import picture_without_noise
from clpipe.engine.device import open_device
from clpipe.engine.runner import Runner
from clpipe.images.jpeg import JpegEncoding, jpeg_round_trip
from clpipe.images.read import read_image
from clpipe.reference.transfer import inverse_srgb_curve
from clpipe.scenes.leaves import dead_leaves
from tools import RENDER
from tools.shared.options import parser_of
from tools.shared.tables import markdown

ISOS, CONTRASTS, ANGLES = (100, 400, 1600, 6400, 25600), (10.0, 4.0, 1.5), (5, 20, 70, 85)
FRAMES = 16
LUMA = np.array([0.2126, 0.7152, 0.0722])
CB, CR = np.array([-0.1687, -0.3313, 0.5]), np.array([0.5, -0.4187, -0.0813])
WARM, COLD = np.array([0.25, 0.16, 0.12]), np.array([0.12, 0.2, 0.3])  # sides of a chroma edge
BAND = (0.29, 0.31)  # cycles/px, of texture
LEAVES = 512  # px
DRAWS, SIDE = 32, (1080, 1920)  # of a typical lens
# 10, 50 and 90 % of real cameras: 119 to 130 finished pictures (docs/validation.md).
REAL = {
    "MTF50, cycles/px": "0.12 / 0.27 / 0.40; good DSLRs 0.32 to 0.40",
    "MTF at 0.5 cycles/px": "0.04 / 0.11 / 0.31",
    "overshoot, %": "0.5 to 4 / 17; sharp ones 5 to 13",
    "chroma edge, 10 to 90 %, px": "3.8 / 5.2 / 7.1",
    "lateral colour at the corner, red and blue, px": "median 0.48 and 0.61; 90 % 1.3 and 1.7",
    "width of edges, corner over centre": "1.39",
    "pixels with a channel at 0, %": "0.1 / 1.0 / 5.6",
    "white pixels, %": "0.03 / 0.88 / 4",
    "median level": "53 / 109 / 156",
}


class Camera:
    """Develops renders with settings."""

    def __init__(self, settings: Settings, truth: str = "", name: str = "") -> None:
        chain = make_chain(settings.drawn(name))
        chain = picture_without_noise(truth, chain) if truth else chain
        self._runner, self._frames = Runner(chain, open_device(None)), 1 if truth else FRAMES

    def pictures(self, render: Floats, frames: int = 0) -> Iterator[Array]:
        """Yield frames of a render, uint8, with noise of their own."""
        for number in range(frames or self._frames):
            encoded = self._runner.run(render, f"look {number}").encoded
            assert encoded is not None
            yield encoded

    def mean(self, render: Floats) -> Array:
        """Return the mean of frames, uint8."""
        return np.mean(list(self.pictures(render)), axis=0).round().astype(np.uint8)


def edge_of(camera: Camera, contrast: float) -> Edge:
    """Return the median of developed edges."""
    renders = [slanted_edge(contrast, angle) for angle in ANGLES]
    return median_edge([e for render in renders for e in edges_in(camera.mean(render))])


def texture(camera: Camera, leaves: Floats) -> float:
    """Return the share of a texture's contrast that a picture has, relative to coarse detail."""
    window = np.hanning(LEAVES) * np.hanning(LEAVES)[:, None]
    frequency = np.hypot(*np.meshgrid(*[np.fft.fftfreq(LEAVES)] * 2))
    picture = inverse_srgb_curve(next(camera.pictures(leaves, 1)) / 255) @ LUMA
    before, after = (np.fft.fft2((p - p.mean()) * window) for p in (leaves @ LUMA, picture))

    def share(low: float, high: float) -> float:
        at = (frequency > low) & (frequency <= high)
        return float((after * before.conj())[at].real.sum() / (abs(before[at]) ** 2).sum())

    return share(*BAND) / share(0.01, 0.04)


def chroma_width(camera: Camera, encoding: JpegEncoding) -> float:
    """Return the distance over which chroma changes from 10 to 90 % across an edge, px."""
    share = (slanted_edge(4.0, 0)[..., :1] - 0.09) / 0.27
    cold = COLD * (WARM @ LUMA) / (COLD @ LUMA)
    render = (WARM + (cold - WARM) * share).astype(np.float32)
    frames = [jpeg_round_trip(picture, encoding) for picture in camera.pictures(render)]
    rows = np.mean(frames, axis=0)[20:-20].mean(0)
    widths = []
    for weights in (CB, CR):
        profile = rows @ weights
        low, high = profile[:20].mean(), profile[-20:].mean()
        rise = (profile - low) / (high - low)
        at = np.flatnonzero((rise[:-1] < 0.5) & (rise[1:] >= 0.5))[0]
        left, right = rise[: at + 1][::-1], rise[at:]
        widths.append(_crossing(right, 0.9) + _crossing(1 - left, 0.9))
    return float(np.mean(widths))


def _crossing(rise: Doubles, level: float) -> float:
    after = int(np.argmax(rise > level))
    return after - 1 + float((level - rise[after - 1]) / (rise[after] - rise[after - 1]))


def lens_faults(settings: Settings) -> dict[str, str]:
    """Return lateral colour at the corner, and how much wider edges are there."""
    height, width = SIDE
    scene = np.tile(slanted_edge(4.0, 20), (height // 120, width // 120, 1))
    shifts, rises = [], []
    for number in range(DRAWS):
        lens = overlay(settings, {"lens": "typical"})
        [picture] = Camera(lens, "clean", f"lens {number}").pictures(scene, 1)
        corners = [picture[:240, :240], picture[-240:, -240:], picture[:240, -240:]]
        middle = np.s_[height // 2 - 120 : height // 2 + 120, width // 2 - 120 : width // 2 + 120]
        corner = median_edge([e for part in corners for e in edges_in(part)])
        shifts.append((corner.red, corner.blue))
        rises.append(median_edge(edges_in(picture[middle])).mtf50 / corner.mtf50)
    medians, high = (np.percentile(shifts, q, axis=0) for q in (50, 90))
    text = f"median {medians[0]:.2f} and {medians[1]:.2f}; 90 % {high[0]:.2f} and {high[1]:.2f}"
    names = list(REAL)[4:6]
    return dict(zip(names, (text, f"{np.median(rises):.2f}"), strict=True))


def tone(settings: Settings, paths: Sequence[str]) -> dict[str, str]:
    """Return statistics of developed renders, means over all."""
    rows = []
    for path in paths:
        picture = next(Camera(settings).pictures(read_image(Path(path)).pixels[..., :3], 1))
        black, white = (picture == 0).any(-1).mean(), (picture == 255).all(-1).mean()
        edge = sharpest(edges_in(picture))
        rows.append((black, white, np.median(picture @ LUMA), edge.mtf50 if edge else np.nan))
    black, white, median, mtf50 = np.nanmean(rows, axis=0)
    figures = f"{100 * black:.2f}", f"{100 * white:.2f}", f"{median:.0f}"
    return {
        **dict(zip(list(REAL)[6:], figures, strict=True)),
        "sharpest quarter of edges in renders, MTF50": f"{mtf50:.2f}",
    }


def print_tables(settings: Settings, renders: Sequence[str]) -> None:
    """Measure, and print Markdown."""
    output = settings.output
    encoding = JpegEncoding(output.jpeg_quality, output.jpeg_subsampling)
    leaves = dead_leaves(LEAVES, LEAVES, seed=3).image
    leaves = (leaves * (0.18 / leaves.mean())).astype(np.float32)
    heading = ["", *(f"ISO {iso}" for iso in ISOS), "real cameras"]
    rows: dict[str, list[str]] = {}
    for iso in ISOS:
        at = overlay(settings, {"iso": iso})
        for contrast in CONTRASTS:
            edge = edge_of(Camera(at), contrast)
            clean, same = (edge_of(Camera(at, t), contrast) for t in ("clean", "development"))
            name = f"contrast {contrast:g}:1"
            for figure, text in (
                ("MTF50, cycles/px", f"{edge.mtf50:.3f}"),
                ("MTF at 0.5 cycles/px", f"{edge.nyquist:.2f}"),
                ("overshoot, %", f"{100 * edge.overshoot:.1f}"),
                ("truths clean and development, MTF50", f"{clean.mtf50:.3f}, {same.mtf50:.3f}"),
            ):
                rows.setdefault(f"{figure}, {name}", []).append(text)
        rows.setdefault("texture at 0.3 cycles/px", []).append(f"{texture(Camera(at), leaves):.2f}")
        width = chroma_width(Camera(at), encoding)
        rows.setdefault("chroma edge, 10 to 90 %, px", []).append(f"{width:.1f}")
    for name, cells in rows.items():
        cells.append(next((text for figure, text in REAL.items() if name.startswith(figure)), ""))
    print(markdown(heading, ([name, *cells] for name, cells in sorted(rows.items()))))
    found = {**lens_faults(settings), **tone(settings, renders)}
    every = ([name, text, REAL.get(name, "")] for name, text in found.items())
    print(f"\n{markdown(['', 'clpipe', 'real cameras'], every)}")


def main() -> None:
    """Measure, and print Markdown."""
    parser = parser_of(__doc__)
    parser.add_argument("renders", nargs="*", default=[str(RENDER)], metavar="RENDER")
    parser.add_argument("-c", "--config", action="append", default=[])
    options = parser.parse_args()
    settings = load_configs(options.config).settings if options.config else Settings()
    print_tables(settings, options.renders)


if __name__ == "__main__":
    main()
