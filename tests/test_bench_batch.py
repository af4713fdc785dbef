"""The benchmark of whole batches."""

import json

import pytest

from clpipe.batch import bench as bench_batch
from clpipe.batch.bench import Load
from clpipe.chain.request import Request
from clpipe.commands import bench as bench_command


@pytest.fixture
def short(monkeypatch):
    monkeypatch.setattr(bench_command, "loads", lambda: (Load(6, 32, 24), Load(5, 40, 17)))


def test_a_batch_is_timed_against_the_same_work_done_serially(clpipe, short):
    result = json.loads(clpipe("bench", "--batch", "--json").stdout)
    assert [b["images"] for b in result["batches"]] == [6, 5]
    for speed in result["batches"]:
        assert set(speed["cpu_ms"]) == {"decode", "device", "encode"}
        assert set(speed["alone_ms"]) == {"decoder", "kernels", "encoder"}
        assert all(ms > 0 for ms in (*speed["cpu_ms"].values(), *speed["alone_ms"].values()))
        assert speed["share_of_limit"] == pytest.approx(speed["limit_s"] / speed["batch_s"])
        beyond = speed["serial_s"] / speed["images"] * 1e3 - sum(speed["alone_ms"].values())
        assert speed["overhead_ms"] == pytest.approx(beyond)


def test_the_table(clpipe, short):
    text = clpipe("bench", "--batch").stdout
    assert "6 of 32x24" in text and "5 of 40x17" in text and "of limit" in text


def test_it_leaves_no_files(device, tmp_path, monkeypatch):
    monkeypatch.setattr(bench_batch.tempfile, "tempdir", str(tmp_path))
    bench_batch.bench_batch(device, Request.from_options(), Load(5, 24, 16))
    assert not list(tmp_path.iterdir())
