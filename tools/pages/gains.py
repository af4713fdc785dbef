"""Draw the gains of denoisers on real pictures, from scores.json of tools/train_on_real.

    sh tools/run pages gains TITLE=scores.json... [-o docs/training.svg]

Each dot is a picture. Its position is the gain in PSNR over the noisy picture, for a network of one
regime. The line is the mean.
"""

import json
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from tools import ROOT
from tools.shared.drawing import svg, text, upright
from tools.shared.options import parser_of

LABELS = {
    "awgn": "Gaussian noise, 0 to 55 levels",
    "iid": "Gaussian noise, as strong as clpipe's",
    "real": "another camera's real pairs",
    "clpipe": "clpipe",
}
LEFT, PANEL, GAP, TOP, ROW = 270, 250, 80, 56, 30  # px; the means are in the gap
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
    groups = ['<g class="own">' if regime == "clpipe" else "<g>" for regime in regimes]
    middles = [TOP + ROW * (row + 0.5) for row in range(len(regimes))]
    bottom = TOP + ROW * len(regimes)
    parts = [
        f"{group}{text(14, y, LABELS[regime])}</g>"
        for group, y, regime in zip(groups, middles, regimes, strict=True)
    ]
    for number, (title, gains) in enumerate(panels.items()):
        left = LEFT + number * (PANEL + GAP)
        count = len(next(iter(gains.values())))
        parts.append(text(left + PANEL / 2, 20, title, "middle"))
        subtitle = f"{count} pictures, gain over the noisy one"
        parts.append(text(left + PANEL / 2, 38, subtitle, "pale middle"))
        for tick in range(int(LOW), int(HIGH) + 1):
            x = left + across(tick)
            label = f"{tick:+d}" if tick else "0 dB"
            parts.append(upright(x, TOP, bottom, "grid" if tick else "zero"))
            parts.append(text(x, bottom + 14, label, "pale middle"))
        for group, y, regime in zip(groups, middles, regimes, strict=True):
            own = gains.get(regime, np.array([]))
            dots = (
                f'<circle class="dot" cx="{left + across(g):.1f}" cy="{y}" r="4"/>' for g in own
            )
            parts += [group, *dots]
            if own.size:
                mean = float(own.mean())
                parts.append(upright(left + across(mean), y - 10, y + 10, "mean"))
                parts.append(text(left + PANEL + 18, y, f"{mean:+.1f}", "pale"))
            parts.append("</g>")
    width = LEFT + len(panels) * (PANEL + GAP)
    label = "What a small denoiser gains on real cameras' pictures, by what it was trained on"
    return svg(width, bottom + 34, STYLE, parts, label)


def across(gain: float) -> float:
    """Return the distance of a gain in dB from the left of its panel, px."""
    return PANEL * (min(max(gain, LOW), HIGH) - LOW) / (HIGH - LOW)


def main() -> None:
    """Read the scores, and draw the figure."""
    parser = parser_of(__doc__)
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
