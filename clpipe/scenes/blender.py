"""Renders scenes in a Blender of its own process: bpy of this Python, or an installed program."""

import importlib.util
import json
import subprocess
import sys
from collections import deque
from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import IO, Any, Self

from clpipe.base.errors import ClpipeError, RequestError
from clpipe.base.files import write_new

SCRIPT = Path(__file__).with_name("blender_script.py")
ASKED = ".rendering.json"  # what is asked, in the folder of the renders
MARK = "@clpipe "  # before each line that the script says to us
LAST_LINES = 12  # of Blender's own, which are shown when it ends unexpectedly


class RenderError(ClpipeError):
    """Blender ended before everything was rendered."""


@dataclass(frozen=True)
class Rendering:
    """A request to Blender.

    Args:
        scene: the .blend file.
        folder: where NAME.exr of each view is written; those that are there stay.
        views: which: ``{"frames": [numbers]}``, ``{"cameras": [records]}``, or ``{"path": "orbit",
            "count": N, "seed": S, "box": None}``, where a box is six numbers.
        resolution: width and height in px; None is the scene's.
        samples: of light paths for each pixel.
        time_limit: seconds for each view; None has none.
        denoise: whether the renderer takes its own noise away.
        seed: of the light paths.
        faces: of a cube, which are rendered in place of each view: their "side" in px, and
            "turns", the rotation from each one's axes to the camera's, by its name; None renders
            views.
    """

    scene: Path
    folder: Path
    views: Mapping[str, Any]
    resolution: tuple[int, int] | None
    samples: int
    time_limit: float | None
    denoise: bool
    seed: int
    faces: Mapping[str, Any] | None = None

    def record(self) -> dict[str, Any]:
        """The rendering as JSON values."""
        return {**asdict(self), "scene": str(self.scene), "folder": str(self.folder)}


@dataclass(frozen=True)
class Scene:
    """What Blender says of a scene before it renders.

    Args:
        blender: its version.
        views: a record for each view: file, width, height, K, R and t, as in a ``cameras.json``.
        objects: the names of objects by their index.
        layers: the names of depth, normals and object numbers in its EXRs.
        unit_metres: how long a unit is; None where the scene does not say.
        notes: of views that see too little, and what was done about it.
    """

    blender: str
    views: list[dict[str, Any]]
    objects: dict[str, list[str]]
    layers: list[str]
    unit_metres: float | None
    notes: list[str] = field(default_factory=list)


def blender_command(program: str | None, asked: Path) -> list[str]:
    """What runs our script in Blender.

    Args:
        program: an installed Blender, or a Python that has the package bpy; None is this Python.
        asked: the file that says what is asked.

    Raises:
        RequestError: this Python has no bpy.
    """
    if program is None and importlib.util.find_spec("bpy") is None:
        raise RequestError(
            "a .blend is rendered by Blender, and none is here: name an installed one with "
            "--blender PATH, or a Python that has the package bpy"
        )
    if program is None or Path(program).name.startswith("python"):
        return [program or sys.executable, str(SCRIPT), str(asked)]
    quiet = ("--background", "--factory-startup", "--python-exit-code", "1")
    return [program, *quiet, "--python", str(SCRIPT), "--", str(asked)]


class Renderer(AbstractContextManager["Renderer"]):
    """A Blender that renders views in the background; it ends with the context.

    Args:
        rendering: what is asked.
        program: see :func:`blender_command`.

    Raises:
        RequestError: there is no Blender, or it cannot be started.
    """

    def __init__(self, rendering: Rendering, program: str | None = None) -> None:
        asked = rendering.folder / ASKED
        command = blender_command(program, asked)
        write_new(asked, json.dumps(rendering.record()).encode())
        self._path, self._asked = rendering.scene, asked
        self._latest: deque[str] = deque(maxlen=LAST_LINES)
        try:
            self._process = subprocess.Popen(  # noqa: S603 - the user's own Blender
                command,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                text=True,
                errors="replace",
            )
        except OSError as error:
            raise RequestError(f"--blender: {program}: {error.strerror}") from None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.stop()
        with self._process:  # closes what it says, and waits
            pass
        self._asked.unlink(missing_ok=True)

    def stop(self) -> None:
        """End it; what it had begun is lost, and done again by the next one."""
        self._process.terminate()

    def scene(self) -> Scene:
        """What is to be rendered, once Blender has read the file.

        Raises:
            RequestError: the scene cannot be rendered.
            RenderError: Blender ended.
        """
        values = self._event("scene")
        return Scene(**{each.name: values[each.name] for each in fields(Scene)})

    def rendered(self, count: int) -> Iterator[tuple[str, float]]:
        """The name of each view as soon as it is there, and the seconds that it took, or 0.

        Raises:
            RenderError: one cannot be rendered, or Blender ended.
        """
        for _ in range(count):
            values = self._event("rendered")
            yield values["name"], values["seconds"]

    def _event(self, kind: str) -> Mapping[str, Any]:
        output: IO[str] | None = self._process.stdout
        assert output
        for line in output:
            if not line.startswith(MARK):
                self._latest.append(line.rstrip())
                continue
            values: dict[str, Any] = json.loads(line[len(MARK) :])
            if values["event"] == "refused":
                refused = RequestError if kind == "scene" else RenderError
                raise refused(f"{self._path}: {values['message']}")
            if values["event"] == kind:
                return values
        status = self._process.wait()
        said = "\n  ".join(self._latest)
        raise RenderError(f"{self._path}: Blender ended with status {status}; it said:\n  {said}")
