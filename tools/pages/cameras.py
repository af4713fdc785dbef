"""Measure all camera profiles, for docs/camera_quality.md.

    tools/run pages cameras

It writes the page: sharpness, visual noise and dynamic range of the default chain with each
profile, at three ISOs.
"""

import math

from clpipe.analysis.quality.measure import chain_quality
from clpipe.base.text import one_line
from clpipe.camera.profile import built_in_cameras, load_camera
from clpipe.chain.settings import settings_from
from clpipe.commands.cameras import make_and_model
from clpipe.engine.device import open_device
from clpipe.engine.service import Service
from tools import ROOT
from tools.shared.options import parser_of
from tools.shared.tables import markdown

ISOS = (100, 1600, 6400)
FIGURES = {
    "MTF50, cycles/px": ("mtf50", ".3f"),
    "visual noise": ("visual_noise", ".1f"),
    "dynamic range, stops": ("dynamic_range", ".1f"),
}
PAGE = ROOT / "docs" / "camera_quality.md"
TEXT = """# Cameras by image quality

[`clpipe quality`](image_quality.md) measured the default chain with each built-in profile.
`tools/run pages cameras` writes this page.

A profile contains neither a lens nor a development. Sharpness therefore depends on the filter
array, and on denoising, which follows the noise. Visual noise is for a middle grey. A dash marks an
ISO that the profile does not have, or a figure that no patch of the chart shows.

"""


def main() -> None:
    """Measure, and write the page."""
    parser_of(__doc__).parse_args()
    service = Service([open_device(None)])
    rows = []
    for name in built_in_cameras():
        camera = load_camera(name)
        low, high = camera.iso_range
        reports = [
            chain_quality("", settings_from({"camera": name, "iso": iso}), service, 480, 480)
            if low <= iso <= high
            else None
            for iso in ISOS
        ]
        cells = [
            "-" if report is None or math.isnan(value := report.figures[key]) else f"{value:{form}}"
            for key, form in FIGURES.values()
            for report in reports
        ]
        print(name, *cells)
        rows.append([f"`{name}`", one_line(make_and_model(camera)), *cells])
    heads = [f"{text}, ISO {iso}" for text in FIGURES for iso in ISOS]
    PAGE.write_text(TEXT + markdown(["profile", "camera", *heads], rows) + "\n", "utf-8")
    print(PAGE.relative_to(ROOT))


if __name__ == "__main__":
    main()
