"""Run clpipe on every OpenCL runtime, and with PoCL on every kind of CPU, that Debian can offer.

Installs PoCL from pip and from Debian, Intel's CPU runtime, Mesa's rusticl on llvmpipe and
Oclgrind, an emulator that reports invalid memory accesses and data races, and runs ``clpipe check``
on each. Then ``clpipe run`` on CPUs that qemu-user emulates: pip's PoCL on those of x86-64 (--only
cpus; two to three minutes each), and Debian's on arm64 (--only arm64; 1 GB is installed in the work
folder). Debian's packages need root.

Prints a table. The exit status is 0 only if at least one runtime could be run and all that could
passed. All files go to the work folder and serve again next time; what each run printed is in
WORK/runs.
"""

import argparse
import json
import re
import sys
import time
from pathlib import Path

from tools import ROOT
from tools.stress.emulated import EMULATED, EmulatedCPU, measure_emulated
from tools.stress.runtimes import (
    BrokenError,
    Run,
    Runtime,
    UnavailableError,
    debian_package,
    pip_install,
    pip_pocl,
)

DEVICES = """if True:
    import json
    from clpipe.engine.discovery import find_devices
    print(json.dumps([[d.platform, d.name, d.driver, d.problem] for d in find_devices()]))
"""
# A write past a buffer and a data race: Oclgrind must report them, else its silence means nothing.
PLANTED = """if True:
    import sys, pyopencl as cl
    device = [d for p in cl.get_platforms() for d in p.get_devices()][int(sys.argv[1])]
    queue = cl.CommandQueue(context := cl.Context([device]))
    source = "kernel void f(global float *a) { a[get_global_id(0)] = 1; a[0] = get_global_id(0); }"
    buffer = cl.Buffer(context, cl.mem_flags.READ_WRITE, 64)
    cl.Program(context, source).build().f(queue, (17,), None, buffer).wait()
    print("planted")
"""


def debian_pocl(work: Path) -> str:
    """What Debian's .icd says."""
    return debian_package("pocl-opencl-icd", ".icd").read_text("utf-8")


def oclgrind(work: Path) -> str:
    """The library: the program that wraps it misses the loader within pyopencl."""
    return str(debian_package("oclgrind", "-icd.so"))


def intel(work: Path) -> None:
    """Nothing: clpipe finds it, as with the extra ``intel``."""
    pip_install(work / "venv", f"{ROOT}[intel]")


def rusticl(work: Path) -> str:
    """What Debian's .icd says."""
    return debian_package("mesa-opencl-icd", "rusticl.icd").read_text("utf-8")


WATCH = {"OCLGRIND_CHECK_API": "1", "OCLGRIND_LOG": "RUN/oclgrind.log"}
RACES = WATCH | {"OCLGRIND_DATA_RACES": "1"}
LLVMPIPE = {"RUSTICL_ENABLE": "llvmpipe", "MESA_SHADER_CACHE_DISABLE": "true"}
RUNTIMES = (
    Runtime("PoCL (pip)", pip_pocl, "Portable Computing Language"),
    Runtime("PoCL (Debian)", debian_pocl, "+debian"),
    Runtime("Intel CPU (pip)", intel, "Intel(R) OpenCL"),
    Runtime("rusticl (Debian)", rusticl, "rusticl", LLVMPIPE),
    Runtime("Oclgrind: memory", oclgrind, "Oclgrind", WATCH, "Invalid write"),
    Runtime("Oclgrind: races", oclgrind, "Oclgrind", RACES, "data race"),
    *EMULATED,
)


def measure(runtime: Runtime, work: Path, row: list[str]) -> bool:
    """Run a runtime: fills the table's row in, and whether it passed."""
    run = Run(runtime, work)
    devices = json.loads(run.python_says("devices", "-c", DEVICES)[0])
    found = [i for i, d in enumerate(devices) if runtime.known_by in f"{d[0]} {d[2]}"]
    if not found:
        raise UnavailableError(f"no device of its own, only {[d[1] for d in devices]}")
    number = str(found[0])
    _, row[1], row[2], problem = devices[found[0]]
    if problem:
        raise UnavailableError(f"clpipe passes it over: {problem}")
    if runtime.planted:
        run.python_says("planted", "-c", PLANTED, number)
        if not run.log.exists() or runtime.planted not in run.log.read_text("utf-8"):
            raise BrokenError("it does not report errors that were planted")
        run.log.unlink()
    small = ["--small"] if runtime.planted else []
    check = ("-m", "clpipe", "check", "--json", "--device", number, *small)
    printed, said = run.python_says("check", *check)
    try:
        checks = json.loads(printed)["checks"]
    except ValueError:
        raise BrokenError(f"check: what it printed is no report: {printed[:60]!r}") from None
    failed = [c for c in checks if not c["passed"]]
    row[3] = f"{len(checks) - len(failed)} passed, {len(failed)} failed"
    row[3] += "".join(f"; {c['stage']} {c['method']} off by {c['largest']:.2g}" for c in failed)
    # Misused calls go to stderr; pyopencl asks clGetDeviceInfo for newer values and takes a no.
    calls = re.findall(r"^\s*Function: (\w+)", said, re.MULTILINE)
    wrong = [f"misuse of {call}" for call in calls if call != "clGetDeviceInfo"]
    if run.log.exists():
        wrong += [line for line in run.log.read_text("utf-8").splitlines() if line.strip()]
    if wrong:
        row[3] += f"; {wrong[0]}, ... (see {run.folder})"
    return bool(checks) and not failed and not wrong


def main() -> int:
    """Install, run, print the table."""
    parser = argparse.ArgumentParser(description=str(__doc__).partition("\n")[0])
    parser.add_argument("--work", type=Path, default=ROOT / "build/portability", metavar="DIR")
    parser.add_argument(
        "--only", default="", metavar="TEXT", help="those with TEXT in the name, as in cpus"
    )
    options = parser.parse_args()
    work: Path = options.work.resolve()
    work.mkdir(parents=True, exist_ok=True)
    try:
        pip_install(work / "venv", ROOT)
    except UnavailableError as error:
        print(f"portability: the project cannot be installed: {error}", file=sys.stderr)
        return 1
    rows = [["runtime", "device", "version", "checks", "seconds"]]
    passed: list[bool] = []
    for runtime in (r for r in RUNTIMES if options.only.lower() in r.name.lower()):
        print(f"{runtime.name} ...", file=sys.stderr, flush=True)
        row, start = [runtime.name, "", "", "", ""], time.monotonic()
        try:
            if isinstance(runtime, EmulatedCPU):
                passed.append(measure_emulated(runtime, work, row))
            else:
                passed.append(measure(runtime, work, row))
        except UnavailableError as error:
            row[3] = f"not run: {error}"
        except BrokenError as error:
            row[3] = f"BROKEN: {error}"
            passed.append(False)
        row[4] = f"{time.monotonic() - start:.0f}"
        rows.append(row)
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    for row in rows:
        print("  ".join(map(str.ljust, row, widths)).rstrip())
    return 0 if passed and all(passed) else 1


if __name__ == "__main__":
    sys.exit(main())
