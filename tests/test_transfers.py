"""Requests to file systems that fail, stall or are stopped."""

import json
import threading
from collections import Counter
from pathlib import Path
from typing import ClassVar

import fsspec
import numpy as np
import pytest
from fsspec.implementations.memory import MemoryFileSystem

import clpipe as package
from clpipe.base import transfers, urls
from clpipe.base.errors import ImageError, OutputError, RequestError
from clpipe.base.transfers import TRANSFERS, class_of
from tests.buckets import MemoryBucket

RUN = ("--iso", 3200, "--device", "numpy", "--skip", "noise")


class ServiceError(Exception):
    """An error like botocore's, which has the answer of the service."""

    def __init__(self, code, message=""):
        super().__init__(f"An error occurred ({code})")
        self.response = {"Error": {"Code": code, "Message": message}}


class Faulty(MemoryBucket):
    """A bucket in memory that calls ``fault`` before each transfer."""

    protocol = "faulty"
    async_impl = True  # one instance for all threads, like that of S3
    store: ClassVar = {}
    pseudo_dirs: ClassVar = [""]
    requests: ClassVar = Counter()

    @staticmethod
    def fault(path):
        """Raise an error, or block."""

    def get_file(self, remote, local, **more):
        self.requests[remote] += 1
        self.fault(remote)
        super().get_file(remote, local, **more)

    def put_file(self, local, remote, **more):
        self.requests[remote] += 1
        self.fault(remote)
        super().put_file(local, remote, **more)

    def find(self, path, *arguments, **more):
        self.requests["find"] += 1
        self.fault("find")
        return super().find(path, *arguments, **more)


@pytest.fixture
def bucket(monkeypatch, clpipe, write_exr):
    """Six renders in a bucket. Requests have no fault."""
    monkeypatch.setattr(transfers, "FIRST_WAIT", 0.0)
    fsspec.register_implementation("faulty", Faulty, clobber=True)
    Faulty.store.clear()
    Faulty.pseudo_dirs[:] = [""]
    Faulty.requests.clear()
    monkeypatch.setattr(Faulty, "fault", staticmethod(lambda path: None))
    system = fsspec.filesystem("faulty")
    for number in range(6):
        rng = np.random.default_rng(number)
        write_exr(f"in/r{number}.exr", rng.random((16, 24, 3)).astype(np.float32))
        system.put_file(f"in/r{number}.exr", f"/b/in/r{number}.exr")
    Faulty.requests.clear()
    yield system
    TRANSFERS.allow()


def answering(code, error_type=OSError, text="", only=""):
    """Return a fault: an error as s3fs raises it for a service's code."""

    def fault(path):
        if only in path:
            raise error_type(text) from ServiceError(code, text)

    return staticmethod(fault)


def images(folder="o"):
    lines = map(json.loads, Path(folder, "run.jsonl").read_text().splitlines())
    return {line["name"]: line for line in lines if line["event"] == "image"}


ANSWERS = [
    ("AccessDenied", PermissionError, "auth", "access is denied (AccessDenied). Renew or correct"),
    ("ExpiredToken", PermissionError, "auth", "access is denied (ExpiredToken). Renew or correct"),
    ("400", OSError, "auth", "access is denied (400). Renew or correct the credentials"),
    ("NoSuchBucket", FileNotFoundError, "not_found", "there is no such bucket (NoSuchBucket)"),
    ("NoSuchKey", FileNotFoundError, "not_found", "there is no such file (NoSuchKey)"),
    ("SlowDown", OSError, "throttled", "OSError (SlowDown), in 3 tries. Repeat the command later"),
    ("503", OSError, "throttled", "OSError (503), in 3 tries. Repeat the command later"),
    ("InternalError", OSError, "network", "OSError (InternalError), in 3 tries"),
]


@pytest.mark.parametrize(("code", "error_type", "error_class", "text"), ANSWERS)
def test_an_answer_has_a_class_and_a_message(
    bucket, clpipe, monkeypatch, code, error_type, error_class, text
):
    monkeypatch.setattr(transfers, "MAX_TRIES", 3)
    monkeypatch.setattr(Faulty, "fault", answering(code, error_type, only="r3"))
    stderr = clpipe("run", "faulty://b/in", "-o", "o", *RUN, status=1).stderr
    assert f"faulty://b/in/r3.exr: cannot be read: {text}" in stderr
    assert "5 of 6 images done, 1 failed" in stderr
    assert images()["r3.exr"]["error_class"] == error_class
    assert images()["r2.exr"]["error_class"] is None
    assert Faulty.requests["/b/in/r3.exr"] == (1 if error_class in transfers.FINAL else 3)


