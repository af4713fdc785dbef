"""Renders scenes with Blender in a separate process: an installed program, or the package bpy."""

import importlib.util
import json
import subprocess
import sys
from collections import deque
from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import IO, Any

from clpipe.base.errors import ClpipeError, RequestError
from clpipe.base.files import write_new

SCRIPT = Path(__file__).with_name("blender_script.py")
REQUEST_FILE = ".rendering.json"  # name of the request's file in the folder of the renders
EVENT_PREFIX = "@clpipe "  # prefix of the script's messages on standard output
LAST_LINES = 12  # lines of Blender's output to show if it ends unexpectedly


class RenderError(ClpipeError):
    """Blender ended before all views were rendered."""


@dataclass(frozen=True)
class Rendering:
    """A request to Blender.

    Args:
        scene: the .blend file.
        folder: the folder for NAME.exr of each view. Existing files are skipped.
        views: ``{"frames": [numbers]}``, ``{"cameras": [records]}``, or ``{"path": "orbit",
            "count": N, "seed": S, "box": None}``, where a box is six numbers.
        resolution: width and height in px; None uses the scene's.
        samples: the number of light paths for each pixel.
        time_limit: the limit in seconds for each view; None is no limit.
        denoise: whether the renderer removes its own noise.
        seed: the seed of the light paths.
        faces: faces of a cube to render instead of each view: "side" in px, and "turns", the
            rotation from each face's axes to the camera's, by name; None renders views.
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
        """Return the request as JSON values."""
        return {**asdict(self), "scene": str(self.scene), "folder": str(self.folder)}


@dataclass(frozen=True)
class Scene:
    """Blender's description of a scene, sent before it renders.

    Args:
        blender: Blender's version.
        views: a record for each view, like in a ``cameras.json``: file, width, height, K, R, t.
        objects: the names of objects, by index.
        layers: the names of the layers of depth, normals and object indices in the EXRs.
        unit_metres: the length of a unit in metres; None if the scene does not state it.
        notes: sentences about views that see too little, and which views replaced them.
    """

    blender: str
    views: list[dict[str, Any]]
    objects: dict[str, list[str]]
    layers: list[str]
    unit_metres: float | None
    notes: list[str] = field(default_factory=list)


def blender_command(program: str | None, request_path: Path) -> list[str]:
    """Return the command that runs clpipe's script in Blender.

    Args:
        program: an installed Blender, or a Python with the package bpy; None is this Python.
        request_path: the file with the request.

    Raises:
        RequestError: this Python has no bpy.
    """
    if program is None and importlib.util.find_spec("bpy") is None:
        raise RequestError(
            "this Python lacks the package bpy, which renders a .blend; install it, or pass an "
            "installed Blender, or a Python that has bpy, with --blender PATH"
        )
    if program is None or Path(program).name.startswith("python"):
        return [program or sys.executable, str(SCRIPT), str(request_path)]
    quiet = ("--background", "--factory-startup", "--python-exit-code", "1")
    return [program, *quiet, "--python", str(SCRIPT), "--", str(request_path)]


class Renderer(AbstractContextManager["Renderer"]):
    """A Blender process that renders views in the background. It ends with the context.

    Args:
        rendering: the request.
        program: see :func:`blender_command`.

    Raises:
        RequestError: there is no Blender, or it cannot be started.
    """

    def __init__(self, rendering: Rendering, program: str | None = None) -> None:
        request_path = rendering.folder / REQUEST_FILE
        command = blender_command(program, request_path)
        write_new(request_path, json.dumps(rendering.record()).encode())
        self._path, self._asked = rendering.scene, request_path
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
            raise RequestError(
                f"--blender: {program} cannot be started: {error.strerror}; give the path of "
                "Blender's program"
            ) from None

    def __exit__(self, *error: object) -> None:
        self.stop()
        with self._process:  # closes the process's output, and waits
            pass
        self._asked.unlink(missing_ok=True)

    def stop(self) -> None:
        """End Blender. Unfinished views are lost, and rendered again by the next process."""
        self._process.terminate()

    def scene(self) -> Scene:
        """Wait until Blender has read the file, and return the description of the scene.

        Raises:
            RequestError: the scene cannot be rendered.
            RenderError: Blender ended.
        """
        values = self._event("scene")
        return Scene(**{each.name: values[each.name] for each in fields(Scene)})

    def rendered(self, count: int) -> Iterator[tuple[str, float]]:
        """Yield the name of each finished view, with its render time in s; 0 if it existed.

        Raises:
            RenderError: a view cannot be rendered, or Blender ended.
        """
        for _ in range(count):
            values = self._event("rendered")
            yield values["name"], values["seconds"]

    def _event(self, kind: str) -> Mapping[str, Any]:
        output: IO[str] | None = self._process.stdout
        assert output
        for line in output:
            if not line.startswith(EVENT_PREFIX):
                self._latest.append(line.rstrip())
                continue
            values: dict[str, Any] = json.loads(line[len(EVENT_PREFIX) :])
            if values["event"] == "refused":
                error_type = RequestError if kind == "scene" else RenderError
                raise error_type(f"{self._path}: {values['message']}")
            if values["event"] == kind:
                return values
        status = self._process.wait()
        last_output = "\n  ".join(self._latest)
        raise RenderError(
            f"{self._path}: Blender ended with status {status}. Its last output:\n  {last_output}"
        )
