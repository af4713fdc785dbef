"""How far a run has come: its log, ``clpipe status``, ``--dry-run``, ``--metrics`` and limits."""

import json
import re
import socket
import time
from pathlib import Path

import fsspec
import numpy as np
import pytest

import clpipe as package
from clpipe.base.errors import RequestError
from clpipe.batch.execution import parse_failures
from clpipe.batch.run_log import read_log
from clpipe.reports.status import read_status
from tests.buckets import MemoryBucket
from tests.conftest import contents, written

RUN = ("--iso", 3200, "--device", "numpy", "--skip", "noise")
TARS = (*RUN, "--webdataset", 2)


@pytest.fixture
def renders(write_exr, clpipe):
    """Six renders in a folder."""
    for number in range(6):
        rng = np.random.default_rng(number)
        write_exr(f"in/r{number}.exr", rng.random((16, 24, 3)).astype(np.float32))


def status_of(clpipe, place="o", status=0):
    return json.loads(clpipe("status", place, "--json", status=status).stdout)


def test_the_log_names_who_did_the_work(renders, clpipe):
    Path("in/r3.exr").write_bytes(b"no EXR")
    clpipe("run", "in", "-o", "o", *RUN, "--shard", "1/2", status=0)
    clpipe("run", "in", "-o", "o", *RUN, "--shard", "2/2", status=1)
    clpipe("run", "in", "-o", "o", *RUN, "--shard", "2/2", status=1)
    starts = [line for line in read_log(Path("o/run.2-of-2.jsonl")) if line["event"] == "start"]
    assert [(line["shard"], line["attempt"]) for line in starts] == [("2/2", 1), ("2/2", 2)]
    images = [line for line in read_log(Path("o/run.2-of-2.jsonl")) if line["event"] == "image"]
    for line in (*starts, *images):
        assert line["host"] == socket.gethostname() and line["pid"] > 0
    devices = {line["name"]: line["device"] for line in images[:3]}
    assert devices == {"r1.exr": "numpy", "r3.exr": None, "r5.exr": "numpy"}
    assert all(start["at"] <= image["at"] for start in starts[:1] for image in images)


def test_the_status_of_images(renders, clpipe):
    Path("in/r3.exr").write_bytes(b"no EXR")
    clpipe("run", "in", "-o", "o", *RUN, "--shard", "2/2", status=1)
    text = clpipe("status", "o", status=1).stdout
    assert text.splitlines()[0] == "2 of 3 images done, 1 failed (1 damaged)"
    assert "shard 2/2: finished, attempt 1 on" in text and "1 shards have not begun" in text
    clpipe("run", "in", "-o", "o", *RUN, "--shard", "1/2")
    assert status_of(clpipe, status=1)["images"] == {
        "images": 6,
        "done": 5,
        "failed": 1,
        "missing": 0,
    }
    Path("in/r3.exr").write_bytes(Path("in/r2.exr").read_bytes())
    clpipe("run", "in", "-o", "o", *RUN, "--shard", "2/2")
    assert status_of(clpipe)["complete"] is True
    assert "there is no log of a run" in clpipe("status", "in", status=2).stderr
    assert "no such file or folder" in clpipe("status", "none", status=2).stderr


def test_the_status_of_tars(renders, clpipe):
    Path("in/r3.exr").write_bytes(b"no EXR")
    clpipe("run", "in", "-o", "o", *TARS, status=1)
    assert status_of(clpipe, status=1)["tars"] == {
        "tars": 3,
        "done": 2,
        "failed": 1,
        "missing": 0,
    }
    Path("o/000002.tar").unlink()
    text = clpipe("status", "o", status=1).stdout
    assert "1 of 3 tars done, 1 with failed images, 1 missing" in text


def test_a_tar_that_took_much_longer_is_slow(renders, clpipe):
    clpipe("run", "in", "-o", "o", *TARS)
    lines = Path("o/run.jsonl").read_text().splitlines()
    slow = [
        re.sub(r'"encode_seconds": [\d.]+', f'"encode_seconds": {90 if "/r5" in line else 1}', line)
        for line in lines
    ]
    Path("o/run.jsonl").write_text("\n".join(slow) + '\n{"event": "im')
    assert list(status_of(clpipe)["slow_tars"]) == ["000002.tar"]
    assert "slow: 000002.tar took 91 s of work; the median is 2 s" in clpipe("status", "o").stdout


