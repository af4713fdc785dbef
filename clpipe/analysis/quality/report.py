"""The image quality of a camera or of a picture: figures with names, and curves."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from clpipe.analysis.report import json_value
from clpipe.base.types import Doubles

CONTRASTS = (10.0, 4.0, 1.5)  # of the slanted edges
MAIN = 4.0  # the contrast of ISO 12233


class Figure(NamedTuple):
    """A figure: its section, its text with the unit, and the format of its value."""

    section: str
    text: str
    form: str = ".1f"


def _edge_figures() -> dict[str, Figure]:
    texts = {
        "mtf50": ("MTF50, cycles/px", ".3f"),
        "mtf10": ("MTF10, cycles/px", ".3f"),
        "nyquist": ("MTF at 0.5 cycles/px", ".2f"),
        "overshoot": ("overshoot, %", ".1f"),
        "undershoot": ("undershoot, %", ".1f"),
    }
    return {
        edge_figure(name, contrast): Figure(
            "Sharpness", text + f", contrast {contrast:g}:1" * (contrast != MAIN), form
        )
        for name, (text, form) in texts.items()
        for contrast in sorted(CONTRASTS, key=lambda each: each != MAIN)
    }


def edge_figure(name: str, contrast: float) -> str:
    """Return the name of a figure of an edge; that of the main contrast has no suffix.

    >>> edge_figure("mtf50", 4), edge_figure("mtf50", 1.5)
    ('mtf50', 'mtf50_at_1.5')
    """
    return name if contrast == MAIN else f"{name}_at_{contrast:g}"


FIGURES: Mapping[str, Figure] = {
    **_edge_figures(),
    **{
        f"mtf50_{name}": Figure("Sharpness", f"MTF50 of {name}, cycles/px", ".3f")
        for name in ("red", "green", "blue")
    },
    "edge_red": Figure("Sharpness", "red against green at edges, px", ".2f"),
    "edge_blue": Figure("Sharpness", "blue against green at edges, px", ".2f"),
    "chroma_edge": Figure("Sharpness", "chroma edge, 10 to 90 %, px"),
    "texture_mtf50": Figure("Sharpness", "texture MTF50, cycles/px", ".3f"),
    "acutance": Figure("Sharpness", "texture acutance", ".2f"),
    "snr": Figure("Noise", "SNR at middle grey, dB"),
    "visual_noise": Figure("Noise", "visual noise at middle grey"),
    "dynamic_range": Figure("Noise", "dynamic range, stops"),
    "grey_level": Figure("Tone", "level of middle grey", ".0f"),
    "gamma": Figure("Tone", "gamma at middle grey", ".2f"),
    "clipping": Figure("Tone", "clipping above middle grey, EV"),
    "black": Figure("Tone", "level of the darkest grey"),
    "delta_e": Figure("Colour", "CIEDE2000, mean"),
    "most_delta_e": Figure("Colour", "CIEDE2000, largest"),
    "delta_c": Figure("Colour", "CIEDE2000 without lightness, mean"),
    "lightness": Figure("Colour", "difference of L*, mean"),
    "hue": Figure("Colour", "hue error, degrees, median"),
    "most_hue": Figure("Colour", "hue error, degrees, largest"),
    "chroma": Figure("Colour", "chroma over the chart's, median", ".2f"),
    "white_balance": Figure("Colour", "white balance error, C*"),
    "grey_axis": Figure("Colour", "grey axis, largest C*"),
    "delta_e_a": Figure("Colour", "CIEDE2000 under light A, mean"),
    "white_balance_a": Figure("Colour", "white balance error under light A, C*"),
    "shading": Figure("Lens", "light in the corners, % of the centre"),
    "darkest_corner": Figure("Lens", "light in the darkest corner, % of the centre"),
    "color_shading": Figure("Lens", "colour shading, %"),
    "distortion": Figure("Lens", "distortion farthest from the centre, %", ".2f"),
    "most_distortion": Figure("Lens", "largest distortion, %", ".2f"),
    "lateral_red": Figure("Lens", "lateral colour of red, px", ".2f"),
    "lateral_blue": Figure("Lens", "lateral colour of blue, px", ".2f"),
    "corners": Figure("Lens", "MTF50 in the corners, % of the centre", ".0f"),
    "corner_red": Figure("Lens", "red against green at edges in the corners, px", ".2f"),
    "corner_blue": Figure("Lens", "blue against green at edges in the corners, px", ".2f"),
    "glare": Figure("Lens", "veiling glare, %", ".2f"),
    "capacity": Figure("Detection", "information capacity, bits/px", ".2f"),
    "detection": Figure("Detection", "2:1 contrast detected in 90 %, from EV"),
}


class Curve(NamedTuple):
    """A curve of a report."""

    x: Doubles
    y: Doubles


@dataclass(frozen=True)
class Quality:
    """The image quality of a camera or picture.

    Args:
        name: of the camera or picture.
        figures: values by names in :data:`FIGURES`; NaN if they could not be measured.
        curves: curves by title and label.
        found: the charts that a picture has; empty for a simulated camera.
        warnings: about the picture's file.
    """

    name: str
    figures: Mapping[str, float]
    curves: Mapping[tuple[str, str], Curve] = field(default_factory=dict)
    found: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()

    def record(self) -> dict[str, Any]:
        """Return the report as JSON values; figures that could not be measured are null."""
        curves: dict[str, dict[str, Any]] = {}
        for (title, label), curve in self.curves.items():
            curves.setdefault(title, {})[label] = {"x": curve.x, "y": curve.y}
        sections: dict[str, dict[str, float]] = {}
        for name, value in self.figures.items():
            sections.setdefault(FIGURES[name].section.lower(), {})[name] = value
        return {
            "name": self.name,
            "found": list(self.found),
            "warnings": list(self.warnings),
            **json_value(sections),
            "curves": json_value(curves),
        }


def table(reports: Sequence[Quality]) -> list[tuple[str, str, list[str]]]:
    """Return the section, the text and the values of each figure that a report has."""
    rows = []
    for name, figure in FIGURES.items():
        values = [report.figures.get(name, math.nan) for report in reports]
        if any(name in report.figures for report in reports):
            cells = ["-" if math.isnan(v) else format(v, f"z{figure.form}") for v in values]
            rows.append((figure.section, figure.text, cells))
    return rows
