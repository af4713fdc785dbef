"""Compile the kernels of common chains for GPUs, without having the GPUs, and print figures.

    tools/run stress gpu_compile [--only TEXT] [--target NAME ...]

The chains are the default and the paper's development, the raw with every source of noise, and each
method of each stage by itself. The targets are NVIDIA sm_80 and sm_90, AMD gfx1030 and gfx1100, and
Intel DG2. The tool names and skips targets without a compiler. To install the compilers:

    apt-get install clang-19 libclc-19                         # NVIDIA and AMD
    pip install nvidia-cuda-nvcc-cu12 nvidia-cuda-nvdisasm     # NVIDIA: ptxas, nvdisasm
    apt-get install intel-opencl-icd                           # Intel: ocloc

The columns are:

- registers: per work item (Intel: per thread).
- spilled B: bytes that spill from registers.
- instructions: in the kernel.
- fused: fused multiply-adds of floats.

The exit status is 1 if a kernel does not compile, or spills. It is also 1 if a
kernel of the raw has a fused multiply-add, because the raw must be identical on every device.
"""

import os
import re
import shutil
import subprocess
import sys
import sysconfig
import tempfile
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import astuple, dataclass
from functools import partial
from pathlib import Path

from clpipe.chain.chain import Chain
from clpipe.chain.making import make_chain
from clpipe.chain.registry import all_stages
from clpipe.chain.request import Request
from clpipe.chain.settings import Settings
from clpipe.engine.check import ISO, chain_for, sensor_parameters
from clpipe.engine.codegen import write_kernel
from clpipe.engine.ir import Kernel
from clpipe.engine.plan import make_plan
from clpipe.reference.cfa import PATTERNS
from clpipe.stage import variant_label, variants
from tools.shared.options import parser_of
from tools.shared.tables import markdown

RAW = "raw: "  # prefix of the names of chains from a render to its raw
OPENCL = "-x cl -cl-std=CL1.2 -O3 -w -S -Xclang -fdeclare-opencl-builtins"
OPENCL += " -Xclang -finclude-default-header -Xclang -mlink-builtin-bitcode -Xclang"
NVIDIA_FUSED = r"\bFFMA"
AMD_FUSED = r"\bv_(dual_)?(fma|fmac|mad|mac|fmamk|fmaak|madmk|madak)_f32|\bv_pk_fma_f32|\bv_fma_mix"
INTEL_FUSED = r"(?m)^(?:\(.*?\))?\s*mad .*:f\b"


class MissingError(Exception):
    """A compiler is not installed. The message names it."""


@dataclass(frozen=True)
class Compiled:
    """Figures of a compiled kernel."""

    registers: int
    spilled: int  # bytes
    instructions: int
    fused: int


@dataclass(frozen=True)
class Job:
    """A kernel to compile, and the first chain that contains it."""

    chain: str
    kernel: Kernel


def tool(name: str) -> str:
    """Return the path of a program, from PATH or from a pip package of NVIDIA.

    Raises:
        MissingError: the program is not installed.
    """
    packages = Path(sysconfig.get_path("purelib"), "nvidia").glob(f"*/bin/{name}")
    found = shutil.which(name) or next(map(str, packages), None)
    if not found:
        raise MissingError(f"no {name}")
    return found


def clang() -> str:
    """Return the newest clang. Distributions add the version to its name."""
    for name in ("clang", *(f"clang-{version}" for version in range(25, 14, -1))):
        if found := shutil.which(name):
            return found
    raise MissingError("no clang")


def builtins(name: str) -> Path:
    """Return libclc's file of OpenCL's built-in functions for a target."""
    for folder in ("/usr/lib/clc", "/usr/share/clc", "/usr/local/share/clc"):
        if (path := Path(folder, name)).exists():
            return path
    raise MissingError(f"no {name} of libclc")


