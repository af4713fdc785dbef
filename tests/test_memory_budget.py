"""The memory budget of images: estimates, waiting images and rejected images."""

import os
import subprocess
import sys
import threading
from types import SimpleNamespace

import numpy as np
import pytest

from clpipe.base import memory
from clpipe.base.errors import DeviceError, ImageError, RequestError
from clpipe.base.memory import FreeMemory
from clpipe.batch import memory_budget
from clpipe.batch.memory_budget import COMPILE_MEMORY, MIN_DEVICE_MEMORY, MemoryBudget, needed
from clpipe.batch.threads import Batch
from clpipe.engine.discovery import find_devices
from clpipe.images.claims import claim_of
from tests.conftest import ROOT, run_python
from tests.held import GUARD

MIB = 2**20
LIMITED = pytest.mark.skipif(not hasattr(os, "geteuid"), reason="this system has no such limit")


class SharingDevice:
    """A device in this machine's memory."""

    def __init__(self, limit, held=0):
        self.info = SimpleNamespace(zero_copy=True)
        self.memory, self.bytes_held = limit, held
        self.limits = []

    def limit_memory(self, limit):
        self.memory, self.bytes_held = limit, 0
        self.limits.append(limit)


def budget_of(free, *devices, size=None, drop=lambda: None):
    """Return a budget with so many free bytes, minus the memory of devices."""
    budget = MemoryBudget(
        size, devices, drop, lambda: FreeMemory(free - sum(d.bytes_held for d in devices), "x")
    )
    for _ in devices:
        budget.device_ready()
    return budget


@pytest.fixture(autouse=True)
def clock(monkeypatch):
    """The memory_budget' clock in s, which only sleeping moves, and the test."""
    now = [0.0]

    def sleep(seconds):
        now[0] += seconds

    monkeypatch.setattr(
        memory_budget, "time", SimpleNamespace(monotonic=lambda: now[0], sleep=sleep)
    )
    return now


def waiting(budget, *arguments):
    """Take budget in a thread that has to wait, and return a function that waits for its end."""
    entered = threading.Event()

    def enter():
        budget.acquire(*arguments)
        entered.set()

    threading.Thread(target=enter, daemon=True).start()
    assert not entered.wait(0.05)

    def finish():
        assert entered.wait(GUARD)

    return finish


def test_what_never_fits_is_refused_and_what_fits_is_let_in():
    budget = budget_of(100 * MIB)
    for _ in range(2):
        budget.acquire(10 * MIB).release()
        with pytest.raises(
            ImageError, match=r"about 233\.0 MiB of memory, but only 100\.0 MiB is available"
        ):
            budget.acquire(200 * MIB)


def test_what_fits_alone_waits_for_the_others():
    budget = budget_of(200 * MIB, size=100 * MIB)
    small = budget.acquire(10 * MIB)
    finish = waiting(budget, 120 * MIB)
    small.release()
    finish()


def test_for_a_large_image_devices_hold_little():
    device, dropped = SharingDevice(150 * MIB, held=100 * MIB), []
    budget = budget_of(300 * MIB, device, drop=lambda: dropped.append(1))
    budget.acquire(100 * MIB).release()
    assert not device.limits
    with budget.acquire(200 * MIB):
        assert device.limits == [MIN_DEVICE_MEMORY]
        assert dropped
    assert device.memory == 150 * MIB
    with pytest.raises(ImageError, match=r"only 268\.0 MiB is available"):
        budget.acquire(280 * MIB)
    assert device.limits == [MIN_DEVICE_MEMORY]  # it would not have helped


def test_devices_hold_little_until_the_large_image_ends():
    device = SharingDevice(150 * MIB)
    budget = budget_of(300 * MIB, device)
    large = budget.acquire(200 * MIB)
    small = budget.acquire(MIB)
    for _ in range(2):
        small.release()
        assert device.memory == MIN_DEVICE_MEMORY
    large.release()
    assert device.memory == 150 * MIB


def test_what_was_taken_before_may_be_freed_late(clock):
    freed = memory_budget.WAIT_SECONDS / 2  # s
    budget = MemoryBudget(
        None, (), left=lambda: FreeMemory((60 if 0 < clock[0] < freed else 200) * MIB, "")
    )
    budget.acquire(150 * MIB).release()
    clock[0] = 1e-3
    budget.acquire(150 * MIB)
    assert clock[0] >= freed


def test_large_images_wait_for_the_compiler():
    budget = MemoryBudget(
        None, (SharingDevice(0),), left=lambda: FreeMemory(COMPILE_MEMORY + 100 * MIB, "")
    )
    budget.acquire(10 * MIB).release()
    finish = waiting(budget, 150 * MIB)
    budget.device_ready()
    finish()


def test_nothing_is_let_in_at_the_end():
    budget = budget_of(100 * MIB)
    budget.acquire(50 * MIB)
    budget.close()
    with pytest.raises(ImageError, match="ended"):
        budget.acquire(60 * MIB)


def test_what_files_claim(write_exr, tmp_path):
    pixels = np.zeros((4, 10, 3), np.float32)

    def bytes_of(*arguments, mosaic=False, **options):
        claim = claim_of(write_exr("a.exr", *arguments, **options), mosaic)
        return claim.image / 40, claim.reading / 40

    assert bytes_of(pixels) == (6, 6)
    assert bytes_of(pixels, half=False) == (12, 12)
    four = np.zeros((4, 10, 4), np.float32)
    assert bytes_of(four, "R,G,B,A") == (6, 14)  # of all four, and of the three together
    assert bytes_of(pixels[..., :1], "Raw", half=False, mosaic=True) == (4, 4)
    (tmp_path / "a.pfm").write_bytes(b"PF\n6000 4000\n-1.0\n")  # only the header is read
    claim = claim_of(tmp_path / "a.pfm")
    assert (claim.width, claim.image, claim.reading) == (6000, 288_000_000, 576_000_000)
    assert claim_of(tmp_path / "missing.exr") is None


