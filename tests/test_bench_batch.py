"""The benchmark of whole batches."""

import json

import pytest

from clpipe.batch import bench as bench_batch
from clpipe.batch.bench import Workload
from clpipe.chain.request import Request
from clpipe.commands import bench as bench_command


@pytest.fixture
def short(monkeypatch):
    monkeypatch.setattr(
        bench_command, "workloads", lambda: (Workload(6, 32, 24), Workload(5, 40, 17))
    )


def test_cpu_time_by_step_is_that_of_the_process(clpipe, short, monkeypatch):
    taken = []
    real = bench_batch.CpuTimes.__exit__

    def leave(times, *error):
        real(times, *error)
        taken.append(times.elsewhere + sum(times.seconds.values()))  # of the process

    monkeypatch.setattr(bench_batch.CpuTimes, "__exit__", leave)
    result = json.loads(clpipe("bench", "--batch", "--json").stdout)
    assert [b["images"] for b in result["batches"]] == [6, 5]
    for speed, seconds in zip(result["batches"], taken, strict=True):
        assert tuple(speed["cpu_ms"]) == bench_batch.CPU_STEPS
        steps = set(bench_batch.CPU_STEPS) - {"convert", "upload", "download"}  # nearly nothing
        assert all(speed["cpu_ms"][step] > 0 for step in steps)
        total = sum(speed["cpu_ms"].values()) * speed["images"] / 1e3
        assert total == pytest.approx(seconds)
        assert speed["busy"] == pytest.approx(total / speed["seconds"] / speed["processors"])


def test_the_table(clpipe, short):
    text = clpipe("bench", "--batch").stdout
    assert "6 of 32x24" in text and "5 of 40x17" in text and "hash" in text and "busy" in text


@pytest.mark.parametrize("options", ["--start-at normalize", "-c unprocess"])
def test_images_are_of_the_kind_that_the_chain_starts_on(clpipe, short, options):
    result = json.loads(clpipe("bench", "--batch", "--json", *options.split()).stdout)
    assert [b["images"] for b in result["batches"]] == [6, 5]


def test_it_leaves_no_files(device, tmp_path, monkeypatch):
    monkeypatch.setattr(bench_batch.tempfile, "tempdir", str(tmp_path))
    bench_batch.bench_batch(device, Request.from_options(), Workload(5, 24, 16))
    assert not list(tmp_path.iterdir())
