"""Develops linear renders by ``clpipe run``, in a process of its own; without bpy."""

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
    """A picture cannot be made; the message is for the user."""


@dataclass(frozen=True)
class Settings:
    """What the panel says.

    Args:
        camera: name or profile; "" is the look's own.
        look: name or path of a configuration.
        iso: the ISO.
        seed: of the noise.
        keep_raw: write the raw, too, as DNG.
    """

    camera: str
    look: str
    iso: int
    seed: int
    keep_raw: bool

    def options(self) -> list[str]:
        """These settings as options of ``clpipe run``."""
        options = ["--config", self.look, "--iso", str(self.iso), "--seed", str(self.seed)]
        if self.camera:
            options += ["--camera", self.camera]
        if self.keep_raw:
            options += ["--format", "jpg", "--format", "dng"]
        return options


@dataclass(frozen=True)
class Render:
    """A linear render that is to be developed.

    Args:
        path: its EXR.
        folder: where NAME.jpg is written.
        settings: how it is developed.
    """

    path: Path
    folder: Path
    settings: Settings

    def goes_with(self, other: "Render") -> bool:
        """Whether one command develops both."""
        return (self.folder, self.settings) == (other.folder, other.settings)

    @property
    def picture(self) -> Path:
        """What is made of it."""
        return self.folder / f"{self.path.name.removesuffix('.exr')}.jpg"


def command(renders: list[Render]) -> list[str]:
    """What develops renders that go together.

    Python leaves out the user's own packages and, as a module of a folder that is called clpipe,
    what lies in the working directory.
    """
    first = renders[0]
    inputs = [str(render.path) for render in renders]
    clpipe = [sys.executable, "-s", "-P", "-m", "clpipe", "run", "--quiet"]
    return [*clpipe, "--output", str(first.folder), *first.settings.options(), "--", *inputs]


def environment() -> dict[str, str]:
    """The environment in which Python finds clpipe, and what it needs.

    Raises:
        DevelopmentError: clpipe is not installed.
    """
    found = importlib.util.find_spec("clpipe")
    if found is None or found.origin is None:
        raise DevelopmentError("the wheels of the extension are missing; install it again")
    packages = [str(PRIVATE), str(Path(found.origin).parents[1])]
    return {**os.environ, "PYTHONPATH": os.pathsep.join(packages)}


class Development:
    """Renders that wait, and the process that develops those before them.

    Renders may be added in one thread, and all else done in another one.
    """

    def __init__(self) -> None:
        self.message = ""  # why a picture was not made; the first of them
        self._waiting: deque[Render] = deque()
        self._renders: list[Render] = []  # those of the process
        self._process: subprocess.Popen[bytes] | None = None
        self._said: IO[bytes]

    def __len__(self) -> int:
        return len(self._waiting) + len(self._renders)

    def add(self, render: Render) -> None:
        """Let a render wait for its turn."""
        self._waiting.append(render)

    def fail(self, message: str) -> None:
        """Keep why a picture was not made, and print it."""
        self.message = self.message or message
        print(f"clpipe: {message}", file=sys.stderr)

    def poll(self) -> Path | None:
        """Go on, without waiting: the latest picture of a process that has ended, if it made all.

        All renders that wait are developed together, as far as their settings are the same.
        """
        picture = None
        if self._process and self._process.poll() is not None:
            picture = self._end()
        if self._process is None and self._waiting:
            self._begin()
        return picture

    def finish(self) -> Path | None:
        """Wait until nothing is left; the latest picture."""
        picture = self.poll()
        while self._process:
            self._process.wait()
            picture = self.poll() or picture
        return picture

    def _begin(self) -> None:
        first = self._waiting[0]
        while self._waiting and self._waiting[0].goes_with(first):
            self._renders.append(self._waiting.popleft())
        self._renders = [*dict.fromkeys(self._renders)]  # a frame may have been rendered twice
        self._said = tempfile.TemporaryFile()  # noqa: SIM115 - it lives as long as the process
        try:
            self._process = subprocess.Popen(
                command(self._renders),
                env=environment(),
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=self._said,
            )
        except (DevelopmentError, OSError) as error:
            self._said.close()
            self._renders = []
            self.fail(str(error))

    def _end(self) -> Path | None:
        assert self._process
        status, renders = self._process.returncode, self._renders
        self._said.seek(0)
        with self._said:
            lines = self._said.read().decode(errors="replace").splitlines()
        self._process, self._renders = None, []
        if status == 0:
            return renders[-1].picture
        said = [line.removeprefix("clpipe: ") for line in lines if line.startswith("clpipe: ")]
        self.fail("; ".join(said or lines[-1:] or [f"clpipe ended with status {status}"]))
        return None