def test_a_run_that_was_killed_has_no_end(renders, clpipe):
    clpipe("run", "in", "-o", "o", *RUN)
    start, *lines = Path("o/run.jsonl").read_text().splitlines()
    Path("o/run.jsonl").write_text("\n".join([start, *lines[:2]]) + "\n")
    text = clpipe("status", "o", status=1).stdout
    assert "2 of 6 images done, 0 failed" in text
    assert re.search(r"killed, or still running, attempt 1 on .*; last image .* ago", text)


class Bucket(MemoryBucket):
    """A bucket in memory that keeps what was uploaded, in order."""

    protocol = "bucket"
    store: dict = {}  # noqa: RUF012
    uploads: list = []  # noqa: RUF012
    forbidden = ""

    def put_file(self, local, remote, **more):
        if self.forbidden and self.forbidden in remote:
            raise PermissionError("no write access")
        self.uploads.append((remote.rpartition("/")[2], Path(local).read_bytes()))
        super().put_file(local, remote, **more)


@pytest.fixture
def bucket(renders, monkeypatch):
    fsspec.register_implementation("bucket", Bucket, clobber=True)
    Bucket.store.clear()
    Bucket.uploads.clear()
    monkeypatch.setattr(Bucket, "forbidden", "")


def test_the_log_is_in_the_bucket_while_the_run_goes_on(bucket, clpipe, monkeypatch):
    monkeypatch.setattr("clpipe.batch.run_log.SEND_SECONDS", 0.0)
    clpipe("run", "in", "-o", "bucket://b/set", *TARS)
    names = [name for name, _ in Bucket.uploads]
    assert names[0].endswith(".jsonl") and json.loads(Bucket.uploads[0][1])["event"] == "start"
    assert names.index("000002.tar") > 3 and len(set(names)) == 8
    logs = [data.count(b"\n") for name, data in Bucket.uploads if name == names[0]]
    assert logs == [1, *range(2, 8), 8]
    text = clpipe("status", "bucket://b/set").stdout
    assert "6 of 6 images done, 0 failed\n3 of 3 tars done" in text
    index = json.loads(dict(Bucket.uploads)["000000.index.json"])
    assert index["counts"] == {"done": 2}
    clpipe("run", "in", "-o", "bucket://b/set", *TARS)
    assert json.loads(Bucket.uploads[-1][1].splitlines()[0])["attempt"] == 2
    assert status_of(clpipe, "bucket://b/set")["complete"] is True


def test_a_bucket_that_may_not_be_written_ends_the_run_at_once(bucket, clpipe, monkeypatch):
    monkeypatch.setattr(Bucket, "forbidden", "b/set")
    stderr = clpipe("run", "in", "-o", "bucket://b/set", *TARS, status=1).stderr
    assert "jsonl: cannot be written: no write access. Renew or correct the credentials" in stderr
    assert "6 not begun" in stderr and not Bucket.uploads
    assert stderr.count("no write access") == 1


@pytest.mark.parametrize(
    ("limit", "failed", "ends"), [("1", 3, True), ("3", 3, False), ("20%", 3, True), ("50%", 3, 0)]
)
def test_failures_stop_a_run(renders, clpipe, limit, failed, ends):
    for number in range(failed):
        Path(f"in/r{number}.exr").write_bytes(b"no EXR")
    command = ("run", "in", "-o", "o", *RUN, "--jobs", 1, "--max-failures", limit)
    stderr = clpipe(*command, status=1).stderr
    assert ("the run stopped, because more than 1 image failed" in stderr) == bool(ends)
    end = read_log(Path("o/run.jsonl"))[-1]
    assert bool(end["gave_up"]) == bool(ends)
    assert end["failed"] == failed or ends


def test_a_failure_limit_in_python(renders):
    for number in range(3):
        Path(f"in/r{number}.exr").write_bytes(b"no EXR")
    made = package.run("in", "o", device="numpy", max_failures=0, jobs=1)
    assert {outcome.status for outcome in made} >= {"failed"}
    assert made.summary.gave_up and made.summary.exit_status == 1