def output_of(*command: str | Path, **variables: str) -> str:
    """Run a compiler, and return its output.

    Raises:
        CalledProcessError: the compiler failed; ``stdout`` contains the message.
    """
    return subprocess.run(
        command,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        check=True,
        env=os.environ | variables,
    ).stdout


def number_in(text: str, pattern: str) -> int:
    """Return the number that a pattern finds; 0 if it finds nothing."""
    found = re.search(pattern, text)
    return int(found[1]) if found else 0


def for_nvidia(arch: str, source: Path) -> Compiled:
    """Compile a kernel with clang and ptxas."""
    ptx, cubin = source.with_suffix(".ptx"), source.with_suffix(".cubin")
    library = builtins("nvptx64--nvidiacl.bc")
    assembler, disassembler = tool("ptxas"), tool("nvdisasm")
    # libclc lacks two functions for NVIDIA. NVIDIA's own library has this intrinsic, and keeps the
    # offset of the third dimension, the only one that kernels read, in an environment register.
    exp2 = "-Dnative_exp2=__nvvm_ex2_approx_ftz_f"
    offset = (
        "-Dget_global_offset(d)=({ size_t offset; "
        '__asm__("{ .reg .u32 t; mov.u32 t, %%envreg5; cvt.u64.u32 %0, t; }" : "=l"(offset)); '
        "offset; })"
    )
    target = ("-target", "nvptx64-nvidia-nvcl", f"-march={arch}", exp2, offset)
    output_of(clang(), *target, *OPENCL.split(), library, "-o", ptx, source)
    log = output_of(assembler, f"-arch={arch}", "-v", "-o", cubin, ptx)
    text = output_of(disassembler, "-c", cubin)
    return Compiled(
        number_in(log, r"Used (\d+) registers"),
        number_in(log, r"(\d+) bytes spill stores"),
        len(re.findall(r"(?m)^\s*/\*[0-9a-f]+\*/\s+(?!NOP)", text)),
        len(re.findall(NVIDIA_FUSED, text)),
    )


def for_amd(arch: str, source: Path) -> Compiled:
    """Compile a kernel with clang."""
    assembly = source.with_suffix(".s")
    library = builtins("amdgcn--amdhsa.bc")
    target = ("-target", "amdgcn-amd-amdhsa", f"-mcpu={arch}", "-nogpulib")
    output_of(clang(), *target, *OPENCL.split(), library, "-o", assembly, source)
    text = assembly.read_text("utf-8")
    return Compiled(
        number_in(text, r"; NumVgprs: (\d+)"),
        number_in(text, r"\.vgpr_spill_count: (\d+)") * 4,
        len(re.findall(r"(?m)^\t[a-z]", text)),
        len(re.findall(AMD_FUSED, text)),
    )


def for_intel(arch: str, source: Path) -> Compiled:
    """Compile a kernel with Intel's compiler, which also writes its assembly."""
    folder = source.with_suffix(".d")
    options = ("-options", "-cl-std=CL1.2", "-internal_options", "-cl-intel-allow-zebin")
    output_of(
        *(tool("ocloc"), "compile", "-file", source, "-device", arch, *options),
        *("-out_dir", folder, "-output", "kernel"),
        IGC_ShaderDumpEnable="1",
        IGC_DumpToCustomDir=str(folder),
    )
    binary = next(folder.glob("kernel*.bin")).read_bytes().decode("latin-1")
    width = number_in(binary, r"simd_size: +(\d+)")
    text = next(folder.glob(f"*_simd{width}_*.asm")).read_text("utf-8")
    return Compiled(
        number_in(binary, r"grf_count: +(\d+)"),
        number_in(text, r"//\.spill size (\d+)"),
        number_in(text, r"//\.instCount (\d+)"),
        len(re.findall(INTEL_FUSED, text)),
    )


