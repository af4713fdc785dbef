"""Kernels are compiled for GPUs that need not be present, by compilers that are installed.

apt-get install clang-19 libclc-19                         # NVIDIA and AMD
pip install nvidia-cuda-nvcc-cu12 nvidia-cuda-nvdisasm     # NVIDIA: ptxas, nvdisasm
apt-get install intel-opencl-icd                           # Intel: ocloc
"""

import os
import re
import shutil
import subprocess
import sysconfig
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from clpipe.chain.making import make_chain
from clpipe.chain.registry import all_stages
from clpipe.chain.request import Request
from clpipe.chain.settings import Settings
from clpipe.engine.check import ISO, sensor_parameters
from clpipe.engine.codegen import write_kernel
from clpipe.engine.plan import make_plan

pytestmark = pytest.mark.slow

OPENCL = "-x cl -cl-std=CL1.2 -O3 -w -S -Xclang -fdeclare-opencl-builtins"
OPENCL += " -Xclang -finclude-default-header -Xclang -mlink-builtin-bitcode -Xclang"
NVIDIA_FUSED = r"\bFFMA"
AMD_FUSED = r"\bv_(dual_)?(fma|fmac|mad|mac|fmamk|fmaak|madmk|madak)_f32|\bv_pk_fma_f32|\bv_fma_mix"
INTEL_FUSED = r"(?m)^(?:\(.*?\))?\s*mad .*:f\b"
FUSED = {  # the same line with a fused multiply-add of floats, and one of integers
    NVIDIA_FUSED: ("FFMA R1, R2, R3, R4 ;", "IMAD R1, R2, R3, R4 ;"),
    AMD_FUSED: ("v_fmac_f32_e32 v1, v2, v3", "v_mad_u64_u32 v[5:6], null, s3, s4, v[5:6]"),
    INTEL_FUSED: (
        "(W) mad (16|M0) r3.0<1>:f r1.0<8;1>:f r2.0<8;1>:f r4.0<1>:f",
        "mad (16|M0) r3.0<1>:d r1.0<8;1>:d r2.0<8;1>:w r4.0<1>:w",
    ),
}


@pytest.mark.parametrize("pattern", FUSED)
def test_fused_multiply_adds_of_floats_are_found(pattern):
    floats, integers = FUSED[pattern]
    assert re.search(pattern, floats) and not re.search(pattern, integers)


def tool(name):
    """Return the path of a program, from PATH or from a pip package of NVIDIA."""
    packages = Path(sysconfig.get_path("purelib"), "nvidia").glob(f"*/bin/{name}")
    newest = sorted(Path("/usr/bin").glob(f"{name}-[1-9][0-9]"))[-1:]
    found = shutil.which(name) or next(iter([*newest, *packages]), None)
    return found or pytest.skip(f"needs {name}")


def builtins(name):
    """Return libclc's file of OpenCL's built-in functions for a target."""
    folders = ("/usr/lib/clc", "/usr/share/clc", "/usr/local/share/clc")
    found = next((path for f in folders if (path := Path(f, name)).exists()), None)
    return found or pytest.skip(f"needs {name} of libclc")


def output_of(*command, **variables):
    environment = os.environ | variables
    return subprocess.run(
        command, capture_output=True, text=True, check=True, env=environment
    ).stdout


def number_in(text, pattern):
    """Return the number that a pattern finds; 0 if it finds nothing."""
    found = re.search(pattern, text)
    return int(found[1]) if found else 0


