"""Which CPU PoCL compiles for."""

import re
from types import SimpleNamespace

import numpy as np
import pytest

from clpipe.base.errors import DeviceError
from clpipe.engine import cpu_target
from clpipe.engine.cpu_target import (
    EQUIVALENT_CPUS,
    TARGETS,
    Target,
    candidates,
    cpu_features,
    driver_target,
    equivalent_target,
    target_for,
)
from tests.conftest import ROOT, run_python

pytestmark = pytest.mark.slow

HASWELL = "ssse3 sse4_1 avx f16c avx2 fma bmi1 bmi2 abm cx16 popcnt"
AVX512 = f"{HASWELL} avx512f avx512bw avx512dq avx512cd avx512vl"
POCL = "OpenCL 3.0 PoCL 3.0-rc2  Linux, Release, RELOC, LLVM 14.0.6, SLEEF, DISTRO, POCL_DEBUG"


@pytest.mark.parametrize(
    ("features", "target"),
    [
        (AVX512, "skx"),  # Zen 4 and 5, Skylake-X, Granite Rapids
        (HASWELL, "haswell"),  # Raptor Lake, Lunar Lake, Zen 3
        (f"{HASWELL} avx512f avx512cd", "haswell"),  # Knights Landing
        (AVX512.replace("bmi2 ", ""), "ivybridge"),
        ("ssse3 sse4_1 avx f16c", "ivybridge"),
        ("ssse3 sse4_1 avx", "sandybridge"),
        ("ssse3 sse4_1 cx16 popcnt", "penryn"),  # also a Haswell whose AVX is masked
        ("ssse3", "core2"),
        ("", "x86-64"),
    ],
)
def test_the_target_follows_the_features(features, target):
    assert target_for(frozenset(features.split())) == target


def test_names_are_of_one_target_each():
    names = [*TARGETS, *(name for of in EQUIVALENT_CPUS.values() for name in of)]
    assert len(names) == len(set(names)) and set(EQUIVALENT_CPUS) <= set(TARGETS)
    assert [equivalent_target(n) for n in ("znver5", "goldmont", "haswell", "generic")] == [
        *("skx", "penryn", "haswell", None)
    ]
    assert Target("cascadelake", "").is_wide and not Target("alderlake", "").is_wide


def test_the_page_has_the_table():
    page = (ROOT / "docs/how_it_works.md").read_text("utf-8")
    rows = re.findall(r"^\| .* \| `([\w-]+)` \| (8|16) \|$", page, re.MULTILINE)
    assert rows == [(name, "16" if Target(name, "").is_wide else "8") for name in TARGETS]


@pytest.fixture
def pocl(monkeypatch):
    """PoCL on a CPU: what it may compile for, by its own choice and the CPU's features."""
    monkeypatch.delenv(cpu_target.VARIABLE, raising=False)

    def may_be(own, features, version=POCL, place=640, forced=None):
        if forced:
            monkeypatch.setenv(cpu_target.VARIABLE, forced)
        flags = None if features is None else frozenset(features.split())
        monkeypatch.setattr(cpu_target, "cpu_features", lambda: flags)
        monkeypatch.setattr(cpu_target, "_name_pointer", lambda _: place)
        hash_ = f"OpenCL 3.0 PoCL HSTR: pthread-x86_64-unknown-linux-gnu-{own}"
        platform = SimpleNamespace(name="Portable Computing Language", version=version)
        return candidates(platform, SimpleNamespace(version=hash_, int_ptr=0))

    return may_be


def names(targets):
    return [target.name for target in targets]


def test_a_name_that_disagrees_with_the_features_is_replaced(pocl):
    assert names(pocl("generic", AVX512)) == ["skx", "x86-64"]
    assert names(pocl("znver3", AVX512)) == ["skx", "znver3", "x86-64"]
    assert names(pocl("goldmont", HASWELL)) == ["haswell", "goldmont", "x86-64"]
    assert names(pocl("haswell", "ssse3 sse4_1")) == ["penryn", "haswell", "x86-64"]
    assert "PoCL's choice is znver3" in pocl("znver3", AVX512)[0].reason


def test_what_agrees_or_cannot_be_proven_is_left_as_it_is(pocl):
    for own, features in (("icelake-server", AVX512), ("znver3", HASWELL), ("x86-64", "")):
        (target,) = pocl(own, features)
        assert target == Target(own, "PoCL's choice, which matches the CPU's features")
    newer = "OpenCL 3.0 PoCL 6.0  Linux, Release, RELOC, LLVM 18.1.8, SLEEF"
    left = (
        pocl("goldmont", HASWELL, version=newer),
        pocl("goldmont", HASWELL, place=None),
        pocl("goldmont", None),
    )
    assert left == ([Target("goldmont", "PoCL's choice")],) * 3
    intel = SimpleNamespace(name="Intel(R) OpenCL", version="OpenCL 3.0")
    assert names(candidates(intel, SimpleNamespace(version="OpenCL 3.0"))) == [""]


