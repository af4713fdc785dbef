"""What lies in the cache of compiled kernels is looked at before it is believed."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pyopencl as cl
import pytest

from clpipe.base import system
from clpipe.engine import cache_folder, pocl_cache
from clpipe.engine.binary_cache import BinaryCache
from clpipe.engine.pocl_cache import is_sound, list_programs
from tests.test_programs import DEVELOP, python

TEXT = "__kernel void f(__global int *a) { a[get_global_id(0)] = 7; }"


def put(path: Path, data: bytes = b"data") -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(data)
    return path


def flip(path: Path) -> None:
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 4
    path.write_bytes(data)


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A folder like PoCL's, with two programs that are listed."""
    monkeypatch.setattr(pocl_cache, "_in_use", {})
    for program in ("AB/ONE", "CD/TWO"):
        put(tmp_path / program / "program.bc", b"bytecode")
        put(tmp_path / program / "last_accessed", b"")
        put(tmp_path / program / "f/8-1-1/f.so", b"library")
    assert again(tmp_path, lambda: put(tmp_path / pocl_cache.INDEX, b"{}"), listing=True)
    return tmp_path


def again(folder, change=lambda: None, listing=False):
    """A process that comes after a change; whether it finds the folder sound."""
    for lock in pocl_cache._in_use.values():
        os.close(lock)
    pocl_cache._in_use.clear()
    change()
    if not listing:
        return is_sound(folder)
    pocl_cache._in_use[folder] = os.open(folder / pocl_cache.LOCK, os.O_RDWR | os.O_CREAT)
    list_programs(folder)
    return True


def programs(folder):
    return sorted(path.name for path in folder.glob("??/*"))


def test_what_is_as_it_was_written_is_believed(folder):
    assert again(folder)
    assert again(folder, lambda: put(folder / "AB/ONE/last_accessed", b"now"))
    assert again(folder, lambda: os.utime(folder / "AB/ONE/program.bc", ns=(1, 1)))
    assert programs(folder) == ["ONE", "TWO"]
    assert is_sound(folder)  # asked twice


@pytest.mark.parametrize(
    "change",
    [
        lambda program: put(program / "f/8-1-1/f.so", b""),
        lambda program: put(program / "f/8-1-1/f.so", b"libr"),
        lambda program: flip(program / "f/8-1-1/f.so"),
        lambda program: flip(program / "program.bc"),
        lambda program: (program / "program.bc").unlink(),
        lambda program: shutil.rmtree(program / "f"),
        lambda program: put(program / "f/16-1-1/f.so", b"not listed"),
        lambda program: put(program.with_name("THREE") / "program.bc", b"of a killed process"),
    ],
)
def test_what_differs_or_is_not_listed_is_removed(folder, change):
    assert again(folder, lambda: change(folder / "AB/ONE"))
    assert "TWO" in programs(folder)
    assert programs(folder) != ["ONE", "THREE", "TWO"]
    assert programs(folder) in (["TWO"], ["ONE", "TWO"])
    if "ONE" in programs(folder):  # it was another that was not listed
        assert (folder / "AB/ONE/f/8-1-1/f.so").read_bytes() == b"library"


@pytest.mark.parametrize(
    "index", [b"", b"{", b"[]", b"null", b'{"AB/ONE": 1}', b'{"a": {"b": []}}']
)
def test_a_damaged_index_lists_nothing(folder, index):
    assert again(folder, lambda: put(folder / pocl_cache.INDEX, index))
    assert programs(folder) == []


def test_folders_in_the_place_of_files_are_removed(folder):
    def change():
        for name in (pocl_cache.INDEX, pocl_cache.LOCK, "tempfile_x"):
            (folder / name).unlink(missing_ok=True)
            put(folder / name / "inside")

    assert again(folder, change)
    assert sorted(p.name for p in folder.iterdir() if p.is_dir()) == ["AB", "CD"]
    assert not (folder / "tempfile_x").exists() and (folder / pocl_cache.LOCK).is_file()


HOLD = """if True:
    import sys
    from pathlib import Path
    from clpipe.engine.pocl_cache import is_sound
    print(is_sound(Path(sys.argv[1])), flush=True)
    sys.stdin.read()
"""


@pytest.fixture
def another(folder):
    """Another process that uses the folder."""
    if not system.fcntl:
        pytest.skip("needs locks of the system")
    for lock in pocl_cache._in_use.values():
        os.close(lock)
    pocl_cache._in_use.clear()
    command = [sys.executable, "-c", HOLD, str(folder)]
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout.readline() == "True\n"
        yield process
        process.stdin.close()


def test_beside_another_process_nothing_is_removed(folder, another):
    put(folder / "CD/NEW/program.bc", b"the other one compiles it now")
    assert again(folder)
    assert programs(folder) == ["NEW", "ONE", "TWO"]
    assert not again(folder, lambda: flip(folder / "AB/ONE/program.bc"))
    assert programs(folder) == ["NEW", "ONE", "TWO"]
    another.kill()
    another.wait()
    assert again(folder)
    assert programs(folder) == ["TWO"]


