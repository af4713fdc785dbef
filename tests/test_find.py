"""The input files of a folder, and the names of their outputs."""

import json
import logging
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import clpipe as clpipe_api
from clpipe.base.errors import RequestError
from clpipe.inputs.find import Job, find_jobs
from tests.conftest import ROOT, written

NOWHERE = Path("/nowhere")


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Make empty files in an empty working directory."""
    monkeypatch.chdir(tmp_path)

    def make(*names):
        for name in names:
            Path(name).parent.mkdir(parents=True, exist_ok=True)
            Path(name).touch()

    return make


def keys(*inputs, **options):
    return [job.key for job in find_jobs(inputs, NOWHERE, **options)]


@pytest.mark.parametrize("backwards", [False, True])
def test_the_real_path_wins_over_a_link_whatever_the_order_on_disk(folder, monkeypatch, backwards):
    folder("in/z/sub/one.exr", "in/a/two.exr", "else/three.exr")
    os.symlink("../z", "in/a/link")
    os.symlink("z/sub", "in/alink")
    for name in ("d", "c", "b"):
        os.symlink("../else", f"in/{name}")
    scandir = os.scandir
    monkeypatch.setattr(os, "scandir", lambda place: Listing(scandir, place, backwards))
    assert keys("in") == ["a/two.exr", "b/three.exr", "z/sub/one.exr"]


class Listing:
    """Return a folder's entries in any order of a file system."""

    def __init__(self, scandir, place, backwards):
        with scandir(place) as entries:
            self._entries = iter(sorted(entries, key=lambda e: e.name, reverse=backwards))

    def __enter__(self):
        return self

    def __exit__(self, *error):
        pass

    def __iter__(self):
        return self

    def __next__(self):
        return next(self._entries)


def test_what_was_ignored_is_counted(folder, caplog):
    caplog.set_level(logging.INFO, "clpipe")
    folder("in/a.exr", "in/b/notes.txt", "in/b/more.TXT", "in/x.json", "in/README", "in/.hidden")
    os.mkfifo("in/b.exr")
    assert keys("in") == ["a.exr"]
    assert caplog.messages == [
        "in: 5 files are not images and were skipped: 2 .txt, 1 .json, 1 pipe or device, "
        "1 without suffix"
    ]
    caplog.clear()
    folder("one/a.exr", "one/a\n.b\tc")
    keys("one")
    assert caplog.messages == ["one: 1 file is not an image and was skipped: 1 .b c"]


def test_exclude(folder, caplog):
    folder("in/a.exr", "in/a_depth.exr", "in/tmp/b.exr", "in/old/tmp/c.exr", "in/old/d.exr")
    assert keys("in", exclude=["*_depth.exr", "tmp"]) == ["a.exr", "old/d.exr"]
    assert keys("in", exclude=["old/*.exr"]) == ["a.exr", "tmp/b.exr"]
    assert keys("in/*.exr", exclude=["*_depth*"]) == ["a.exr"]
    assert keys("in/a_depth.exr", exclude=["*_depth*"]) == ["a_depth.exr"]  # it was named
    assert "exclude *_depth* matches no file" in caplog.messages
    for inputs in ("in", "in/*.exr"):
        with pytest.raises(RequestError, match="excluded"):
            find_jobs([inputs], NOWHERE, exclude=["*"])


@pytest.mark.slow
def test_a_folder_that_cannot_be_read_is_refused(tmp_path):
    """An unreadable folder is an error. Root can read everything, so run as another user."""
    (tmp_path / "in" / "locked").mkdir(parents=True)
    (tmp_path / "in" / "locked").chmod(0)
    (tmp_path / "in" / "a.exr").touch()
    for place in (tmp_path, *tmp_path.parents):
        if place.owner() != "root" or place.stat().st_mode & 0o077 == 0:
            place.chmod(place.stat().st_mode | 0o055)
    code = (
        "import os, sys; from pathlib import Path; from clpipe.inputs.find import find_jobs\n"
        "os.getuid() or os.setuid(65534)\n"
        "find_jobs([sys.argv[1]], Path('/nowhere'))"
    )
    command = [sys.executable, "-c", code, str(tmp_path / "in")]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert "in/locked: this folder cannot be read: Permission denied" in done.stderr


