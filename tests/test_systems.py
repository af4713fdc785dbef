"""Without features that macOS or Windows lack, clpipe works and returns the same results."""

import errno
import os
import shutil
from collections import namedtuple
from pathlib import Path

import numpy as np
import pytest

from clpipe.base import system
from clpipe.base.errors import ImageError, RequestError
from clpipe.base.processors import available_processors
from clpipe.images.write import write_png
from clpipe.inputs.find import Shard
from clpipe.outputs import folder as output_folders
from clpipe.outputs.folder import LOCK, output_folder, write_problem
from tests.conftest import ROOT, run_python, written

pytestmark = pytest.mark.slow

# What Windows' Python has none of; macOS lacks the first lines of it. The library's own modules
# that read such names when they are called get what they have on Windows.
TAKE_AWAY = """
import collections, os, shutil, signal, subprocess, sys
import platformdirs  # it asks which system this is, and that is still Linux

MODULES = "fcntl resource grp pwd termios tty pty syslog"
NAMES = '''
    sched_getaffinity posix_fallocate memfd_create ST_NOEXEC
    statvfs fstatvfs pread pwrite preadv pwritev posix_fadvise lockf
    chown fchown lchown getuid geteuid getgid getegid getpgid setsid killpg nice
    fork forkpty mkfifo mknod sync openpty
    O_NOFOLLOW O_NONBLOCK O_DIRECTORY O_CLOEXEC O_SYNC O_DSYNC O_NOCTTY
'''
SIGNALS = "SIGKILL SIGHUP SIGALRM SIGUSR1 SIGUSR2 SIGPIPE SIGCHLD SIGQUIT"

statvfs, usage = os.statvfs, collections.namedtuple("usage", "total used free")

def disk_usage(path):
    status = statvfs(path)
    return usage(0, 0, status.f_bavail * status.f_frsize)

shutil.disk_usage = disk_usage
shutil._use_fd_functions = False
for name in MODULES.split():
    sys.modules[name] = None
for holder, names in ((os, NAMES), (signal, SIGNALS)):
    for name in names.split():
        if hasattr(holder, name):
            delattr(holder, name)
"""

LOAD = """
import importlib, pkgutil
import clpipe

loaded = 0
for module in pkgutil.walk_packages(clpipe.__path__, "clpipe."):
    if module.name.startswith("clpipe.scenes.blender_"):  # they run in Blender
        continue
    try:
        importlib.import_module(module.name)
    except ModuleNotFoundError as error:
        extras = "bpy distributed jinja2 lensfunpy markupsafe matplotlib scipy starlette torch"
        extras += " uvicorn"
        if error.name.partition(".")[0] not in extras.split():
            raise
    loaded += 1
print(loaded)
"""

# PoCL 3.0, which only exists for Linux, receives its CPU through /proc/self/mem.
FOR_POCL = TAKE_AWAY.replace(" pread pwrite ", " ")

RUN = "from clpipe.commands.main import main; main()"


def test_every_module_loads(tmp_path):
    modules = [p for p in (ROOT / "clpipe").rglob("*.py") if not p.name.startswith("blender_")]
    done = run_python("-c", TAKE_AWAY + LOAD, cwd=tmp_path)
    assert int(done.stdout) == len(modules) - 1  # the package itself


@pytest.mark.parametrize(
    ("taken", "device", "shards"),
    [(TAKE_AWAY, ("--device", "numpy"), ("1/2", "2/2")), (FOR_POCL, (), ("1/1",))],
    ids=["numpy", "default"],
)
def test_a_batch_runs_resumes_and_has_the_same_bytes(
    tmp_path, clpipe, write_exr, taken, device, shards
):
    random = np.random.default_rng(3)
    for name in ("in/a.exr", "in/b/c.exr"):
        write_exr(name, random.random((12, 16, 3), np.float32))
    noise, files = ("--iso", 3200, "--seed", 5), ("--truth", "clean", "--keep", "quantize")
    run = ("run", "in", *noise, *files, "--format", "png", *device, "-o")
    clpipe(*run, "usual")
    for shard in shards:
        run_python("-c", taken + RUN, *run, "out", "--shard", shard, cwd=tmp_path)
    again = run_python("-c", taken + RUN, *run, "out", cwd=tmp_path)
    assert "2 of them were there already" in again.stderr
    usual = written(tmp_path / "usual")
    made = [name for name in written(tmp_path / "out") if not name.endswith(".jsonl")]
    # Without locks of any kind, nobody knows whether the file is still of use.
    assert made == sorted([*usual, LOCK])
    for name in usual:
        assert (tmp_path / "out" / name).read_bytes() == (tmp_path / "usual" / name).read_bytes()


