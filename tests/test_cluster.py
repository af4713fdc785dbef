"""A run through a Dask cluster: two worker processes on this machine."""

import itertools
import json
import os
import signal
import socket
import time
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

import dask
import numpy as np
import pytest
from distributed import Client, LocalCluster, WorkerPlugin

import clpipe as package
from clpipe.batch import dask_client as cluster
from clpipe.batch import dask_worker, work
from clpipe.batch.dask_worker import (
    DaskSpec,
    WorkerEnvironment,
    probe_worker,
    share_on_machine,
    worker_environment,
)
from clpipe.batch.execution import ExecutionOptions
from clpipe.chain.request import ResolvedRequest
from clpipe.commands.progress import Reporter
from clpipe.engine.device import open_devices
from clpipe.engine.discovery import devices_of_process
from clpipe.engine.hardware import Hardware
from clpipe.inputs.find import Job
from tests.conftest import ROOT
from tests.held import GUARD, before

IMAGES = 16


@pytest.fixture(scope="module")
def workers():
    """A client of two worker processes, which restart if they die.

    Dask gives up one that is not back after 15 s, which a busy machine may need.
    """
    with (
        dask.config.set({"distributed.deploy.lost-worker-timeout": "10m"}),
        LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address="127.0.0.1:0") as local,
        Client(local, set_as_default=False) as client,
    ):
        yield client


@pytest.fixture
def address(workers, monkeypatch):
    for limit in ("CONNECT_TIMEOUT", "FIRST_TIMEOUT", "WORKER_TIMEOUT", "LONG_CHUNK"):
        monkeypatch.setattr(cluster, limit, GUARD)  # a busy machine takes its time
    workers.wait_for_workers(2, timeout=GUARD)
    return workers.scheduler.address


@pytest.fixture
def renders(write_exr):
    for i in range(IMAGES):
        pixels = np.random.default_rng(i).random((64, 64, 3)).astype(np.float32)
        write_exr(f"in/f{i:02}.exr", pixels)


def contents(folder):
    """Return the bytes of all files except logs and shared values."""
    found = {p.relative_to(folder): p.read_bytes() for p in Path(folder).rglob("*") if p.is_file()}
    return {path: data for path, data in found.items() if path.suffix not in (".jsonl", ".run")}


def log(folder):
    return [json.loads(line) for line in (Path(folder) / "run.jsonl").read_text().splitlines()]


def die_at_sidecar(number):
    """On a worker: kill the process while it writes the sidecar of that number."""
    write, numbers = work.write_sidecar, itertools.count(1)

    def planted(path, record):
        if next(numbers) == number:
            path.with_name(f".{path.stem}.00000000.part{path.suffix}").write_text("{")
            os.kill(os.getpid(), signal.SIGKILL)
        write(path, record)

    work.write_sidecar = planted


def note_folders():
    """On a worker: record the working directory at each following image."""
    decode, work.folders = work.ImageWorker.begin, set()

    def noting(this, job, *arguments):
        work.folders.add(os.getcwd())
        return decode(this, job, *arguments)

    work.ImageWorker.begin = noting


class DieOf(WorkerPlugin):
    """An image of this name kills each worker, also restarted ones."""

    def __init__(self, name):
        self.name = name

    def setup(self, worker):
        exec(
            before("begin", f"given[1].path.name == {self.name!r} and os.kill(os.getpid(), 9)"), {}
        )


@pytest.mark.slow
def test_one_machine_three_shards_and_a_cluster_that_loses_a_worker(
    clpipe, renders, workers, address
):
    clpipe("run", "in", "-o", "whole", "--jobs", 1)
    whole = contents("whole")
    assert len(whole) == 2 * IMAGES

    backwards = sorted(Path("in").iterdir(), reverse=True)
    for number in (3, 1, 2):
        clpipe("run", *backwards, "-o", "sharded", "--shard", f"{number}/3", "--jobs", 3)
    assert contents("sharded") == whole

    before = set(workers.nthreads())
    workers.run(die_at_sidecar, 5)  # at least one of the two comes so far
    clpipe("run", "in", "-o", "dask", "--dask", address)
    assert contents("dask") == whole
    assert before - set(workers.nthreads())
    start, *images, end = log("dask")
    assert (start["event"], end["event"]) == ("start", "end")
    assert sorted(i["name"] for i in images) == sorted(p.name for p in backwards)
    assert {i["status"] for i in images} <= {"done", "skipped"}
    assert end["done"] + end["skipped"] == IMAGES and end["skipped"] <= 2 * 4

    result = clpipe("run", "in", "-o", "dask", "--dask", address)
    assert f"({IMAGES} of them were there already)" in result.stderr
    assert contents("dask") == whole


