"""Batches: resuming, failing images, interruption, progress."""

import contextlib
import errno
import itertools
import json
import logging
import os
import shutil
import signal
import subprocess
import sys
import threading
import tracemalloc
from pathlib import Path

import numpy as np
import pytest

from clpipe.base.errors import DeviceError, ImageError, OutputError, RequestError
from clpipe.batch import replay
from clpipe.batch.job_state import JobState
from clpipe.batch.memory_budget import host_bytes
from clpipe.batch.outcome import DONE, Outcome, Span
from clpipe.batch.run_log import read_log
from clpipe.batch.threads import Batch
from clpipe.batch.trace import Trace
from clpipe.batch.work import ImageWorker
from clpipe.chain.formats import extension_of
from clpipe.chain.request import Request
from clpipe.commands.progress import Reporter
from clpipe.engine.device import Device
from clpipe.engine.runner import Runner
from clpipe.images import write
from clpipe.inputs.find import Job, Shard, parse_shard
from clpipe.inputs.loader import ImageLoader
from clpipe.outputs import folder as output_folders
from clpipe.outputs import record
from clpipe.outputs.folder import LOCK, output_folder, remove_unfinished
from clpipe.outputs.writer import OutputWriter
from tests.conftest import ROOT, contents, reseal, stamps, statuses, values_of, worker_of, written
from tests.held import (
    GO,
    GUARD,
    HOLDING,
    finish,
    interrupt,
    kill_after,
    sidecars,
    start,
    wait_until,
)

# A chain that other tests compile too.
RUN = ("-o", "out", "--iso", 3200)


def test_what_is_missing_or_changed_is_made_again(clpipe, renders, write_exr):
    clpipe("run", renders(), *RUN)
    whole, before = contents("out"), stamps()
    Path("out/r000.jpg").unlink()
    Path("out/r001.json").unlink()
    touched = Path("in/r002.exr")
    os.utime(touched, ns=(1, 1))  # the same bytes
    write_exr("in/r003.exr", np.full((24, 32, 3), 0.3, np.float32))
    clpipe("run", "in", *RUN)
    made = {name for name, at in stamps().items() if before.get(name) != at}
    assert made == {f"r00{i}.{e}" for i in (0, 1, 3) for e in ("jpg", "json")}
    after = contents("out")
    assert {n for n in whole if whole[n] != after[n]} == {"r003.jpg", "r003.json"}


@pytest.mark.parametrize(
    "more",
    [
        ("--seed", 1),
        ("--set", "exposure.ev=1"),
        ("--format", "png"),
        ("--keep", "normalize"),
        ("--set", "output.jpeg_quality=50"),
        ("--noise-key", "ours"),
    ],
)
def test_another_request_is_a_change(clpipe, renders, more):
    clpipe("run", renders(2), *RUN)
    changed = more if "--iso" in more else (*RUN[2:], *more)
    clpipe("run", "in", *RUN[:2], *changed)
    assert set(statuses("out").values()) == {"done"}
    clpipe("run", "in", *RUN[:2], *changed)
    assert set(statuses("out").values()) == {"skipped"}


def test_frames_that_are_missing_are_made_alone(clpipe, renders):
    clpipe("run", renders(1), *RUN, "--frames", 3)
    before, whole = stamps(), contents("out")
    Path("out/r000.frame1.jpg").unlink()
    clpipe("run", "in", *RUN, "--frames", 3)
    made = {name for name, at in stamps().items() if before[name] != at}
    assert made == {"r000.frame1.jpg", "r000.frame1.json"}
    assert contents("out") == whole


@pytest.mark.parametrize(
    "text", ['{"annotations": []}', "[1, 2]", "no JSON", pytest.param("[" * 100_000, id="deep")]
)
def test_a_file_of_another_hand_is_not_written_over(clpipe, renders, text):
    renders(2)
    Path("out").mkdir()
    Path("out/r000.json").write_text(text)
    result = clpipe("run", "in", *RUN, status=1)
    assert "out/r000.json: clpipe did not write this file" in result.stderr
    assert Path("out/r000.json").read_text() == text
    assert statuses("out") == {"r000.exr": "failed", "r001.exr": "done"}
    clpipe("run", "in", *RUN, "--redo", "all")
    assert json.loads(Path("out/r000.json").read_text())["clpipe"]


