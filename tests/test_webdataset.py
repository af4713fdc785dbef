"""WebDataset shards: their contents for readers, and resuming."""

import io
import json
import os
import re
import tarfile
import threading
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import clpipe as api
from clpipe.base.errors import ImageError, RequestError
from clpipe.batch import tar_sink
from clpipe.batch.run_log import read_log
from clpipe.batch.tars import split_into_tars
from clpipe.batch.work import ImageWorker
from clpipe.inputs.find import Job
from clpipe.outputs import folder as output_folders
from clpipe.outputs import writer
from tests.conftest import stamps, statuses, written
from tests.held import GO, HOLDING, finish, interrupt, start, wait_until

# A chain that other tests compile too.
OTHER = ("-o", "out", "--iso", 3200, "--webdataset")
RUN = (*OTHER, 4)
OUT = Path("out")


@pytest.fixture
def renders(write_exr):
    """A folder of small renders of two sizes, with dots in their names, some in a folder."""

    def write(count=10, folder="in"):
        rng = np.random.default_rng(0)
        for i in range(count):
            size = (24, 32) if i % 2 else (17, 40)
            name = f"sub.x/r{i:03}.exr" if i >= 8 else f"r.{i:03}.exr"
            write_exr(f"{folder}/{name}", rng.random((*size, 3)).astype(np.float32))
        return folder

    return write


def samples(path):
    """The samples of a tar as WebDataset's readers group them: neighbours with the same key."""
    found = []
    with tarfile.open(path) as tar:
        for member in tar:
            key, ending = re.match(r"^((?:.*/|)[^.]+)[.]([^/]*)$", member.name).groups()
            if not found or found[-1]["__key__"] != key:
                found.append({"__key__": key})
            assert ending not in found[-1]
            found[-1][ending] = tar.extractfile(member).read()
    return found


def contents(folder):
    """Each file's bytes, by name, without the logs."""
    names = [n for n in written(Path(folder)) if not n.endswith(".jsonl")]
    return {name: (Path(folder) / name).read_bytes() for name in names}


def test_what_readers_see(clpipe, renders):
    clpipe("run", renders(), *RUN, "--keep", "quantize")
    assert written(OUT) == ["000000.tar", "000001.tar", "000002.tar"]
    tars = [samples(OUT / name) for name in written(OUT)]
    keys = [[s["__key__"] for s in tar] for tar in tars]
    assert keys[1:] == [[f"r_00{i}" for i in range(4, 8)], ["sub.x/r008", "sub.x/r009"]]
    clpipe("run", "in", "-o", "plain", "--iso", 3200, "--keep", "quantize")
    for sample in (sample for tar in tars for sample in tar):
        assert set(sample) == {"__key__", "jpg", "json", "quantize.exr"}
        record = json.loads(sample["json"])
        image = Image.open(io.BytesIO(sample["jpg"]))
        assert image.size == (record["width"], record["height"])
        stem = Path("plain", record["image_key"].partition("@")[0])
        for ending in ("jpg", "quantize.exr"):
            assert sample[ending] == stem.with_suffix(f".{ending}").read_bytes()


def test_an_image_is_done_when_its_tar_exists(clpipe, renders):
    run = api.run(renders(), "out", iso=3200, device="numpy", webdataset=4)
    waiting: list[int] = []
    run.watch = lambda: waiting.append(run.summary.waiting)
    for outcome in run:
        with tarfile.open(OUT / outcome.job.name.partition("/")[0]) as tar:
            assert {n.partition("/")[2] for n in outcome.outputs} <= {*tar.getnames()}
            assert len(outcome.outputs) == 2
    assert run.summary.counts["done"] == 10
    assert max(waiting) >= 4 and waiting[-1] == 0


def test_a_stopped_run_says_what_waits_for_its_tar(clpipe, renders, monkeypatch):
    run = api.run(renders(), "out", iso=3200, device="numpy", webdataset=8, jobs=1)
    stopped, decode = threading.Event(), ImageWorker.begin

    def held(worker, job, *rest):
        assert job.key < "r.004.exr" or stopped.wait(120)
        return decode(worker, job, *rest)

    def watch():
        if run.summary.waiting == 3:
            run.stop()
            stopped.set()

    monkeypatch.setattr(ImageWorker, "begin", held)
    run.watch = watch
    assert list(run) == [] and not (OUT / "000000.tar").exists()
    assert run.summary.made >= 3 and run.summary.interrupted
    kept = run.summary.made
    again = api.run("in", "out", iso=3200, device="numpy", webdataset=8)
    assert [outcome.status for outcome in again].count("skipped") == kept


