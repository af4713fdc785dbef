"""Develops linear renders with ``clpipe run`` in a separate process, without bpy."""

import importlib.util
import os
import subprocess
import sys
import tempfile
from collections import deque
from dataclasses import dataclass
from pathlib import Path
from typing import IO

PRIVATE = Path(__file__).with_name("private")  # packages that Blender has in other versions


class DevelopmentError(Exception):
    """A picture cannot be made. The message is shown to the user."""


@dataclass(frozen=True)
class Settings:
    """The settings of the panel.

    Args:
        camera: name or path of a profile; "" for the camera of the look.
        look: name or path of a configuration.
        iso: the ISO.
        seed: of the noise.
        keep_raw: also write the raw as DNG.
    """

    camera: str
    look: str
    iso: int
    seed: int
    keep_raw: bool

    def options(self) -> list[str]:
        """Return the settings as options of ``clpipe run``."""
        options = ["--config", self.look, "--iso", str(self.iso), "--seed", str(self.seed)]
        if self.camera:
            options += ["--camera", self.camera]
        if self.keep_raw:
            options += ["--format", "jpg", "--format", "dng"]
        return options


@dataclass(frozen=True)
class Render:
    """A linear render to develop.

    Args:
        path: the EXR.
        folder: the output directory of NAME.jpg.
        settings: settings of the development.
    """

    path: Path
    folder: Path
    settings: Settings

    def shares_command(self, other: "Render") -> bool:
        """Return whether one command can develop both renders."""
        return (self.folder, self.settings) == (other.folder, other.settings)

    @property
    def picture(self) -> Path:
        """The path of the developed picture."""
        return self.folder / f"{self.path.name.removesuffix('.exr')}.jpg"


def command(renders: list[Render]) -> list[str]:
    """Return the command that develops renders with the same folder and settings.

    The options keep the user's own packages and modules of the working directory off Python's path.
    """
    first = renders[0]
    inputs = [str(render.path) for render in renders]
    clpipe = [sys.executable, "-s", "-P", "-m", "clpipe", "run", "--quiet"]
    return [*clpipe, "--output", str(first.folder), *first.settings.options(), "--", *inputs]


def environment() -> dict[str, str]:
    """Return the environment in which Python finds clpipe and its dependencies.

    Raises:
        DevelopmentError: clpipe is not installed.
    """
    found = importlib.util.find_spec("clpipe")
    if found is None or found.origin is None:
        raise DevelopmentError("the wheels of the extension are missing; install it again")
    packages = [str(PRIVATE), str(Path(found.origin).parents[1])]
    return {**os.environ, "PYTHONPATH": os.pathsep.join(packages)}


class Development:
    """A queue of renders, and the process that develops the first of them.

    One thread may add renders while another one calls the other methods.
    """

    def __init__(self) -> None:
        self.message = ""  # the first error
        self._waiting: deque[Render] = deque()
        self._renders: list[Render] = []  # in the running process
        self._process: subprocess.Popen[bytes] | None = None
        self._stderr: IO[bytes]

    def __len__(self) -> int:
        return len(self._waiting) + len(self._renders)

    def add(self, render: Render) -> None:
        """Add a render to the queue."""
        self._waiting.append(render)

    def fail(self, message: str) -> None:
        """Store the first error, and print every one."""
        self.message = self.message or message
        print(f"clpipe: {message}", file=sys.stderr)

    def poll(self) -> Path | None:
        """Start the next process if none runs, without blocking.

        One process develops all waiting renders up to the first with other settings.

        Returns:
            The latest picture of a process that has succeeded since the last call, or None.
        """
        picture = None
        if self._process and self._process.poll() is not None:
            picture = self._end()
        if self._process is None and self._waiting:
            self._begin()
        return picture

    def finish(self) -> Path | None:
        """Wait until the queue is empty, and return the latest picture."""
        picture = self.poll()
        while self._process:
            self._process.wait()
            picture = self.poll() or picture
        return picture

    def _begin(self) -> None:
        first = self._waiting[0]
        while self._waiting and self._waiting[0].shares_command(first):
            self._renders.append(self._waiting.popleft())
        self._renders = [*dict.fromkeys(self._renders)]  # a frame may have been rendered twice
        self._stderr = tempfile.TemporaryFile()  # noqa: SIM115 - it lives as long as the process
        try:
            self._process = subprocess.Popen(
                command(self._renders),
                env=environment(),
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=self._stderr,
            )
        except (DevelopmentError, OSError) as error:
            self._stderr.close()
            self._renders = []
            self.fail(str(error))

    def _end(self) -> Path | None:
        assert self._process
        status, renders = self._process.returncode, self._renders
        self._stderr.seek(0)
        with self._stderr:
            lines = self._stderr.read().decode(errors="replace").splitlines()
        self._process, self._renders = None, []
        if status == 0:
            return renders[-1].picture
        errors = [line.removeprefix("clpipe: ") for line in lines if line.startswith("clpipe: ")]
        self.fail("; ".join(errors or lines[-1:] or [f"clpipe ended with status {status}"]))
        return None
