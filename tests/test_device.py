"""The choice of a device, and the limits of devices."""

import ctypes.util
import json
import struct
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pyopencl as cl
import pytest

from clpipe.base.errors import DeviceError, ImageError
from clpipe.chain.making import make_chain
from clpipe.chain.settings import settings_from
from clpipe.commands.devices import device_rows
from clpipe.engine import hardware, vendors
from clpipe.engine.cpu_target import Target
from clpipe.engine.device import Device, open_devices
from clpipe.engine.discovery import choose, choose_all, find_devices
from clpipe.engine.hardware import Hardware, hardware_of
from clpipe.engine.runner import Runner
from clpipe.engine.runtimes import lanes_for
from tests.conftest import STILL_LIFE


@pytest.fixture
def devices(device):
    """A CPU, an emulator, a broken GPU and a good one, in this order."""
    cpu = replace(device.info, index=0, name="slow", platform="Portable Computing Language")
    return [
        replace(cpu, type="CPU"),
        replace(cpu, index=1, name="grind", platform="Oclgrind", type="emulator"),
        replace(
            cpu, index=2, name="broken", platform="A", type="GPU", problem="it has no compiler"
        ),
        replace(cpu, index=3, name="fast", platform="B", type="GPU"),
    ]


def test_a_gpu_comes_first_then_intels_runtime_then_pocl(devices):
    pocl = devices[0]
    mesa = replace(pocl, index=4, name="llvmpipe", platform="rusticl")
    intel = replace(pocl, index=5, name="Xeon", platform="Intel(R) OpenCL")
    assert choose(None, [mesa, *devices, intel]).name == "fast"
    assert choose(None, [mesa, *devices[:3], intel]) is choose("cpu", [mesa, pocl, intel]) is intel
    assert choose(None, [mesa, *devices[:3]]).name == "slow"
    assert choose(None, [devices[1], mesa]) is mesa


@pytest.mark.parametrize(
    ("type_", "platform", "target", "width", "lanes"),
    [
        ("GPU", "NVIDIA CUDA", "", 1, 1),
        ("CPU", "Portable Computing Language", "skx", 16, 16),
        ("CPU", "Portable Computing Language", "cascadelake", 16, 16),
        ("CPU", "Portable Computing Language", "znver3", 16, 8),
        ("CPU", "Portable Computing Language", "x86-64", 4, 8),
        ("CPU", "Portable Computing Language", "cortex-a57", 4, 8),
        ("CPU", "Intel(R) OpenCL", "", 16, 16),
        ("CPU", "Intel(R) OpenCL", "", 8, 8),
        ("CPU", "rusticl", "", 1, 1),
    ],
)
def test_lanes(type_, platform, target, width, lanes):
    of, device = SimpleNamespace(name=platform), SimpleNamespace(native_vector_width_float=width)
    assert lanes_for(type_, of, device, Target(target, "")) == lanes


@pytest.mark.parametrize(
    ("selector", "name"),
    [
        ("0", "slow"),
        ("pocl", "slow"),
        ("portable", "slow"),
        ("FAST", "fast"),
        ("cpu", "slow"),
        ("GPU", "fast"),
        ("oclgrind", "grind"),
    ],
)
def test_a_device_is_chosen_by_index_or_name(devices, selector, name):
    assert choose(selector, devices).name == name


def test_devices_that_cannot_be_used(devices, monkeypatch):
    with pytest.raises(DeviceError, match=r"broken .A.: it has no compiler"):
        choose("broken", devices)
    with pytest.raises(DeviceError, match=r"no usable OpenCL device .*an emulator.*no compiler"):
        choose(None, devices[1:3])
    named_gpu = replace(devices[0], name="a CPU, no GPU")
    with pytest.raises(DeviceError, match=r"no OpenCL runtime offers a GPU\. Install the GPU's"):
        choose("gpu", [named_gpu])
    with pytest.raises(DeviceError, match=r"unknown device 'x'.*0: slow.*numpy"):
        choose("x", devices)
    with pytest.raises(DeviceError, match="no OpenCL platform"):
        choose(None, [])
    monkeypatch.setenv("OCL_ICD_VENDORS", "/nowhere")
    with pytest.raises(
        DeviceError, match=r"was found .OCL_ICD_VENDORS is '/nowhere'.. On this machine, try"
    ):
        choose(None, [])


def test_drivers_that_do_not_load_are_named(monkeypatch, clpipe):
    library = Path(ctypes.util.find_library("c") or "libc.so.6")
    files = {
        "good.icd": f"{library}\n",
        "gone.icd": "libclpipe-none.so\n",
        "empty.icd": "",
    }
    monkeypatch.setattr(vendors, "icd_files", lambda: [(Path(n), t) for n, t in files.items()])
    found = vendors.unloadable_drivers()
    assert found.keys() == {"gone.icd", "empty.icd"}
    assert "libclpipe-none.so: cannot open shared object file" in found["gone.icd"]
    output = clpipe("devices").stdout
    assert "gone.icd: its library cannot be loaded" in output and "empty.icd: it is" in output
    assert json.loads(clpipe("devices", "--json").stdout)["unloadable_drivers"] == found
    if any(each.type == "GPU" for each in find_devices()):
        return
    failed = clpipe("run", STILL_LIFE, "-o", "out", "--device", "gpu", status=3).stderr
    assert "no OpenCL runtime offers a GPU. gone.icd: its library" in failed


