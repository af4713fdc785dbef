"""Runs in a process of their own that a test stops, kills or resumes at a defined point.

A held run does not start an image whose name is ``HOLD`` or sorts after it until the file ``GO``
exists in its working directory. Each of its processes that has come to such an image creates a file
``held.<number of the process>`` there. So the test knows which images the run has begun when it
sends a signal, however fast or slow the machine is.
"""

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

from clpipe.batch import local_worker, processes
from tests.conftest import ROOT

GUARD = 300.0  # s; a wait that reaches it has failed, however busy the machine is
HOLD, GO = "r020", "go"

HOLDING = f"""
import os, pathlib, time
from clpipe.batch.work import ImageWorker
decode = ImageWorker.begin
def held(self, job, *arguments):
    if job.path.stem.replace(".", "") >= {HOLD!r}:
        pathlib.Path("held." + str(os.getpid())).touch()
        while not os.path.exists({GO!r}):
            time.sleep(0.01)
    return decode(self, job, *arguments)
ImageWorker.begin = held
"""
# In the processes that a run starts, not in the run's own process.
HOLDING_PROCESSES = f"from tests.held import plant; plant({HOLDING!r})"
PROGRAM = "exec({planted!r}); from clpipe.__main__ import main; main()"


def plant(code: str) -> None:
    """Let each process that a run starts execute some code first."""
    processes.prepare = partial(_planted, code)  # type: ignore[assignment]


def before(method: str, statement: str) -> str:
    """Return code for :func:`plant` with a statement before each call of an ImageWorker's method.

    The statement may use the method's arguments as ``given``.
    """
    return f"""
import json, logging, os, pathlib, time
from clpipe.base.errors import DeviceError
from clpipe.batch.work import ImageWorker
def planted(*given, real=ImageWorker.{method}):
    {statement}
    return real(*given)
ImageWorker.{method} = planted
"""


def _planted(code: str, *arguments: Any) -> None:
    exec(code, {})
    local_worker.prepare(*arguments)


def start(
    *arguments: object,
    folder: Path | None = None,
    planted: str = "",
    environment: Mapping[str, str] | None = None,
) -> "subprocess.Popen[str]":
    """Start ``clpipe run`` with these arguments.

    Args:
        arguments: of ``clpipe run``.
        folder: the working directory; None is that of the test.
        planted: Python that the process runs first, for example :data:`HOLDING`.
        environment: variables that are added to those of the test.
    """
    program = PROGRAM.format(planted=planted)
    command = [sys.executable, "-c", program, "run", *map(str, arguments)]
    variables = {**os.environ, "PYTHONPATH": str(ROOT), **(environment or {})}
    return subprocess.Popen(command, cwd=folder, env=variables, stderr=subprocess.PIPE, text=True)


def wait_until(
    is_so: Callable[[], bool], what: str, process: "subprocess.Popen[str] | None" = None
) -> None:
    """Wait until a condition holds. Fail after :data:`GUARD`, or if the process ends before."""
    end = time.monotonic() + GUARD
    while not is_so():
        assert time.monotonic() < end, f"waited {GUARD:g} s for {what}"
        if process and process.poll() is not None and not is_so():
            raise AssertionError(f"the run ended without {what}: {finish(process)}")
        time.sleep(0.01)


def sidecars(folder: Path) -> int:
    """Return how many images of a run are finished: the sidecars at any depth."""
    return len([path for path in folder.rglob("*.json") if path.name[0] != "."])


def interrupt(process: "subprocess.Popen[str]", number: int = signal.SIGINT) -> None:
    """Send a signal, and wait until the run says on stderr that it is stopping."""
    assert process.stderr
    process.send_signal(number)
    with _guarded(process):
        is_noticed = any("to stop now" in line for line in process.stderr)
    assert is_noticed, "the run ended, or hung, without noticing the signal"


def finish(process: "subprocess.Popen[str]") -> str:
    """Wait until a run has ended, and return what it has printed on stderr since the last read."""
    assert process.stderr
    with _guarded(process), process.stderr:
        text = process.stderr.read()
        process.wait()
    return text


@contextmanager
def _guarded(process: "subprocess.Popen[str]") -> Iterator[None]:
    """Kill a process that hangs, so that whoever reads its output fails instead of hanging."""
    guard = threading.Timer(GUARD, process.kill)
    guard.start()
    try:
        yield
    finally:
        guard.cancel()


def kill_after(process: "subprocess.Popen[str]", folder: Path, count: int) -> None:
    """Kill a run once ``count`` of its images are finished, or it has ended."""
    wait_until(lambda: sidecars(folder) >= count or process.poll() is not None, f"{count} sidecars")
    process.kill()
    finish(process)
