"""Sidecars contain their own digest: every reader treats an edited one as missing."""

import copy
import hashlib
import json
import os
import random
import subprocess
import tarfile
from pathlib import Path

import numpy as np
import pytest

from clpipe.base.errors import ImageError
from clpipe.batch.run_log import read_log
from clpipe.outputs.sidecar import (
    DIGEST_KEY,
    SidecarError,
    parse_sidecar,
    read_sidecar,
    sidecar_bytes,
)
from tests.conftest import reseal

CHANGED = f"this sidecar was changed after clpipe wrote it (its {DIGEST_KEY} does not match)"
CAMERA = ("--set", "render.fx=30", "--set", "render.fy=30")


@pytest.fixture
def made(clpipe, write_exr):
    """Run two renders, and return a function that runs again and returns their status by name."""
    for name, value in (("a", 0.25), ("b", 0.5)):
        write_exr(f"in/{name}.exr", np.full((8, 8, 3), value, np.float32))

    def run(*options, status=0):
        clpipe("run", "in", "-o", "out", "--device", "numpy", *CAMERA, *options, status=status)
        lines = [line for line in read_log(Path("out/run.jsonl")) if line["event"] == "image"]
        return {Path(line["input"]).stem: line["status"] for line in lines[-2:]}

    run()
    return run


def edit_intrinsics(path: Path) -> None:
    text = path.read_text()
    assert '"fx": 30.0' in text
    path.write_text(text.replace('"fx": 30.0', '"fx": 31.0'))


def lay_out_anew(path: Path) -> None:
    path.write_text(json.dumps(json.loads(path.read_text())))


def cut_off(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:300])


def without_beginning(path: Path) -> None:
    path.write_bytes(b"x" + path.read_bytes()[40:])


def without_seal(path: Path) -> None:
    values = json.loads(path.read_text())
    del values[DIGEST_KEY]
    path.write_text(json.dumps(values, indent=2))


EDITS = [edit_intrinsics, lay_out_anew, cut_off, without_beginning, without_seal]


def test_the_digest_is_that_of_the_lines_before(made):
    last = Path("out/a.json").read_text().splitlines()[-2]
    before = subprocess.run(["head", "-n", "-2", "out/a.json"], capture_output=True, check=True)
    assert last == f'  "{DIGEST_KEY}": "{hashlib.sha256(before.stdout).hexdigest()}"'
    assert read_sidecar(Path("out/a.json"))[DIGEST_KEY] in last


@pytest.mark.parametrize("edit", EDITS)
def test_an_edited_sidecar_is_a_missing_one(made, clpipe, edit):
    sidecar, whole = Path("out/a.json"), Path("out/a.json").read_bytes()
    edit(sidecar)
    for command in ("poses", "report"):
        printed = clpipe(command, "out").output
        if command == "report":
            printed = Path("out/report.html").read_text()
        assert "a.json" in printed and "was changed after clpipe wrote it" in printed
        assert "repeat the same clpipe run" in printed
    views = json.loads(Path("out/cameras.json").read_text())["views"]
    assert [view["file"] for view in views] == ["b.jpg"]
    printed = clpipe("replay", sidecar, "-o", "again", status=2).stderr
    assert printed.startswith(f"clpipe: {sidecar}: {CHANGED}")
    assert "use options or a configuration" in printed
    assert made() == {"a": "done", "b": "skipped"}
    assert sidecar.read_bytes() == whole
    assert made() == {"a": "skipped", "b": "skipped"}


def test_every_byte_counts():
    whole = sidecar_bytes(
        {"clpipe": "0.1.0", "input": "a.exr", "stages": [{"name": "x"}], "iso": 100}
    )
    assert parse_sidecar(whole, "a.json")["iso"] == 100
    for place in range(len(whole)):
        for data in (
            whole[:place] + bytes([whole[place] ^ 1]) + whole[place + 1 :],
            whole[:place] + whole[place + 1 :],
            whole[:place] + b" " + whole[place:],
            whole[: place + 1] + bytes(len(whole) - place - 1),
            whole[: place + 1],
        ):
            if data == whole:
                continue
            with pytest.raises(SidecarError, match=r"a\.json: this sidecar was changed after"):
                parse_sidecar(data, "a.json")


def test_file_names_that_are_not_utf_8():
    assert (
        parse_sidecar(sidecar_bytes({"clpipe": "0", "input": "\udcff"}), "a.json")["input"]
        == "\udcff"
    )
    with pytest.raises(SidecarError):
        parse_sidecar(sidecar_bytes({"clpipe": "0", "input": "\ud800"}), "a.json")


@pytest.mark.parametrize("text", ["", "{}", "[1, 2]", '{"a": "clpipe"}', "no JSON", "\0" * 50])
def test_what_others_wrote_is_no_sidecar(tmp_path, text):
    assert parse_sidecar(text.encode(), "a.json") is None
    path = tmp_path / "a.json"
    path.write_text(text)
    expected = ImageError if text.strip("\0") else FileNotFoundError
    with pytest.raises(expected) as caught:
        read_sidecar(path)
    assert not isinstance(caught.value, SidecarError)


ODD = [7, -1.5, [], ["x"], None, "", "\0", {}, {"a": {"b": [1]}}, True, 10**400, float("nan")]


