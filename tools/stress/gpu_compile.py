"""Compile the kernels of the usual chains for GPUs that are not here, and print what came of it.

    tools/run stress gpu_compile [--only TEXT] [--target NAME ...]

The chains: the default and the paper's development, the raw with every source of noise, and each
method of each stage alone. The targets: NVIDIA sm_80 and sm_90, AMD gfx1030 and gfx1100, Intel DG2.
What a compiler is missing for is said and left out:

    apt-get install clang-19 libclc-19                         # NVIDIA and AMD
    pip install nvidia-cuda-nvcc-cu12 nvidia-cuda-nvdisasm     # NVIDIA: ptxas, nvdisasm
    apt-get install intel-opencl-icd                           # Intel: ocloc

Columns: registers of a work item (of Intel: of a thread), bytes that spill from them, bytes of
private memory (spills included, but on Intel), occupancy as registers and work-groups allow (of
Intel: work items of a thread), instructions of the whole text, those a pixel away from the edges
(a loop's count once), and fused multiply-adds of floats.

The exit status is 1 if a kernel does not compile, spills more than ALLOWED says, or if one that
makes the raw has a fused multiply-add: the raw's bits must be the same on every device.
"""

import argparse
import os
import re
import shutil
import subprocess
import sys
import sysconfig
import tempfile
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from clpipe.chain.chain import Chain
from clpipe.chain.making import make_chain
from clpipe.chain.registry import all_stages
from clpipe.chain.request import Request
from clpipe.chain.settings import Settings
from clpipe.engine.check import ISO, NOISE, chain_for
from clpipe.engine.codegen import write_kernel
from clpipe.engine.ir import Kernel, Launch
from clpipe.engine.plan import make_plan
from clpipe.engine.work_items import columns_of
from clpipe.reference.cfa import PATTERNS
from clpipe.stage import variant_label, variants

ALLOWED: dict[str, int] = {}  # bytes that a launch may spill, on any target; others none
RAW = "raw: "  # begins the names of the chains from a render to its raw
OPENCL = "-x cl -cl-std=CL1.2 -O3 -w -S -Xclang -fdeclare-opencl-builtins"
OPENCL += " -Xclang -finclude-default-header -Xclang -mlink-builtin-bitcode -Xclang"
NEAR_EDGE = "INLINE bool near_edge(site at, uint rows, extent e) {"
NVIDIA_FUSED = r"\bFFMA"
AMD_FUSED = r"\bv_(dual_)?(fma|fmac|mad|mac|fmamk|fmaak|madmk|madak)_f32|\bv_pk_fma_f32|\bv_fma_mix"
INTEL_FUSED = r"(?m)^(?:\(.*?\))?\s*mad .*:f\b"


class MissingError(Exception):
    """A compiler that is not installed; the message says which."""


@dataclass(frozen=True)
class Compiled:
    """What a compiler made of a kernel."""

    registers: int
    spilled: int  # bytes
    private: int  # bytes
    occupancy: str
    instructions: int
    fused: int


@dataclass(frozen=True)
class Job:
    """A kernel that is compiled, and the first chain that has it."""

    chain: str
    kernel: Kernel

    @property
    def pixels(self) -> int:
        """Pixels of a work item; 0 where it has none."""
        launch = self.kernel.launch
        return launch.rows * columns_of(launch, 1) if isinstance(launch, Launch) else 0


def tool(name: str) -> str:
    """The path of a program: on the PATH, or of a package that pip installed.

    Raises:
        MissingError: it is not there.
    """
    packages = Path(sysconfig.get_path("purelib"), "nvidia").glob(f"*/bin/{name}")
    found = shutil.which(name) or next(map(str, packages), None)
    if not found:
        raise MissingError(f"no {name}")
    return found


def clang() -> str:
    """The newest clang; distributions put the version into its name."""
    for name in ("clang", *(f"clang-{version}" for version in range(25, 14, -1))):
        if found := shutil.which(name):
            return found
    raise MissingError("no clang")


def builtins(name: str) -> Path:
    """OpenCL's built-in functions for a target, of libclc."""
    for folder in ("/usr/lib/clc", "/usr/share/clc", "/usr/local/share/clc"):
        if (path := Path(folder, name)).exists():
            return path
    raise MissingError(f"no {name} of libclc")