@pytest.mark.slow
def test_an_image_that_kills_workers_fails_alone(clpipe, renders, workers, address):
    Path("in/damaged.exr").write_bytes(b"no EXR")
    Path("in/f05.exr").rename("in/deadly.exr")

    def allow(deaths):
        workers.run_on_scheduler(
            lambda dask_scheduler: setattr(dask_scheduler, "allowed_failures", deaths)
        )

    allow(0)
    workers.register_plugin(DieOf("deadly.exr"), name="die")
    try:
        result = clpipe("run", "in", "-o", "out", "--dask", address, status=1)
    finally:
        workers.unregister_worker_plugin("die")
        allow(3)
    failed = {i["name"]: i["error"] for i in log("out")[1:-1] if i["status"] == "failed"}
    assert sorted(failed) == ["damaged.exr", "deadly.exr"]
    assert "killed the worker that took it, 1 in all, the last one tcp" in failed["deadly.exr"]
    assert f"{IMAGES - 1} of {IMAGES + 1} images done" in result.stderr
    assert len(contents("out")) == 2 * (IMAGES - 1)


def test_interrupted_it_finishes_what_is_in_flight(clpipe, renders, address, monkeypatch, tmp_path):
    stops = []

    def interruptible(stop):
        stops.append(stop)
        return nullcontext()

    report = Reporter.report

    def interrupting(self, outcome):
        report(self, outcome)
        stops[0]()  # as Ctrl-C does

    monkeypatch.setattr("clpipe.commands.progress.interruptible", interruptible)
    monkeypatch.setattr(Reporter, "report", interrupting)
    result = clpipe("run", "in", "-o", "out", "--dask", address, status=130)
    assert "not begun" in result.stderr
    images = log("out")[1:-1]
    assert 0 < len(images) < IMAGES
    made = contents("out")
    assert len(made) == 2 * len(images)
    monkeypatch.undo()
    monkeypatch.chdir(tmp_path)
    clpipe("run", "in", "-o", "out", "--dask", address)
    assert len(contents("out")) == 2 * IMAGES
    assert made.items() <= contents("out").items()


def test_a_wrong_request(clpipe, renders, address):
    wrong = ("run", "in", "-o", "out", "--dask", address)
    clpipe(*wrong, "--set", "no=1", status=2)
    assert not Path("out").exists()
    stderr = clpipe(*wrong, "--device", "no such device", status=2).stderr
    assert "worker tcp://" in stderr and "'no such device'" in stderr


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("version", "0.0.9", "workers differ in their version"),
        ("device", "Fast GPU (A Platform), 1 lanes", "Fast GPU (A Platform), 1 lanes on tcp://"),
        ("libraries", "Pillow 1.0", "workers differ in their libraries"),
    ],
)
def test_workers_of_another_make(clpipe, renders, workers, address, name, value, message):
    def pretend(first=0, **to):
        real = dask_worker.real = getattr(dask_worker, "real", worker_environment)
        calls = itertools.count()
        dask_worker.worker_environment = lambda selector: replace(
            real(selector), **(to if next(calls) >= first else {})
        )
        package.__version__ = to.get("version", "0.1.0")

    worker = next(iter(workers.nthreads()))
    workers.run(pretend, **{name: value}, workers=[worker])
    try:
        stderr = clpipe("run", "in", "-o", "out", "--dask", address, status=2).stderr
        assert message in stderr and worker in stderr
        workers.run(pretend, first=1, **{name: value})  # after the probe of all workers
        later = clpipe("run", "in", "-o", "out", "--dask", address, status=2).stderr
        assert f"workers differ in their {name}" in later
        assert not contents("out")
    finally:
        workers.run(pretend)


