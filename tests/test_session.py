"""Runs from Python: the command's files, and the use of outcomes in scripts."""

import json
from pathlib import Path

import numpy as np
import pytest

import clpipe as package
from clpipe.batch.run_log import read_log
from tests.conftest import contents, written

DEVICE = {"device": "numpy", "stages": ["exposure", "gamma"]}
OPTIONS = ("--device", "numpy", "--stages", "exposure,gamma")


@pytest.fixture
def renders(write_exr, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in "abc":
        write_exr(f"in/{name}.exr", np.full((8, 12, 3), 0.25))


def test_a_script_and_the_command_make_the_same_bytes(renders, clpipe):
    made = package.run("in", "script", iso=[100, 400], exposure={"ev": 0.5}, **DEVICE)
    outcomes = {outcome.job.stem: outcome.status for outcome in made}
    assert outcomes == {f"iso{iso}/{name}": "done" for iso in (100, 400) for name in "abc"}
    assert made.summary.counts["done"] == 6 and made.summary.exit_status == 0
    command = ("run", "in", "--iso", "100,400", "--set", "exposure.ev=0.5", *OPTIONS, "-o")
    clpipe(*command, "command")
    pictures = {name: data for name, data in contents("command").items() if name.endswith(".jpg")}
    assert len(pictures) == 6 and pictures.items() <= contents("script").items()
    assert "6 of them were there already" in clpipe(*command, "script").stderr
    again = package.run("in", "command", iso=[100, 400], exposure={"ev": 0.5}, **DEVICE)
    assert [outcome.status for outcome in again] == ["skipped"] * 6


def test_nothing_is_written_before_a_run_is_iterated(renders):
    made = package.run("in", "out", **DEVICE)
    assert len(made.jobs) == 3 and not Path("out").exists()
    list(made)
    assert "a.jpg" in written(Path("out"))


def test_a_run_that_is_left_finishes_what_is_in_flight(renders):
    for outcome in (made := package.run("in", "out", jobs=1, **DEVICE)):
        assert outcome.status == "done"
        break
    assert made.summary.interrupted and made.summary.exit_status == 130
    *_, end = read_log(Path("out/run.jsonl"))
    assert end["event"] == "end" and end["interrupted"]
    for path in Path("out").glob("*.jpg"):  # nothing is half there
        assert path.with_suffix(".json").exists()
    made = package.run("in", "out", **DEVICE)
    assert {outcome.status for outcome in made} <= {"done", "skipped"}
    assert len(list(Path("out").glob("*.jpg"))) == 3


def test_a_run_that_is_stopped_before_it_began(renders):
    made = package.run("in", "out", jobs=1, **DEVICE)
    made.stop()
    assert list(made) == [] and made.summary.interrupted


def test_one_image_fails_alone(renders):
    Path("in/b.exr").write_bytes(b"no image")
    outcomes = {o.job.stem: o for o in package.run("in", "out", **DEVICE)}
    assert [outcomes[name].status for name in "abc"] == ["done", "failed", "done"]
    assert "in/b.exr" in outcomes["b"].error


def test_a_draw_of_the_iso_and_what_there_is_to_say_behind_a_run(renders):
    drawn = {"camera": {"choice": ["canon-5d2"]}, "iso": {"choice": [100, 200]}}
    made = package.run("in", "out", **drawn, **DEVICE)
    list(made)
    assert {json.loads(p.read_text())["iso"] for p in Path("out").glob("*.json")} <= {100, 200}
    assert made.notes == []
    Path("in/a.exr").unlink()
    made = package.run("in", "out", **drawn, **DEVICE)
    list(made)
    assert made.notes == ["1 picture in out is of inputs that no longer exist"]