@pytest.mark.parametrize("text", ["", "-1", "1.5", "101%", "%", "many", "nan%"])
def test_wrong_failure_limits(text):
    with pytest.raises(RequestError, match="--max-failures: found"):
        parse_failures(text)


def test_a_dry_run_writes_nothing(renders, clpipe):
    text = clpipe("run", "in", "-o", "o", *RUN, "--dry-run").stdout
    assert "6 images: 0 exist, 6 would be made" in text
    assert "about 0.0023 megapixels" in text and "on this machine" in text
    assert not Path("o").exists()
    clpipe("run", "in/r0.exr", "in/r1.exr", "-o", "o", *RUN)
    before = contents("o")
    text = clpipe("run", "in", "-o", "o", *RUN, "--dry-run").stdout
    assert "6 images: 2 exist, 4 would be made" in text
    assert contents("o") == before
    clpipe("run", "in", "-o", "o", *RUN)
    text = clpipe("run", "in", "-o", "o", *RUN, "--dry-run").stdout
    assert text == "6 images: 6 exist, 0 would be made\n"
    series = clpipe("run", "in", "-o", "s", *RUN[2:], "--iso", "100,800", "--dry-run").stdout
    assert "12 images: 0 exist, 12 would be made" in series


def test_a_dry_run_of_tars(bucket, clpipe):
    for place in ("o", "bucket://b/set"):
        text = clpipe("run", "in", "-o", place, *TARS, "--dry-run").stdout
        assert "6 images: 0 exist, 6 would be made" in text
        clpipe("run", "in", "-o", place, *TARS)
        uploads = len(Bucket.uploads)
        text = clpipe("run", "in", "-o", place, *TARS, "--dry-run").stdout
        assert "6 images: 6 exist, 0 would be made" in text and len(Bucket.uploads) == uploads


def test_a_dry_run_of_damaged_images(renders, clpipe):
    Path("in/r0.exr").write_bytes(b"no EXR")
    result = clpipe("run", "in", "-o", "o", *RUN, "--dry-run")
    assert "r0.exr" in result.stderr and "6 would be made" in result.stdout
    for path in Path("in").iterdir():
        path.write_bytes(b"no EXR")
    stderr = clpipe("run", "in", "-o", "o", *RUN, "--dry-run", status=1).stderr
    assert "--dry-run: none of 6 images could be made" in stderr


def samples(text):
    """Return the samples of Prometheus' text format."""
    form = re.compile(r'(clpipe_\w+)(?:\{(\w+)="(\w+)"\})? ([\d.e+-]+)')
    lines = [line for line in text.splitlines() if not line.startswith("#")]
    found = [form.fullmatch(line) for line in lines]
    assert all(found)
    return {(match[1], match[3]): float(match[4]) for match in found}


def test_metrics(renders, clpipe):
    Path("in/r3.exr").write_bytes(b"no EXR")
    clpipe("run", "in", "-o", "o", *RUN, "--metrics", "m.prom", status=1)
    text = Path("m.prom").read_text()
    found = samples(text)
    assert found["clpipe_images_planned", None] == 6
    assert found["clpipe_images_total", "done"] == 5
    assert found["clpipe_images_total", "failed"] == 1
    assert found["clpipe_step_seconds_total", "decode"] > 0
    assert abs(found["clpipe_update_timestamp_seconds", None] - time.time()) < 600
    names = re.findall(r"^# TYPE (\w+) (?:counter|gauge)$", text, re.MULTILINE)
    assert {name for name, _ in found} == set(names)
    stderr = clpipe("run", "in", "-o", "o", *RUN, "--metrics", "none/m.prom", status=1).stderr
    assert "--metrics: " in stderr and "5 of 6 images done" in stderr


def test_a_status_from_python_reads_no_pictures(renders, clpipe):
    clpipe("run", "in", "-o", "o", *TARS)
    for name in written(Path("o")):
        if name.endswith(".tar"):
            Path("o", name).write_bytes(b"")
    assert read_status("o").is_complete