class Windows:
    """A stand-in for msvcrt, by what is written of it; each open file is as another process.

    Ranges begin at the file's position. None may overlap another, not its own holder's either, and
    the C runtime counts with 31 bits.
    """

    LK_NBLCK, LK_UNLCK = 2, 0

    def __init__(self):
        self.held = {}

    def locking(self, file, mode, length):
        first = os.lseek(file, 0, os.SEEK_CUR)
        assert 0 < length <= first + length < 2**31
        held = self.held.setdefault(file, set())
        if mode == self.LK_UNLCK:
            held.remove((first, length))
        elif any(
            first < f + n and f < first + length
            for other, ranges in self.held.items()
            for f, n in ranges
            if os.path.sameopenfile(file, other)
        ):
            raise OSError(errno.EACCES, os.strerror(errno.EACCES))
        else:
            held.add((first, length))


def test_shards_share_a_folder_by_the_locks_of_windows(tmp_path, monkeypatch):
    monkeypatch.setattr(system, "fcntl", None)
    monkeypatch.setattr(system, "msvcrt", Windows())
    monkeypatch.setattr(output_folders, "LOCKABLE_BYTES", 2**30)
    out = tmp_path / "out"
    with output_folder(out, Shard(1, 2)):
        for shard in (Shard(), Shard(1, 2), Shard(1, 3)):
            with (
                pytest.raises(RequestError, match="another run is writing to this directory"),
                output_folder(out, shard),
            ):
                pass
    with output_folder(out, Shard(999_999, 1_000_000)), output_folder(out, Shard(1, 1_000_000)):
        pass
    with output_folder(out, Shard()):
        assert (out / LOCK).exists()
    assert not list(out.iterdir())


def test_a_link_is_not_followed_where_the_system_cannot_be_told_so(tmp_path, monkeypatch):
    (tmp_path / "a").write_text("a")
    (tmp_path / "link").symlink_to("a")
    monkeypatch.delattr(os, "O_NOFOLLOW")
    with pytest.raises(OSError, match="symbolic links"):
        system.open_plain(tmp_path / "link", os.O_RDONLY)
    file = system.open_plain(tmp_path / "a", os.O_RDONLY)
    assert os.read(file, 9) == b"a"
    os.close(file)


@pytest.fixture
def _full_disk(monkeypatch):
    usage = namedtuple("usage", "total used free")
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage(2**30, 2**30 - 10, 10))


@pytest.mark.usefixtures("_full_disk")
def test_a_full_disk_is_noticed_without_posix_fallocate(tmp_path, monkeypatch):
    assert write_problem(tmp_path) == ""
    monkeypatch.delattr(os, "posix_fallocate")
    assert write_problem(tmp_path) == (
        "cannot write to this directory: No space left on device (8.0 MiB are needed)"
    )
    assert not list(tmp_path.iterdir())


@pytest.mark.usefixtures("_full_disk")
def test_a_full_disk_is_noticed_before_an_encoder_meets_it(tmp_path, monkeypatch):
    pixels = np.zeros((8, 8), np.uint8)
    write_png(tmp_path / "a.png", pixels)
    monkeypatch.delattr(os, "memfd_create")
    with pytest.raises(ImageError, match=r"b\.png: cannot be written: No space left on device"):
        write_png(tmp_path / "b.png", pixels)
    assert os.listdir(tmp_path) == ["a.png"]


def test_files_for_encoders_are_gone_afterwards(tmp_path, monkeypatch):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    monkeypatch.delattr(os, "memfd_create")
    with system.temporary_file(10) as name:
        Path(name).write_bytes(b"x")
        assert Path(name).is_relative_to(tmp_path)
    assert not list(tmp_path.iterdir())


def test_all_processors_count_where_the_system_does_not_say_which_are_ours(tmp_path, monkeypatch):
    monkeypatch.delattr(os, "sched_getaffinity")
    monkeypatch.setattr(os, "cpu_count", lambda: 12)
    assert available_processors(tmp_path) == 12
    monkeypatch.setattr(os, "cpu_count", lambda: None)
    assert available_processors(tmp_path) == 1
