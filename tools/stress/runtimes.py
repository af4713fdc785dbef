"""What portability.py installs and runs OpenCL runtimes with."""

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

LIMIT = 1800  # seconds a runtime; race detection takes the longest
FOREIGN = ("OCL", "OPENCL_", "POCL_", "PYOPENCL_", "CL_", "CLPIPE_", "RUSTICL_", "MESA_", "PYTHON")
FOREIGN += ("LD_LIBRARY",)


class UnavailableError(Exception):
    """A runtime cannot be run here; the message says why."""


class BrokenError(Exception):
    """A run that crashed, hung or said nothing that makes sense; the message says which."""


@dataclass(frozen=True)
class Runtime:
    """An OpenCL runtime.

    ``install`` takes the work folder and returns the text of an .icd that alone is to be seen; None
    where clpipe is to find the runtime by itself.
    """

    name: str
    install: Callable[[Path], str | None]
    known_by: str  # in its platform's name or its driver's version
    environment: dict[str, str] = field(default_factory=dict)  # RUN is the folder of the run
    planted: str = ""  # what an emulator says about planted errors


def output_of(*command: str | Path) -> str:
    """What a command of the installation prints."""
    variables = {"DEBIAN_FRONTEND": "noninteractive", "PIP_DISABLE_PIP_VERSION_CHECK": "1"}
    environment = os.environ | variables
    try:
        done = subprocess.run(command, capture_output=True, text=True, env=environment, check=False)
    except OSError as error:
        raise UnavailableError(f"{command[0]}: {error.strerror}") from None
    if done.returncode:
        said = (done.stderr.strip() or done.stdout.strip() or "it said nothing").splitlines()
        errors = [line for line in said if re.match(r"\s*(E:|\w*Error:)", line, re.IGNORECASE)]
        raise UnavailableError(f"{Path(command[0]).name}: {(errors or said)[-1].strip()}")
    return done.stdout


def debian_package(package: str, ending: str) -> Path:
    """A file of a Debian package, which is installed if it is not there."""
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
    """Put packages into a virtual environment, which is made if it is not there."""
    if not (venv / "bin/pip").exists():
        output_of(sys.executable, "-m", "venv", venv)
    output_of(venv / "bin/python", "-m", "pip", "install", "-q", *requirements)


def pip_pocl(work: Path) -> str:
    """Nothing: it came with the project and pyopencl always loads it. It needs a linker, though."""
    if not shutil.which("ld"):
        debian_package("binutils", "/ld")
    return ""


class Run:
    """A runtime's run: a fresh folder, and the programs run there, all within the time limit."""

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

    def python_says(self, name: str, *arguments: str) -> tuple[str, str]:
        """Standard output and error of a Python program, which are kept in files too.

        Raises:
            BrokenError: it hung, crashed or ended in an error.
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
                raise BrokenError(f"{name}: not done after {LIMIT} s") from None
            finally:
                with contextlib.suppress(ProcessLookupError):
                    os.killpg(process.pid, signal.SIGKILL)  # what it left running too
                process.wait()
        printed, said = (
            out.read_text("utf-8", errors="replace"),
            err.read_text("utf-8", errors="replace"),
        )
        if status < 0:
            raise BrokenError(f"{name}: crashed, {signal.Signals(-status).name}")
        if status and not printed.strip():  # a failed check prints its report
            last = (said.strip() or "it said nothing").splitlines()[-1]
            raise BrokenError(f"{name}: exit status {status}: {last}")
        return printed, said
