"""Run clpipe with PoCL on CPUs that qemu-user emulates, for the table in docs/install.md.

    tools/run stress portability [--work DIR] [--only TEXT]

- x86-64 with pip's PoCL (--only cpus; two to three minutes each)
- arm64 with Debian's PoCL (--only arm64; installs 1 GB into the work folder)

Debian's packages need root. ``clpipe run`` makes a small picture on the emulated CPU, and NumPy
makes it on the host. Both raws must be identical. The emulation of qemu (TCG) has AVX2 but no
AVX-512. /proc/cpuinfo still lists the features of the host; glibc and LLVM query the emulated CPU.

Programs that an emulated program starts run on the host CPU. clpipe tests runtimes in a process
that it starts with ``sys.executable``. To emulate this process as well, the Python of each virtual
environment is a script that starts qemu. On arm64, the linker that PoCL starts is such a script as
well. So nothing has to be registered with the kernel (binfmt_misc), and the host does not change.

The tool prints a table. The exit status is 0 if at least one CPU could run and all of those passed.
All files are in the work folder, and later runs reuse them. WORK/runs contains the output of each
run.
"""

import json
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

from tools import ROOT
from tools.shared.options import parser_of
from tools.shared.tables import markdown

LIMIT = 1800  # seconds for each CPU
FOREIGN = ("OCL", "OPENCL_", "POCL_", "PYOPENCL_", "CL_", "CLPIPE_", "PYTHON", "LD_LIBRARY")
RENDER = """if True:
    import numpy as np, OpenEXR
    pixels = np.random.default_rng(0).random((21, 33, 3)) ** 2 * 1.4 - 0.05
    OpenEXR.File({}, {"RGB": pixels.astype(np.float16)}).write("render.exr")
"""
# This also tests the runtime, which takes longer than clpipe's limit for real CPUs.
DEVICE = """if True:
    import json, platform
    from clpipe.engine import verdicts
    from clpipe.engine.cpu_target import driver_target
    from clpipe.engine.discovery import find_devices
    verdicts.LIMIT = 1200
    pocl = [d for d in find_devices() if "Portable Computing" in d.platform]
    print(json.dumps([
        [platform.machine(), (driver_target(d.version) or ("", ""))[1], d.target.name,
        d.lanes, d.driver, d.problem] for d in pocl]))
"""
DEVELOP = ("-m", "clpipe", "run", "render.exr", "--iso", "3200", "--keep", "quantize")
DEVELOP += ("--format", "jpg", "--format", "npy", "--quiet")
COMPARE = """if True:
    import json, numpy as np
    one, two = ([np.load(f"{folder}/render{of}.npy") for of in ("", ".quantize")]
        for folder in ("expected", "emulated"))
    same = one[1].dtype == two[1].dtype and one[1].tobytes() == two[1].tobytes()
    print(json.dumps([same, float(np.abs(one[0].astype(np.float32) - two[0]).max())]))
"""
STEP = 1 / 255  # the largest difference of pictures; only raws are identical on all devices


class UnavailableError(Exception):
    """A CPU cannot be emulated on this machine. The message states the reason."""


class BrokenError(Exception):
    """A run crashed, hung or printed nonsense. The message states which."""


@dataclass(frozen=True)
class EmulatedCPU:
    """A CPU that qemu-user emulates.

    Args:
        name: the name in the table.
        cpu: the value of qemu's option -cpu.
        own: PoCL's name of the CPU, by LLVM 14 in pip's PoCL; "" if it gives none.
        target: LLVM's name of clpipe's expected compile target.
        wider: a target that needs more than the CPU has. The test of the runtime must end in SIGILL
            with it. This shows that a wrong target would be noticed.
        machine: the machine of its programs.
    """

    name: str
    cpu: str
    own: str = ""
    target: str = ""
    wider: str = ""
    machine: str = "x86_64"