def test_files_of_one_name_need_another(folder, clpipe, write_exr):
    for name in ("in/a.exr", "in/a.hdr"):
        write_exr(name, np.full((4, 6, 3), 0.25))
    Path("list.csv").write_text("path,name\nin/a.exr,\nin/a.hdr,\n")
    run = ("run", "-o", "out", "--device", "numpy")
    for inputs in (["in"], ["in/a.exr", "in/a.hdr"]):
        refused = clpipe(*run, *inputs, status=2)
        assert (
            "use different output directories, or give them names in a manifest" in refused.output
        )
    assert (
        "give them different names in a column called name"
        in clpipe(*run, "list.csv", status=2).output
    )
    refused = clpipe(*run, "in", "--webdataset", 2, status=2)
    assert "give one of them another name" in refused.output
    clpipe(*run, "in", "--exclude", "*.hdr")
    Path("list.csv").write_text("path,name\nin/a.exr,\nin/a.hdr,other\n")
    assert [job.stem for job in find_jobs(["list.csv"], NOWHERE)] == ["in/a", "other"]
    assert Job(Path("x"), "a.cr2").stem == "a"


def test_a_depth_file_in_a_folder_is_left_out(clpipe, write_exr):
    write_exr("in/a.exr", np.full((4, 6, 3), 0.25))
    for name in ("a_depth", "b_depth"):
        write_exr(f"in/{name}.exr", np.ones((4, 6, 1)), "Z")
    run = ("run", "-o", "out", "--device", "numpy")
    done = clpipe(*run, "in")
    assert "1 file is a companion of another image, such as in/a_depth.exr" in done.output
    assert "left out: 1 image in a directory has no picture, such as in/b_depth.exr" in done.output
    assert "_depth.exr: there are no R, G and B channels; found Z" in done.output
    assert "1 of 2 images done, 0 failed, 1 left out" in done.output
    assert written(Path("out")) == ["a.jpg", "a.json"]
    lines = map(json.loads, Path("out/run.jsonl").read_text("utf-8").splitlines())
    left_out = [line for line in lines if line.get("status") == "left out"]
    assert {line["error"] for line in left_out} == {None}
    assert all("found Z" in line["reason"] for line in left_out)
    assert "1 of 2" in clpipe(*run, "in/*.exr", status=1).output  # b_depth.exr alone fails
    for inputs in ("in/a_depth.exr", "in/*_depth.exr"):
        assert "no R, G and B channels; found Z" in clpipe(*run, inputs, status=1).output
    assert "left out" not in clpipe(*run, "in", "--quiet").output


def test_names_that_would_break_a_line_or_the_terminal(clpipe, write_exr):
    for name in ("new\nline", "esc\x1b[31m", "left\u202e", "[bold]"):
        write_exr(f"in/{name}.exr", np.full((4, 6, 3), 0.25))
    Path("in/bad\n\x1b[0m.exr").write_text("no image")
    Path(os.fsdecode(b"in/no\xff.exr")).write_bytes(b"")
    done = clpipe("run", "in", "-o", "out", "--device", "numpy", status=1)
    lines = done.output.splitlines()
    assert all(line.isprintable() for line in lines)
    assert sum(" -> out/" in line for line in lines) == 4
    assert r"in/new\nline.exr -> out/new\nline.jpg" in done.output
    assert r"in/bad\n\x1b[0m.exr: cannot be read as an image" in done.output
    assert r"in/no\udcff.exr" in done.output
    logged = Path("out/run.jsonl").read_text("utf-8").splitlines()
    assert len([json.loads(line) for line in logged]) == 8
    refused = clpipe("plan", "-c", "no\nsu\x1bch.toml", status=2).output
    assert refused.replace("\n", "").isprintable()


def test_names_that_are_too_long_fail_alone(clpipe, write_exr):
    for name in ("a" * 251, "b" * 240, "short"):
        write_exr(f"in/{name}.exr", np.full((4, 6, 3), 0.25))
    done = clpipe("run", "in", "-o", "out", "--device", "numpy", status=1)
    assert "a.json: this file cannot be read: File name too long" in done.output
    assert "in/short.exr -> out/short.jpg" in done.output