def test_what_the_service_says_is_in_the_message(bucket, clpipe, monkeypatch):
    text = "The provided token has expired."
    monkeypatch.setattr(Faulty, "fault", answering("ExpiredToken", PermissionError, text, "put"))
    monkeypatch.setattr(Faulty, "fault", answering("ExpiredToken", PermissionError, text))
    with pytest.raises(OutputError, match=r"The provided token has expired \(ExpiredToken\)\. R"):
        urls.upload(Path("in/r0.exr"), "faulty://b/x")
    with pytest.raises(RequestError, match=r"cannot be listed: .*expired \(ExpiredToken\)"):
        urls.list_urls("faulty://b/in")


def test_a_missing_bucket_is_no_empty_one(bucket, clpipe, monkeypatch):
    gone = answering("NoSuchBucket", FileNotFoundError, only="find")
    monkeypatch.setattr(Faulty, "fault", gone)
    stderr = clpipe("run", "faulty://b/in", "-o", "o", *RUN, status=2).stderr
    assert "cannot be listed: there is no such bucket (NoSuchBucket). Create it" in stderr
    command = ("run", "in", "-o", "faulty://none/set", "--webdataset", 3, *RUN)
    assert "no such bucket" in clpipe(*command, status=2).stderr


def test_error_types_that_have_no_code():
    class NoCredentialsError(Exception):
        pass

    assert class_of(NoCredentialsError()) == "auth"
    assert class_of(TimeoutError()) == "network"


def test_errors_of_files_have_a_class(clpipe, write_exr):
    write_exr("in/good.exr", np.ones((8, 8, 3), np.float32))
    Path("in/bad.exr").write_bytes(Path("in/good.exr").read_bytes()[:200])
    Path("in/gone.exr").symlink_to("nowhere.exr")
    write_exr("in/tall.exr", np.ones((1024, 8, 3), np.float32))
    clpipe("run", "in", "-o", "o", *RUN, "--max-pixels", 4096, status=1)
    classes = {name: line["error_class"] for name, line in images().items()}
    assert classes == {
        "good.exr": None,
        "bad.exr": "damaged",
        "gone.exr": "not_found",
        "tall.exr": "damaged",
    }


def test_a_transfer_that_stalls_is_abandoned(bucket, clpipe, monkeypatch):
    """The next try is right, whatever the abandoned one still writes."""
    monkeypatch.setattr(transfers, "TRY_SECONDS", 0.2)
    go, ended = threading.Event(), threading.Event()
    get = MemoryFileSystem.get_file

    def stalling(self, remote, local, **more):
        if "r3" in remote and not go.is_set():
            self.requests[remote] += 1
            Path(local).write_bytes(b"half")
            if self.requests[remote] == 1:
                go.wait(60)
                Path(local).write_bytes(b"late, and of the same file")
                ended.set()
                return
        get(self, remote, local, **more)

    monkeypatch.setattr(Faulty, "get_file", stalling)
    stderr = clpipe("run", "faulty://b/in", "-o", "o", *RUN).stderr
    go.set()
    assert "6 of 6 images done, 0 failed" in stderr
    assert ended.wait(60) and Faulty.requests["/b/in/r3.exr"] == 2
    clpipe("run", "in", "-o", "whole", *RUN)
    assert Path("o/r3.jpg").read_bytes() == Path("whole/r3.jpg").read_bytes()


def test_a_stall_without_end_is_an_error(bucket, monkeypatch):
    monkeypatch.setattr(transfers, "TRY_SECONDS", 0.1)
    monkeypatch.setattr(transfers, "MAX_TRIES", 2)
    go = threading.Event()
    monkeypatch.setattr(Faulty, "fault", staticmethod(lambda path: go.wait(60)))
    with (
        pytest.raises(ImageError, match="it took more than 0 s, in 2 tries"),
        urls.fetched_files([urls.path_of("faulty://b/in/r0.exr")]),
    ):
        pass
    go.set()


@pytest.mark.parametrize("kind", ["stalls", "fails"])
def test_nothing_is_retried_after_a_stop(bucket, clpipe, monkeypatch, kind):
    """Images whose files did not arrive are left to the next run."""
    monkeypatch.setattr(transfers, "STOP_SECONDS", 0.2)
    go = threading.Event()

    def fault(path):
        if "r3" in path:
            TRANSFERS.stop()
            if kind == "stalls":
                go.wait(60)
            raise OSError("cut off")

    monkeypatch.setattr(Faulty, "fault", staticmethod(fault))
    stderr = clpipe("run", "faulty://b/in/r3.exr", "-o", "o", *RUN, "--jobs", 1, status=130).stderr
    go.set()
    assert "0 failed, 1 not begun" in stderr
    assert Faulty.requests["/b/in/r3.exr"] == 1
    assert not Path("o/run.jsonl").exists() or images() == {}
    monkeypatch.setattr(Faulty, "fault", staticmethod(lambda path: None))
    clpipe("run", "faulty://b/in/r3.exr", "-o", "o", *RUN)  # the stop is forgotten
    assert images()["r3.exr"]["status"] == "done"