# "Without": a hypervisor masks the feature, or qemu lacks it.
HASWELL = "Haswell-noTSX,pcid=off,x2apic=off,tsc-deadline=off,invpcid=off"
MASKED = f"{HASWELL},avx=off,avx2=off,fma=off,f16c=off"
RAPTOR_LAKE = f"{HASWELL},model=183,clflushopt=on,sha-ni=on,x-force-features=on"
ZEN_5 = "EPYC,family=26,model=2"
EMULATED = (
    EmulatedCPU("cpus: Nehalem", "Nehalem", "nehalem", "nehalem", "haswell"),
    EmulatedCPU("cpus: Haswell", HASWELL, "haswell", "haswell", "skx"),
    EmulatedCPU("cpus: Haswell without AVX", MASKED, "haswell", "penryn", "haswell"),
    EmulatedCPU(
        *("cpus: Skylake-Server without AVX-512", "Skylake-Server"),
        *("skylake-avx512", "haswell", "skx"),
    ),
    EmulatedCPU("cpus: EPYC", "EPYC", "znver1", "znver1", "skx"),
    EmulatedCPU("cpus: Raptor Lake", RAPTOR_LAKE, "goldmont", "haswell", "skx"),
    EmulatedCPU("cpus: Zen 5 without AVX-512", ZEN_5, "generic", "haswell", "skx"),
    EmulatedCPU("arm64 (Debian)", "cortex-a72", machine="aarch64"),
)


def output_of(*command: str | Path) -> str:
    """Run a command of the installation, and return its standard output.

    Raises:
        UnavailableError: it cannot be started, or fails.
    """
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


def qemu(machine: str, work: Path) -> list[str]:
    """Return the command that runs a program of another machine, without CPU and program."""
    emulator = debian_package("qemu-user-static", f"/qemu-{machine}-static")
    return [str(emulator), *(["-L", str(arm64_tree(work))] if machine == "aarch64" else [])]


def arm64_tree(work: Path) -> Path:
    """Return a Debian tree for arm64 with Python, PoCL and a linker, unpacked, not configured."""
    tree, part = work / "arm64/tree", work / "arm64/part"
    if not tree.exists():
        bootstrap = debian_package("debootstrap", "/debootstrap")
        if os.geteuid():
            raise UnavailableError(f"needs root for: {bootstrap.name} --arch=arm64")
        shutil.rmtree(part, ignore_errors=True)
        part.parent.mkdir(exist_ok=True)
        output_of(
            *(bootstrap, "--arch=arm64", "--foreign", "--variant=minbase"),
            *("--include=python3,pocl-opencl-icd,binutils", "bookworm", part),
        )
        for package in sorted(part.glob("var/cache/apt/archives/*.deb")):
            output_of("dpkg", "-x", package, part)
        part.rename(tree)
    return tree


def icd_of(machine: str, work: Path) -> str:
    """Return the text of the only .icd file that a run may see. Without one, it is pip's PoCL.

    Debian's .icd file for arm64 has only the library's name. With that name, the library does not
    find its own files, because qemu resolves faccessat outside of the tree.
    """
    if machine == "aarch64":
        (library,) = arm64_tree(work).glob("usr/lib/aarch64-linux-gnu/libpocl.so.2.*")
        return str(library)
    if not shutil.which("ld"):
        debian_package("binutils", "/ld")
    return ""


def arm64_packages(work: Path, python: str) -> Path:
    """Install the project and its dependencies for arm64, in the versions of the work folder.

    ``python`` is a version such as 3.11. Pip cannot resolve dependencies for another machine, so
    the versions are those of this one, without PoCL's wheel.
    """
    listed = output_of(work / "venv/bin/python", "-m", "pip", "freeze").splitlines()
    versions = [line for line in listed if "==" in line and not line.startswith("pocl")]
    packages, done = work / "arm64/packages", work / "arm64/packages.txt"
    if not done.exists() or done.read_text("utf-8").split() != versions:
        shutil.rmtree(packages, ignore_errors=True)
        platforms = [f"--platform=manylinux{n}_aarch64" for n in ("_2_28", "_2_17", "2014")]
        to = ("--target", packages, "--no-deps", "--only-binary=:all:")
        pip_install(work / "venv", *to, *platforms, f"--python-version={python}", *versions)
        done.write_text("\n".join(versions), "utf-8")
    pip_install(work / "venv", "--target", packages, "--no-deps", "--upgrade", ROOT)
    return packages