def test_a_worker_that_comes_later_must_see_the_output(clpipe, renders, workers, address):
    def look_for(name):
        dask_worker.LOCK = name

    workers.run(look_for, ".none")  # the probe of all workers does not look for it
    try:
        stderr = clpipe("run", "in", "-o", "out", "--dask", address, status=2).stderr
        assert "does not see the output directory" in stderr
        assert not contents("out")
    finally:
        workers.run(look_for, ".clpipe.lock")


def test_a_trace_is_told_by_one_clock(clpipe, renders, address):
    start = time.perf_counter()
    options = ("--device", "numpy", "--until", "quantize", "--trace", "t.json")
    clpipe("run", "in/f00.exr", "in/f01.exr", "-o", "out", "--dask", address, *options)
    events = json.loads(Path("t.json").read_text())["traceEvents"]
    threads = [e["args"]["name"] for e in events if e["ph"] == "M"]
    assert threads and all(name.startswith("tcp://") for name in threads)
    ends = [e["ts"] + e["dur"] for e in events if e["ph"] == "X"]
    # Another clock would be hours away: how long this machine has been on, or the time of day.
    minutes, took = 300e6, 1e6 * (time.perf_counter() - start)
    assert len(ends) == 6 and -minutes < min(ends) <= max(ends) < took + minutes


def test_a_worker_sees_the_same_files(tmp_path):
    (tmp_path / "out").mkdir()
    (tmp_path / "probe").touch()
    execution, first = ExecutionOptions(Path("out"), ("numpy",)), Job(Path("a.exr"), "a.exr")
    spec = DaskSpec(
        ResolvedRequest(formats=("jpg",)), execution, first, tmp_path
    ).with_absolute_paths()
    spec = replace(spec, first=spec.absolute_job(first))
    assert probe_worker(spec, "probe", None).startswith("does not see the output directory")
    (tmp_path / "probe").rename(tmp_path / "out" / "probe")
    assert probe_worker(spec, "probe", 3) == f"does not see the input {tmp_path / 'a.exr'}"
    (tmp_path / "a.exr").write_text("abcd")
    assert probe_worker(spec, "probe", 3) == f"does not see the input {tmp_path / 'a.exr'}"
    assert probe_worker(spec, "probe", 4) == worker_environment(("numpy",))
    assert isinstance(probe_worker(spec, "probe", None), WorkerEnvironment)


def test_a_worker_has_a_folder_of_its_own(clpipe, renders, workers, address, tmp_path):
    profile = (ROOT / "clpipe/camera/profiles/sony-a7r2.toml").read_text()
    Path("own").mkdir()
    Path("own/mine.toml").write_text(profile)
    Path("curve.csv").write_text("0,0\n1,1\n")
    Path("own/c.toml").write_text('camera = "mine.toml"\n')
    Path("own/list.csv").write_text("path,name\n../in/f01.exr,a\n../in/no.exr,b\n")
    workers.run(note_folders)
    shared_options = ("--device", "numpy", "--keep", "mosaic", "--format", "png")
    chosen = (*shared_options, "-c", "own/c.toml", "--set", "tone_curve.method=file")
    chosen += ("--set", "tone_curve.path=curve.csv")
    inputs = ("in/f00.exr", "own/list.csv")
    result = clpipe("run", *inputs, *chosen, "-o", "out", "--dask", address, status=1)
    assert "clpipe: own/../in/no.exr: no such file" in result.stderr
    seen = workers.run(lambda: work.folders).values()
    assert set().union(*seen) == set(workers.run(os.getcwd).values()) != {str(tmp_path)}
    clpipe("run", *inputs, *chosen, "-o", "whole", status=1)
    for folder in ("out", "whole"):
        assert json.loads((tmp_path / folder / "f00.json").read_text())["input"] == "in/f00.exr"
    logged = [{(i["input"], i["error"]) for i in log(o)[1:-1]} for o in ("out", "whole")]
    assert logged[0] == logged[1]
    dask, whole = contents("out"), contents("whole")
    assert dask.keys() == whole.keys()
    pictures = [path for path in dask if path.suffix == ".png"]
    assert len(pictures) == 2 and all(dask[path] == whole[path] for path in pictures)
    again = clpipe("run", *inputs, *chosen, "-o", "out", status=1)  # the request is the same
    assert "(2 of them were there already)" in again.stderr
    # The settings in a kept image also name files.
    go_on = ("--start-at", "inverse_white_balance", "--device", "numpy", "--format", "png")
    clpipe("run", "out/f00.mosaic.exr", *go_on, "-o", "next", "--dask", address)
    clpipe("run", "whole/f00.mosaic.exr", *go_on, "-o", "after")
    png = Path("f00.mosaic.png")
    assert contents("next")[png] == contents("after")[png]