def test_a_run_that_leaves_everything_out_is_no_success(clpipe, write_exr):
    write_exr("in/a_depth.exr", np.ones((4, 6, 1)), "Z")
    done = clpipe("run", "in", "-o", "out", "--device", "numpy", status=1)
    assert "left out: 1 image in a directory has no picture, such as in/a_depth.exr" in done.output


def test_a_dataset_leaves_out_what_is_excluded(write_exr, tmp_path):
    write_exr("in/a.exr", np.full((4, 6, 3), 0.25))
    write_exr("in/a_depth.exr", np.ones((4, 6, 1)), "Z")
    write_exr("in/b.exr", np.full((4, 6, 3), 0.25))
    (sample,) = clpipe_api.Dataset(tmp_path / "in", device="numpy", exclude="b*")
    assert sample["key"] == "a.exr"


@pytest.mark.parametrize(
    ("pattern", "numbers"),
    [
        ("f.%04d.exr", ["0998", "1001", "1003", "1004", "10000"]),
        ("f.####.exr", ["0998", "1001", "1003", "1004", "10000"]),
        ("f.@@@@.exr", ["0998", "1001", "1003", "1004", "10000"]),
        ("f.$F4.exr", ["0998", "1001", "1003", "1004", "10000"]),
        ("f.%d.exr", ["-7", "3", "1001", "1003", "1004", "10000"]),
        ("f.#.exr", ["-7", "3", "0998", "1001", "1003", "1004", "10000"]),
        ("f.1001-1004x2####.exr", ["1001", "1003"]),
        ("f.0-999,1004-1004%04d.exr", ["0998", "1004"]),
    ],
)
def test_patterns_of_numbered_files(tmp_path, pattern, numbers):
    for number in ("-7", "3", "0998", "1001", "1003", "1004", "10000"):
        (tmp_path / f"f.{number}.exr").touch()
    for other in ("f.a.exr", "f.1001.png", "g.1001.exr", "f.1001.b.exr"):
        (tmp_path / other).touch()
    jobs = find_jobs([str(tmp_path / pattern)], tmp_path / "out")
    found = [job.key.split(".")[1] for job in jobs]
    assert found == numbers


def test_missing_numbers_of_a_range_are_named(tmp_path, caplog):
    (tmp_path / "f.1001.exr").touch()
    pattern = str(tmp_path / "f.1001-1009x2####.exr")
    assert len(find_jobs([pattern], tmp_path / "out")) == 1
    assert "4 of 5 frames are missing: 1003, 1005, 1007, 1009" in caplog.text
    for wrong, message in (
        ("f.7-9####.exr", "no file matches this pattern of numbers"),
        ("f.9-7####.exr", "the range 9-7 has no numbers; use FIRST-LASTxSTEP"),
        ("f.1-9x0####.exr", "the range 1-9x0 has no numbers"),
    ):
        with pytest.raises(RequestError, match=message):
            find_jobs([str(tmp_path / wrong)], tmp_path / "out")


def test_patterns_with_special_characters(tmp_path):
    names = ("gl[1]b/f.1001.exr", "shot-1001.exr", "shot-1003.exr", "100%d_0001.exr")
    for name in names:
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    for pattern, expected in (
        ("gl[1]b/f.####.exr", ["f.1001.exr"]),
        ("shot-1001-1003####.exr", ["shot-1001.exr", "shot-1003.exr"]),
        ("100%d_%04d.exr", ["100%d_0001.exr"]),
        ("100%d_*.exr", ["100%d_0001.exr"]),
    ):
        jobs = find_jobs([str(tmp_path / pattern)], tmp_path / "out")
        assert [job.key for job in jobs] == expected


def test_a_file_with_the_name_of_a_pattern_is_a_file(tmp_path):
    (tmp_path / "a#1.exr").touch()
    [job] = find_jobs([str(tmp_path / "a#1.exr")], tmp_path / "out")
    assert job.key == "a#1.exr"