def test_one_that_is_too_large_costs_one_line(write_exr, clpipe, tmp_path, monkeypatch):
    for i in range(3):
        write_exr(f"in/r{i}.exr", np.full((8, 12, 3), 0.2, np.float32))
    (tmp_path / "in" / "b.pfm").write_bytes(b"PF\n6000 4000\n-1.0\n")
    monkeypatch.setattr(memory_budget, "free_memory", lambda: FreeMemory(300 * MIB, "a limit"))
    for _ in range(2):
        result = clpipe("run", "in", "-o", "out", "--device", "numpy", status=1)
        lines = [line for line in result.stderr.splitlines() if "b.pfm" in line]
        assert all("(a limit)" in line for line in lines)
        assert len(list((tmp_path / "out").glob("*.jpg"))) == 3
        assert "3 of 4 images done" in result.stderr


def test_threads_that_cannot_be_started_are_one_line(monkeypatch):
    def start(self):
        raise RuntimeError("can't start new thread")

    worker = SimpleNamespace(reserve=lambda count: None)
    monkeypatch.setattr(threading.Thread, "start", start)
    with pytest.raises(RequestError, match=r"--jobs: 3: no thread can be started for 'write'"):
        list(Batch(worker, [None], threads=3).run([]))


def test_address_space_counts(tmp_path, monkeypatch):
    monkeypatch.setattr(memory, "max_address_space", lambda: 100 * 2**20)
    (tmp_path / "proc/self").mkdir(parents=True)
    (tmp_path / "proc/self/status").write_text("VmPeak:  2 kB\nVmSize:\t 61440 kB\n")
    left = memory.free_memory(tmp_path)
    assert left == FreeMemory(40 * MIB, "ulimit -v, which is 100.0 MiB")


def test_no_runtime_is_loaded_where_addresses_are_too_few(monkeypatch):
    monkeypatch.setattr(memory, "max_address_space", lambda: 2**20)
    with pytest.raises(
        DeviceError, match=r"an OpenCL runtime needs .* is available \(ulimit -v, which"
    ):
        find_devices()


def limited(text, megabytes):
    """Run Python in a process with limited address space."""
    import resource

    return subprocess.run(
        [sys.executable, "-c", text],
        cwd=ROOT,
        capture_output=True,
        text=True,
        preexec_fn=lambda: resource.setrlimit(
            resource.RLIMIT_AS, (megabytes * MIB, resource.RLIM_INFINITY)
        ),
        check=False,
    )


@LIMITED
def test_the_program_starts_in_no_less_than_it_needs():
    text = "import sys; from clpipe.commands.main import main; main(['run', 'a', '-o', 'b'])"
    done = limited(text, 150)
    assert done.returncode == 3
    assert "loading clpipe's libraries needs about" in done.stderr
    assert len(done.stderr.splitlines()) == 1


WITHOUT_ROOM = """
from pathlib import Path
import resource
import numpy as np
from clpipe.base.memory import _proc_value
from clpipe.chain.request import Request
from clpipe.engine.device import open_device
from clpipe.engine.runner import Runner
runner = Runner(Request().chain(), open_device(None), bands=False)
image = np.full((2000, 4400, 3), 0.2, np.float16)
runner.compile()
hard = resource.getrlimit(resource.RLIMIT_AS)[1]
least = _proc_value(Path("/proc/self/status"), "VmSize") + (100 << 20)
resource.setrlimit(resource.RLIMIT_AS, (least, hard))
tiled = runner.run(image, "a").encoded
print(runner.device.bytes_held < 100 << 20)
resource.setrlimit(resource.RLIMIT_AS, (hard, hard))
print(np.array_equal(runner.run(image, "a").encoded, tiled), runner.device.bytes_held > 100 << 20)
held = _proc_value(Path("/proc/self/status"), "VmSize")
runner.device.limit_memory(0)
print(held - _proc_value(Path("/proc/self/status"), "VmSize") > 100 << 20)
"""


@pytest.mark.slow
@LIMITED
def test_where_memory_ends_tiles_become_smaller(device):
    if device is None or not device.info.zero_copy:
        pytest.skip("needs an OpenCL device for CPUs, such as PoCL")
    assert run_python("-c", WITHOUT_ROOM).stdout == "True\nTrue True\nTrue\n"


HEAPS = """
import threading
from pathlib import Path
from clpipe.base.memory import _proc_value
from clpipe.base.system import use_single_heap
use_single_heap()
def work():
    held = [bytes(600) for _ in range(100)]
    barrier.wait()  # all hold memory
    barrier.wait()  # it was measured
barrier = threading.Barrier(7)
before = _proc_value(Path("/proc/self/status"), "VmSize")
threads = [threading.Thread(target=work) for _ in range(6)]
for thread in threads: thread.start()
barrier.wait()
print(_proc_value(Path("/proc/self/status"), "VmSize") - before)
barrier.wait()
"""


@LIMITED
def test_heaps_are_shared_where_addresses_are_few():
    done = limited(HEAPS, 2000)
    assert int(done.stdout) < 6 * 64 * MIB, done.stderr


def test_an_eighth_and_some_more_is_to_be_free():
    assert needed(80 * MIB) == 98 * MIB