def for_nvidia(source):
    """Return the spilled bytes and the instructions."""
    ptx, cubin = source.with_suffix(".ptx"), source.with_suffix(".cubin")
    # libclc lacks two functions for NVIDIA. NVIDIA's own library has this intrinsic, and keeps the
    # offset of the third dimension, the only one that kernels read, in an environment register.
    exp2 = "-Dnative_exp2=__nvvm_ex2_approx_ftz_f"
    offset = (
        "-Dget_global_offset(d)=({ size_t offset; "
        '__asm__("{ .reg .u32 t; mov.u32 t, %%envreg5; cvt.u64.u32 %0, t; }" : "=l"(offset)); '
        "offset; })"
    )
    target = ("-target", "nvptx64-nvidia-nvcl", "-march=sm_90", exp2, offset)
    library = builtins("nvptx64--nvidiacl.bc")
    output_of(tool("clang"), *target, *OPENCL.split(), library, "-o", ptx, source)
    command = [tool("ptxas"), "-arch=sm_90", "-v", "-o", cubin, ptx]
    log = subprocess.run(command, capture_output=True, text=True, check=True).stderr
    spilled = number_in(log, r"(\d+) bytes spill stores")
    return spilled, output_of(tool("nvdisasm"), "-c", cubin)


def for_amd(source):
    """Return the spilled bytes and the instructions."""
    assembly = source.with_suffix(".s")
    target = ("-target", "amdgcn-amd-amdhsa", "-mcpu=gfx1030", "-nogpulib")
    library = builtins("amdgcn--amdhsa.bc")
    output_of(tool("clang"), *target, *OPENCL.split(), library, "-o", assembly, source)
    text = assembly.read_text("utf-8")
    return number_in(text, r"\.vgpr_spill_count: (\d+)") * 4, text


def for_intel(source):
    """Return the spilled bytes and the instructions, which the compiler writes to a folder."""
    folder = source.with_suffix(".d")
    options = ("-options", "-cl-std=CL1.2", "-internal_options", "-cl-intel-allow-zebin")
    output_of(
        *(tool("ocloc"), "compile", "-file", source, "-device", "dg2", *options),
        *("-out_dir", folder, "-output", "kernel"),
        IGC_ShaderDumpEnable="1",
        IGC_DumpToCustomDir=str(folder),
    )
    binary = next(folder.glob("kernel*.bin")).read_bytes().decode("latin-1")
    width = number_in(binary, r"simd_size: +(\d+)")
    text = next(folder.glob(f"*_simd{width}_*.asm")).read_text("utf-8")
    return number_in(text, r"//\.spill size (\d+)"), text


TARGETS = {
    "sm_90": (for_nvidia, NVIDIA_FUSED),
    "gfx1030": (for_amd, AMD_FUSED),
    "dg2": (for_intel, INTEL_FUSED),
}


def kernels(*chains):
    plans = [make_plan(chain) for chain in chains]
    made = (write_kernel(plan, each, lanes=1) for plan in plans for each in plan.launches)
    return {kernel.name: kernel.source for kernel in made}


def developments():
    return (
        Request.from_options(config=c, values={"iso": ISO}).chain() for c in ("default", "paper")
    )


def raws():
    """The chains from a render to the raw: the default's, the paper's, and every noise at once."""
    for chain in developments():
        yield chain.up_to(["quantize"])
    names = list(all_stages())
    stages = tuple(names[: names.index("quantize") + 1])
    for noise in all_stages()["sensor_noise"].by_name:
        parameters = {**sensor_parameters(), "sensor_noise": {"method": noise}}
        yield make_chain(Settings(iso=ISO, stages=stages, parameters=parameters))


@pytest.mark.parametrize("target", TARGETS)
def test_developments_do_not_spill_and_raws_have_no_fused_multiply_adds(target, tmp_path):
    compile_, fused = TARGETS[target]
    of_raws, developed = kernels(*raws()), kernels(*developments())
    every = of_raws | developed

    def check(name):
        source = tmp_path / f"{name}.cl"
        source.write_text(every[name])
        spilled, text = compile_(source)
        assert len(text.splitlines()) > 50, name
        assert name not in developed or spilled == 0, name
        assert name not in of_raws or not re.search(fused, text), name

    with ThreadPoolExecutor(os.cpu_count()) as threads:
        list(threads.map(check, every))