def script(path: Path, *command: str | Path) -> None:
    """Write a shell script that runs a command with further arguments."""
    text = " ".join('"$0"' if part == "$0" else shlex.quote(str(part)) for part in command)
    path.write_text(f'#!/bin/sh\nexec {text} "$@"\n', "utf-8")
    path.chmod(0o755)


def emulated_python(cpu: EmulatedCPU, work: Path, folder: Path) -> Path:
    """Create a virtual environment with an emulated Python in the folder of a run.

    Python finds its environment by the name of its program.
    """
    venv = folder / "venv"
    program = venv / "bin/python"
    program.parent.mkdir(parents=True)
    emulator = qemu(cpu.machine, work)
    if cpu.machine == "aarch64":
        binaries = arm64_tree(work) / "usr/bin"
        (python,) = (path for path in binaries.glob("python3.*") if path.name[8:].isdecimal())
        (venv / "pyvenv.cfg").write_text(f"home = {binaries}\n", "utf-8")
        libraries = venv / "lib" / python.name
        libraries.mkdir(parents=True)
        packages = arm64_packages(work, python.name.removeprefix("python"))
        (libraries / "site-packages").symlink_to(packages)
        script(venv / "bin/ld", *emulator, binaries / "aarch64-linux-gnu-ld.bfd")
    else:
        python = work / "venv/bin/python"
        shutil.copy(work / "venv/pyvenv.cfg", venv)
        (venv / "lib").symlink_to(work / "venv/lib")
    script(program, *emulator, "-0", "$0", "-cpu", cpu.cpu, python)
    return program


class Run:
    """A run on a CPU: an empty folder for its programs, which share one time limit."""

    def __init__(self, cpu: EmulatedCPU, work: Path) -> None:
        self.folder = work / "runs" / re.sub(r"\W+", "-", cpu.name.lower()).strip("-")
        shutil.rmtree(self.folder, ignore_errors=True)
        vendors, cache = self.folder / "vendors", self.folder / "pocl"
        vendors.mkdir(parents=True)
        cache.mkdir()
        if icd := icd_of(cpu.machine, work):
            (vendors / "runtime.icd").write_text(f"{icd}\n", "utf-8")
        self.environment = {k: v for k, v in os.environ.items() if not k.startswith(FOREIGN)}
        self.environment |= {"POCL_CACHE_DIR": str(cache), "PYOPENCL_NO_CACHE": "1"}
        self.environment["CLPIPE_CACHE_DIR"] = str(self.folder / "clpipe")
        self.environment["OCL_ICD_VENDORS"] = str(vendors)
        # LLVM recognizes Raptor Lake by SHA. qemu may lack SHA, so OpenSSL must not use it.
        self.environment["OPENSSL_ia32cap"] = ":~0x20000000"
        self.end = time.monotonic() + LIMIT

    def run_python(self, python: Path, name: str, *arguments: str) -> str:
        """Run Python, and return standard output. Files NAME.out and NAME.err keep all output.

        Raises:
            BrokenError: the program hung, crashed or failed.
        """
        out, err = self.folder / f"{name}.out", self.folder / f"{name}.err"
        with out.open("w", encoding="utf-8") as stdout, err.open("w", encoding="utf-8") as stderr:
            streams = {"stdin": subprocess.DEVNULL, "stdout": stdout, "stderr": stderr}
            command, left = [python, *arguments], self.end - time.monotonic()
            options = {"env": self.environment, "cwd": self.folder, "timeout": left}
            try:
                status = subprocess.run(command, **streams, **options, check=False).returncode
            except subprocess.TimeoutExpired:
                raise BrokenError(f"{name} did not end within {LIMIT} s") from None
        if status:
            errors = err.read_text("utf-8", errors="replace").strip() or "it printed nothing"
            how = signal.Signals(-status).name if status < 0 else f"exit status {status}"
            raise BrokenError(f"{name}: {how}: {errors.splitlines()[-1]}")
        return out.read_text("utf-8", errors="replace")

    def pocl(self, python: Path, name: str) -> list[str]:
        """Return PoCL's record: machine, own name, target, lanes, version, problem.

        Raises:
            BrokenError: the program failed, or there is not one device.
        """
        found = json.loads(self.run_python(python, name, "-c", DEVICE))
        if len(found) != 1:
            raise BrokenError(f"{name}: found {len(found)} devices of PoCL; expected one")
        return found[0]