def test_order_threads_and_shards_do_not_change_a_byte(clpipe, renders):
    renders(7)
    names = sorted(str(p) for p in Path("in").iterdir())
    clpipe("run", *names, *RUN)
    clpipe("run", *reversed(names), "-o", "b", *RUN[2:], "--jobs", 1)
    for i in (3, 1, 2):
        clpipe("run", *names, "-o", "c", *RUN[2:], "--jobs", 5, "--shard", f"{i}/3")
    one, two, three = (contents(f) for f in ("out", "b", "c"))
    assert one == two
    logs = {f"run.{i}-of-3.jsonl" for i in (1, 2, 3)}
    assert {n: b for n, b in three.items() if n not in logs} == one
    assert logs < set(three)


def test_a_shard_without_images_is_no_mistake(clpipe, renders):
    result = clpipe("run", renders(2), *RUN, "--shard", "3/3")
    assert "shard 3 of 3 has no images" in result.stderr
    assert not Path("out").exists()


@pytest.mark.slow
def test_several_devices_share_a_run(clpipe, renders, tmp_path):
    clpipe("run", renders(24), "-o", "whole", *RUN[2:])
    both = ("--device", "0", "--device", "1")
    environment = {"POCL_DEVICES": "pthread pthread"}
    process = start("in", *RUN, *both, environment=environment)
    stderr = finish(process)
    if "unknown device '1'" in stderr:
        pytest.skip("needs PoCL, which makes two devices of one CPU")
    assert process.returncode == 0, stderr
    assert contents("out") == contents("whole")


@pytest.mark.slow
def test_memory_does_not_grow_with_the_number_of_images(renders, tmp_path):
    renders(1)
    code = (
        "import sys; from clpipe.base.memory import peak_memory\n"
        "from clpipe.commands.main import main\n"
        "try: main(sys.argv[1:])\n"
        "except SystemExit as end: assert not end.code, end.code\n"
        "print(peak_memory())"
    )
    peaks = []
    for count in (20, 200):
        for i in range(count):
            link = tmp_path / f"many{count}" / f"{i}.exr"
            link.parent.mkdir(exist_ok=True)
            link.symlink_to(tmp_path / "in" / "r000.exr")
        command = [sys.executable, "-c", code, "run", f"many{count}", "-o", f"o{count}", "--quiet"]
        environment = {**os.environ, "PYTHONPATH": str(ROOT)}
        done = subprocess.run(
            command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=True
        )
        peaks.append(int(done.stdout))
    assert peaks[1] < peaks[0] + 16 * 2**20, peaks


def test_the_log_says_what_was_done_when(clpipe, renders):
    clpipe("run", renders(2), *RUN)
    with open("out/run.jsonl", "ab") as file:
        file.write(b'{"event": "ima')  # as a killed run may leave it
    clpipe("run", "in", *RUN, "--seed", 1)
    lines = read_log(Path("out/run.jsonl"))
    assert [x["event"] for x in lines] == ["start", "image", "image", "end"] * 2
    image = lines[1]
    assert image["status"] == "done" and image["error"] is None
    assert image["outputs"] == [Path(image["input"]).stem + e for e in (".jpg", ".json")]
    assert all(image[f"{step}_seconds"] > 0 for step in ("decode", "device", "encode"))
    assert lines[3]["done"] == 2 and lines[3]["images"] == 2 and not lines[3]["interrupted"]
    assert lines[3]["peak_memory"] > 20 << 20


def test_quiet_and_stdout(clpipe, renders):
    renders(3)
    Path("in/r001.exr").write_bytes(b"no image")
    result = clpipe("run", "in", *RUN, "--quiet", status=1)
    assert result.stdout == ""
    (line,) = result.stderr.splitlines()
    assert line.startswith("clpipe: in/r001.exr: ")
    result = clpipe("run", "in", "-o", "b", status=1)
    assert result.stdout == ""
    assert "in/r000.exr -> b/r000.jpg" in result.stderr


def test_a_trace_for_perfetto(clpipe, renders):
    clpipe("run", renders(3), *RUN, "--trace", "trace.json")
    events = json.loads(Path("trace.json").read_text())["traceEvents"]
    spans = [e for e in events if e["ph"] == "X"]
    assert {e["cat"] for e in spans} == {"decode", "device", "encode", "launch"}
    names = {e["tid"]: e["args"]["name"] for e in events if e["ph"] == "M"}
    for device in (e for e in spans if e["cat"] == "device"):
        assert names[device["tid"]].startswith("device")
    inside = [e for e in spans if e["cat"] == "launch"]
    assert {"upload", "download", "quantize"} & {e["name"] for e in inside}
    for launch in inside:
        whole = [e for e in spans if e["cat"] == "device" and e["tid"] == launch["tid"]]
        slack = 200  # us: two clocks
        assert any(
            e["ts"] - slack <= launch["ts"]
            and launch["ts"] + launch["dur"] <= e["ts"] + e["dur"] + slack
            for e in whole
        )


