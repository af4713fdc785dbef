"""Helpers of portability.py that install and run OpenCL runtimes."""

import contextlib
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

LIMIT = 1800  # seconds for each runtime; race detection takes the longest
FOREIGN = ("OCL", "OPENCL_", "POCL_", "PYOPENCL_", "CL_", "CLPIPE_", "RUSTICL_", "MESA_", "PYTHON")
FOREIGN += ("LD_LIBRARY",)


class UnavailableError(Exception):
    """A runtime cannot run on this machine. The message states the reason."""


class BrokenError(Exception):
    """A run crashed, hung or printed nonsense. The message states which."""


@dataclass(frozen=True)
class Runtime:
    """An OpenCL runtime.

    ``install`` receives the work folder. It returns the text of the only .icd file that the run
    may see, or None if clpipe finds the runtime by itself.
    """

    name: str
    install: Callable[[Path], str | None]
    marker: str  # a text in the platform's name or the driver's version
    environment: dict[str, str] = field(default_factory=dict)  # RUN/ becomes the folder of the run
    planted: str = ""  # the emulator's message about planted errors


def output_of(*command: str | Path) -> str:
    """Run a command of the installation, and return its standard output."""
    variables = {"DEBIAN_FRONTEND": "noninteractive", "PIP_DISABLE_PIP_VERSION_CHECK": "1"}
    environment = os.environ | variables
    try:
        done = subprocess.run(command, capture_output=True, text=True, env=environment, check=False)
    except OSError as error:
        raise UnavailableError(f"{command[0]}: {error.strerror}") from None
    if done.returncode:
        lines = (done.stderr.strip() or done.stdout.strip() or "it printed nothing").splitlines()
        errors = [line for line in lines if re.match(r"\s*(E:|\w*Error:)", line, re.IGNORECASE)]
        raise UnavailableError(f"{Path(command[0]).name}: {(errors or lines)[-1].strip()}")
    return done.stdout


def debian_package(package: str, ending: str) -> Path:
    """Return a file of a Debian package, after installing the package if necessary."""
    try:
        listed = output_of("dpkg", "-L", package)
    except UnavailableError:
        if os.geteuid():
            raise UnavailableError(f"needs root for: apt-get install {package}") from None
        output_of("apt-get", "update")
        output_of("apt-get", "install", "-y", "--no-install-recommends", package)
        listed = output_of("dpkg", "-L", package)
    return next(Path(line) for line in listed.splitlines() if line.endswith(ending))


def pip_install(venv: Path, *requirements: str | Path) -> None:
    """Install packages into a virtual environment, after creating it if necessary."""
    if not (venv / "bin/pip").exists():
        output_of(sys.executable, "-m", "venv", venv)
    output_of(venv / "bin/python", "-m", "pip", "install", "-q", *requirements)


def pip_pocl(work: Path) -> str:
    """Install a linker for the PoCL that came with the project; pyopencl loads it without .icd."""
    if not shutil.which("ld"):
        debian_package("binutils", "/ld")
    return ""


class Run:
    """A run of a runtime: an empty folder for its programs, which share one time limit."""

    def __init__(self, runtime: Runtime, work: Path) -> None:
        self.python = work / "venv/bin/python"
        self.folder = work / "runs" / re.sub(r"\W+", "-", runtime.name.lower()).strip("-")
        self.log = self.folder / "oclgrind.log"
        shutil.rmtree(self.folder, ignore_errors=True)
        vendors, cache = self.folder / "vendors", self.folder / "pocl"
        vendors.mkdir(parents=True)
        cache.mkdir()
        self.environment = {k: v for k, v in os.environ.items() if not k.startswith(FOREIGN)}
        self.environment |= {"POCL_CACHE_DIR": str(cache), "PYOPENCL_NO_CACHE": "1"}
        self.environment["CLPIPE_CACHE_DIR"] = str(self.folder / "clpipe")
        if (icd := runtime.install(work)) is not None:
            if icd:
                (vendors / "runtime.icd").write_text(icd.strip() + "\n", "utf-8")
            self.environment["OCL_ICD_VENDORS"] = str(vendors)
        for name, value in runtime.environment.items():
            self.environment[name] = value.replace("RUN/", f"{self.folder}/")
        self.end = time.monotonic() + LIMIT

    def run_python(self, name: str, *arguments: str) -> tuple[str, str]:
        """Run Python, and return standard output and error. Files NAME.out and NAME.err keep them.

        Raises:
            BrokenError: the program hung, crashed or failed.
        """
        out, err = self.folder / f"{name}.out", self.folder / f"{name}.err"
        with out.open("w", encoding="utf-8") as stdout, err.open("w", encoding="utf-8") as stderr:
            process = subprocess.Popen(
                [self.python, *arguments],
                stdin=subprocess.DEVNULL,
                stdout=stdout,
                stderr=stderr,
                env=self.environment,
                cwd=self.folder,
                start_new_session=True,
            )
            try:
                status = process.wait(self.end - time.monotonic())
            except subprocess.TimeoutExpired:
                raise BrokenError(f"{name} did not end within {LIMIT} s") from None
            finally:
                with contextlib.suppress(ProcessLookupError):
                    os.killpg(process.pid, signal.SIGKILL)  # also its child processes
                process.wait()
        printed, errors = (
            out.read_text("utf-8", errors="replace"),
            err.read_text("utf-8", errors="replace"),
        )
        if status < 0:
            raise BrokenError(f"{name}: crashed, {signal.Signals(-status).name}")
        if status and not printed.strip():  # a failed check prints its report
            last = (errors.strip() or "it printed nothing").splitlines()[-1]
            raise BrokenError(f"{name}: exit status {status}: {last}")
        return printed, errors
