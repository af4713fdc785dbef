"""tools/stress/gpu_compile.py on a few kernels, for targets with an installed compiler."""

import re
import subprocess
from dataclasses import replace

import pytest

from tools.stress import gpu_compile as tool

pytestmark = pytest.mark.slow

FUSED = {  # the same line with a fused multiply-add of floats, and one of integers
    tool.NVIDIA_FUSED: ("FFMA R1, R2, R3, R4 ;", "IMAD R1, R2, R3, R4 ;"),
    tool.AMD_FUSED: ("v_fmac_f32_e32 v1, v2, v3", "v_mad_u64_u32 v[5:6], null, s3, s4, v[5:6]"),
    tool.INTEL_FUSED: (
        "(W) mad (16|M0) r3.0<1>:f r1.0<8;1>:f r2.0<8;1>:f r4.0<1>:f",
        "mad (16|M0) r3.0<1>:d r1.0<8;1>:d r2.0<8;1>:w r4.0<1>:w",
    ),
}


@pytest.mark.parametrize("pattern", FUSED)
def test_fused_multiply_adds_of_floats_are_found(pattern):
    floats, integers = FUSED[pattern]
    assert re.search(pattern, floats) and not re.search(pattern, integers)


@pytest.fixture
def job():
    """The kernel that makes the raw in the default chain, after the one that loads the render."""
    *_, found = tool.jobs("raw: default")
    return found


def test_what_a_kernel_may_not_do(job):
    good = tool.Compiled(40, 0, 500, 0)
    assert tool.violation(job, good) == ""
    assert tool.violation(job, replace(good, fused=1)) == "FUSED"
    assert tool.violation(job, replace(good, spilled=4)) == "SPILLS"
    assert tool.violation(replace(job, chain="gamma=srgb"), replace(good, fused=1)) == ""


@pytest.mark.parametrize("target", ["sm_90", "gfx1030", "dg2"])
def test_the_raw_is_compiled_without_spills_and_fused_multiply_adds(job, target, tmp_path):
    source = tmp_path / "k.cl"
    source.write_text(job.kernel.source)
    try:
        result = tool.TARGETS[target](source)
    except tool.MissingError as error:
        pytest.skip(f"needs {str(error).removeprefix('no ')}")
    assert tool.violation(job, result) == "" and result.registers and result.instructions > 100


def test_a_kernel_that_does_not_compile_is_told(job, tmp_path, monkeypatch):
    def fail(source):
        raise subprocess.CalledProcessError(1, "clang", "k.cl:1: error: no")

    monkeypatch.setitem(tool.TARGETS, "sm_90", fail)
    texts, good = tool.row(job, "sm_90", tmp_path)
    assert not good and texts[-1] == "does not compile: k.cl:1: error: no"