def test_the_trace_of_a_run_that_ends_early(clpipe, renders, monkeypatch):
    run = ("run", renders(6), "-o", "out", "--device", "numpy", "--stages", "exposure,gamma")

    def stop(self, outcome):
        raise OutputError("the disk is full")

    with monkeypatch.context() as patch:
        patch.setattr(Reporter, "report", stop)
        clpipe(*run, "--jobs", 1, "--trace", "folder/t.json", status=1)
    assert json.loads(Path("folder/t.json").read_text())["traceEvents"]
    assert written(Path("folder")) == ["t.json"]
    clpipe(*run, "--redo", "all", "--trace", "folder/t.json")  # one of its own
    assert len(json.loads(Path("folder/t.json").read_text())["traceEvents"]) > 3 * 6


def test_a_trace_is_not_held_in_memory(tmp_path):
    spans = tuple(Span(step, "device 0", 1.0, 0.5) for step in ("decode", "device", "encode"))
    outcome = Outcome(Job(tmp_path / "a.exr", "a"), DONE, spans=spans)
    tracemalloc.start()
    with Trace(tmp_path / "t.json") as trace:
        for _ in range(100):
            trace.add(outcome)
        before = tracemalloc.get_traced_memory()[0]
        for _ in range(600):
            trace.add(outcome)
        assert tracemalloc.get_traced_memory()[0] < before + 20_000
        tracemalloc.stop()
        (extra_images,) = tmp_path.iterdir()
        # What a killed process leaves can be read: the array needs no end.
        text = extra_images.read_text().rpartition(",\n")[0] + "]}"
        assert len(json.loads(text)["traceEvents"]) > 100
    events = json.loads((tmp_path / "t.json").read_text())["traceEvents"]
    assert len(events) == 1 + 3 * 700


def test_a_trace_that_cannot_be_written_stops_no_image(clpipe, renders, monkeypatch):
    def full(self, outcome):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(Trace, "_events", full)
    run = ("run", renders(3), "-o", "out", "--device", "numpy", "--stages", "exposure,gamma")
    stderr = clpipe(*run, "--trace", "t.json", status=1).stderr
    assert "t.json: cannot be written: No space left on device" in stderr
    assert len(written(Path("out"))) == 6
    assert not list(Path().glob("*t.json"))


@pytest.mark.parametrize("options", [(), ("--webdataset", 2)])
def test_a_disk_without_room_is_no_problem_where_all_is_done(clpipe, renders, monkeypatch, options):
    clpipe("run", renders(2), *RUN, *options)
    before = contents("out")

    def full(descriptor, offset, length):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "posix_fallocate", full)
    assert "2 of them were there already" in clpipe("run", "in", *RUN, *options).stderr
    stderr = clpipe("run", "in", *RUN, *options, "--seed", 7, status=1).stderr
    assert (
        "out: cannot write to this directory: No space left on device (8.0 MiB are needed); "
        in stderr
    )
    assert {name: data for name, data in contents("out").items() if name in before} == before


@pytest.mark.slow
def test_two_runs_in_one_folder(tmp_path):
    holder = (
        "import sys; from pathlib import Path; from clpipe.outputs.folder import output_folder\n"
        "from clpipe.inputs.find import Shard\n"
        "with output_folder(Path('out'), Shard(1, 2)): print('held', flush=True); input()"
    )
    with subprocess.Popen(
        [sys.executable, "-c", holder],
        cwd=tmp_path,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    ) as process:
        process.stdout.readline()
        for shard in (Shard(), Shard(1, 2), Shard(1, 3)):
            with (
                pytest.raises(RequestError, match="another run is writing to this directory"),
                output_folder(tmp_path / "out", shard),
            ):
                pass
        with output_folder(tmp_path / "out", Shard(2, 2)):
            pass
        assert (tmp_path / "out" / LOCK).exists()
        process.kill()
    with output_folder(tmp_path / "out", Shard()):
        pass
    assert not list((tmp_path / "out").iterdir())


