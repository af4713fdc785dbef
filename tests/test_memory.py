"""Memory and processors: parsing of sizes, and the free resources of a machine."""

import os

import pytest

from clpipe.base.errors import RequestError
from clpipe.base.memory import available_memory, parse_size
from clpipe.base.processors import available_processors


@pytest.mark.parametrize(
    ("text", "size"),
    [("1", 1), ("512M", 2**29), ("8g", 2**33), ("8GB", 2**33), (" 1.5 KiB", 1536), (".5T", 2**39)],
)
def test_sizes(text, size):
    assert parse_size(text) == size


@pytest.mark.parametrize(
    "text", ["", "M", "8X", "-1G", "0", "1e3", "nan", "8 G G", "9" * 30, "9" * 400]
)
def test_what_is_no_size(text):
    with pytest.raises(RequestError, match=r"is not a size. Use a size such as 512M or 8G"):
        parse_size(text)


def write(root, **files):
    for name, text in files.items():
        path = root / name.replace("__", "/")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)


def test_memory_left_is_the_least_of_what_the_kernel_and_control_groups_say(tmp_path):
    assert available_memory(tmp_path) is None
    write(tmp_path, proc__meminfo="MemTotal: 100 kB\nMemAvailable:   90 kB\n")
    assert available_memory(tmp_path) == 90 * 1024
    write(tmp_path, proc__self__cgroup="0::/job/step\n")
    assert available_memory(tmp_path) == 90 * 1024
    group = tmp_path / "sys/fs/cgroup/job"
    (group / "step").mkdir(parents=True)
    for name, text in (("max", "50000"), ("current", "40000"), ("stat", "inactive_file 5000\n")):
        (group / f"memory.{name}").write_text(text)
    (group / "step" / "memory.max").write_text("max\n")
    (group / "step" / "memory.current").write_text("40000\n")
    assert available_memory(tmp_path) == 15000


def test_memory_left_in_groups_of_the_first_version(tmp_path):
    write(
        tmp_path,
        proc__meminfo="MemAvailable: 90 kB\n",
        proc__self__cgroup="5:cpu:/x\n4:memory:/not/here\n",
    )
    # As in a container: its own group is what is mounted.
    group = tmp_path / "sys/fs/cgroup/memory"
    group.mkdir(parents=True)
    for name, text in (("limit_in_bytes", "9000"), ("usage_in_bytes", "8000"), ("stat", "")):
        (group / f"memory.{name}").write_text(text)
    assert available_memory(tmp_path) == 1000


def test_memory_left_on_this_machine():
    left = available_memory()
    assert left is None or left > 2**20


@pytest.fixture
def _hundred_processors(monkeypatch):
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(100)))


@pytest.mark.usefixtures("_hundred_processors")
def test_processors_are_the_least_of_what_the_kernel_and_control_groups_say(tmp_path):
    assert available_processors(tmp_path) == 100
    write(tmp_path, proc__self__cgroup="0::/job/step\n")
    group = tmp_path / "sys/fs/cgroup/job"
    (group / "step").mkdir(parents=True)
    (group / "step" / "cpu.max").write_text("max 100000\n")
    assert available_processors(tmp_path) == 100
    (group / "cpu.max").write_text("250000 100000\n")
    assert available_processors(tmp_path) == 3
    (group / "step" / "cpu.max").write_text("10000 100000\n")
    assert available_processors(tmp_path) == 1


@pytest.mark.usefixtures("_hundred_processors")
def test_processors_in_groups_of_the_first_version(tmp_path):
    write(tmp_path, proc__self__cgroup="5:memory:/x\n4:cpu,cpuacct:/docker/1\n")
    group = tmp_path / "sys/fs/cgroup/cpu"
    group.mkdir(parents=True)
    (group / "cpu.cfs_period_us").write_text("50000\n")
    (group / "cpu.cfs_quota_us").write_text("-1\n")
    assert available_processors(tmp_path) == 100
    (group / "cpu.cfs_quota_us").write_text("200000\n")
    assert available_processors(tmp_path) == 4