def output_of(*command: str | Path, **variables: str) -> str:
    """What a compiler prints.

    Raises:
        CalledProcessError: it fails; ``stdout`` has the message.
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
    """The number that a pattern finds; 0 where it finds nothing."""
    found = re.search(pattern, text)
    return int(found[1]) if found else 0


def for_nvidia(arch: str, source: Path) -> Compiled:
    """A kernel by clang and ptxas."""
    ptx, cubin = source.with_suffix(".ptx"), source.with_suffix(".cubin")
    library = builtins("nvptx64--nvidiacl.bc")
    assembler, disassembler = tool("ptxas"), tool("nvdisasm")
    # The library lacks what NVIDIA's own has for native_exp2.
    exp2 = "-Dnative_exp2=__nvvm_ex2_approx_ftz_f"
    target = ("-target", "nvptx64-nvidia-nvcl", f"-march={arch}", exp2)
    output_of(clang(), *target, *OPENCL.split(), library, "-o", ptx, source)
    said = output_of(assembler, f"-arch={arch}", "-v", "-o", cubin, ptx)
    text = output_of(disassembler, "-c", cubin)
    registers = number_in(said, r"Used (\d+) registers")
    # A multiprocessor has room for 32 groups, 64 warps and 65536 registers, of which a warp takes
    # 256 at a time.
    group = -(-number_in(source.read_text("utf-8"), r"reqd_work_group_size\((\d+)") // 32)
    warps = 65536 // (-(-registers * 32 // 256) * 256)
    warps = min(warps // group, 64 // group, 32) * group
    return Compiled(
        registers,
        number_in(said, r"(\d+) bytes spill stores"),
        number_in(said, r"(\d+) bytes stack frame"),
        f"{warps / 64:.0%}",
        len(re.findall(r"(?m)^\s*/\*[0-9a-f]+\*/\s+(?!NOP)", text)),
        len(re.findall(NVIDIA_FUSED, text)),
    )


def for_amd(arch: str, source: Path) -> Compiled:
    """A kernel by clang."""
    assembly = source.with_suffix(".s")
    library = builtins("amdgcn--amdhsa.bc")
    target = ("-target", "amdgcn-amd-amdhsa", f"-mcpu={arch}", "-nogpulib")
    output_of(clang(), *target, *OPENCL.split(), library, "-o", assembly, source)
    text = assembly.read_text("utf-8")
    return Compiled(
        number_in(text, r"; NumVgprs: (\d+)"),
        number_in(text, r"\.vgpr_spill_count: (\d+)") * 4,
        number_in(text, r"; ScratchSize: (\d+)"),
        f"{number_in(text, '; Occupancy: ([0-9]+)') / 16:.0%}",
        len(re.findall(r"(?m)^\t[a-z]", text)),
        len(re.findall(AMD_FUSED, text)),
    )


def for_intel(arch: str, source: Path) -> Compiled:
    """A kernel by Intel's compiler, which is asked for its assembly."""
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
        number_in(binary, r"usage: +private_space\n +size: +(\d+)"),
        f"SIMD{width}",
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
    """The chains and their names."""
    names = list(all_stages())
    until_raw = tuple(names[: names.index("quantize") + 1])
    for noise in all_stages()["sensor_noise"].by_name:
        parameters = {**NOISE, "sensor_noise": {"method": noise}}
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
    """The kernels of the chains with a text in their names, each once."""
    found: dict[str, Job] = {}
    for name, chain in chains():
        if only in name:
            plan = make_plan(chain)
            for launch in plan.launches:
                kernel = write_kernel(plan, launch, lanes=1)
                found.setdefault(kernel.name, Job(name, kernel))
    return list(found.values())


def compiled(job: Job, target: str, folder: Path) -> tuple[Compiled, int]:
    """What a target's compiler makes of a kernel, and its instructions without code for edges."""
    whole, inside = (folder / f"{target}-{job.kernel.name}-{name}.cl" for name in ("", "inside"))
    source = job.kernel.source
    assert NEAR_EDGE in source
    whole.write_text(source, "utf-8")
    result = TARGETS[target](whole)
    if not job.pixels:
        return result, 0
    inside.write_text(source.replace(NEAR_EDGE, f"{NEAR_EDGE} return false;"), "utf-8")
    return result, TARGETS[target](inside).instructions


def wrong_with(job: Job, result: Compiled) -> str:
    """What a kernel may not do and does, or nothing."""
    if result.spilled > ALLOWED.get(job.kernel.launch.name, 0):
        return "SPILLS"
    return "FUSED" if job.chain.startswith(RAW) and result.fused else ""


def row(job: Job, target: str, folder: Path) -> tuple[list[str], bool]:
    """The row of a kernel, and whether all is well with it.

    Raises:
        MissingError: a compiler is not installed.
    """
    name = [job.chain, job.kernel.launch.name]
    try:
        result, inside = compiled(job, target, folder)
    except subprocess.CalledProcessError as error:
        said = error.stdout.strip().splitlines() or ["it said nothing"]
        return [*name, *[""] * 7, f"does not compile: {said[-1]}"], False
    wrong = wrong_with(job, result)
    numbers = [result.registers, result.spilled, result.private, result.occupancy]
    numbers += [result.instructions, inside // job.pixels if job.pixels else "-", result.fused]
    return [*name, *map(str, numbers), wrong], not wrong


HEADINGS = ["chain", "launch", "registers", "spilled B", "private B", "occupancy"]
HEADINGS += ["instructions", "a pixel", "fused", ""]


def show(target: str, rows: list[list[str]], wrong: int) -> None:
    """Print the table of a target."""
    print(f"{target}: {len(rows)} kernels, {wrong} not as they should be")
    table = [HEADINGS, *rows]
    widths = [max(map(len, column)) for column in zip(*table, strict=True)]
    for texts in table:
        names = map(str.ljust, texts[:2], widths)
        print("  ".join([*names, *map(str.rjust, texts[2:-1], widths[2:]), texts[-1]]).rstrip())
    print(flush=True)


def main() -> int:
    """Compile, print a table for each target."""
    parser = argparse.ArgumentParser(description=str(__doc__).partition("\n")[0])
    parser.add_argument("--only", default="", metavar="TEXT", help="chains with TEXT in their name")
    parser.add_argument("--target", action="append", choices=TARGETS, help="may be repeated")
    options = parser.parse_args()
    kernels = jobs(options.only)
    well: list[bool] = []
    with tempfile.TemporaryDirectory() as folder, ThreadPoolExecutor(os.cpu_count()) as threads:
        for target in options.target or TARGETS:
            compile_ = partial(row, target=target, folder=Path(folder))
            try:
                rows = list(threads.map(compile_, kernels))
            except MissingError as error:
                print(f"{target}: left out, there is {error}\n")
                continue
            well += [good for _, good in rows]
            show(target, [texts for texts, _ in rows], sum(not good for _, good in rows))
    if not well:
        print("gpu_compile: nothing was compiled", file=sys.stderr)
    return 0 if well and all(well) else 1


if __name__ == "__main__":
    sys.exit(main())
