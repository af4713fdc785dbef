"""Programs of the project's developers, in groups; ``sh tools/run GROUP NAME`` runs one.

compare sets clpipe beside other programs, stress looks for faults, pages measures and draws what
the documentation shows, reconstruction is the paper's experiment, blender makes the extension and
the test render. Modules import those of other groups by their full names; examples are for users
and import clpipe alone.
"""

from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
RENDER = ROOT / "tests" / "data" / "still_life.exr"