STOPPED_TWICE = """
import os, signal
from pathlib import Path
from clpipe.batch.interrupt import interruptible
from clpipe.inputs.find import Shard
from clpipe.outputs.folder import output_folder
with output_folder(Path("out"), Shard(1, 2)), interruptible(lambda: None):
    for _ in range(2):
        os.kill(os.getpid(), signal.SIGINT)
    signal.pause()
"""


@pytest.mark.slow
@pytest.mark.parametrize("is_shared", [False, True])
def test_a_run_that_is_stopped_twice_removes_its_lock(tmp_path, is_shared):
    out, other = tmp_path / "out", Shard(2, 2)
    with output_folder(out, other) if is_shared else contextlib.nullcontext():
        ended = subprocess.run(
            [sys.executable, "-c", STOPPED_TWICE],
            cwd=tmp_path,
            env={**os.environ, "PYTHONPATH": str(ROOT)},
        )
        assert ended.returncode == 130
        assert [path.name for path in out.iterdir()] == [LOCK] * is_shared
    assert not is_shared or not list(out.iterdir())


def test_halves_of_a_killed_run_are_removed(tmp_path):
    ours = (".a.0123abcd.part.jpg", "sub/.b.c.normalize.0123abcd.part.exr")
    others = (".x.0123abcd.part.jpg", ".a.part.jpg", "a.jpg", ".a.0123abc.part.jpg")
    for name in (*ours, *others):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    patches = (".a_0001.0123abcd.part.npy", "sub/.b.c_0002.normalize.0123abcd.part.npy")
    for name in patches:
        (tmp_path / name).touch()
    jobs = [Job(Path("a.exr"), "a.exr"), Job(Path("b"), "sub/b.c.exr")]
    remove_unfinished(tmp_path, jobs)
    assert written(tmp_path) == sorted((*others, *patches))
    remove_unfinished(tmp_path, jobs, patches=True)
    assert written(tmp_path) == sorted(others)


def test_the_disk_is_full(clpipe, renders, monkeypatch):
    renders(5)
    real, count = write._write, []

    def fail_to_write(path, spec, pixels):
        count.append(path)
        if len(count) > 2:
            monkeypatch.setattr(output_folders, "MIN_FREE", 2**62)  # more than any disk has
            raise ImageError(f"{path}: cannot be written: the disk is full")
        return real(path, spec, pixels)

    monkeypatch.setattr(write, "_write", fail_to_write)
    result = clpipe("run", "in", *RUN, "--jobs", 1, status=1)
    assert "clpipe: out: cannot write to this directory: " in result.stderr
    assert "the same command resumes" in result.stderr
    assert len(written(Path("out"))) == 4
    monkeypatch.undo()


def test_the_folder_has_gone(clpipe, renders, monkeypatch):
    renders(5)
    real = write._write

    def fail_to_write(path, spec, pixels):
        stored = real(path, spec, pixels)
        if path.name == "r002.jpg":
            wait_until(lambda: sidecars(Path("out")) >= 2, "2 sidecars")
            Path("out").rename("elsewhere")
        return stored

    monkeypatch.setattr(write, "_write", fail_to_write)
    result = clpipe("run", "in", *RUN, "--jobs", 1, status=1)
    assert "out: " in result.stderr and "the same command resumes" in result.stderr
    assert not Path("out").exists()
    assert {"r000.jpg", "r000.json"} <= set(written(Path("elsewhere")))


def test_a_manifest_and_draws(clpipe, renders):
    renders(2)
    Path("in/list.csv").write_text(
        "path,name,iso,seed,frames,sensor_noise.a\n"
        "r000.exr,a/low.0001,400,,,\n"
        "r000.exr,a/high,12800,3,,\n"
        'r001.exr,,,,2,"{uniform = [1e-4, 1e-3]}"\n'
    )
    clpipe("run", "in/list.csv", *RUN)
    burst = [f"r001.{n}" for n in ("truth", "frame0", "frame1")]
    names = [f"{n}.{e}" for n in ("a/low.0001", "a/high", *burst) for e in ("jpg", "json")]
    assert written(Path("out")) == sorted(names)
    low, high, one, two = (
        json.loads(Path(f"out/{n}.json").read_text())
        for n in ("a/low.0001", "a/high", "r001.frame0", "r001.frame1")
    )
    assert (low["iso"], high["iso"], high["seed"], one["iso"]) == (400, 12800, 3, 3200)
    assert low["image_key"].startswith("a/low.0001@") and one["image_key"].startswith("r001.exr@")
    assert 1e-4 < one["noise"]["signal"]["a"] == two["noise"]["signal"]["a"] < 1e-3
    whole = contents("out")
    lines = Path("in/list.csv").read_text().splitlines()
    Path("in/list.csv").write_text("\n".join([lines[0], *reversed(lines[1:])]))
    clpipe("run", "in/list.csv", *RUN)
    assert set(statuses("out").values()) == {"skipped"}
    clpipe("run", "in/list.csv", *RUN, "--redo", "all", "--jobs", 1)
    assert contents("out") == whole
    Path("in/list.csv").write_text("\n".join(lines).replace("12800", "6400"))
    clpipe("run", "in/list.csv", *RUN)
    assert statuses("out") == {"a/low.0001": "skipped", "a/high": "done", "r001.exr": "skipped"}