def test_a_stop_in_python_ends_transfers(bucket, monkeypatch):
    monkeypatch.setattr(transfers, "STOP_SECONDS", 0.2)
    go = threading.Event()

    def fault(path):
        if path.endswith("r5.exr"):
            run.stop()
            go.wait(60)

    monkeypatch.setattr(Faulty, "fault", staticmethod(fault))
    run = package.run("faulty://b/in", "o", device="numpy", jobs=1)
    run.stop()  # before it begins: no transfer of another run is affected
    assert [each.status for each in package.run("faulty://b/in/r0.exr", "p", device="numpy")] == [
        "done"
    ]
    run = package.run("faulty://b/in", "o", device="numpy", jobs=1)
    outcomes = list(run)
    go.set()
    assert "r5.exr" not in {outcome.job.key for outcome in outcomes}
    assert run.summary.interrupted and not run.summary.failures
    monkeypatch.setattr(Faulty, "fault", staticmethod(lambda path: None))
    assert {each.status for each in package.run("faulty://b/in", "o")} <= {"done", "skipped"}


FILE = {"type": "file", "size": 0}


def test_skipped_keys_are_counted(bucket, clpipe, monkeypatch):
    names = ["r0.exr", "a//b.exr", "../up.exr", ".hidden.exr", ".tmp/c.exr", "notes.txt"]
    monkeypatch.setattr(Faulty, "find", lambda *_, **__: {f"/b/in/{n}": FILE for n in names})
    stderr = clpipe("run", "faulty://b/in", "-o", "o", *RUN).stderr
    assert "1 of 1 image" in stderr or "r0.exr ->" in stderr
    text = "2 hidden, 2 with '..', '.' or empty parts in the key, 1 .txt"
    assert f"faulty://b/in: other files were skipped: {text}" in " ".join(stderr.split())
    names[:] = [".hidden.exr", "notes.txt"]
    stderr = clpipe("run", "faulty://b/in", "-o", "p", *RUN, status=2).stderr
    assert "and found 1 .txt, 1 hidden" in " ".join(stderr.split())


def test_s3_has_one_layer_of_retries():
    s3fs = pytest.importorskip("s3fs", reason="needs s3fs, in the extra cloud")
    system, _ = transfers._system_of("s3://bucket/key")
    assert system.retries == 1
    assert system.config_kwargs["retries"] == {"total_max_attempts": 1}
    others = s3fs.S3FileSystem()
    assert others.retries == s3fs.S3FileSystem.retries > 1  # what the user's own code uses


def test_a_listing_of_one_file_may_lack_its_stamp(bucket, monkeypatch):
    """For a URL that is a file, fsspec's own listing gives no information."""
    monkeypatch.setattr(Faulty, "find", lambda self, path, **more: {path: {}})
    assert urls.list_urls("faulty://b/in/r0.exr") == ["faulty://b/in/r0.exr"]
    size = Path("in/r0.exr").stat().st_size
    assert urls.stamp_of_url("faulty://b/in/r0.exr")[0] == size


def test_a_file_that_changes_after_its_listing_is_fetched(bucket, monkeypatch):
    (url,) = urls.list_urls("faulty://b/in/r0.exr")
    listed = urls.stamp_of_url(url)
    bucket.pipe_file("/b/in/r0.exr", b"another one")
    with urls.fetched_files([urls.path_of(url)]) as (path,):
        assert path.read_bytes() == b"another one"
    assert urls.stamp_of_url(url) == listed  # of this run
    urls.forget_stamps()
    assert urls.stamp_of_url(url)[0] == 11


def test_a_run_of_one_file_sends_no_request_before_it_begins(bucket, monkeypatch):
    monkeypatch.setattr(transfers, "MAX_TRIES", 4)
    requests = []

    def failing(self, path, **more):
        requests.append(path)
        raise OSError("the server is away")

    monkeypatch.setattr(Faulty, "info", failing)
    run = package.run("faulty://b/in/r0.exr", "o", device="numpy")
    (outcome,) = run
    assert outcome.error_class == "network" and len(requests) == 4
