"""Existing files in the output directory: skipped, recomputed, or left untouched."""

import json
import os
import time
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from clpipe.batch.run_log import read_log
from clpipe.chain.formats import ALL_FORMATS, extension_of
from clpipe.images.whole import is_complete
from clpipe.outputs.existing import is_marked
from clpipe.outputs.sidecar import output_entries
from tests.conftest import contents, reseal, stamps, statuses

RUN = ("-o", "out", "--device", "numpy", "--keep", "normalize", "--truth", "mosaic")
MADE = ("a.jpg", "a.normalize.exr", "a.truth_mosaic.exr")


@pytest.fixture
def again(clpipe, write_exr):
    """Run an image, and return the files that the run wrote."""
    write_exr("in/a.exr", np.full((8, 8, 3), 0.25, np.float32))

    def run(*options, status=0):
        clpipe("run", "in", *RUN, *options, status=status)
        image = [line for line in read_log(Path("out/run.jsonl")) if line["event"] == "image"][-1]
        return {"done": image["outputs"], "skipped": []}[image["status"]]

    assert set(MADE) < set(run())
    return run


def damaged(path: Path, how: str) -> None:
    data = path.read_bytes()
    flipped = bytes([data[500] ^ 1])
    path.write_bytes(
        {
            "empty": b"",
            "zeros": bytes(len(data)),
            "cut": data[: len(data) // 2],
            "long": data + b"x",
            "flipped": data[:500] + flipped + data[501:],
        }[how]
    )


@pytest.mark.parametrize("name", MADE)
@pytest.mark.parametrize("how", ["gone", "empty", "zeros", "cut"])
def test_what_is_missing_or_damaged_is_made_again(again, name, how):
    path = Path("out", name)
    before, status = path.read_bytes(), path.stat()
    assert again() == []
    if how == "gone":
        path.unlink()
    else:
        damaged(path, how)
        os.utime(path, ns=(status.st_atime_ns, status.st_mtime_ns))  # it looks as old as before
    assert name in again()
    assert path.read_bytes() == before
    assert again() == []


NUMPY = ("-o", "out", "--device", "numpy")
KINDS = {
    "pictures": (NUMPY, ["f0.jpg", "f1.jpg", "f2.jpg"]),
    "patches": ((*NUMPY, "--patch", 6, "--patches-per-image", 2), ["f0_0000.jpg", "f1_0001.jpg"]),
    "sequence": ((*NUMPY, "--sequence"), ["f0.jpg", "f1.jpg", "f2.jpg"]),
    "tars": ((*NUMPY, "--webdataset", 2), ["000000.tar"]),
    "tars of patches": (
        (*NUMPY, "--webdataset", 2, "--patch", 6, "--patches-per-image", 2, "--keep", "quantize"),
        ["000000.tar", "000001.tar"],
    ),
    "clips": ((*NUMPY, "--format", "mkv", "--codec", "ffv1"), ["f.mkv", "f.mkv.jsonl"]),
}


@pytest.mark.parametrize("kind", KINDS)
def test_files_of_each_kind_are_skipped_recomputed_or_left(clpipe, write_exr, kind):
    options, names = KINDS[kind]
    if kind == "clips":
        pytest.importorskip("av", reason="needs PyAV: pip install av")
    for number in range(3):
        write_exr(f"in/f/f{number}.exr", np.full((8, 12, 3), 0.1 + 0.1 * number, np.float32))
    run = ("run", "in/f", *options)
    clpipe(*run)
    before, whole = stamps(), contents("out")
    clpipe(*run)
    assert stamps() == before
    assert set(statuses("out").values()) == {"skipped"}
    for number, name in enumerate(names):
        path = Path("out", name)
        path.write_bytes(whole[name][: len(whole[name]) // 2])
        clpipe(*run)
        assert contents("out") == whole
        path.write_bytes(b"somebody else's" * 20_000)
        for json_ in path.parent.glob(f"{path.stem.partition('_')[0]}*.json"):
            json_.unlink()
        stderr = clpipe(*run, status=(1, 2)).stderr
        assert f"{path}: clpipe did not write this " in stderr
        assert path.read_bytes().startswith(b"somebody")
        clpipe(*run, "--redo", "all")
        assert contents("out") == whole
        before = stamps()
        write_exr("in/f/f1.exr", np.full((8, 12, 3), 0.6 + 0.1 * number, np.float32))
        clpipe(*run)
        made = {name for name, at in stamps().items() if before.get(name) != at}
        assert made == {each for each in before if each.startswith(("f1", "f.", "000000"))}
        whole = contents("out")
    clpipe(*run, "--seed", 1)
    assert set(statuses("out").values()) == {"done"}


@pytest.mark.parametrize("name", MADE)
@pytest.mark.parametrize("how", ["long", "flipped"])
def test_what_is_whole_and_was_changed_is_somebodys(again, clpipe, name, how):
    path = Path("out", name)
    before, status = path.read_bytes(), path.stat()
    damaged(path, how)
    os.utime(path, ns=(status.st_atime_ns, status.st_mtime_ns))  # it looks as old as before
    changed = path.read_bytes()
    for option in (
        (),
        (
            "--redo",
            "damaged",
        ),
        ("--set", "sharpen.amount=0.3"),
    ):
        stderr = clpipe("run", "in", *RUN, *option, status=1).stderr
        sidecar = "a.truth_mosaic.json" if "truth" in name else "a.json"
        assert (
            f"{path}: this file was changed after clpipe wrote it (its SHA-256 differs from "
            in stderr
        )
        assert f"{sidecar})" in stderr and "move it, " in stderr and "use --redo all" in stderr
        assert path.read_bytes() == changed
    assert name in again("--redo", "all")
    assert path.read_bytes() == before


@pytest.mark.parametrize("format_", [each for each in ALL_FORMATS if each != "npy"])
def test_a_picture_that_somebody_edited_is_kept(clpipe, write_exr, format_):
    write_exr("in/a.exr", np.random.default_rng(1).random((40, 60, 3)))
    write_exr("in/b.exr", np.full((20, 30, 3), 0.5, np.float32))
    run = ("run", "in", "-o", "out", "--device", "numpy", "--format", format_)
    clpipe(*run)
    path = Path(f"out/a.{extension_of(format_)}")
    if format_ in ("jpg", "png"):
        with Image.open(path) as picture:
            darker, exif = picture.point(lambda value: value // 2), picture.getexif()
        darker.save(path, exif=exif)
    else:
        path.write_bytes(path.read_bytes() + b"and more")
    changed = path.read_bytes()
    assert is_marked(path)
    stderr = clpipe(*run, status=1).stderr
    assert f"{path}: this file was changed after clpipe wrote it" in stderr
    assert path.read_bytes() == changed
    clpipe(*run, "--redo", "all")


@pytest.mark.parametrize("format_", ALL_FORMATS)
def test_of_every_format_what_is_not_whole_is_made_again(clpipe, write_exr, format_):
    write_exr("in/a.exr", np.random.default_rng(1).random((60, 80, 3)))
    run = ("run", "in", "-o", "out", "--device", "numpy", "--format", format_)
    clpipe(*run)
    path = Path(f"out/a.{extension_of(format_)}")
    whole = path.read_bytes()
    for size in (0, 5, 1000, len(whole) // 2):
        for data in (whole[:size], bytes(len(whole[:size]))):
            path.write_bytes(data)
            assert is_complete(path) is False
    path.write_bytes(whole[: len(whole) // 2])
    if is_marked(path):  # some of a format's tags are at its end
        clpipe(*run)
        assert path.read_bytes() == whole


def test_a_run_that_was_killed_between_a_picture_and_its_new_sidecar(again, clpipe, monkeypatch):
    changed = ("--set", "sharpen.amount=0.3")

    def killed(path, record):
        raise ZeroDivisionError

    with monkeypatch.context() as patch:
        patch.setattr("clpipe.batch.work.write_sidecar", killed)
        clpipe("run", "in", *RUN, *changed, status=1)
    assert not Path("out/a.json").exists()
    assert "a.jpg" in again(*changed)


def test_verify_reads_everything(again):
    path = Path("out/a.jpg")
    before = path.read_bytes()
    damaged(path, "flipped")
    os.utime("out/a.json")  # as if the sidecar had been written after that
    assert again() == []
    assert again("--redo", "damaged") != []
    assert path.read_bytes() == before
    assert again("--redo", "damaged") == []


@pytest.mark.parametrize("how", ["empty", "cut"])
def test_what_lost_its_end_before_its_sidecar_was_written_is_made_again(again, how):
    path = Path("out/a.jpg")
    before = path.read_bytes()
    damaged(path, how)
    os.utime("out/a.json")  # its time says nothing; its size does
    assert "a.jpg" in again()
    assert path.read_bytes() == before


@pytest.mark.parametrize("looks_the_same", [False, True])
def test_an_input_that_is_replaced_by_another_of_its_size(again, write_exr, looks_the_same):
    status = Path("in/a.exr").stat()
    write_exr("in/a.exr", np.full((8, 8, 3), 0.5, np.float32))
    assert Path("in/a.exr").stat().st_size == status.st_size
    if looks_the_same:
        os.utime("in/a.exr", ns=(status.st_atime_ns, status.st_mtime_ns))
        assert again() == []
    assert "a.jpg" in again(*("--redo", "damaged") * looks_the_same)
    assert again() == []


def test_copied_moved_and_dated_elsewhere_it_is_done_still(again, tmp_path):
    os.utime("out/a.json", (0, 0))  # long before its pictures
    assert again() == []
    os.utime("out/a.json", (time.time() + 1e6,) * 2)  # by a clock that was wrong
    assert again() == []


@pytest.mark.parametrize("value", [None, {}, ["a.jpg"], [{"name": "../a.jpg"}], [{"name": 1}]])
def test_a_sidecar_with_a_list_that_is_none_counts_for_nothing(again, value):
    values = json.loads(Path("out/a.json").read_text())
    assert set(output_entries(values)) == {"a.jpg", "a.normalize.exr"}
    reseal(Path("out/a.json"), {**values, "outputs": value})
    assert "a.jpg" in again()


def test_a_picture_beside_our_negative_is_somebody_elses(clpipe, write_exr, tmp_path):
    write_exr("in/a.exr", np.full((8, 8, 3), 0.3, np.float32))
    run = ("run", "in", "-o", "out", "--device", "numpy")
    clpipe(*run, "--format", "dng")
    # A converter's: it repeats the camera of our DNG, and names itself.
    exif = Image.Exif()
    exif[0x010F], exif[0x0110], exif[0x0131] = "Sony", "clpipe ILCE-7RM2", "darktable 5.0"
    Image.new("RGB", (8, 8)).save("out/a.jpg", exif=exif)
    before = Path("out/a.jpg").read_bytes()
    result = clpipe(*run, "--format", "jpg", status=1)
    assert "out/a.jpg: clpipe did not write this file" in result.stderr
    assert Path("out/a.jpg").read_bytes() == before
    clpipe(*run, "--format", "jpg", "--redo", "all")


@pytest.mark.parametrize("name", ["a.jpg", "a.normalize.exr", "a.json"])
@pytest.mark.parametrize("kind", ["link", "pipe", "folder"])
def test_what_is_no_file_is_not_ours(clpipe, write_exr, tmp_path, name, kind):
    write_exr("in/a.exr", np.full((8, 8, 3), 0.3, np.float32))
    path = Path("out", name)
    path.parent.mkdir()
    Path("victim").write_text("keep")
    if kind == "link":
        path.symlink_to("../victim")
    elif kind == "pipe":
        os.mkfifo(path)
    else:
        path.mkdir()
    result = clpipe("run", "in", *RUN, status=1)
    assert f"out/{name}: " in result.stderr
    assert Path("victim").read_text() == "keep"
    assert not list(Path("out").glob("*.truth*"))


def test_pictures_of_inputs_that_are_gone_are_counted(clpipe, write_exr):
    for name in ("in/a", "in/b", "in/sub/c", "other/d"):
        write_exr(f"{name}.exr", np.full((8, 8, 3), 0.3, np.float32))
    run = ("-o", "out", "--device", "numpy")
    clpipe("run", "other", *run)
    clpipe("run", "in", *run, "--truth", "clean")
    there = "no longer exist"
    Path("other/d.exr").unlink()
    assert there not in clpipe("run", "in", *run).stderr  # that is not looked at
    Path("in/b.exr").unlink()
    said = clpipe("run", "in", *run, "--truth", "clean").stderr
    assert said.endswith("\n2 pictures in out are of inputs that no longer exist\n")
    Path("in/sub/c.exr").unlink()
    for given in ("in", "./in/", "in/*.exr", "in/a.exr"):
        count = 4 if given in ("in", "./in/") else 2  # b and its truth; so with c
        told = clpipe("run", given, *run).stderr
        assert f"\n{count} pictures in out are of inputs that {there}" in told
    for option in (("--quiet",), ("--shard", "1/2"), ("--json-lines",)):
        assert there not in clpipe("run", "in", *run, *option).output


@pytest.fixture
def program(monkeypatch):
    """Change the digest of the program."""

    def be(digest):
        for module in ("existing", "record"):
            monkeypatch.setattr(f"clpipe.outputs.{module}.program_digest", lambda: digest)

    return be


@pytest.mark.slow
def test_pictures_of_another_program_are_made_again_and_that_is_said(again, clpipe, program):
    program("f" * 64)
    stderr = clpipe("run", "in", *RUN).stderr
    assert "2 pictures were made by another version of clpipe" in stderr
    assert "and are recomputed; --redo missing keeps them" in stderr
    assert again() == []
    assert "another version" not in clpipe("run", "in", *RUN).stderr
    assert read_log(Path("out/run.jsonl"))[-1]["of_another_program"] == 0


def test_pictures_of_another_program_can_be_kept(again, clpipe, program):
    before = Path("out/a.jpg").read_bytes()
    program("f" * 64)
    assert "and stay (--redo missing)" in clpipe("run", "in", *RUN, "--redo", "missing").stderr
    assert again("--redo", "missing") == []
    assert Path("out/a.jpg").read_bytes() == before
    damaged(Path("out/a.jpg"), "cut")
    assert "a.jpg" in again("--redo", "missing")  # it is kept where it is whole


def test_a_tar_of_another_program(clpipe, write_exr, program):
    write_exr("in/a.exr", np.full((8, 8, 3), 0.25, np.float32))
    run = ("run", "in", *RUN, "--webdataset", "2")
    clpipe(*run)
    program("f" * 64)
    before = Path("out/000000.tar").read_bytes()
    assert "and stay (--redo missing)" in clpipe(*run, "--redo", "missing").stderr
    assert Path("out/000000.tar").read_bytes() == before
    assert "and are recomputed" in clpipe(*run).stderr
    assert Path("out/000000.tar").read_bytes() != before
    assert "another version" not in clpipe(*run).stderr