def test_what_is_compiled_is_listed_and_what_is_listed_stays(folder):
    assert again(folder)
    put(folder / "CD/NEW/program.bc", b"new")
    flip(folder / "AB/ONE/program.bc")  # while this process runs
    list_programs(folder)
    listed = json.loads((folder / pocl_cache.INDEX).read_text())
    assert sorted(listed) == ["AB/ONE", "CD/NEW", "CD/TWO"]
    assert again(folder)
    assert programs(folder) == ["NEW", "TWO"]


def test_a_library_that_was_cut_is_compiled_again(device, tmp_path):
    if "Portable Computing" not in device.info.platform:
        pytest.skip("looks into PoCL's cache")
    python(DEVELOP, CLPIPE_CACHE_DIR=tmp_path)
    libraries = list(tmp_path.rglob("*.so"))
    whole = {path: path.stat().st_size for path in libraries}
    assert libraries
    for number, path in enumerate(libraries):
        os.truncate(path, whole[path] // 2 if number % 2 else 0)
    python(DEVELOP, CLPIPE_CACHE_DIR=tmp_path)  # SIGBUS or SIGABRT, where PoCL maps them
    rebuilt = {path: path.stat().st_size for path in tmp_path.rglob("*.so")}
    developed = {p: s for p, s in rebuilt.items() if "trial" not in p.name}
    assert developed and all(whole.get(path) == size for path, size in developed.items())


@pytest.fixture
def binaries(device, tmp_path):
    """A folder of binaries, and what compiles and runs a program through it."""
    context = cl.Context([device.info.handle])
    kept = BinaryCache(tmp_path / "programs", device.info.handle)

    def value():
        """What the program writes, and whether it was compiled."""
        program, options = kept.load(context, TEXT, ["-w"]), ["-w"]
        compiled = program is None
        if compiled:
            program = cl.Program(context, TEXT).build(options, cache_dir=False)
            kept.store(program, TEXT, options)
        queue = cl.CommandQueue(context)
        result = bytearray(4)
        buffer = cl.Buffer(context, cl.mem_flags.WRITE_ONLY, 4)
        cl.Kernel(program, "f")(queue, (1,), None, buffer)
        cl.enqueue_copy(queue, result, buffer)
        return result[0], compiled

    value.path = kept.path(TEXT, ["-w"])
    return value


def test_a_binary_is_kept_and_taken(binaries):
    assert binaries() == (7, True)
    assert binaries() == (7, False)


@pytest.mark.parametrize(
    "damage",
    [
        flip,
        lambda path: os.truncate(path, path.stat().st_size // 2),
        lambda path: os.truncate(path, 0),
        lambda path: (path.unlink(), put(path / "inside")),
    ],
)
def test_a_damaged_binary_is_compiled_again(binaries, damage):
    binaries()
    damage(binaries.path)
    assert binaries() == (7, True)
    assert binaries() == (7, False)


def test_binaries_are_of_one_text_driver_and_options(device, tmp_path):
    kept = BinaryCache(tmp_path, device.info.handle)
    other = BinaryCache(tmp_path, device.info.handle)
    other._made_by += "1"
    paths = [kept.path(TEXT, []), kept.path(TEXT + " ", []), kept.path(TEXT, ["-w"])]
    assert len({*paths, other.path(TEXT, [])}) == 4


@pytest.mark.parametrize(
    ("mode", "said"),
    [(0o700, None), (0o755, None), (0o777, "mode 0777"), (0o1777, "1777"), (0o770, "mode 0770")],
)
def test_a_folder_that_others_may_write_to_is_not_used(tmp_path, caplog, mode, said):
    place = tmp_path / "cache"
    place.mkdir()
    place.chmod(mode)
    cache_folder.is_private.cache_clear()
    for _ in range(2):
        assert cache_folder.is_private(place) is (said is None)
    assert len(caplog.messages) == (said is not None)
    assert said is None or (said in caplog.text and "CLPIPE_CACHE_DIR" in caplog.text)


def test_another_users_folder_is_not_used(tmp_path, monkeypatch, caplog):
    cache_folder.is_private.cache_clear()
    monkeypatch.setattr(os, "geteuid", lambda: os.stat(tmp_path).st_uid + 1)
    assert not cache_folder.is_private(tmp_path)
    assert "belongs to another user" in caplog.text


def test_kernels_then_go_to_a_folder_of_the_process(device, tmp_path):
    shared = tmp_path / "shared"
    shared.mkdir()
    shared.chmod(0o777)
    code = f"{DEVELOP}; import os; print(os.environ['POCL_CACHE_DIR'])"
    for variable in ("CLPIPE_CACHE_DIR", "POCL_CACHE_DIR"):
        used = Path(python(code, HOME=tmp_path, **{variable: shared}))
        assert list(shared.iterdir()) == []
        assert shared not in used.parents and used != shared


def test_folders_that_are_made_are_the_users_alone(tmp_path):
    code = "from clpipe.engine.cache_folder import *; prepare_environment(); print(cache_folder())"
    for path in (Path(python(code, CLPIPE_CACHE_DIR=tmp_path / "new")), tmp_path / "new/pocl"):
        assert path.stat().st_mode & 0o777 == 0o700
