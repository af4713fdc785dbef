"""Files are written whole or not at all, and what is read is a regular file."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from clpipe.base import files
from clpipe.base.errors import ImageError, OutputError
from clpipe.base.files import FileGroup, deferred_files, sync_folder, write_atomic
from clpipe.batch.outcome import DONE, Outcome
from clpipe.batch.run_log import RunLog, read_log
from clpipe.inputs.find import Job
from tests.conftest import file_limit

PARTS = (b"head" * 20, bytes(50_000), memoryview(np.arange(900, dtype=np.uint8)))
WHOLE = b"".join(PARTS)


@pytest.mark.parametrize("size", [0, 1, 79, 80, 4096, 50_080, len(WHOLE) - 1])
@pytest.mark.parametrize("before", [None, b"what was there"])
def test_a_file_that_the_disk_does_not_hold_stays_as_it_was(tmp_path, size, before):
    path = tmp_path / "a.bin"
    if before:
        path.write_bytes(before)
    with file_limit(size), pytest.raises(ImageError, match=r"a\.bin: cannot be written: File too"):
        write_atomic(path, *PARTS)
    assert [p.read_bytes() for p in tmp_path.iterdir()] == ([before] if before else [])
    with file_limit(len(WHOLE)):
        assert write_atomic(path, *PARTS).size == len(WHOLE)
    assert path.read_bytes() == WHOLE


def test_an_error_in_between_leaves_the_file_as_it_was(tmp_path):
    write_atomic(tmp_path / "a", b"before")
    with pytest.raises(TypeError):
        write_atomic(tmp_path / "a", b"after", "no bytes")
    assert [p.read_bytes() for p in tmp_path.iterdir()] == [b"before"]


def test_deferred_files_are_on_the_disk_before_they_have_names(tmp_path, monkeypatch):
    done = []
    monkeypatch.setattr(files, "sync_file", lambda path: done.append("disk"))
    replace = Path.replace
    renamed = lambda path, to: done.append(to.name) or replace(path, to)  # noqa: E731
    monkeypatch.setattr(Path, "replace", renamed)
    groups = []
    for letter in "ab":
        with deferred_files() as group:
            write_atomic(tmp_path / f"{letter}.jpg", PARTS[0])
            write_atomic(tmp_path / f"{letter}.json", PARTS[1])
            sync_folder(tmp_path)
        groups.append(group)
    write_atomic(tmp_path / "c", b"not deferred")
    assert [p.name for p in tmp_path.iterdir() if p.name[0] != "."] == ["c"]
    done.clear()
    assert FileGroup.commit(groups) == [None, None]
    assert done == [*["disk"] * 2, "a.jpg", "a.json", *["disk"] * 2, "b.jpg", "b.json"]
    assert {p.name for p in tmp_path.iterdir()} == {"a.jpg", "a.json", "b.jpg", "b.json", "c"}
    picture, sidecar = tmp_path / "a.jpg", tmp_path / "a.json"
    assert sidecar.stat().st_mtime_ns >= picture.stat().st_ctime_ns


def test_a_group_that_fails_leaves_nothing_and_the_others_are_whole(tmp_path):
    groups = []
    for letter in "abc":
        (tmp_path / letter).mkdir()
        with deferred_files() as group:
            write_atomic(tmp_path / letter / "picture", b"x")
            write_atomic(tmp_path / letter / "sidecar", b"y")
        groups.append(group)
    (tmp_path / "b/sidecar").mkdir()  # a folder, which no file can replace
    first, second, third = FileGroup.commit(groups)
    assert first is third is None
    assert "b/sidecar: cannot be written: Is a directory" in str(second)
    found = {p.relative_to(tmp_path).as_posix() for p in tmp_path.rglob("*") if p.is_file()}
    assert found == {"a/picture", "a/sidecar", "b/picture", "c/picture", "c/sidecar"}
    with pytest.raises(TypeError):
        write_and_fail(tmp_path / "d")
    assert not list(tmp_path.glob("*d*"))


def test_an_error_that_nobody_expected_leaves_no_part_of_a_group(tmp_path, monkeypatch):
    groups = []
    for letter in "ab":
        with deferred_files() as group:
            write_atomic(tmp_path / letter, b"x")
        groups.append(group)

    def fail(path):
        raise MemoryError

    monkeypatch.setattr(files, "sync_file", fail)
    with pytest.raises(MemoryError):
        FileGroup.commit(groups)
    assert not list(tmp_path.iterdir())


def write_and_fail(path):
    with deferred_files():
        write_atomic(path, b"x")
        raise TypeError


WRITING_WHILE_IT_ENDS = """
import os, sys, threading, time
from pathlib import Path
from clpipe.base.files import deferred_files, remove_temporary_files, write_atomic

