"""Run clpipe on every OpenCL runtime for Debian, and with PoCL on emulated CPUs.

The tool installs these runtimes, and runs ``clpipe check`` on each: PoCL from pip and from Debian,
Intel's CPU runtime, Mesa's rusticl on llvmpipe, and Oclgrind. Oclgrind is an emulator that reports
invalid memory accesses and data races. Debian's packages need root.

Then the tool runs ``clpipe run`` on CPUs that qemu-user emulates:

- x86-64 with pip's PoCL (--only cpus; two to three minutes each)
- arm64 with Debian's PoCL (--only arm64; installs 1 GB into the work folder)

It prints a table. The exit status is 0 if at least one runtime could run and all of those passed.
All files are in the work folder, and later runs reuse them. WORK/runs contains the output of each
run.
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
# A write past a buffer and a data race. Oclgrind must report both; otherwise it detects nothing.
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
    """Return the text of Debian's .icd file."""
    return debian_package("pocl-opencl-icd", ".icd").read_text("utf-8")


def oclgrind(work: Path) -> str:
    """Return the library. Oclgrind's wrapper program does not affect the loader within pyopencl."""
    return str(debian_package("oclgrind", "-icd.so"))


def intel(work: Path) -> None:
    """Install the extra ``intel``; clpipe finds the runtime without an .icd file."""
    pip_install(work / "venv", f"{ROOT}[intel]")


def rusticl(work: Path) -> str:
    """Return the text of Debian's .icd file."""
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
    """Check a runtime, fill in its row of the table, and return whether it passed."""
    run = Run(runtime, work)
    devices = json.loads(run.run_python("devices", "-c", DEVICES)[0])
    found = [i for i, d in enumerate(devices) if runtime.marker in f"{d[0]} {d[2]}"]
    if not found:
        raise UnavailableError(f"found none of its devices, only {[d[1] for d in devices]}")
    number = str(found[0])
    _, row[1], row[2], problem = devices[found[0]]
    if problem:
        raise UnavailableError(f"clpipe skips it: {problem}")
    if runtime.planted:
        run.run_python("planted", "-c", PLANTED, number)
        if not run.log.exists() or runtime.planted not in run.log.read_text("utf-8"):
            raise BrokenError("it does not report the planted errors")
        run.log.unlink()
    small = ["--small"] if runtime.planted else []
    check = ("-m", "clpipe", "check", "--json", "--device", number, *small)
    printed, errors = run.run_python("check", *check)
    try:
        checks = json.loads(printed)["checks"]
    except ValueError:
        raise BrokenError(f"check: expected a report, found {printed[:60]!r}") from None
    failed = [c for c in checks if not c["passed"]]
    row[3] = f"{len(checks) - len(failed)} passed, {len(failed)} failed"
    row[3] += "".join(f"; {c['stage']} {c['method']} off by {c['largest']:.2g}" for c in failed)
    # Misused calls go to stderr. pyopencl queries new values by clGetDeviceInfo and handles errors.
    calls = re.findall(r"^\s*Function: (\w+)", errors, re.MULTILINE)
    wrong = [f"misuse of {call}" for call in calls if call != "clGetDeviceInfo"]
    if run.log.exists():
        wrong += [line for line in run.log.read_text("utf-8").splitlines() if line.strip()]
    if wrong:
        row[3] += f"; {wrong[0]}, ... (see {run.folder})"
    return bool(checks) and not failed and not wrong


def main() -> int:
    """Install and check the runtimes, and print the table."""
    parser = argparse.ArgumentParser(description=str(__doc__).partition("\n")[0])
    parser.add_argument("--work", type=Path, default=ROOT / "build/portability", metavar="DIR")
    parser.add_argument(
        "--only",
        default="",
        metavar="TEXT",
        help="run only runtimes with TEXT in their name, such as cpus",
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
            row[3] = f"skipped: {error}"
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
