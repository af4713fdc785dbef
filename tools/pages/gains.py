"""Draw the gains of denoisers on real pictures, from scores.json of tools/train_on_real.

    sh tools/run pages gains TITLE=scores.json... [-o docs/training.svg]

Each dot is a picture. Its position is the gain in PSNR over the noisy picture, for a network of one
regime. The line is the mean.
"""

import argparse
import json
from collections.abc import Mapping
from html import escape
from pathlib import Path

import numpy as np

from tools import ROOT

LABELS = {
    "awgn": "Gaussian noise, 0 to 55 levels",
    "iid": "Gaussian noise, as strong as clpipe's",
    "intensity": "the same, by intensity",
    "real": "another camera's real pairs",
    "clpipe": "clpipe",
}
LEFT, PANEL, GAP, TOP, ROW = 270, 250, 30, 56, 30  # px
LOW, HIGH = -1.0, 5.0  # dB
STYLE = """<style>
text { font: 13px sans-serif; fill: #24292e; dominant-baseline: middle; }
text.pale { fill: #5d676f; } text.middle { text-anchor: middle; } text.right { text-anchor: end; }
.paper { fill: #fcfcfb; } .grid { stroke: #dfe2e0; } .zero { stroke: #8a949b; }
.dot { fill: #8a949b; fill-opacity: .45; } .mean { stroke: #5d676f; stroke-width: 3; }
.own .dot { fill: #00796b; } .own .mean { stroke: #00796b; } .own text { font-weight: 600; }
@media (prefers-color-scheme: dark) {
text { fill: #e4e6e8; } text.pale { fill: #a0a8b0; } .paper { fill: #1f2227; }
.grid { stroke: #373d44; } .zero, .mean { stroke: #a0a8b0; } .own .dot { fill: #4db6ac; }
.own .mean { stroke: #4db6ac; }
}
</style>
"""


def gains_of(scores: Mapping[str, Mapping[str, list[list[float]]]]) -> dict[str, np.ndarray]:
    """Return each picture's gain over the noisy picture by regime, dB, as means over seeds."""
    psnr = {regime: np.mean(each["psnr"], axis=0) for regime, each in scores.items()}
    return {regime: psnr[regime] - psnr["noisy"] for regime in LABELS if regime in psnr}


def drawn(panels: Mapping[str, Mapping[str, np.ndarray]]) -> str:
    """Return the figure as SVG: a panel for each set of pictures, a row for each regime."""
    regimes = [r for r in LABELS if any(r in gains for gains in panels.values())]
    width = LEFT + len(panels) * (PANEL + GAP)
    height = TOP + ROW * len(regimes) + 34
    parts = [f'<rect width="{width}" height="{height}" rx="6" class="paper"/>']
    for row, regime in enumerate(regimes):
        own = ' class="own"' if regime == "clpipe" else ""
        y = TOP + ROW * (row + 0.5)
        parts.append(f'<g{own}><text x="14" y="{y}">{escape(LABELS[regime])}</text></g>')
    for number, (title, gains) in enumerate(panels.items()):
        left = LEFT + number * (PANEL + GAP)

        def x(gain: float, left: float = left) -> float:
            return left + PANEL * (min(max(gain, LOW), HIGH) - LOW) / (HIGH - LOW)

        count = len(next(iter(gains.values())))
        middle = left + PANEL / 2
        parts.append(f'<text class="middle" x="{middle}" y="20">{escape(title)}</text>')
        subtitle = f"{count} pictures, gain over the noisy one"
        parts.append(f'<text class="pale middle" x="{middle}" y="38">{subtitle}</text>')
        bottom = TOP + ROW * len(regimes)
        for tick in range(int(LOW), int(HIGH) + 1):
            kind = "grid" if tick else "zero"
            at = f'x1="{x(tick):.1f}" x2="{x(tick):.1f}" y1="{TOP}" y2="{bottom}"'
            parts.append(f'<line class="{kind}" {at}/>')
            label = f"{tick:+d}" if tick else "0 dB"
            parts.append(
                f'<text class="pale middle" x="{x(tick):.1f}" y="{bottom + 14}">{label}</text>'
            )
        for row, regime in enumerate(regimes):
            if regime not in gains:
                continue
            y = TOP + ROW * (row + 0.5)
            dots = "".join(
                f'<circle class="dot" cx="{x(g):.1f}" cy="{y}" r="4"/>' for g in gains[regime]
            )
            mean = float(np.mean(gains[regime]))
            at = f'x1="{x(mean):.1f}" x2="{x(mean):.1f}" y1="{y - 10}" y2="{y + 10}"'
            own = ' class="own"' if regime == "clpipe" else ""
            label = f'<text class="pale" x="{left + PANEL - 6:.1f}" y="{y}">{mean:+.1f}</text>'
            parts.append(f'<g{own}>{dots}<line class="mean" {at}/>{label}</g>')
    size = f'viewBox="0 0 {width} {height}" width="{width}" height="{height}"'
    title = "What a small denoiser gains on real cameras' pictures, by what it was trained on"
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" {size} role="img" aria-label="{escape(title)}">\n'
        + STYLE
        + "\n".join(parts)
        + "\n</svg>\n"
    )


def main() -> None:
    """Read the scores, and draw the figure."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scores", nargs="+", metavar="TITLE=scores.json")
    parser.add_argument("-o", "--output", type=Path, default=ROOT / "docs" / "training.svg")
    options = parser.parse_args()
    panels = {}
    for each in options.scores:
        title, _, path = each.partition("=")
        panels[title] = gains_of(json.loads(Path(path).read_text("utf-8"))["regimes"])
    options.output.write_text(drawn(panels), "utf-8")


if __name__ == "__main__":
    main()