def write(name):
    with deferred_files():
        for i in range(10**9):
            write_atomic(folder / f"{name}{i % 50}", bytes(4096))
            if i == 50:
                writing.wait()

folder, writing = Path(sys.argv[1]), threading.Barrier(5)
for name in "abcd":
    threading.Thread(target=write, args=name, daemon=True).start()
writing.wait()  # each thread is in the midst of its files
remove_temporary_files()
time.sleep(0.1)  # a thread that went on would leave something
os._exit(0)
"""


def test_a_process_that_ends_at_once_leaves_no_part_though_other_threads_write(tmp_path):
    subprocess.run([sys.executable, "-c", WRITING_WHILE_IT_ENDS, tmp_path], check=True)
    assert not list(tmp_path.iterdir())


def test_no_link_is_followed(tmp_path, monkeypatch):
    (tmp_path / "victim").write_text("keep")
    monkeypatch.setattr(files.secrets, "token_hex", lambda count: "00000000")
    (tmp_path / ".a.00000000.part.bin").symlink_to("victim")
    with pytest.raises(ImageError, match="File exists"):
        write_atomic(tmp_path / "a.bin", b"new")
    monkeypatch.undo()
    (tmp_path / "a.bin").symlink_to("victim")
    write_atomic(tmp_path / "a.bin", b"new")  # the link is replaced, and not what it leads to
    assert (tmp_path / "victim").read_text() == "keep"
    assert (tmp_path / "a.bin").read_bytes() == b"new"


def test_the_longest_name_that_a_disk_takes(tmp_path):
    name = "é" * 125 + ".json"
    write_atomic(tmp_path / name, b"x")
    assert [p.name for p in tmp_path.iterdir()] == [name]
    with pytest.raises(ImageError, match="File name too long"):
        write_atomic(tmp_path / f"x{name}", b"x")


def outcome(number):
    return Outcome(Job(Path(f"{number}.exr"), f"{number}.exr"), DONE, 0.1)


def test_the_log_has_whole_lines_only(tmp_path):
    path = tmp_path / "run.jsonl"
    log = RunLog(path, {})
    log.add(outcome(0))
    before = path.read_bytes()
    for room in (0, 1, 100):
        with (
            file_limit(len(before) + room),
            pytest.raises(OutputError, match=r"run\.jsonl: cannot"),
        ):
            log.add(outcome(1))
        assert path.read_bytes() == before
    log.add(outcome(2))
    log.close()
    with open(path, "ab") as file:
        file.write(b'{"event": "ima')  # cut off by an earlier version
    log = RunLog(path, {})
    log.add(outcome(3))
    log.close()
    assert [line.get("input") for line in read_log(path)] == [None, "0.exr", "2.exr", None, "3.exr"]
    assert len([json.loads(line) for line in before.splitlines()]) == 2


@pytest.mark.parametrize("kind", ["link", "pipe"])
def test_a_log_that_is_something_else_is_not_written_to(tmp_path, kind):
    (tmp_path / "victim").write_text("keep")
    path = tmp_path / "run.jsonl"
    path.symlink_to("victim") if kind == "link" else os.mkfifo(path)
    with pytest.raises(OutputError, match=r"run\.jsonl: cannot be written"):
        RunLog(path, {}).add(outcome(0))
    assert (tmp_path / "victim").read_text() == "keep"