def test_members_say_nothing_of_who_made_them_when(clpipe, renders):
    clpipe("run", renders(1), *RUN)
    with tarfile.open("out/000000.tar") as tar:
        for m in tar:
            assert (m.mtime, m.uid, m.gid, m.uname, m.gname, m.mode) == (0, 0, 0, "", "", 0o644)


@pytest.mark.parametrize(
    ("options", "pictures"),
    [
        (("--frames", 2), {"truth.jpg", "frame0.jpg", "frame1.jpg"}),
        (("--truth", "mosaic", "--truth", "development"), {"jpg", "truth.jpg", "truth_mosaic.exr"}),
    ],
)
def test_a_burst_and_its_truths_are_one_sample(clpipe, renders, options, pictures):
    clpipe("run", renders(2), *RUN, *options)
    sidecars = {each[:-3] + "json" for each in pictures}
    for sample in samples("out/000000.tar"):
        assert set(sample) - {"__key__"} == pictures | sidecars


def test_a_sidecar_makes_its_picture_again(clpipe, renders):
    clpipe("run", renders(5), *RUN)
    sample = samples("out/000001.tar")[0]
    Path("one.json").write_bytes(sample["json"])
    clpipe("replay", "one.json", "-o", "again")
    assert Path("again/r_004.jpg").read_bytes() == sample["jpg"]


def test_threads_and_shards_do_not_change_a_byte(clpipe, renders):
    clpipe("run", renders(), *RUN)
    clpipe("run", "in", "-o", "b", *RUN[2:], "--jobs", 1)
    for i in (3, 1, 2):
        clpipe("run", "in", "-o", "c", *RUN[2:], "--jobs", 5, "--shard", f"{i}/3")
    assert contents("out") == contents("b") == contents("c")
    assert len(contents("out")) == 3
    result = clpipe("run", "in", "-o", "c", *RUN[2:], "--shard", "4/4")
    assert "shard 4 of 4 has no image" in result.stderr


def test_an_image_that_is_gone_goes_from_its_tar_and_a_new_one_comes(clpipe, renders, write_exr):
    clpipe("run", renders(), *RUN)
    Path("in/sub.x/r009.exr").unlink()
    clpipe("run", "in", *RUN)
    assert [s["__key__"] for s in samples("out/000002.tar")] == ["sub.x/r008"]
    write_exr("in/sub.x/r010.exr", np.full((24, 32, 3), 0.3, np.float32))
    clpipe("run", "in", *RUN)
    assert [s["__key__"] for s in samples("out/000002.tar")] == ["sub.x/r008", "sub.x/r010"]
    assert list(statuses("out").values()).count("done") == 1


@pytest.mark.slow
def test_an_image_that_failed_is_left_out_and_tried_again(clpipe, renders):
    clpipe("run", renders(), "-o", "whole", *RUN[2:])
    whole = Path("in/r.002.exr").read_bytes()
    stamp = Path("in/r.002.exr").stat().st_mtime_ns
    Path("in/r.002.exr").write_bytes(whole[:200])
    result = clpipe("run", "in", *RUN, status=1)
    assert "clpipe: in/r.002.exr: " in result.stderr and "9 of 10 images done" in result.stderr
    assert [s["__key__"] for s in samples("out/000000.tar")] == ["r_000", "r_001", "r_003"]
    before = stamps()
    clpipe("run", "in", *RUN, status=1)
    assert stamps() == before
    Path("in/r.002.exr").write_bytes(whole)
    os.utime("in/r.002.exr", ns=(stamp, stamp))
    clpipe("run", "in", *RUN)
    assert list(statuses("out").values()).count("done") == 1
    assert contents("out") == contents("whole")


def test_tars_stay_where_every_image_fails(clpipe, renders):
    clpipe("run", renders(4), *RUN)
    before = stamps()
    for path in Path("in").iterdir():
        path.write_bytes(b"no image")
    clpipe("run", "in", *RUN, status=1)
    assert stamps() == before
    clpipe("run", "in", "-o", "none", *RUN[2:], status=1)
    assert contents("none") == {}


