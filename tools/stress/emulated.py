"""Runs PoCL on CPUs that qemu-user emulates, for portability.py.

``clpipe run`` makes a small picture on the emulated CPU, and NumPy makes it on the host. Both raws
must be identical. The emulation of qemu (TCG) has AVX2 but no AVX-512. /proc/cpuinfo still
lists the features of the host; glibc and LLVM query the emulated CPU.

Programs that an emulated program starts run on the host CPU. clpipe tests runtimes in a process
that it starts with ``sys.executable``. To emulate this process as well, the Python of each virtual
environment is a script that starts qemu. On arm64, the linker that PoCL starts is such a script as
well. So nothing has to be registered with the kernel (binfmt_misc), and the host does not change.
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


@dataclass(frozen=True, kw_only=True)
class EmulatedCPU(Runtime):
    """PoCL on a CPU that qemu-user emulates.

    ``wider`` is a target that needs more than the CPU has. The test of the runtime must end in
    SIGILL with it. This shows that a wrong target would be noticed.
    """

    cpu: str  # value of qemu's option -cpu
    machine: str = "x86_64"
    own: str = ""  # PoCL's name of the CPU; "" if it gives none
    target: str = ""  # LLVM's name of the expected compile target
    wider: str = ""


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


def arm64_pocl(work: Path) -> str:
    """Return the full path of PoCL's library in that tree.

    Debian's .icd file has only the library's name. With that name, the library does not find its
    own files, because qemu resolves faccessat outside of the tree.
    """
    (library,) = arm64_tree(work).glob("usr/lib/aarch64-linux-gnu/libpocl.so.2.*")
    return str(library)


def arm64_packages(work: Path, python: str) -> Path:
    """Install the project and its dependencies for arm64, in the versions of the work folder.

    ``python`` is a version such as 3.11. Pip cannot resolve dependencies for another machine, so a
    script lists them. It skips PoCL's wheel, whose marker names a machine.
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


# Columns: name, qemu's CPU, its name by LLVM 14 in pip's PoCL, clpipe's expected target, and a
# target that needs more. "Without": a hypervisor masks the feature, or qemu lacks it.
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
    """Return pip's PoCL on one of :data:`CPUS`.

    Raptor Lake reports SHA, because LLVM recognizes it by that. qemu may lack SHA, so the
    environment disables it in OpenSSL.
    """
    values = {"cpu": cpu, "own": own, "target": target, "wider": wider}
    return EmulatedCPU(f"cpus: {name}", pip_pocl, "", {"OPENSSL_ia32cap": ":~0x20000000"}, **values)


EMULATED = (
    *(emulated_cpu(*row) for row in CPUS),
    EmulatedCPU("arm64 (Debian)", arm64_pocl, "", machine="aarch64", cpu="cortex-a72"),
)


def script(path: Path, *command: str | Path) -> None:
    """Write a shell script that runs a command with further arguments."""
    text = " ".join('"$0"' if part == "$0" else shlex.quote(str(part)) for part in command)
    path.write_text(f'#!/bin/sh\nexec {text} "$@"\n', "utf-8")
    path.chmod(0o755)


def emulated_python(runtime: EmulatedCPU, work: Path, folder: Path) -> Path:
    """Create a virtual environment with an emulated Python in the folder of a run.

    Python finds its environment by the name of its program.
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
    """Develop on an emulated CPU, fill in its row of the table, and return whether it passed."""
    host = os.uname().machine
    if runtime.machine == "x86_64" != host:
        raise UnavailableError(f"it needs the packages of x86_64, and this machine is {host}")
    run = Run(runtime, work)
    run.run_python("render", "-c", RENDER)
    run.run_python("expected", *DEVELOP, "--device", "numpy", "-o", "expected")
    native, run.python = run.python, emulated_python(runtime, work, run.folder)
    run.environment["PATH"] = f"{run.python.parent}{os.pathsep}{os.environ['PATH']}"
    machine, own, target, lanes, row[2], problem = pocl_of(run, "device")
    row[1] = " -> ".join(dict.fromkeys(name for name in (own, target) if name)) or machine
    row[1] += f", {lanes} lanes"
    if problem:
        raise BrokenError(f"clpipe skips it: {problem}")
    wrong = []
    if (machine, own, target) != (runtime.machine, runtime.own, runtime.target):
        expected = f"{runtime.machine}, {runtime.own or '-'} -> {runtime.target or '-'}"
        wrong.append(f"it is {machine}, {own or '-'} -> {target or '-'}; expected {expected}")
    run.run_python("emulated", *DEVELOP, "--device", "pocl", "-o", "emulated")
    run.python = native
    same, difference = json.loads(run.run_python("compare", "-c", COMPARE)[0])
    row[3] = (
        f"the raw is {'' if same else 'NOT '}NumPy's, the picture differs by up to {difference:.2g}"
    )
    if difference > STEP:
        wrong.append(f"the picture may differ by {STEP:.2g}")
    if runtime.wider:
        run.python = run.folder / "venv/bin/python"
        run.environment["CLPIPE_CPU_TARGET"] = runtime.wider
        *_, problem = pocl_of(run, "wider")
        if "SIGILL" not in problem:
            result = problem or "it works"
            raise BrokenError(f"with {runtime.wider} it must end in SIGILL, but: {result}")
        row[3] += f"; {runtime.wider}: SIGILL, as expected"
    row[3] += "".join(f"; {text}" for text in wrong)
    return same and not wrong


def pocl_of(run: Run, name: str) -> list[str]:
    """Return PoCL's record in a run: machine, own name, target, lanes, version, problem."""
    printed, _ = run.run_python(name, "-c", DEVICE)
    found = json.loads(printed)
    if len(found) != 1:
        raise BrokenError(f"{name}: found {len(found)} devices of PoCL; expected one")
    return found[0]
