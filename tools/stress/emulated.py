"""PoCL, for portability.py, on CPUs that are not here, emulated by qemu-user.

``clpipe run`` makes a small picture there, files to files, and NumPy makes it here: the raw must be
the same, bit for bit. qemu's emulation (TCG) has AVX2 and no AVX-512. Linux's list of features,
/proc/cpuinfo, is still that of the CPU that is here; glibc and LLVM ask the emulated one.

What an emulated program starts runs on the CPU that is here. The Python of each CPU is therefore a
script that starts qemu, within a virtual environment of its own, so that the trial of runtimes,
which clpipe starts with ``sys.executable``, is emulated too. The linker that PoCL starts need not
be, but for arm64, where it is such a script as well. So nothing has to be registered with the
kernel (binfmt_misc), and nothing on this machine changes.
"""

import json
import os
import shlex
import shutil
from dataclasses import dataclass
from pathlib import Path

from tools import ROOT
from tools.stress.runtimes import (
    BrokenError,
    Run,
    Runtime,
    UnavailableError,
    debian_package,
    output_of,
    pip_install,
    pip_pocl,
)

RENDER = """if True:
    import numpy as np, OpenEXR
    pixels = np.random.default_rng(0).random((21, 33, 3)) ** 2 * 1.4 - 0.05
    OpenEXR.File({}, {"RGB": pixels.astype(np.float16)}).write("render.exr")
"""
# It tries the runtime, too, which takes longer than clpipe allows a real CPU.
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
STEP = 1 / 255  # by which pictures may differ; only raws are bit for bit the same on all devices


@dataclass(frozen=True, kw_only=True)
class EmulatedCPU(Runtime):
    """PoCL on a CPU that qemu-user emulates.

    ``wider`` is a target that needs more than the CPU has: the trial must end in SIGILL there, else
    it would not be noticed here if clpipe chose one.
    """

    cpu: str  # as qemu's option -cpu
    machine: str = "x86_64"
    own: str = ""  # what PoCL takes it for; "" where it does not say
    target: str = ""  # what it is to compile for, LLVM's name
    wider: str = ""


def qemu(machine: str, work: Path) -> list[str]:
    """The command that runs a program of another machine, less its CPU and the program."""
    emulator = debian_package("qemu-user-static", f"/qemu-{machine}-static")
    return [str(emulator), *(["-L", str(arm64_tree(work))] if machine == "aarch64" else [])]


def arm64_tree(work: Path) -> Path:
    """A Debian for arm64: Python, PoCL and a linker, unpacked but not set up, so nothing runs."""
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


def arm64_pocl(work: Path) -> str:
    """The whole path of that Debian's library, which looks for its files beside it.

    Its .icd has the bare name. The library would be found by that, but not its files: qemu looks
    for them outside of the tree where a program only asks whether they are there (faccessat).
    """
    (library,) = arm64_tree(work).glob("usr/lib/aarch64-linux-gnu/libpocl.so.2.*")
    return str(library)


def arm64_packages(work: Path, python: str) -> Path:
    """The project, and the wheels for arm64 of the versions that the work folder's Python has.

    ``python`` is its version, as in 3.11. Pip cannot resolve for another machine, so dependencies
    are listed here; those with a machine of their own in the marker are PoCL's wheel.
    """
    listed = """if True:
        import re
        from importlib.metadata import PackageNotFoundError, requires, version
        found, left = {}, ["clpipe"]
        while left:
            for line in requires(left.pop()) or ():
                name, marker = re.match(r"[\\w.-]+", line)[0], line.partition(";")[2]
                if name not in found and "extra" not in marker and "machine" not in marker:
                    try:
                        found[name] = version(name)
                    except PackageNotFoundError:
                        continue
                    left.append(name)
        print(*(f"{name}=={of}" for name, of in found.items()))
    """
    versions = output_of(work / "venv/bin/python", "-c", listed).split()
    packages, done = work / "arm64/packages", work / "arm64/packages.txt"
    if not done.exists() or done.read_text("utf-8").split() != versions:
        shutil.rmtree(packages, ignore_errors=True)
        platforms = [f"--platform=manylinux{n}_aarch64" for n in ("_2_28", "_2_17", "2014")]
        to = ("--target", packages, "--no-deps", "--only-binary=:all:")
        pip_install(work / "venv", *to, *platforms, f"--python-version={python}", *versions)
        done.write_text("\n".join(versions), "utf-8")
    pip_install(work / "venv", "--target", packages, "--no-deps", "--upgrade", ROOT)
    return packages


