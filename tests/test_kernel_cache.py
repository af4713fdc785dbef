"""The kernel cache is verified before use, and private to the user."""

import json
import mmap
import os
import shutil
import subprocess
import sys
import zipfile
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import pyopencl as cl
import pytest

from clpipe.base import process_folder, system
from clpipe.base.errors import DeviceError
from clpipe.base.memory import FreeMemory
from clpipe.engine import builders, cache_folder, runtimes
from clpipe.engine.builders import BinaryBuilder, PoclBuilder
from clpipe.engine.store import Store
from tests.conftest import ROOT, run_python
from tests.test_programs import DEVELOP, python

TEXT = "__kernel void f(__global int *a) { a[get_global_id(0)] = 7; }"
COMPILED = "compiled a program that was not in the cache"


def text_of(test: Path) -> str:
    """A program of one test: all tests of a process share PoCL's folder."""
    return f"{TEXT} __kernel void of_{test.name}(__global int *a) {{ a[0] = 1; }}"


def put(path: Path, data: bytes = b"data") -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(data)
    return path


def flip(path: Path) -> None:
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 4
    path.write_bytes(data)


DAMAGE = [
    flip,
    lambda path: os.truncate(path, path.stat().st_size // 2),
    lambda path: os.truncate(path, 0),
    lambda path: (path.unlink(), put(path / "inside")),
]


@pytest.mark.parametrize("damage", DAMAGE)
def test_what_is_damaged_is_not_there(tmp_path, damage):
    store = Store(tmp_path, "driver")
    store.keep(b"program", "text", "-w")
    assert store.load("text", "-w") == b"program"
    damage(store.path("text", "-w"))
    assert store.load("text", "-w") is None
    store.keep(b"again", "text", "-w")
    assert store.load("text", "-w") == b"again"


def test_what_is_kept_is_of_one_text_driver_and_options(tmp_path):
    store, other = Store(tmp_path, "driver 1"), Store(tmp_path, "driver 2")
    keys = (("a",), ("b",), ("a", "-w"), ("a-w",), ("a\0-w",))
    assert len({*(store.path(*key) for key in keys), other.path("a")}) == 6


def test_a_store_that_cannot_be_written_to_keeps_nothing(tmp_path):
    for store in (Store(None), Store(put(tmp_path / "file") / "x")):
        store.keep(b"program", "text")
        assert store.load("text") is None


@pytest.fixture
def builder(device, tmp_path):
    """What builds a program as a process would that starts now, and runs it."""
    context = cl.Context([device.info.handle])
    store = Store(tmp_path / "programs", "test")
    # A PoCL has one folder as long as its process lives, so the folder stays where it is.
    of_pocl = Path(os.environ["POCL_CACHE_DIR"])

    def new():
        if "Portable Computing" in device.info.platform:
            return PoclBuilder(context, store, of_pocl)
        return BinaryBuilder(context, store)

    def value(text=TEXT, made=new):
        builder = made()
        program = builder.build(text, ["-w"])
        queue, result = cl.CommandQueue(context), bytearray(4)
        buffer = cl.Buffer(context, cl.mem_flags.WRITE_ONLY, 4)
        cl.Kernel(program, "f")(queue, (1,), None, buffer)
        cl.enqueue_copy(queue, result, buffer)
        builder.keep()
        return result[0]

    value.store, value.context = store, context
    return value


def test_a_program_is_built_and_kept(builder, tmp_path):
    text = text_of(tmp_path)
    assert builder(text) == 7
    assert builder.store.load(text, "-w")
    assert builder(text) == 7


def test_a_program_that_cannot_be_stored_is_named_once(tmp_path, monkeypatch, caplog):
    monkeypatch.setattr(Store, "keep", lambda *_: False)
    monkeypatch.setattr(builders, "cache_problem", lambda: "")
    for _ in range(2):
        builders.store_compiled(Store(tmp_path / "programs", "full"), b"data", TEXT)
    assert len(caplog.messages) == 1
    assert f"{tmp_path}/programs: compiled kernels could not be written" in caplog.text
    monkeypatch.setattr(builders, "cache_problem", lambda: "they cannot be cached in x")
    builders.store_compiled(Store(tmp_path / "other", "read-only"), b"data", TEXT)
    assert len(caplog.messages) == 1  # the notice of compiling says it


def test_the_key_has_all_that_determines_compiled_kernels(device, monkeypatch):
    info = device.info
    driver = info.handle.platform
    key = partial(runtimes.compiler_key, driver, info.handle, info.target)
    first = key()
    if sys.platform == "linux":
        path = runtimes.library_of(driver.int_ptr)
        assert path.is_file() and str(path) in first[1]
    for name in ("POCL_EXTRA_BUILD_FLAGS", "POCL_WORK_GROUP_METHOD", "CL_CONFIG_CPU_TARGET_ARCH"):
        with monkeypatch.context() as patch:
            patch.setenv(name, "-DX")
            assert key() != first
    for name in runtimes.RUN_TIME_VARIABLES:
        with monkeypatch.context() as patch:
            patch.setenv(name, "1")
            assert key() == first
    monkeypatch.setattr(runtimes, "library_of", lambda _: None)
    assert key() != first


def test_what_a_runtime_does_not_take_is_compiled(builder, device):
    binary = lambda: BinaryBuilder(builder.context, builder.store)  # noqa: E731
    assert builder(made=binary) == 7
    if "Portable Computing" in device.info.platform:
        return  # it ends the process for what is whole and no binary
    builder.store.keep(b"no binary at all", TEXT, "-w")
    assert builder(made=binary) == 7


def test_a_library_in_use_is_not_written_to(tmp_path):
    path = put(tmp_path / "one/AB/CDEF/f.so", b"library")
    packed = builders._pack(tmp_path / "one", "AB/CDEF", frozenset({"f.so"}))
    path.write_bytes(b"running")
    with open(path, "rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as mapped:
        builders._unpack(packed, tmp_path / "one")
        assert mapped[:] == path.read_bytes() == b"running"


@pytest.mark.parametrize("archive", [True, False])
def test_nothing_is_put_elsewhere(builder, device, tmp_path, archive):
    if "Portable Computing" not in device.info.platform:
        pytest.skip("looks at PoCL's programs")
    text, path = text_of(tmp_path), put(tmp_path / "a.zip", b"no archive")
    if archive:
        names = ["../{}", "/{}", "AB/../{}", "AB/CD/../../../{}", "AB/CD/./{}", "{}", "AB/cd/{}"]
        with zipfile.ZipFile(path, "w") as file:
            for name in names:
                file.writestr(name.format("elsewhere"), b"data")
    builder.store.keep(path.read_bytes(), text, "-w")
    assert builder(text) == 7
    assert not list(Path(os.environ["POCL_CACHE_DIR"]).parent.rglob("elsewhere"))
    assert not Path("/elsewhere").exists()


def test_without_room_to_compile_pocl_is_not_asked(tmp_path, monkeypatch):
    monkeypatch.setattr(builders, "has_free_space", lambda _: False)
    builder = PoclBuilder(None, Store(None), tmp_path / "pocl")
    with pytest.raises(DeviceError, match=r"needs 32 MiB of free space there .* TMPDIR"):
        builder.build(TEXT, [])
    monkeypatch.undo()
    with pytest.raises(DeviceError, match=r"removed while this process used it .* start again"):
        PoclBuilder(None, Store(None), tmp_path / "gone" / "pocl").build(TEXT, [])
    monkeypatch.setattr(builders, "has_free_space", lambda _: True)
    monkeypatch.setattr(PoclBuilder, "_has_compiled", False)
    monkeypatch.setattr(builders, "free_memory", lambda: FreeMemory(50 << 20, "ulimit -v"))
    with pytest.raises(
        DeviceError, match=r"needs about 112.0 MiB .* only 50.0 MiB is available \(ulimit"
    ):
        builder.build(TEXT, [])


COUNTED = f"import logging; logging.basicConfig(level=logging.DEBUG); {DEVELOP}"


def compilations(**environment):
    """The number of programs that a fresh process compiles."""
    with pytest.MonkeyPatch.context() as patch:
        for name in ("XDG_CACHE_HOME", "POCL_CACHE_DIR", "PYTHONPATH"):
            patch.delenv(name, raising=False)
        return run_python("-c", COUNTED, **environment).stderr.count(COMPILED)


@pytest.mark.slow
def test_environments_and_variables_that_alternate_compile_once_each(device, tmp_path):
    if "Portable Computing" not in device.info.platform:
        pytest.skip("needs PoCL")
    packages, copied = Path(cl.__file__).parents[1], tmp_path / "copied"
    for name in ("pyopencl", "pocl_binary_distribution"):
        if (packages / name).is_dir():
            shutil.copytree(packages / name, copied / name, copy_function=os.link)
    environments = (
        {},
        {"PYTHONPATH": os.pathsep.join((str(copied), str(ROOT)))},
        {"POCL_WORK_GROUP_METHOD": "loops"},
        {"POCL_EXTRA_BUILD_FLAGS": "-DX"},
    )
    cache = {"CLPIPE_CACHE_DIR": tmp_path / "cache"}
    counts = [[compilations(**cache, **e) for e in environments] for _ in range(2)]
    assert all(counts[0]) and not any(counts[1])
    usable = [
        json.loads(run_python("-m", "clpipe", "devices", "--json", **cache, **environment).stdout)[
            "kernel_cache"
        ]
        for environment in environments
    ]
    assert [state["usable"] for state in usable] == counts[0]
    assert {state["programs"] for state in usable} == {sum(counts[0])}


@pytest.mark.slow
def test_processes_that_start_at_once_leave_a_cache_that_the_next_one_uses(device, tmp_path):
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "CLPIPE_CACHE_DIR": str(tmp_path)}
    command = [sys.executable, "-c", DEVELOP]
    processes = [subprocess.Popen(command, env=environment) for _ in range(2)]
    assert [process.wait(timeout=300) for process in processes] == [0, 0]
    assert compilations(CLPIPE_CACHE_DIR=tmp_path) == 0


@pytest.mark.slow
def test_a_read_only_cache_is_used_and_a_new_program_is_not_promised(device, tmp_path):
    cache, unwritable = tmp_path / "cache", "cache_folder.is_usable = lambda _: False"
    first = compilations(CLPIPE_CACHE_DIR=cache)
    read_only = f"from clpipe.engine import cache_folder; {unwritable}; {COUNTED}"
    done = run_python("-c", read_only, CLPIPE_CACHE_DIR=cache)
    assert first and done.stderr.count(COMPILED) == 0
    notice = (
        f"{read_only}; from clpipe.engine.programs import *; from clpipe.engine.discovery import *;"
        "print(cache_notice(choose(None, find_devices())))"
    )
    said = run_python("-c", notice, CLPIPE_CACHE_DIR=cache).stdout.strip()
    assert said == f"later runs compile them again, because they cannot be cached in {cache}"


@pytest.mark.slow
def test_a_second_process_compiles_nothing(device, tmp_path):
    """Nor does one after damage compile more than was damaged."""
    if "Portable Computing" not in device.info.platform:
        pytest.skip("looks at PoCL's programs")

    def kept():
        return {path: path.stat().st_mtime_ns for path in tmp_path.glob("programs/*/*")}

    python(DEVELOP, CLPIPE_CACHE_DIR=tmp_path)
    first = kept()
    assert first
    python(DEVELOP, CLPIPE_CACHE_DIR=tmp_path)
    assert kept() == first
    one, *others = sorted(first)
    os.truncate(one, one.stat().st_size // 2)
    python(DEVELOP, CLPIPE_CACHE_DIR=tmp_path)
    assert kept()[one] != first[one]
    assert all(kept()[path] == first[path] for path in others)


@pytest.mark.parametrize(
    ("mode", "said"),
    [(0o700, None), (0o755, None), (0o777, "mode 0777"), (0o1777, "1777"), (0o770, "mode 0770")],
)
def test_a_folder_that_others_may_write_to_is_not_used(tmp_path, caplog, mode, said):
    place = tmp_path / "cache"
    place.mkdir()
    place.chmod(mode)
    assert cache_folder.is_private(place) is (said is None)
    assert len(caplog.messages) == (said is not None)
    assert said is None or (said in caplog.text and "CLPIPE_CACHE_DIR" in caplog.text)


def test_another_users_folder_is_not_used(tmp_path, monkeypatch, caplog):
    monkeypatch.setattr(os, "geteuid", lambda: os.stat(tmp_path).st_uid + 1)
    assert not cache_folder.is_private(tmp_path)
    assert "belongs to another user" in caplog.text


@pytest.mark.slow
def test_kernels_are_not_kept_there_and_that_is_said_once(device, tmp_path):
    shared = tmp_path / "shared"
    shared.mkdir()
    shared.chmod(0o777)
    done = run_python("-c", DEVELOP, CLPIPE_CACHE_DIR=shared, POCL_CACHE_DIR=shared)
    assert done.stderr.count("others may write to it (mode 0777)") == 1
    assert list(shared.iterdir()) == []


def test_folders_that_are_made_are_the_users_alone(tmp_path):
    code = (
        "from clpipe.engine.cache_folder import *; prepare_environment(); print(cache_folder());"
        "print(oct(process_folder().stat().st_mode))"
    )
    made, mode = python(code, CLPIPE_CACHE_DIR=tmp_path / "new").splitlines()
    assert Path(made).stat().st_mode & 0o777 == 0o700
    assert mode.endswith("700")


FOLDER_OF_A_PROCESS = (
    "from clpipe.base.process_folder import process_folder; print(process_folder(), flush=True)"
)
needs_locks = pytest.mark.skipif(not system.fcntl, reason="needs file locks (Linux or macOS)")


@needs_locks
def test_folders_of_killed_processes_are_removed_and_others_stay(tmp_path):
    kill = f"{FOLDER_OF_A_PROCESS}; import os; os.kill(os.getpid(), 9)"
    killed = Path(run_python("-c", kill, status=-9, TMPDIR=tmp_path).stdout.strip())
    assert killed.is_dir() and tmp_path in killed.parents
    foreign = killed.with_name("mine")
    foreign.mkdir()
    wait = f"{FOLDER_OF_A_PROCESS}; import sys; sys.stdin.read()"
    environment = {**os.environ, "TMPDIR": str(tmp_path)}
    streams = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    with subprocess.Popen([sys.executable, "-c", wait], env=environment, **streams) as process:
        used = Path(process.stdout.readline().strip())
        for path in used.iterdir():  # as a program may that cleans up temporary files
            path.unlink()
        own = Path(python(FOLDER_OF_A_PROCESS, TMPDIR=tmp_path))
        assert own.parent == used.parent == killed.parent
        assert not own.exists() and not killed.exists()
        assert used.is_dir() and foreign.is_dir()
        process.stdin.close()


@needs_locks
def test_a_new_folder_that_another_process_removes_is_made_again(tmp_path, monkeypatch):
    make, made = process_folder.tempfile.mkdtemp, []

    def removed_once(**options):
        made.append(Path(make(**options)))
        if len(made) == 1:
            process_folder._remove_unlocked(made[0])
        return made[-1]

    monkeypatch.setattr(process_folder.tempfile, "mkdtemp", removed_once)
    assert process_folder._create_folder(tmp_path) == made[1].resolve()
    assert made[1].is_dir() and not made[0].exists()


FORK = """
import os, sys
from clpipe.base.process_folder import process_folder
parents = process_folder()
reader, writer = os.pipe()
child = os.fork()
if child == 0:
    os.close(writer)
    os.read(reader, 1)  # until the parent has ended
    own = process_folder()
    print(own != parents, own.is_dir(), parents.exists(), flush=True)
    os._exit(0)
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork (Linux or macOS)")
def test_a_forked_process_has_a_folder_of_its_own(tmp_path):
    assert python(FORK, TMPDIR=tmp_path) == "True True False"


def test_a_parent_that_somebody_else_made_is_passed_over(tmp_path):
    (tmp_path / f"clpipe-processes-{os.getuid()}").mkdir(mode=0o700)
    (tmp_path / f"clpipe-processes-{os.getuid()}").chmod(0o777)
    assert Path(python(FOLDER_OF_A_PROCESS, TMPDIR=tmp_path)).parent == tmp_path


def test_a_folder_needs_room_and_the_right_to_run_programs(tmp_path, monkeypatch):
    fresh = process_folder.process_folder.__wrapped__
    monkeypatch.setattr(process_folder, "temporary_folders", lambda: [tmp_path])
    with monkeypatch.context() as patch:
        patch.setattr(process_folder, "forbids_programs", lambda _: True)
        assert fresh() is None
    with monkeypatch.context() as patch:
        usage = SimpleNamespace(free=2**20)
        patch.setattr(process_folder.shutil, "disk_usage", lambda _: usage)
        assert fresh() is None
    assert tmp_path in fresh().parents