def test_a_pocl_that_names_no_cpu_chooses_by_itself():
    version = "OpenCL 3.0 PoCL HSTR: pthread-aarch64-unknown-linux-gnu-(null)"  # Debian 12's
    debian = SimpleNamespace(name="Portable Computing Language", version=POCL.replace("3.0", "3.1"))
    assert driver_target(version) is None
    assert candidates(debian, SimpleNamespace(version=version)) == [
        Target("", "the driver's choice")
    ]


def test_a_target_can_be_forced(pocl):
    assert names(pocl("znver3", AVX512, forced="sandybridge")) == ["sandybridge"]
    (left,) = pocl("znver3", AVX512, forced="driver")
    assert left.name == "znver3" and "set by CLPIPE_CPU_TARGET" in left.reason
    (left,) = pocl("znver3", AVX512, place=None, forced="sandybridge")
    assert left.name == "znver3" and "CLPIPE_CPU_TARGET cannot change it" in left.reason
    with pytest.raises(DeviceError, match=r"CLPIPE_CPU_TARGET: unknown target 'haswel'.*haswell"):
        pocl("znver3", AVX512, forced="haswel")


def test_features_are_those_that_linux_lists_and_glibc_finds(monkeypatch):
    if not cpu_features():
        pytest.skip("needs an x86-64 CPU")
    monkeypatch.setattr(cpu_target, "_usable", lambda: frozenset({"avx", "fma"}))
    listed = "vendor_id : X\nflags : avx avx512f\n\nvendor_id : X\nflags : avx sse2\n"
    monkeypatch.setattr(cpu_target, "cpu_text", lambda: listed)
    assert cpu_features.__wrapped__() == {"avx"}
    monkeypatch.setattr(cpu_target, "cpu_text", str)
    assert cpu_features.__wrapped__() == {"avx", "fma"}
    monkeypatch.setattr(cpu_target, "_usable", lambda: None)
    assert cpu_features.__wrapped__() is None
    monkeypatch.setattr(cpu_target.this_system, "machine", lambda: "aarch64")
    assert cpu_features.__wrapped__() is None


@pytest.fixture
def pip_pocl(device):
    """The PoCL that the wheel brings: the one that the name is set in."""
    if "PoCL 3.0" not in device.info.handle.platform.version:
        pytest.skip("needs version 3.0 of the package pocl-binary-distribution")
    return device.info


RAW = """if True:
    import hashlib, sys
    import numpy as np
    from clpipe.chain.making import make_chain
    from clpipe.chain.settings import Settings
    from clpipe.engine.check import example
    from clpipe.engine.device import open_device
    from clpipe.engine.runner import Runner
    device = open_device("Portable Computing" if sys.argv[1] == "pocl" else "numpy")
    chain = make_chain(Settings(iso=3200), until="quantize")
    image = example(chain.source, (37, 53), half=True)
    raw = Runner(chain, device, ("quantize",)).run(image, "k").kept["quantize"]
    print(hashlib.sha256(raw.tobytes()).hexdigest(), *([device.info.target.name] if device else []))
"""


def raw_for(target, device="pocl"):
    """The digest of a raw in a process of its own, and the target that it was made for."""
    done = run_python("-c", RAW, device, **{cpu_target.VARIABLE: target})
    assert done.stderr == ""  # the compiler's own "30 warnings generated." neither
    return done.stdout.split()


def test_a_narrow_target_makes_the_same_raw_of_a_half_render(pip_pocl):
    # PoCL's library is still the one for this CPU: vload_half8 of it is called in other registers.
    (expected,) = raw_for("", "numpy")
    assert raw_for("x86-64") == [expected, "x86-64"]


def test_halves_are_widened_by_their_bits(device):
    import pyopencl as cl

    from clpipe.engine.sources import files_text

    every = np.arange(2**16, dtype=np.uint16).view(np.float16)
    context = cl.Context([device.info.handle])
    for lanes in sorted({1, device.info.lanes}):
        text = f"#define LANES {lanes}\n" + files_text(["lib/builtins.h", "lib/lanes.h"], set())
        text += (
            "__kernel void widen(__global const half *src, __global float *dst) {"
            "const size_t i = get_global_id(0) * LANES; store(load_half(src + i), dst + i); }"
        )
        queue, wide = cl.CommandQueue(context), np.zeros(2**16, np.float32)
        flags = cl.mem_flags.READ_ONLY | cl.mem_flags.COPY_HOST_PTR
        src = cl.Buffer(context, flags, hostbuf=every)
        dst = cl.Buffer(context, cl.mem_flags.WRITE_ONLY, wide.nbytes)
        program = cl.Program(context, text).build(["-cl-std=CL1.2", "-w"], cache_dir=False)
        program.widen(queue, (2**16 // lanes,), None, src, dst)
        cl.enqueue_copy(queue, wide, dst)
        np.testing.assert_array_equal(wide, every.astype(np.float32))