def places(values, at=()):
    """Return the path of keys to each value of a sidecar; for a list, to its first item."""
    if at:
        yield at
    if isinstance(values, dict):
        for key, value in values.items():
            yield from places(value, (*at, key))
    elif isinstance(values, list) and values:
        yield from places(values[0], (*at, 0))


def edited(values, at, value):
    values = copy.deepcopy(values)
    inner = values
    for key in at[:-1]:
        inner = inner[key]
    inner[at[-1]] = value
    return values


NUMPY = ("-o", "b", "--device", "numpy", "--redo", "all")

PATCHES = ("--patch", 4, "--patches-per-image", 2, "--keep", "normalize", "--format", "png")


@pytest.mark.slow
@pytest.mark.parametrize("options", [(), PATCHES])
def test_whatever_a_forged_sidecar_holds_no_command_ends_in_a_traceback(made, clpipe, options):
    made(*options)
    whole, rng = read_sidecar(Path("out/a.json")), random.Random(0)
    everywhere = [(at, odd) for at in places(whole) for odd in ODD]
    for number, (at, odd) in enumerate(rng.sample(everywhere, 200)):
        Path(f"odd/{number}").mkdir(parents=True)
        os.link("out/a.jpg", f"odd/{number}/a.jpg")
        reseal(Path(f"odd/{number}/a.json"), edited(whole, at, odd))
    assert "Traceback" not in clpipe("poses", "odd", status=2 if options else 0).output
    clpipe("report", "odd")
    resumed = ("clpipe", "input_size", "input_modified", "sha256", "request", "outputs")
    cases = [(key, odd) for key in (*resumed, "subframes", "carried", "depth") for odd in ODD]
    for number, (key, odd) in enumerate(cases):
        os.link("in/a.exr", f"in/x{number}.exr")
        reseal(Path(f"out/x{number}.json"), {**whole, key: odd})
    run = ("run", "in", "-o", "out", "--device", "numpy", *CAMERA, *options)
    assert "unexpected" not in clpipe(*run).stderr
    for key in whole["request"]:
        for odd in rng.sample(ODD, 2):
            reseal(Path("e.json"), edited(whole, ("request", key), odd))
            again = clpipe("replay", "e.json", *NUMPY, status=(0, 1, 2))
            assert "unexpected" not in again.stderr, (key, odd)


FORGED = [
    *(("photometry", value) for value in ([1], {}, {"response": 3})),
    *(("motion", value) for value in ([1], {"first_row": 1}, {"exposure_time": 1.0})),
]


@pytest.mark.parametrize(("key", "value"), FORGED)
def test_forged_light_and_motion_leave_a_picture_out(made, clpipe, key, value):
    made()
    reseal(Path("out/a.json"), {**read_sidecar(Path("out/a.json")), key: value})
    assert "damaged or of another version" in clpipe("poses", "out", status=(0, 1, 2)).output


@pytest.mark.slow
@pytest.mark.parametrize("key", ["iso", "noise", "width", "camera", "outputs"])
def test_a_card_goes_without_what_a_forged_sidecar_holds(clpipe, write_exr, key):
    for name in "ab":
        write_exr(f"in/{name}.exr", np.full((8, 8, 3), 0.25, np.float32))
    run = ("dataset", "in", "-o", "out", "--device", "numpy", "--iso", 100)
    clpipe(*run)
    values = read_sidecar(Path("out/iso100/a.json"))
    for odd in ODD:
        reseal(Path("out/iso100/a.json"), {**values, key: odd})
        clpipe(*run)


def edited_in_tar(path: Path, name: str) -> None:
    data = path.read_bytes()
    with tarfile.open(path) as tar:
        start = tar.getmember(name).offset_data
    place = data.index(b'"iso": 1', start) + 7
    path.write_bytes(data[:place] + b"2" + data[place + 1 :])


@pytest.mark.parametrize(
    ("options", "names"),
    [
        ((), ["a.json", "b.json"]),
        (("--patch", 4, "--patches-per-image", 2), ["__clpipe__/a.json", "b_0001.json"]),
    ],
)
def test_an_edited_sidecar_in_a_tar(clpipe, write_exr, options, names):
    for name in "ab":
        write_exr(f"in/{name}.exr", np.full((8, 8, 3), 0.25, np.float32))
    run = ("run", "in", "-o", "out", "--device", "numpy", "--webdataset", 2, *options)
    clpipe(*run)
    tar, whole = Path("out/000000.tar"), Path("out/000000.tar").read_bytes()
    for name in names:
        edited_in_tar(tar, name)
        clpipe("report", "out")
        text = Path("out/report.html").read_text()
        assert f"{name}: this sidecar was changed after clpipe wrote it" in text
        clpipe(*run)
        assert tar.read_bytes() == whole


def test_a_dataset_without_what_was_edited_and_cannot_be_made_again(clpipe, write_exr):
    for name in "ab":
        write_exr(f"in/{name}.exr", np.full((8, 8, 3), 0.25, np.float32))
    run = ("dataset", "in", "-o", "out", "--device", "numpy", "--iso", 100)
    clpipe(*run)
    lay_out_anew(Path("out/iso100/a.json"))
    Path("in/a.exr").write_bytes(b"no picture")
    stderr = clpipe(*run, status=1).stderr
    assert f"out/iso100/a.json: {CHANGED}" in stderr
    rows = Path("out/manifest.csv").read_text().splitlines()[1:]
    assert [row.split(",")[0] for row in rows] == ["b"]