def test_two_names_of_one_key():
    jobs = [Job(Path("in/a.b.exr"), "a.b.exr"), Job(Path("in/a_b.exr"), "a_b.exr")]
    with pytest.raises(
        RequestError, match=r"in/a\.b\.exr and in/a_b\.exr would both be the sample"
    ):
        split_into_tars(jobs, 1, OUT)
    with pytest.raises(RequestError, match="WebDataset skips folders"):
        split_into_tars([Job(Path("in/__x__/a.exr"), "__x__/a.exr")], 1, OUT)


def test_a_name_longer_than_ustar_holds(clpipe, write_exr):
    name = f"in/{'f' * 80}/{'g' * 120}.exr"
    write_exr(name, np.full((24, 32, 3), 0.3, np.float32))
    clpipe("run", "in", *RUN)
    (sample,) = samples("out/000000.tar")
    assert sample["__key__"] == name[3:-4]


def test_a_tar_of_another_hand_is_not_written_over(clpipe, renders):
    renders(2)
    OUT.mkdir()
    path = OUT / "000000.tar"
    Path("data.json").write_text('{"annotations": []}')
    with tarfile.open(path, "w") as tar:
        tar.add("data.json")
    before = path.read_bytes()
    result = clpipe("run", "in", *RUN, status=2)
    assert "out/000000.tar: clpipe did not write this tar" in result.stderr
    assert path.read_bytes() == before
    clpipe("run", "in", *RUN, "--redo", "all")
    assert len(samples(path)) == 2


def test_tars_of_a_run_with_more_of_them_are_not_mixed_with(clpipe, renders):
    clpipe("run", renders(), *RUN)
    result = clpipe("run", "in", *OTHER, 5, status=2)
    assert "out/000002.tar: is of another run, as this one makes 2 tars" in result.stderr
    Path("out/000002.tar").unlink()
    clpipe("run", "in", *OTHER, 5)
    assert [len(samples(OUT / name)) for name in contents("out")] == [5, 5]


@pytest.mark.slow
@pytest.mark.parametrize("when", ["picture", "tar"])
def test_the_disk_is_full(clpipe, renders, when):
    clpipe("run", renders(), "-o", "whole", *RUN[2:])
    real, count = writer.write_display, []

    with pytest.MonkeyPatch.context() as patch:

        def full(path):
            raise ImageError(f"{path}: cannot be written: No space left on device")

        def write(path, pixels, tags):
            count.append(path)
            if len(count) > 5:
                patch.setattr(output_folders, "MIN_FREE", 2**62)  # more than any disk has
                full(path)
            return real(path, pixels, tags)

        if when == "tar":
            patch.setattr(tar_sink, "atomic_file", full)
        else:
            patch.setattr(writer, "write_display", write)
        result = clpipe("run", "in", *RUN, "--jobs", 1, status=1)
    assert "the same command resumes" in result.stderr
    clpipe("run", "in", *RUN)
    assert list(statuses("out").values()).count("skipped") >= 4
    assert contents("out") == contents("whole")


@pytest.mark.slow
def test_killed_and_resumed_again_and_again(clpipe, renders, tmp_path):
    renders(24)
    clpipe("run", "in", "-o", "whole", *RUN[2:])
    for count in (1, 6, 13):
        process = start("in", *RUN)
        wait_until(
            lambda count=count, process=process: (
                len(logged_as_done()) >= count or process.poll() is not None
            ),
            f"{count} images in the log",
        )
        process.kill()
        finish(process)
    clpipe("run", "in", *RUN)
    assert contents("out") == contents("whole")
    assert not [n for n in os.listdir("out") if n.startswith(".")]
    done = logged_as_done()
    assert len(done) == len(set(done)), "an image was made twice"


def logged_as_done():
    """The images that the log lists as done, by all runs together."""
    try:
        lines = read_log(OUT / "run.jsonl")
    except OSError:
        return []
    return [line["name"] for line in lines if line.get("status") == "done"]


@pytest.mark.slow
def test_stopped_and_gone_on_with(clpipe, renders):
    renders(60)
    process = start("in", *RUN, "--jobs", 1, planted=HOLDING)
    wait_until((OUT / "000000.tar").exists, "the first tar", process)
    interrupt(process)
    Path(GO).touch()
    assert "not begun" in finish(process)
    assert process.returncode == 130
    before = stamps()
    clpipe("run", "in", *RUN)
    assert len(contents("out")) == 15
    assert all(stamps()[n] == at for n, at in before.items() if not n.startswith("."))
    assert not [n for n in os.listdir("out") if n.startswith(".")]