@pytest.mark.slow
def test_what_is_drawn_for_an_image_is_drawn_again_where_it_re_enters(clpipe, renders):
    renders(3)
    Path("draws.toml").write_text("iso = { log_uniform = [200, 12800] }\n")
    draws = ("-c", "draws.toml", "--format", "png")
    clpipe("run", "in", "-o", "out", *draws, "--keep", "demosaic")
    isos = [json.loads(Path(f"out/r00{i}.json").read_text())["iso"] for i in range(3)]
    assert len(set(isos)) == 3
    clpipe("run", "out", "-o", "again", *draws, "--start-at", "denoise")
    for i in range(3):
        one, two = Path(f"out/r00{i}.png"), Path(f"again/r00{i}.demosaic.png")
        assert one.read_bytes() == two.read_bytes()


@pytest.mark.parametrize("text", ["0/3", "4/3", "1", "1/", "a/b", "1/0", "-1/3", "1.0/3"])
def test_a_wrong_shard(text):
    with pytest.raises(RequestError, match="expected I/N"):
        parse_shard(text)


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_stopped_once_what_is_begun_is_finished(clpipe, renders, tmp_path, number):
    renders(60)
    process = start("in", *RUN, "--jobs", 1, planted=HOLDING)
    wait_until(lambda: sidecars(tmp_path / "out") == 20, "the images before the held one", process)
    interrupt(process, number)
    Path(GO).touch()
    assert "not begun" in finish(process)
    assert process.returncode == 130
    found = written(tmp_path / "out")
    assert found == sorted(f"r{i:03}.{e}" for i in range(21) for e in ("jpg", "json"))
    assert read_log(tmp_path / "out" / "run.jsonl")[-1]["interrupted"]
    clpipe("run", "in", *RUN)
    assert len(written(tmp_path / "out")) == 120


def test_stopped_twice_it_ends_now(clpipe, renders, tmp_path):
    renders(60)
    process = start("in", *RUN, "--jobs", 1, planted=HOLDING)
    wait_until(lambda: sidecars(tmp_path / "out") == 20, "the images before the held one", process)
    interrupt(process)
    process.send_signal(signal.SIGINT)  # the held image never ends
    finish(process)
    assert process.returncode == 130
    assert not [p for p in (tmp_path / "out").iterdir() if ".part." in p.name]


@pytest.mark.slow
def test_killed_and_resumed_again_and_again(clpipe, renders, tmp_path):
    renders(24)
    clpipe("run", "in", "-o", "whole", *RUN[2:])
    finished = {}
    for count in (1, 7, 16):
        kill_after(start("in", *RUN), tmp_path / "out", count)
        for name in written(tmp_path / "out"):
            if name.endswith(".json") and not name.startswith("."):
                at = (tmp_path / "out" / name).stat().st_mtime_ns
                assert finished.setdefault(name, at) == at, f"{name} was made again"
        assert len(finished) >= count
    clpipe("run", "in", *RUN)
    assert contents("out") == contents("whole")


def test_a_sidecar_makes_its_picture_again(clpipe, renders):
    renders(2)
    Path("draws.toml").write_text("iso = { log_uniform = [200, 12800] }\n")
    Path("in/list.csv").write_text("path,name,frames,seed\nr000.exr,a/x.1,3,5\nr001.exr,,,\n")
    options = ("--truth", "variance", "--keep", "normalize", "--format", "png", "--format", "dng")
    clpipe("run", "in/list.csv", "-o", "out", "-c", "draws.toml", *options)
    whole = contents("out")
    for name in (n for n in whole if n.endswith(".json")):
        clpipe("replay", f"out/{name}", "-o", "again")
    assert contents("again") == whole
    clpipe("replay", "out/r001.json", "-o", "again")
    assert set(statuses("again").values()) == {"skipped"}


