"""A program that tests OpenCL runtimes in a separate process, because they may crash it.

Every runtime computes a small kernel, and the program checks the result. ``clpipe.engine.verdicts``
starts the program, writes the known results to its standard input, and reads lines of JSON. A line
before each step names the step, so that a crash can be attributed to it. A line after the step
contains its result.
"""

import json
import os
import sys
from typing import Any

import numpy as np

from clpipe.base.errors import DeviceError
from clpipe.base.types import Floats
from clpipe.engine.cpu_target import candidates, compile_for
from clpipe.engine.runtimes import attempt, lanes_for, needs_test, platform_id, type_of
from clpipe.engine.sources import files_text
from clpipe.engine.vendors import load_pyopencl, platforms
from clpipe.reference.math import square_root
from clpipe.reference.random import Stream, normal_of, philox

# The operations that a raw needs: half floats, 64-bit products, square roots and a division. The
# kernel uses lanes and a local size.
SOURCE = """
__kernel void trial(__global const half *src, __global float *dst, float divisor) {
    const uint i = (uint)get_global_id(0) * LANES, count = (uint)get_global_size(0) * LANES;
    const stream s = {1, 2, 3};
    const vf a = load_half(src + i);
    const vf noise = normal_of(philox(lane_indices(i), 0, 0, s).word0);
    store(a + square_root(magnitude(a)) * noise, dst + i);
    store(a / divisor, dst + count + i);
}
"""
COUNT, LOCAL, DIVISOR = 1024, 8, np.float32(0.7)


def samples() -> np.ndarray:
    """Return float16 values of all magnitudes and both signs, (COUNT,)."""
    bits = np.random.default_rng(0).integers(0, 0x7C00, COUNT) | np.arange(COUNT) % 2 << 15
    return bits.astype(np.uint16).view(np.float16)


def expected(source: np.ndarray) -> tuple[Floats, Floats]:
    """Return the kernel's expected results: noisy values, bit for bit, and quotients."""
    a, zero = source.astype(np.float32), np.zeros(1, np.uint32)
    word, *_ = philox(np.arange(COUNT, dtype=np.uint32), zero, zero, zero + 3, Stream(1, 2, 3))
    return a + square_root(np.abs(a)) * normal_of(word), a / DIVISOR


def find_problem(device: Any, lanes: int) -> str:
    """Return why a ``pyopencl.Device`` is unusable; "" if it computes correctly.

    Raises:
        pyopencl.Error: the device cannot be opened, or is out of memory.
    """
    import pyopencl as cl

    queue = cl.CommandQueue(context := cl.Context([device]))
    text = f"#define LANES {lanes}\n" + files_text(
        [f"lib/{name}.h" for name in ("builtins", "lanes", "math", "image", "random")], set()
    )
    try:
        program = cl.Program(context, text + SOURCE).build(["-cl-std=CL1.2", "-w"], cache_dir=False)
    except cl.MemoryError:
        raise
    except cl.Error as error:
        return f"it cannot compile kernels: {first_error(str(error))}"
    source, results = samples(), np.zeros((2, COUNT), np.float32)
    flags = cl.mem_flags.READ_ONLY | cl.mem_flags.COPY_HOST_PTR
    src = cl.Buffer(context, flags, hostbuf=source)
    dst = cl.Buffer(context, cl.mem_flags.WRITE_ONLY, results.nbytes)
    program.trial(queue, (COUNT // lanes,), (LOCAL,), src, dst, DIVISOR)
    cl.enqueue_copy(queue, results, dst)
    queue.finish()
    noisy, quotients = expected(source)
    wrong = int((results[0] != noisy).sum())
    wrong += int((np.abs(results[1] - quotients) > 4e-7 * np.abs(quotients)).sum())
    return f"{wrong} of {2 * COUNT} numbers that it computes are wrong" if wrong else ""


def first_error(text: str) -> str:
    """Return the first line of a compiler's output that contains an error.

    >>> first_error("x failed\\nerror: unknown target CPU 'generic'\\nmore")
    "unknown target CPU 'generic'"
    """
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    errors = [line.partition("error: ")[2] for line in lines if "error: " in line]
    return [*errors, *lines, "the compiler gives no reason"][0]


def test_all(known: dict[str, Any]) -> None:
    """Test all runtimes without known results, and write the results to the standard output."""
    report = os.dup(sys.stdout.fileno())  # because runtimes write to the standard output
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())

    def write_line(**values: Any) -> None:
        os.write(report, json.dumps(values).encode() + b"\n")

    cl = load_pyopencl()
    write_line(at="list")
    for platform in platforms(known["hidden"]):
        if platform_id(platform) in known["platforms"]:
            continue
        write_line(at="platform", name=platform_id(platform))
        try:
            devices = platform.get_devices()
        except cl.Error:
            continue
        for device in [] if known["only_listing"] else devices:
            if not needs_test(type_of(platform, device), platform, device):
                continue
            for target in candidates(platform, device):
                name = attempt(platform, device, target)
                if name in known["attempts"]:
                    if known["attempts"][name]:
                        continue
                    break
                write_line(at="attempt", name=name)
                compile_for(device, target)
                lanes = lanes_for(type_of(platform, device), platform, device, target)
                is_temporary = False
                try:
                    problem = find_problem(device, lanes)
                except cl.Error as error:  # perhaps temporary: other programs may use the device
                    problem, is_temporary = "", True
                    sys.stderr.write(f"{error}\n")
                write_line(attempt=name, problem=problem, passing=is_temporary)
                known["attempts"][name] = problem
                if not problem:
                    break


def main() -> None:
    """Read the known results from the standard input, and test the rest."""
    known = json.load(sys.stdin)
    try:
        test_all(known)
    except DeviceError as error:
        sys.exit(str(error))


if __name__ == "__main__":
    main()