def test_what_is_left_of_a_kill_while_packing_goes(clpipe, renders):
    clpipe("run", renders(4), *RUN)
    whole = contents("out")
    for name in (".000000.0123abcd.part.tar", ".clpipe.000007.tar/r_000.jpg"):
        (OUT / name).parent.mkdir(exist_ok=True)
        (OUT / name).write_bytes(b"half")
    folder = OUT / ".clpipe.000000.tar"  # packed, but not removed any more
    folder.mkdir()
    with tarfile.open(OUT / "000000.tar") as tar:
        tar.extractall(folder, filter="data")
    before = stamps()["000000.tar"]
    clpipe("run", "in", *RUN)
    assert contents("out") == whole and {*os.listdir("out")} - {"run.jsonl"} == {
        "000000.tar",
        *(path.name for path in Path("out").glob("*.run")),
    }
    assert stamps()["000000.tar"] == before


PATCHES = ("--patch", 12, "--augment", "--patches-per-image", 3, "--keep", "quantize")


@pytest.mark.slow
def test_patches_are_samples_as_dataset_makes_them(clpipe, renders):
    options = (*PATCHES, "--truth", "clean", "--format", "npy")
    clpipe("run", renders(3), *RUN, *options)
    found = [s for s in samples("out/000000.tar") if not s["__key__"].startswith("__clpipe__/")]
    keys = [f"r_00{i}_000{n}" for i in range(3) for n in range(3)]
    assert [s.pop("__key__") for s in found] == keys
    given = {"iso": 3200, "patch": api.Patches(12, 3, augment=True), "truth": "clean"}
    floats = api.Dataset("in", **given, dtype="float16")
    raws = api.Dataset("in", **given, raw="mosaic")
    for sample, pictures, made in zip(found, floats, raws, strict=True):
        record = json.loads(sample.pop("json"))
        arrays = {name: np.load(io.BytesIO(data)) for name, data in sample.items()}
        expected = {
            "npy": pictures["image"],
            "truth_clean.npy": pictures["truth"],
            "quantize.npy": made["raw"],
            "truth_clean.quantize.npy": made["truth.raw"],
        }
        assert arrays.keys() == expected.keys()
        for name, array in expected.items():
            assert arrays[name].dtype == array.dtype
            assert np.array_equal(arrays[name], array)
        assert (record["place"], record["turn"]) == (made["place"].tolist(), made["turn"])
        assert record["noise"]["signal"] == {"a": made["a"], "b": made["b"]}
        for name in ("camera", "iso", "seed", "cfa", "black_level", "white_level"):
            assert record[name] == made[name]


def test_patches_in_a_folder(clpipe, renders):
    run = ("run", renders(2), "-o", "plain", "--iso", 3200, *PATCHES, "--format", "png")
    clpipe(*run)
    assert "r.000_0002.png" in written(Path("plain"))
    assert "r.001_0000.quantize.npy" in written(Path("plain"))
    whole = contents("plain")
    Path("plain/r.001_0001.png").unlink()
    clpipe(*run)
    assert list(statuses("plain").values()).count("skipped") == 1
    assert contents("plain") == whole
    clpipe("replay", "plain/r.000.json", "-o", "again")
    assert contents("again") == {n: whole[n] for n in whole if n.startswith("r.000")}


def test_the_variance_of_patches(clpipe, renders):
    given = {"iso": 3200, "until": "normalize", "device": "numpy"}
    options = [o for name, value in given.items() for o in (f"--{name}", value)]
    clpipe("run", renders(1), "-o", "v", *options, "--patch", 11, "--truth", "variance")
    for number, sample in enumerate(api.Dataset("in", **given, patch=11, variance=True)):
        for name, ending in (("image", ""), ("variance", ".truth_variance")):
            assert np.array_equal(np.load(f"v/r.000_{number:04}{ending}.npy"), sample[name])


def test_a_patch_larger_than_an_image_fails_that_image(clpipe, renders):
    result = clpipe("run", renders(2), *RUN, "--patch", 20, "--patches-per-image", "grid", status=1)
    assert "in/r.000.exr: the picture of this image has 40x17 pixels" in result.stderr
    keys = [s["__key__"] for s in samples("out/000000.tar")][1:]
    assert keys == [f"r_001_000{n}" for n in range(4)]