def test_a_sidecar_whose_picture_cannot_be_the_same(clpipe, renders, monkeypatch):
    Path("mine.toml").write_text((ROOT / "clpipe/camera/profiles/sony-a7r2.toml").read_text())
    clpipe("run", renders(2), *RUN, "--camera", "mine.toml")

    def refused(*more):
        return clpipe("replay", "out/r000.json", "-o", "b", *more, status=2).stderr

    assert "No such option '--iso'" in refused("--iso", 100)
    assert "unexpected extra argument" in refused("in/r000.exr", "in/r001.exr")
    Path("in/r000.exr").rename("moved.exr")
    assert "in/r000.exr: cannot be read" in refused()
    assert "in/r001.exr: this file has changed" in refused("in/r001.exr")
    clpipe("replay", "out/r000.json", "moved.exr", "-o", "b")
    assert Path("b/r000.jpg").read_bytes() == Path("out/r000.jpg").read_bytes()
    Path("mine.toml").write_text(Path("mine.toml").read_text() + "\n")
    assert "mine.toml: this file has changed" in refused("moved.exr")
    for module in (record, replay):
        monkeypatch.setattr(module, "__version__", "9.9.9")
    assert "it is of clpipe 0" in refused("moved.exr")
    assert "clpipe did not write" in clpipe("replay", "mine.toml", "-o", "b", status=2).stderr
    Path("half.json").write_text('{"clpipe": "9.9.9", "request": {}}')
    assert "was changed after" in clpipe("replay", "half.json", "-o", "b", status=2).stderr
    reseal(Path("half.json"), {"clpipe": "9.9.9", "request": {}})
    assert "it is damaged" in clpipe("replay", "half.json", "-o", "b", status=2).stderr
    assert "no such file" in clpipe("replay", "no.json", "-o", "b", status=2).stderr


@pytest.mark.parametrize("format_", ["jpg", "exr", "npy", "dng"])  # of each way to mark a file
def test_a_picture_of_another_hand_is_not_written_over(clpipe, renders, format_):
    run = ("run", renders(1), *RUN, "--device", "numpy", "--format", format_)
    clpipe(*run)
    Path("out/r000.json").unlink()
    clpipe(*run)  # as a killed run may have left it
    Path("out/r000.json").unlink()
    picture = Path(f"out/r000.{extension_of(format_)}")
    picture.write_bytes(b"somebody else's" * 20_000)
    assert f"{picture}: clpipe did not write this file" in clpipe(*run, status=1).stderr
    assert picture.read_bytes().startswith(b"somebody")
    clpipe(*run, "--redo", "all")


def test_a_link_that_leads_nowhere_is_a_failed_image(clpipe, renders):
    Path(renders(1), "gone.exr").symlink_to("/nowhere/gone.exr")
    assert "in/gone.exr: no such file" in clpipe("run", "in", *RUN, status=1).stderr
    assert statuses("out") == {"r000.exr": "done", "gone.exr": "failed"}


def test_a_file_is_the_same_however_it_is_spelled(clpipe, renders, tmp_path, monkeypatch):
    Path("mine.toml").write_text((ROOT / "clpipe/camera/profiles/sony-a7r2.toml").read_text())
    clpipe("run", renders(2), *RUN, "--camera", "mine.toml")
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    clpipe("run", "../in", "-o", "../out", *RUN[2:], "--camera", "../mine.toml")
    assert set(statuses("../out").values()) == {"skipped"}
    Path("../mine.toml").write_text(Path("../mine.toml").read_text() + "\n")
    clpipe("run", "../in", "-o", "../out", *RUN[2:], "--camera", "../mine.toml")
    assert set(statuses("../out").values()) == {"done"}


def test_what_a_trace_must_not_write_over(clpipe, renders):
    renders(1)
    Path("notes.json").write_text("{}")
    for name in ("in/r000.exr", "notes.json", ".", "in"):
        assert "--trace: " in clpipe("run", "in", *RUN, "--trace", name, status=2).stderr
    assert not Path("out").exists()
    for _ in range(2):
        clpipe("run", "in", *RUN, "--trace", "trace.json")


