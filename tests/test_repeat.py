"""Several pictures of each render, and an ISO drawn from a range."""

import csv
import json

import numpy as np
import pytest

import clpipe as package
from tests.conftest import written

RAW = {"until": "quantize", "format": "npy", "device": "numpy"}


def run(folder, output, **options):
    return [outcome.status for outcome in package.run(folder, output, **RAW, **options)]


@pytest.fixture
def folder(write_exr, tmp_path):
    for name in ("a", "sub/b.0007"):
        write_exr(f"in/{name}.exr", np.full((12, 16, 3), 0.3))
    return tmp_path / "in"


def test_each_repetition_has_noise_and_draws_of_its_own(folder, tmp_path):
    out = tmp_path / "out"
    assert run(folder, out, repeat=3, iso=(100, 6400)) == ["done"] * 6
    pictures = [name for name in written(out) if name.endswith(".npy")]
    assert pictures == [
        *(f"a_000{n}.npy" for n in range(3)),
        *(f"sub/b.0007_000{n}.npy" for n in range(3)),
    ]
    assert len({(out / name).read_bytes() for name in pictures}) == 6
    isos = [json.loads((out / name).with_suffix(".json").read_text())["iso"] for name in pictures]
    assert len({*isos}) == 6 and 100 <= min(isos) < max(isos) <= 6400


def test_more_repetitions_extend_a_run(folder, tmp_path):
    out = tmp_path / "out"
    run(folder, out, repeat=2, iso="100..6400")
    first = {name: (out / name).read_bytes() for name in written(out) if name.endswith(".npy")}
    assert sorted(run(folder, out, repeat=3, iso="100..6400")) == ["done"] * 2 + ["skipped"] * 4
    assert {name: (out / name).read_bytes() for name in first} == first


def test_a_repetition_is_replayed(folder, tmp_path, clpipe):
    run(folder, tmp_path / "out", repeat=2, iso="100..6400")
    done = clpipe("replay", "out/a_0001.json", "-o", "again", "--device", "numpy", "--json")
    assert json.loads(done.stdout)["same"]


def test_rows_of_a_manifest_and_isos_are_repeated(folder, tmp_path):
    with (tmp_path / "list.csv").open("w") as file:
        csv.writer(file).writerows([("path", "name"), ("in/a.exr", "x"), ("in/a.exr", "y")])
    run(tmp_path / "list.csv", tmp_path / "out", repeat=2, iso=[100, 800])
    pictures = [name for name in written(tmp_path / "out") if name.endswith(".npy")]
    assert pictures == [f"iso{i}/{n}_000{k}.npy" for i in (100, 800) for n in "xy" for k in (0, 1)]


@pytest.mark.parametrize("iso", [(100, 6400), "100..6400"])
def test_a_range_of_isos_is_log_uniform(iso):
    settings = package.Pipeline(device="numpy", iso=iso).settings
    isos = np.array([settings.drawn(str(number)).iso for number in range(400)])
    counts, _ = np.histogram(np.log2(isos / 100), 6, (0, 6))
    assert counts == pytest.approx(400 / 6, abs=30) and counts.sum() == 400


def test_a_list_is_no_range():
    with pytest.raises(package.RequestError, match="log_uniform"):
        package.Pipeline(device="numpy", iso=[100, 6400])


@pytest.mark.parametrize("iso", [(100, 800, 3200), ("low", "high"), "100..", (100,)])
def test_a_range_has_two_ends(iso):
    with pytest.raises(package.RequestError, match="expected the two ends of a range"):
        package.Pipeline(device="numpy", iso=iso)