def test_workers_of_a_machine_share_its_devices(device):
    at = [Hardware(1, pci=(0, bus, 0, 0)) for bus in (3, 1, 2)]
    gpus = [replace(device.info, index=i, type="GPU", hardware=h) for i, h in enumerate(at)]

    def shared(of, devices=gpus):
        return [[d.hardware.pci[1] for d in devices_of_process(devices, i, of)] for i in range(of)]

    assert shared(1) == [[3, 1, 2]]
    assert shared(2) == [[1, 3], [2]]
    assert shared(3, gpus[::-1]) == [[1], [2], [3]]  # as dask-cuda turns them round
    assert shared(5) == [[1], [2], [3], [1], [2]]
    assert share_on_machine("inproc://10.0.0.1/7/1", ["inproc://10.0.0.1/7/2"]) == (0, 1)
    assert share_on_machine("tcp://[::1]:9", ["tcp://[::1]:8"]) == (1, 2)


def test_what_processes_share_is_for_all_of_them(monkeypatch):
    opened = [open_devices(["0"], share=(i, of))[0] for i, of in ((0, 1), (1, 4))]
    assert 0.2 < opened[1].memory / opened[0].memory < 0.3


def test_an_environment_names_driver_and_libraries(device):
    environment = worker_environment(())
    platform = device.info.handle.platform.version
    assert f"driver {device.info.driver}, {platform}" in environment.device
    for library in ("NumPy", "OpenImageIO", "rawpy", "OpenEXR"):
        assert f"{library} " in environment.libraries


@pytest.mark.slow
def test_a_scheduler_that_cannot_be_reached(clpipe, renders, monkeypatch):
    monkeypatch.setattr(cluster, "CONNECT_TIMEOUT", 0.4)
    with socket.create_server(("127.0.0.1", 0)) as silent:
        port = silent.getsockname()[1]
        for address in (f"tcp://127.0.0.1:{port}", "tcp://127.0.0.1:1", "nonsense", ""):
            stderr = clpipe("run", "in", "-o", "out", "--dask", address, status=2).stderr
            assert f"no Dask scheduler answers at '{address}'" in stderr
    assert not Path("out").exists()


@pytest.mark.slow
def test_a_scheduler_without_workers(clpipe, renders, monkeypatch):
    monkeypatch.setattr(cluster, "CONNECT_TIMEOUT", GUARD)
    monkeypatch.setattr(cluster, "FIRST_TIMEOUT", 0.5)
    monkeypatch.setattr(cluster, "NOTE_SECONDS", 0.1)
    with LocalCluster(n_workers=0, dashboard_address="127.0.0.1:0", processes=False) as empty:
        address = empty.scheduler_address
        stderr = clpipe("run", "in", "-o", "out", "--dask", address, status=2).stderr
        assert f"the scheduler at {address} has no workers" in stderr
        assert f"waiting for a worker; to start one: dask worker {address}" in stderr
    assert not contents("out")


@pytest.mark.slow
def test_an_adaptive_cluster_without_workers_starts_some(clpipe, renders, monkeypatch):
    for limit in ("CONNECT_TIMEOUT", "FIRST_TIMEOUT", "WORKER_TIMEOUT"):
        monkeypatch.setattr(cluster, limit, GUARD)
    clpipe("run", "in", "-o", "whole", "--iso", 3200)
    with LocalCluster(n_workers=0, threads_per_worker=1, dashboard_address="127.0.0.1:0") as local:
        local.adapt(minimum=0, maximum=2, interval="100ms", wait_count=1)
        clpipe("run", "in", "-o", "out", "--iso", 3200, "--dask", local.scheduler_address)
    found, expected = contents("out"), contents("whole")
    pictures = {name for name in expected if name.suffix == ".jpg"}
    assert len(pictures) == IMAGES
    assert all(found[name] == expected[name] for name in pictures)