# What qemu is to be, what LLVM 14 within pip's PoCL takes that for, what clpipe is to compile for,
# and a target that needs more than is there. "Without" is what a hypervisor masks, or qemu lacks.
HASWELL = "Haswell-noTSX,pcid=off,x2apic=off,tsc-deadline=off,invpcid=off"
MASKED = f"{HASWELL},avx=off,avx2=off,fma=off,f16c=off"
RAPTOR_LAKE = f"{HASWELL},model=183,clflushopt=on,sha-ni=on,x-force-features=on"
CPUS = (
    ("Nehalem", "Nehalem", "nehalem", "nehalem", "haswell"),
    ("Haswell", HASWELL, "haswell", "haswell", "skx"),
    ("Haswell without AVX", MASKED, "haswell", "penryn", "haswell"),
    ("Skylake-Server without AVX-512", "Skylake-Server", "skylake-avx512", "haswell", "skx"),
    ("EPYC", "EPYC", "znver1", "znver1", "skx"),
    ("Raptor Lake", RAPTOR_LAKE, "goldmont", "haswell", "skx"),
    ("Zen 5 without AVX-512", "EPYC,family=26,model=2", "generic", "haswell", "skx"),
)


def emulated_cpu(name: str, cpu: str, own: str, target: str, wider: str) -> EmulatedCPU:
    """Pip's PoCL on one of :data:`CPUS`.

    Raptor Lake says that it has SHA, as LLVM goes by that. qemu may not have it, so OpenSSL is told
    not to use it.
    """
    said = {"cpu": cpu, "own": own, "target": target, "wider": wider}
    return EmulatedCPU(f"cpus: {name}", pip_pocl, "", {"OPENSSL_ia32cap": ":~0x20000000"}, **said)


EMULATED = (
    *(emulated_cpu(*row) for row in CPUS),
    EmulatedCPU("arm64 (Debian)", arm64_pocl, "", machine="aarch64", cpu="cortex-a72"),
)


def script(path: Path, *command: str | Path) -> None:
    """Write a program that is another one, with its arguments."""
    text = " ".join('"$0"' if part == "$0" else shlex.quote(str(part)) for part in command)
    path.write_text(f'#!/bin/sh\nexec {text} "$@"\n', "utf-8")
    path.chmod(0o755)


def emulated_python(runtime: EmulatedCPU, work: Path, folder: Path) -> Path:
    """The Python of a virtual environment that runs on a CPU, in the folder of a run.

    Python goes by the name that it was started with to find its environment and itself.
    """
    venv = folder / "venv"
    program = venv / "bin/python"
    program.parent.mkdir(parents=True)
    emulator = qemu(runtime.machine, work)
    if runtime.machine == "aarch64":
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
    script(program, *emulator, "-0", "$0", "-cpu", runtime.cpu, python)
    return program


def measure_emulated(runtime: EmulatedCPU, work: Path, row: list[str]) -> bool:
    """Develop on an emulated CPU: fills the table's row in, and whether it passed."""
    here = os.uname().machine
    if runtime.machine == "x86_64" != here:
        raise UnavailableError(f"it needs the packages of x86_64, and this machine is {here}")
    run = Run(runtime, work)
    run.python_says("render", "-c", RENDER)
    run.python_says("expected", *DEVELOP, "--device", "numpy", "-o", "expected")
    native, run.python = run.python, emulated_python(runtime, work, run.folder)
    run.environment["PATH"] = f"{run.python.parent}{os.pathsep}{os.environ['PATH']}"
    machine, own, target, lanes, row[2], problem = pocl_there(run, "device")
    row[1] = " -> ".join(dict.fromkeys(name for name in (own, target) if name)) or machine
    row[1] += f", {lanes} lanes"
    if problem:
        raise BrokenError(f"clpipe passes it over: {problem}")
    wrong = []
    if (machine, own, target) != (runtime.machine, runtime.own, runtime.target):
        expected = f"{runtime.machine}, {runtime.own or '-'} -> {runtime.target or '-'}"
        wrong.append(f"it is {machine}, {own or '-'} -> {target or '-'}; expected {expected}")
    run.python_says("emulated", *DEVELOP, "--device", "pocl", "-o", "emulated")
    run.python = native
    raw, apart = json.loads(run.python_says("compare", "-c", COMPARE)[0])
    row[3] = f"the raw is {'' if raw else 'NOT '}NumPy's, the picture differs by up to {apart:.2g}"
    if apart > STEP:
        wrong.append(f"the picture may differ by {STEP:.2g}")
    if runtime.wider:
        run.python = run.folder / "venv/bin/python"
        run.environment["CLPIPE_CPU_TARGET"] = runtime.wider
        *_, problem = pocl_there(run, "wider")
        if "SIGILL" not in problem:
            said = problem or "it works"
            raise BrokenError(f"with {runtime.wider} it must end in SIGILL, yet: {said}")
        row[3] += f"; {runtime.wider}: SIGILL, as it must"
    row[3] += "".join(f"; {text}" for text in wrong)
    return raw and not wrong


def pocl_there(run: Run, name: str) -> list[str]:
    """What a run's Python says of PoCL: machine, own name, target, lanes, version, problem."""
    printed, _ = run.python_says(name, "-c", DEVICE)
    found = json.loads(printed)
    if len(found) != 1:
        raise BrokenError(f"{name}: it finds {len(found)} devices of PoCL; expected one")
    return found[0]