def test_several_devices_are_chosen(devices):
    def names(*selectors):
        return [f"{d.index}{d.name}" for d in choose_all(selectors, devices)]

    assert names() == ["3fast"]
    assert names("slow", "3", "FAST", "0") == ["0slow", "3fast"]
    assert [d.index for d in choose_all((), [devices[0], replace(devices[0], index=1)])] == [0]
    twin = replace(devices[3], index=4)
    devices += [twin, replace(twin, index=5, name="other"), replace(twin, index=6, problem="no")]
    assert names() == ["3fast", "4fast"]
    with pytest.raises(DeviceError, match="unknown device 'x'"):
        names("slow", "x")


def test_a_gpu_that_two_drivers_offer_is_one(devices):
    gpu = devices[3]
    on_board = {"pci": (0, 65, 0, 0), "uuid": b"a" * 16}

    def chosen(*hardware, selectors=()):
        both = [replace(gpu, index=i, hardware=h) for i, h in enumerate(hardware)]
        return [d.index for d in choose_all(selectors, both)]

    assert chosen(Hardware(1, **on_board), Hardware(2, pci=(0, 65, 0, 0))) == [0]
    assert chosen(Hardware(1, **on_board), Hardware(2, uuid=b"a" * 16)) == [0]
    assert chosen(Hardware(1, **on_board), Hardware(2, **on_board), selectors=("1", "0")) == [1]
    assert chosen(Hardware(1, **on_board), Hardware(2, pci=(0, 66, 0, 0))) == [0, 1]
    assert chosen(Hardware(1, **on_board), Hardware(1, **on_board)) == [0, 1]  # parts of a board
    assert chosen(Hardware(1), Hardware(2)) == [0, 1]  # nobody knows


class FakeDevice:
    """The attributes of pyopencl.Device that hardware_of() reads."""

    def __init__(self, **values):
        self.platform = SimpleNamespace(int_ptr=7)
        self.values = values

    def __getattr__(self, name):
        if name not in self.values:
            raise cl.LogicError("clGetDeviceInfo failed: INVALID_VALUE")
        return self.values[name]


def test_what_drivers_say_of_hardware(device, monkeypatch):
    properties = {}
    monkeypatch.setattr(hardware, "query_device", lambda _, name: properties.get(name))
    nvidia = FakeDevice(pci_domain_id_nv=1, pci_bus_id_nv=65, pci_slot_id_nv=3 << 3 | 1)
    assert hardware_of(nvidia) == Hardware(7, (1, 65, 3, 1))
    amd = FakeDevice(topology_amd=SimpleNamespace(bus=65, device=3, function=1))
    assert hardware_of(amd) == Hardware(7, (0, 65, 3, 1))
    assert hardware_of(FakeDevice()) == Hardware(7)
    properties.update({0x410F: struct.pack("4I", 1, 65, 3, 1), 0x106A: b"u" * 16})
    assert hardware_of(FakeDevice()) == Hardware(7, (1, 65, 3, 1), b"u" * 16)
    monkeypatch.undo()
    version = hardware.query_device(device.info.handle, cl.device_info.VENDOR_ID, 4)
    assert version == struct.pack("I", device.info.handle.vendor_id)
    assert hardware.query_device(device.info.handle, 0xFFFF) is None


def test_devices_are_opened():
    assert open_devices(["numpy"]) == []
    with pytest.raises(DeviceError, match="devices pocl, NumPy: numpy cannot be combined"):
        open_devices(["pocl", "NumPy"])
    (one,) = open_devices(["0", "0"], memory=2**30)
    assert one.memory == 2**30


def test_devices_run_at_the_same_time(device):
    images = [np.full((40 + 3 * i, 50, 3), 0.1 * i, np.float16) for i in range(8)]
    alone = Runner(make_chain(settings_from({})), device)
    expected = [alone.run(image, f"{i}").encoded for i, image in enumerate(images)]

    def work(_):
        with_all = Runner(alone.chain, Device(device.info))  # which compiles at the same time, too
        return [with_all.run(image, f"{i}").encoded for i, image in enumerate(images)]

    with ThreadPoolExecutor(3) as threads:
        for results in threads.map(work, range(3)):
            assert all(np.array_equal(a, b) for a, b in zip(results, expected, strict=True))


def test_why_devices_are_passed_over(devices):
    status = [row["status"] for row in device_rows(devices)]
    assert status == [
        "not used: there is a GPU; use it with --device 0",
        "not used: an emulator is slow; use it with --device 1",
        "not used: it has no compiler",
        "used by default",
        "slow; use it with --device numpy",
    ]


def test_a_missing_linker_is_a_problem_of_pocl(monkeypatch):
    monkeypatch.setenv("PATH", "")
    for found in find_devices():
        if "Portable Computing" in found.platform:
            assert "no 'ld' on the PATH" in found.problem


def test_after_an_image_that_is_too_large_the_next_one_works(device):
    small = Device(device.info, memory=100_000)
    runner = Runner(make_chain(settings_from({})), small)
    image = np.full((20, 30, 3), 0.5, np.float16)
    expected = runner.run(image, "k").encoded
    for _ in range(2):
        with pytest.raises(ImageError, match=r"[Tt]he limit is 97"):
            runner.run(np.zeros((1, 30000, 3), np.float16), "k")
    assert np.array_equal(runner.run(image, "k").encoded, expected)


@pytest.mark.parametrize("value", [np.nan, 65504])
def test_what_memory_held_before_does_not_matter(device, value):
    runner = Runner(make_chain(settings_from({})), device)
    image = np.random.default_rng(0).random((97, 203, 3)).astype(np.float16)
    expected = runner.run(image, "k").encoded
    for info in (device.info, replace(device.info, type="GPU")):
        for memory in (None, 300_000):  # whole, and in tiles
            other = Runner(runner.chain, Device(info, memory))
            other.run(np.full((120, 240, 3), value, np.float16), "k")
            assert np.array_equal(other.run(image, "k").encoded, expected)