def measure(cpu: EmulatedCPU, work: Path, row: list[str]) -> bool:
    """Develop on an emulated CPU, fill in its row of the table, and return whether it passed.

    Raises:
        UnavailableError: this machine cannot emulate the CPU.
        BrokenError: a run fails.
    """
    host = os.uname().machine
    if cpu.machine == "x86_64" != host:
        raise UnavailableError(f"it needs the packages of x86_64, and this machine is {host}")
    run, native = Run(cpu, work), work / "venv/bin/python"
    run.run_python(native, "render", "-c", RENDER)
    run.run_python(native, "expected", *DEVELOP, "--device", "numpy", "-o", "expected")
    python = emulated_python(cpu, work, run.folder)
    run.environment["PATH"] = f"{python.parent}{os.pathsep}{os.environ['PATH']}"
    machine, own, target, lanes, row[2], problem = run.pocl(python, "device")
    row[1] = " -> ".join(dict.fromkeys(name for name in (own, target) if name)) or machine
    row[1] += f", {lanes} lanes"
    if problem:
        raise BrokenError(f"clpipe skips it: {problem}")
    wrong = []
    if (machine, own, target) != (cpu.machine, cpu.own, cpu.target):
        expected = f"{cpu.machine}, {cpu.own or '-'} -> {cpu.target or '-'}"
        wrong.append(f"it is {machine}, {own or '-'} -> {target or '-'}; expected {expected}")
    run.run_python(python, "emulated", *DEVELOP, "--device", "pocl", "-o", "emulated")
    same, difference = json.loads(run.run_python(native, "compare", "-c", COMPARE))
    row[3] = (
        f"the raw is {'' if same else 'NOT '}NumPy's, the picture differs by up to {difference:.2g}"
    )
    if difference > STEP:
        wrong.append(f"the picture may differ by {STEP:.2g}")
    if cpu.wider:
        run.environment["CLPIPE_CPU_TARGET"] = cpu.wider
        problem = run.pocl(python, "wider")[-1]
        if "SIGILL" not in problem:
            result = problem or "it works"
            raise BrokenError(f"with {cpu.wider} it must end in SIGILL, but: {result}")
        row[3] += f"; {cpu.wider}: SIGILL, as expected"
    row[3] += "".join(f"; {text}" for text in wrong)
    return same and not wrong


def main() -> int:
    """Emulate the CPUs, and print the table."""
    parser = parser_of(__doc__)
    parser.add_argument("--work", type=Path, default=ROOT / "build/portability", metavar="DIR")
    text = "run only CPUs with TEXT in their name, such as cpus"
    parser.add_argument("--only", default="", metavar="TEXT", help=text)
    options = parser.parse_args()
    work: Path = options.work.resolve()
    work.mkdir(parents=True, exist_ok=True)
    try:
        pip_install(work / "venv", ROOT)
    except UnavailableError as error:
        print(f"portability: the project cannot be installed: {error}", file=sys.stderr)
        return 1
    rows, passed = [], []
    for cpu in (each for each in EMULATED if options.only.lower() in each.name.lower()):
        print(f"{cpu.name} ...", file=sys.stderr, flush=True)
        row, start = [cpu.name, "", "", ""], time.monotonic()
        try:
            passed.append(measure(cpu, work, row))
        except UnavailableError as error:
            row[3] = f"skipped: {error}"
        except BrokenError as error:
            row[3] = f"BROKEN: {error}"
            passed.append(False)
        rows.append([*row, f"{time.monotonic() - start:.0f}"])
    print(markdown(["CPU", "device", "version", "result", "seconds"], rows))
    return 0 if passed and all(passed) else 1


if __name__ == "__main__":
    sys.exit(main())