def test_a_sidecar_that_somebody_edited(clpipe, renders):
    clpipe("run", renders(1), *RUN)
    record = json.loads(Path("out/r000.json").read_text())
    names = {"name": "../../evil"}, {"name": "/tmp/evil"}, {"frames": -3}, {"picture": ".frame9"}
    requests = {"formats": []}, {"options": 3}, {"image_name": None}
    for changed in (*names, *({"request": record["request"] | each} for each in requests)):
        reseal(Path("edited.json"), record | changed)
        stderr = clpipe("replay", "edited.json", "-o", "b", status=2).stderr
        assert "edited.json: it is damaged" in stderr, changed
    assert not Path("b").exists()


def test_a_replay_with_other_bytes_says_what_was_different(clpipe, renders):
    clpipe("run", renders(1), *RUN)
    sidecar_ = Path("out/r000.json")
    record = json.loads(sidecar_.read_text())
    record["outputs"][0]["sha256"] = "0" * 64

    record = {**values_of(sidecar_), "outputs": record["outputs"]}
    del record["run"]  # what it shares is in the sidecar itself

    def differs(**changes):
        reseal(sidecar_, {**record, **changes})
        shutil.rmtree("d", ignore_errors=True)
        return clpipe("replay", sidecar_, "-o", "d", status=1).stderr

    assert "d/r000.jpg: other bytes (r000.jpg): by the same program and device" in differs()
    versions = {**record["versions"], "OpenImageIO": "1.2.3"}
    now = record["versions"]["OpenImageIO"]
    assert f"made with OpenImageIO 1.2.3 (now {now})" in differs(versions=versions)
    for key, value in (("driver", "9.9"), ("name", "GPU"), ("lanes", 3), ("target", "knl")):
        device = {**record["device"], key: value}
        assert f"made with device {key} {value} (now " in differs(device=device)
    was, now = "ab" * 6, record["program"][:12]
    assert f"made with program {was} (now {now})" in differs(program="ab" * 32)


class Panic(BaseException):
    """An exception like those of Rust extensions."""


# Where an image is decoded, developed and encoded.
INSIDE = {
    "decode": (ImageLoader, "read"),
    "order": (OutputWriter, "results"),
    "device": (Runner, "work"),
    "finish": (ImageWorker, "finish"),
    "encode": (OutputWriter, "write"),
}


@pytest.mark.parametrize("step", INSIDE)
@pytest.mark.parametrize(
    ("error", "text"),
    [
        (ValueError("a mistake of ours"), "unexpected ValueError: a mistake of ours"),
        (Panic("of a library"), "unexpected Panic: of a library"),
        (SystemExit(0), "unexpected SystemExit: 0"),
        (MemoryError(), "there is not enough memory for it"),
    ],
)
def test_what_nobody_expected_fails_its_image_alone(
    clpipe, renders, monkeypatch, caplog, step, error, text
):
    owner, name = INSIDE[step]
    right, calls = getattr(owner, name), itertools.count()

    def planted(*arguments, **options):
        if next(calls) == 2:
            raise error
        return right(*arguments, **options)

    renders(6)
    run = ("run", "in", "-o", "out", "--device", "numpy", "--stages", "exposure,gamma")
    with monkeypatch.context() as patch, caplog.at_level(logging.DEBUG, "clpipe.batch.job_state"):
        patch.setattr(owner, name, planted)
        stderr = clpipe(*run, status=1).stderr
    (failed,) = [key for key, status in statuses("out").items() if status == "failed"]
    assert f"clpipe: in/{failed}: {text}" in stderr
    assert "5 of 6 images done, 1 failed" in stderr
    assert not [name for name in written(Path("out")) if name.startswith(failed[:4])]
    records = [r for r in caplog.records if r.name == "clpipe.batch.job_state"]
    assert [r.levelname for r in records] == ["DEBUG"] * (not isinstance(error, MemoryError))
    assert all(r.exc_info[1] is error for r in records)
    clpipe(*run)
    assert "failed" not in statuses("out").values()


def test_a_thread_that_dies_ends_the_run(renders, tmp_path, monkeypatch):
    renders(30)
    (tmp_path / "out").mkdir()
    worker, jobs = worker_of(tmp_path)
    for dies in (Panic, ValueError):
        caught = []

        def die(*_, dies=dies):
            raise dies("a mistake of ours")

        def run(batch, caught=caught):
            try:
                list(batch.run(jobs))
            except Exception as error:
                caught.append(str(error))

        with monkeypatch.context() as patch:
            patch.setattr(JobState, "outcome", die)  # an error in the scheduling of images
            thread = threading.Thread(target=run, args=(Batch(worker, [None], 1),), daemon=True)
            thread.start()
            thread.join(GUARD)
            assert not thread.is_alive()
        assert len(caught) == 1 and "a mistake of ours" in caught[0]


