"""Programs for the project's developers, in groups. ``sh tools/run GROUP NAME`` runs one.

- compare: compares clpipe with other programs.
- stress: looks for faults.
- pages: measures and draws figures for the documentation.
- reconstruction: repeats the paper's experiment.
- training: trains denoisers on clpipe's pictures.
- blender: builds the extension and the test render.
- examples: scripts for users, which import only clpipe.
- shared: what several groups use; it contains no tool.

Modules import those of other groups by their full names.
"""

from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
RENDER = ROOT / "tests" / "data" / "still_life.exr"