TARGETS: dict[str, Callable[[Path], Compiled]] = {
    "sm_80": partial(for_nvidia, "sm_80"),
    "sm_90": partial(for_nvidia, "sm_90"),
    "gfx1030": partial(for_amd, "gfx1030"),
    "gfx1100": partial(for_amd, "gfx1100"),
    "dg2": partial(for_intel, "dg2"),
}


def chains() -> Iterator[tuple[str, Chain]]:
    """Yield the names and chains."""
    names = list(all_stages())
    until_raw = tuple(names[: names.index("quantize") + 1])
    for noise in all_stages()["sensor_noise"].by_name:
        parameters = {**sensor_parameters(), "sensor_noise": {"method": noise}}
        settings = Settings(iso=ISO, stages=until_raw, parameters=parameters)
        yield f"{RAW}{noise}, all noise", make_chain(settings)
    for config in ("default", "paper"):
        request = Request.from_options(config=config, values={"iso": ISO})
        yield f"{RAW}{config}", request.chain().up_to(["quantize"])
        yield config, request.chain()
    for stage in all_stages().values():
        for method in stage.methods:
            for values in variants(method):
                label = f"{stage.name}={variant_label(method, values)}"
                yield label, chain_for(stage, method, values, PATTERNS[0])


def jobs(only: str) -> list[Job]:
    """Return the distinct kernels of chains whose names contain a text."""
    found: dict[str, Job] = {}
    for name, chain in chains():
        if only in name:
            plan = make_plan(chain)
            for launch in plan.launches:
                kernel = write_kernel(plan, launch, lanes=1)
                found.setdefault(kernel.name, Job(name, kernel))
    return list(found.values())


def violation(job: Job, result: Compiled) -> str:
    """Return the requirement that a kernel violates, or an empty text."""
    if result.spilled:
        return "SPILLS"
    return "FUSED" if job.chain.startswith(RAW) and result.fused else ""


def row(job: Job, target: str, folder: Path) -> tuple[list[str], bool]:
    """Return the row of a kernel, and whether it meets all requirements.

    Raises:
        MissingError: a compiler is not installed.
    """
    name = [job.chain, job.kernel.launch.name]
    source = folder / f"{target}-{job.kernel.name}.cl"
    source.write_text(job.kernel.source, "utf-8")
    try:
        result = TARGETS[target](source)
    except subprocess.CalledProcessError as error:
        lines = error.stdout.strip().splitlines() or ["it printed nothing"]
        return [*name, *[""] * 4, f"does not compile: {lines[-1]}"], False
    wrong = violation(job, result)
    return [*name, *map(str, astuple(result)), wrong], not wrong


HEADINGS = ["chain", "launch", "registers", "spilled B", "instructions", "fused", ""]


def main() -> int:
    """Compile the kernels, and print a table for each target."""
    parser = parser_of(__doc__)
    parser.add_argument(
        "--only", default="", metavar="TEXT", help="compile only chains with TEXT in their name"
    )
    parser.add_argument("--target", action="append", choices=TARGETS, help="may be repeated")
    options = parser.parse_args()
    kernels = jobs(options.only)
    passed: list[bool] = []
    with tempfile.TemporaryDirectory() as folder, ThreadPoolExecutor(os.cpu_count()) as threads:
        for target in options.target or TARGETS:
            compile_ = partial(row, target=target, folder=Path(folder))
            try:
                rows = list(threads.map(compile_, kernels))
            except MissingError as error:
                print(f"{target}: skipped, there is {error}\n")
                continue
            passed += [good for _, good in rows]
            wrong = sum(not good for _, good in rows)
            table = markdown(HEADINGS, (texts for texts, _ in rows))
            print(
                f"{target}: {len(rows)} kernels, {wrong} with violations\n\n{table}\n", flush=True
            )
    if not passed:
        print("gpu_compile: no target has a compiler", file=sys.stderr)
    return 0 if passed and all(passed) else 1


if __name__ == "__main__":
    sys.exit(main())