@pytest.mark.parametrize(
    ("name", "error", "text"),
    [
        ("device", RequestError, "--jobs: 2: no thread can be started for 'device'"),
        ("encode", RuntimeError, "can't start new thread"),
    ],
)
def test_threads_that_cannot_start_end_the_run(renders, tmp_path, monkeypatch, name, error, text):
    renders(6)
    (tmp_path / "out").mkdir()
    worker, jobs = worker_of(tmp_path)
    start, caught = threading.Thread.start, []

    def starting(thread):
        if thread.name.startswith(name):
            raise RuntimeError("can't start new thread")
        start(thread)

    def run():
        try:
            list(Batch(worker, [None], 2).run(jobs))
        except Exception as problem:
            caught.append(problem)

    monkeypatch.setattr(threading.Thread, "start", starting)
    running = threading.Thread(target=run, daemon=True, name="run")
    running.start()
    running.join(GUARD)
    assert [type(each) for each in caught] == [error] and text in str(caught[0])


def test_a_run_that_skips_all_images_starts_no_device(device, renders, tmp_path):
    renders(4)
    (tmp_path / "out").mkdir()

    class Unused(Device):
        def submit(self, works):
            raise DeviceError("it is used")

    worker, jobs = worker_of(tmp_path)
    assert [o.status for o in Batch(worker, [device]).run(jobs)] == ["done"] * 4
    worker, jobs = worker_of(tmp_path)
    unused = Unused(device.info)
    unused.is_compiled = lambda _: False
    assert [o.status for o in Batch(worker, [unused]).run(jobs)] == ["skipped"] * 4


def test_what_a_device_leaves_another_does(device, renders, tmp_path, caplog):
    renders(8)
    (tmp_path / "out").mkdir()
    worker, jobs = worker_of(tmp_path)
    is_broken = threading.Event()

    class Broken(Device):
        def submit(self, works):
            is_broken.set()
            raise DeviceError("it is given up")

    class Other(Device):
        def submit(self, works):
            assert is_broken.wait(GUARD)
            return super().submit(works)

    broken = Broken(device.info)
    broken.is_compiled = Other.is_compiled = lambda *_: True
    outcomes = list(Batch(worker, [broken, Other(device.info)]).run(jobs))
    assert [o.status for o in outcomes] == ["done"] * 8
    assert "it is given up; the other devices continue" in caplog.text
    for path in (tmp_path / "out").iterdir():
        path.unlink()
    with pytest.raises(DeviceError, match="it is given up"):
        list(Batch(worker_of(tmp_path)[0], [broken]).run(jobs))


def test_what_images_take(tmp_path, write_exr):
    loader = ImageLoader(Request())
    chain = loader.chain
    exr = loader.claim(Job(write_exr("a.exr", np.zeros((10, 20, 3), np.float32)), "a"))
    assert host_bytes(exr, chain, 1, ("jpg",), ()) == 200 * (6 + 3 + 1)
    deep = 200 * (6 + 3 * (3 + 12 * 2 + 24))
    assert host_bytes(exr, chain, 3, ("jpg", "exr"), ("mosaic",)) == deep
    assert host_bytes(exr, chain, 1, ("jpg",), (), 2) == 200 * (6 + 3 + 1 + 24)
    smaller = Request({"stages": ["exposure", "resize"], "resize": {"scale": 0.5}}).chain()
    assert host_bytes(exr, smaller, 1, ("exr",), ()) == 200 * 6 + 50 * (3 + 12 + 24)
    raw = tmp_path / "a.nef"
    raw.write_bytes(bytes(1000))
    claim = loader.claim(Job(raw, "b"))
    assert host_bytes(claim, chain, 1, ("dng",), ()) == 1000 * (4 + 3 + 12 + 12)
    missing = loader.claim(Job(tmp_path / "missing.exr", "c"))
    assert host_bytes(missing, chain, 1, ("jpg",), ()) == 0
    # What is refused for its size takes nothing, and its message is that of reading.
    few = ImageLoader(Request(max_pixels=199))
    assert few.claim(Job(tmp_path / "a.exr", "a")).reading == 0
