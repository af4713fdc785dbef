"""Inputs and tars at URLs, on an unreliable file system."""

import io
import json
import random
import shutil
import tarfile
from collections import Counter
from pathlib import Path
from typing import ClassVar

import fsspec
import numpy as np
import pytest

import clpipe as package
from clpipe.base import transfers, urls
from clpipe.base.errors import OutputError, RequestError
from clpipe.base.process_folder import process_folder
from clpipe.batch.run_log import read_log
from clpipe.camera.profile import built_in_cameras
from tests.buckets import MemoryBucket
from tests.conftest import contents, written

RUN = ("--iso", 3200, "--device", "numpy", "--skip", "noise")


class Flaky(MemoryBucket):
    """A bucket in memory, where requests randomly fail or return half a file."""

    protocol = "flaky"
    store: ClassVar = {}
    pseudo_dirs: ClassVar = [""]
    rate = 0.0
    rng = random.Random(0)
    failures: ClassVar = Counter()
    forbidden = ""

    def _may_fail(self, what, path):
        if self.forbidden and self.forbidden in path:
            raise PermissionError("the token has expired")
        if self.rng.random() < self.rate:
            self.failures[what] += 1
            raise self.rng.choice([OSError("503 slow down"), TimeoutError(), ConnectionError()])

    def find(self, path, *arguments, **more):
        self._may_fail("find", path)
        return super().find(path, *arguments, **more)

    def info(self, path, **more):
        self._may_fail("info", path)
        return super().info(path, **more)

    def cat_file(self, path, *arguments, **more):
        self._may_fail("cat", path)
        return super().cat_file(path, *arguments, **more)

    def get_file(self, remote, local, **more):
        self._may_fail("get", remote)
        super().get_file(remote, local, **more)
        if self.rate and not self.failures[f"half of {remote}"]:
            self.failures[f"half of {remote}"] += 1
            data = Path(local).read_bytes()
            Path(local).write_bytes(data[: len(data) // 2])

    def put_file(self, local, remote, **more):
        self._may_fail("put", remote)
        super().put_file(local, remote, **more)


@pytest.fixture
def bucket(write_exr, clpipe, monkeypatch):
    """Seven renders, in a bucket and in the working directory."""
    monkeypatch.setattr(transfers, "FIRST_WAIT", 0.0)
    monkeypatch.setattr(transfers, "MAX_TRIES", 30)
    fsspec.register_implementation("flaky", Flaky, clobber=True)
    system = fsspec.filesystem("flaky")
    Flaky.store.clear()
    Flaky.pseudo_dirs[:] = [""]
    Flaky.failures.clear()
    for number in range(7):
        name = f"x{number % 2}/r{number}.exr"
        rng = np.random.default_rng(number)
        write_exr(f"in/{name}", rng.random((16, 24, 3)).astype(np.float32))
        system.pipe_file(f"/b/renders/{name}", Path("in", name).read_bytes())
    system.pipe_file("/b/renders/notes.txt", b"no image")
    yield system
    Flaky.rate, Flaky.forbidden = 0.0, ""


class Listed(Flaky):
    """A bucket that counts requests."""

    protocol = "listed"
    async_impl = True  # one instance for all threads, like that of S3
    requests: ClassVar = Counter()

    def find(self, path, *arguments, **more):
        self.requests["list"] += 1
        return super().find(path, *arguments, **more)

    def get_file(self, remote, local, **more):
        Path(local).write_bytes(self.store[self._strip_protocol(remote)].getvalue())

    def info(self, path, **more):
        self.requests[f"head {self._strip_protocol(path)}"] += 1
        return super().info(path, **more)


def test_inputs_of_a_listing_need_no_request_each(bucket, clpipe):
    fsspec.register_implementation("listed", Listed, clobber=True)
    command = ("run", "listed://b/renders", "-o", "listed://b/set", "--webdataset", 4, *RUN)

    def requests():
        Listed.requests.clear()
        done = clpipe(*command)
        heads = [name for name in Listed.requests if name.startswith("head /b/renders")]
        return done.stderr, heads

    assert requests()[1] == []
    assert requests() == (requests()[0], [])
    assert "(7 of them were there already)" in requests()[0]
    assert sum(Listed.requests.values()) <= 10
    # The next listing sees what has changed.
    bucket.pipe_file("/b/renders/x0/r0.exr", bucket.cat_file("/b/renders/x1/r1.exr"))
    stderr, heads = requests()
    assert "already" in stderr and "(7 of them" not in stderr and heads == []


def tars(system, folder="/b/set"):
    """The members of each tar, with their bytes."""
    found = {}
    for path in system.find(folder):
        if path.endswith(".tar"):
            with tarfile.open(fileobj=io.BytesIO(system.cat_file(path))) as tar:
                names = [(info.name, tar.extractfile(info).read()) for info in tar]
            found[path.rpartition("/")[2]] = names
    return found


@pytest.mark.parametrize("rate", [0.0, 0.3])
def test_renders_behind_a_url_make_the_pictures_of_files(bucket, clpipe, rate):
    clpipe("run", "in", "-o", "whole", *RUN)
    Flaky.rate = rate
    stderr = clpipe("run", "flaky://b/renders", "-o", "o", *RUN).stderr
    assert "7 of 7 images done, 0 failed" in stderr
    pictures = {n: data for n, data in contents("o").items() if n.endswith(".jpg")}
    # What is drawn for an image belongs to its name among the inputs and to its bytes.
    assert pictures == {n: d for n, d in contents("whole").items() if n.endswith(".jpg")}
    assert json.loads(Path("o/x0/r0.json").read_text())["input"] == "flaky://b/renders/x0/r0.exr"
    _, *images, _ = read_log(Path("o/run.jsonl"))
    assert {each["input"] for each in images} == {
        f"flaky://b/renders/x{n % 2}/r{n}.exr" for n in range(7)
    }
    assert bool(Flaky.failures) == (rate > 0)
    assert Flaky.failures["half of /b/renders/x0/r0.exr"] == (rate > 0)
    again = clpipe("run", "flaky://b/renders", "-o", "o", *RUN).stderr
    assert "(7 of them were there already)" in again
    output = clpipe("replay", "o/x0/r2.json", "-o", "again", *RUN[2:4]).output
    assert "the same bytes" in output
    Flaky.rate = 0.0
    bucket.pipe_file("/b/renders/x0/r0.exr", Path("in/x1/r1.exr").read_bytes())
    again = clpipe("run", "flaky://b/renders", "-o", "o", *RUN).stderr
    assert "(6 of them were there already)" in again


def test_files_globs_and_manifests_behind_urls(bucket, clpipe):
    bucket.pipe_file(
        "/b/renders/list.csv", b"path,name\nx0/r0.exr,one\nflaky://b/renders/x1/r1.exr,\n"
    )
    clpipe("run", "flaky://b/renders/x0/r2.exr", "-o", "a", *RUN)
    clpipe("run", "flaky://b/renders/x0/*.exr", "-o", "b", *RUN)
    clpipe("run", "flaky://b/renders/list.csv", "-o", "c", *RUN)
    Path("own.csv").write_text("path\nflaky://b/renders/x1/r3.exr\nin/x0/r0.exr\n")
    clpipe("run", "own.csv", "-o", "d", *RUN)
    found = {f: [n for n in written(Path(f)) if n.endswith(".jpg")] for f in "abcd"}
    assert found["a"] == ["r2.jpg"]
    assert found["b"] == ["r0.jpg", "r2.jpg", "r4.jpg", "r6.jpg"]
    assert found["c"] == ["one.jpg", "r1.jpg"]
    assert found["d"] == ["in/x0/r0.jpg", "r3.jpg"]


@pytest.mark.parametrize("kind", ["zip", "tar"])
def test_files_in_archives_behind_urls(bucket, clpipe, kind):
    archive = shutil.make_archive("all", kind, ".", "in")
    bucket.put_file(archive, f"/b/all.{kind}")
    clpipe("run", "in", "-o", "whole", *RUN)
    pictures = {n: data for n, data in contents("whole").items() if n.endswith(".jpg")}
    for where in (f"flaky://b/all.{kind}", f"all.{kind}", Path(archive).as_uri()):
        shutil.rmtree("o", ignore_errors=True)
        clpipe("run", f"{kind}://in/x0/r0.exr::{where}", "-o", "o", *RUN)
        clpipe("run", f"{kind}://in/x1/*.exr::{where}", "-o", "o", *RUN)
        made = [n for n in written(Path("o")) if n.endswith(".jpg")]
        assert made == [f"r{n}.jpg" for n in (0, 1, 3, 5)]
        assert (
            json.loads(Path("o/r0.json").read_text())["input"] == f"{kind}://in/x0/r0.exr::{where}"
        )
        clpipe("run", f"{kind}://::{where}", "-o", "o/all", *RUN)
        made = [n for n in written(Path("o/all")) if n.endswith(".jpg")]
        assert made == [f"in/{name}" for name in sorted(pictures)]
        clpipe("run", f"{kind}://in::{where}", "-o", "o/in", *RUN)
        # What is drawn for an image belongs to its name among the inputs.
        made = {n: data for n, data in contents("o/in").items() if n.endswith(".jpg")}
        assert made == pictures
    missing = clpipe("run", f"{kind}://none.exr::{where}", "-o", "o", *RUN, status=1).stderr
    assert f"{kind}://none.exr::{where}: cannot be read: there is no such file" in missing


def test_listings_are_urls(bucket):
    assert urls.list_urls("flaky://b/renders/notes.txt") == ["flaky://b/renders/notes.txt"]
    assert urls.list_urls("flaky://b/renders/x1/") == [
        f"flaky://b/renders/x1/r{n}.exr" for n in (1, 3, 5)
    ]
    assert urls.list_urls("flaky://*/renders/*/r0.exr") == ["flaky://b/renders/x0/r0.exr"]
    assert urls.list_urls("flaky://b/r*") == []  # folders are no files
    assert urls.list_urls("flaky://none/x") == []


def test_tars_behind_urls_are_streamed(bucket, clpipe):
    with tarfile.open("a.tar", "w") as tar:
        tar.add("in/x0/r0.exr", "r0.exr")
    bucket.put_file("a.tar", "/b/tars/a.tar")
    options = {"device": "numpy", "iso": 3200}
    here = [sample["image"] for sample in package.StreamingDataset("a.tar", **options)]
    for name in ("flaky://b/tars/a.tar", "flaky://b/tars/*.tar"):
        streamed = list(package.StreamingDataset(name, **options))
        assert [sample["key"] for sample in streamed] == ["a/r0.exr"]
        assert np.array_equal(streamed[0]["image"], here[0])


def test_what_is_wrong_with_a_url_is_said(bucket, clpipe, monkeypatch):
    monkeypatch.setattr(transfers, "MAX_TRIES", 2)

    def stderr_of(*arguments, status):
        text = clpipe("run", *arguments, *RUN, status=status).stderr
        assert "Traceback" not in text
        return " ".join(text.split())

    assert "flaky://b/none: there are no images at this URL" in stderr_of(
        "flaky://b/none", "-o", "o", status=2
    )
    for url in ("nosuch://b/x", "nosuch://b/x.exr"):
        assert f"clpipe: {url}: Protocol not known" in stderr_of(url, "-o", "o", status=2)
    assert "it needs no cache; use flaky://b/x.exr" in stderr_of(
        "simplecache::flaky://b/x.exr", "-o", "o", status=2
    )
    text = stderr_of("flaky://b/gone.exr", "in/x0/r0.exr", "-o", "o", status=1)
    assert "flaky://b/gone.exr: cannot be read: there is no such file" in text
    assert "1 of 2 images done" in text
    assert "'..'" in stderr_of("flaky://b/../x.exr", "-o", "o", status=2)
    text = stderr_of("in", "-o", "flaky://b/set", status=2)
    assert "found flaky://b/set; only tars are written to a URL, so add --webdataset N" in text
    text = clpipe("emva", "-o", "flaky://b/m", status=2).stderr
    assert "only clpipe run writes to URLs" in text
    Flaky.forbidden = "r3"
    text = stderr_of("flaky://b/renders", "-o", "o", status=1)
    assert "flaky://b/renders/x1/r3.exr: cannot be read: the token has expired" in text
    assert "6 of 7 images done, 1 failed" in text
    Flaky.forbidden, Flaky.rate = "", 1.0
    assert "flaky://b/renders: cannot be listed: " in stderr_of(
        "flaky://b/renders", "-o", "p", status=1
    )


@pytest.mark.slow
@pytest.mark.parametrize("rate", [0.0, 0.25])
def test_tars_behind_a_url_are_those_of_a_folder(bucket, clpipe, rate):
    clpipe("run", "in", "-o", "here", "--webdataset", 3, *RUN)
    Flaky.rate = rate
    clpipe("run", "in", "-o", "flaky://b/set", "--webdataset", 3, *RUN)
    Flaky.rate = 0.0
    sent = tars(bucket)
    assert sorted(sent) == ["000000.tar", "000001.tar", "000002.tar"]
    for name, members in sent.items():
        with tarfile.open(Path("here", name)) as tar:
            assert members == [(info.name, tar.extractfile(info).read()) for info in tar]
    index = json.loads(bucket.cat_file("/b/set/000002.index.json"))
    assert index["samples"] == ["x1/r5"] and index["failed"] == []
    assert index["size"] == bucket.info("/b/set/000002.tar")["size"]
    logs = [each for each in bucket.find("/b/set") if each.endswith(".jsonl")]
    assert len(logs) == 1
    Flaky.rate = rate
    stderr = clpipe("run", "in", "-o", "flaky://b/set", "--webdataset", 3, *RUN).stderr
    assert "7 of 7 images done (7 of them were there already)" in stderr
    result = clpipe(
        "run", "in", "-o", "flaky://b/set", "--webdataset", 3, "--redo", "damaged", *RUN
    )
    assert "(7 of them were there already)" in result.stderr


@pytest.mark.slow
def test_a_run_that_was_cut_off_goes_on(bucket, clpipe, monkeypatch):
    command = ("run", "in", "-o", "flaky://b/set", "--webdataset", 3, *RUN)
    monkeypatch.setattr(transfers, "MAX_TRIES", 1)
    Flaky.forbidden = "000001.tar"
    stderr = clpipe(*command, status=1).stderr
    assert "flaky://b/set/000001.tar: cannot be written: the token has expired" in stderr
    # The last one, of a single image, may have been on its way when the second one was refused.
    begun = set(tars(bucket))
    assert {"000000.tar"} <= begun <= {"000000.tar", "000002.tar"}
    Flaky.forbidden = ""
    before = bucket.modified("/b/set/000000.tar")
    stderr = clpipe(*command).stderr
    there = 2 + len(begun)
    assert f"7 of 7 images done ({there} of them were there already)" in stderr
    assert bucket.modified("/b/set/000000.tar") == before
    assert sorted(tars(bucket)) == ["000000.tar", "000001.tar", "000002.tar"]
    # A tar that was cut off, and one whose index was: both are made again.
    whole = tars(bucket)
    data = bucket.cat_file("/b/set/000001.tar")
    bucket.pipe_file("/b/set/000001.tar", data[:-512])
    bucket.pipe_file("/b/set/000002.index.json", b'{"cl')
    assert "(3 of them were there already)" in clpipe(*command).stderr
    assert tars(bucket) == whole
    bucket.pipe_file("/b/set/000001.tar", bytes(len(data)))  # its size is right
    assert "(7 of them were there already)" in clpipe(*command).stderr
    assert "(4 of them were there already)" in clpipe(*command, "--redo", "damaged").stderr
    assert tars(bucket) == whole
    assert "already" not in clpipe(*command, "--seed", 5).stderr


def test_what_lies_behind_a_url_is_looked_at(bucket, clpipe):
    command = ("run", "in", "-o", "flaky://b/set", "--webdataset", 3, *RUN)
    bucket.pipe_file("/b/set/000001.tar", b"mine")
    assert (
        "000001.tar: has no index, so clpipe did not write it" in clpipe(*command, status=2).stderr
    )
    clpipe(*command, "--redo", "all")
    assert len(tars(bucket)) == 3
    stderr = clpipe(*command[:5], 4, *RUN, status=2).stderr
    assert "000002.tar: is of another run, as this one makes 2 tars" in stderr


def test_an_image_that_fails_is_tried_again(bucket, clpipe):
    Path("in/x0/r2.exr").write_bytes(b"no EXR")
    command = ("run", "in", "-o", "flaky://b/set", "--webdataset", 3, *RUN)
    clpipe(*command, status=1)
    assert json.loads(bucket.cat_file("/b/set/000000.index.json"))["failed"] == ["x0/r2"]
    stderr = clpipe(*command, status=1).stderr
    assert "6 of 7 images done (4 of them were there already), 1 failed" in stderr


def test_from_python(bucket, monkeypatch):
    made = package.run("flaky://b/renders", "flaky://b/set", device="numpy", webdataset=4)
    assert Counter(each.status for each in made) == {"done": 7}
    assert sorted(tars(bucket)) == ["000000.tar", "000001.tar"]
    with pytest.raises(RequestError, match="add webdataset=N"):
        package.run("in", "flaky://b/set")
    monkeypatch.setattr(transfers, "MAX_TRIES", 1)
    Flaky.forbidden = "000000.index"
    with pytest.raises(OutputError, match="the token has expired"):
        list(package.run("in", "flaky://b/other", device="numpy", webdataset=4))


@pytest.mark.slow
def test_one_render_by_several_isos_and_processes(bucket, clpipe):
    stderr = clpipe(
        *("run", "flaky://b/renders/x0", "-o", "o", *RUN[2:], "--iso", "100,200,400,800"),
        *("--jobs", 4),
    ).stderr
    assert "16 of 16 images done, 0 failed" in stderr
    rows = "".join(f"flaky://b/renders/x1/r1.exr,a{n},{n}\n" for n in range(12))
    Path("twice.csv").write_text(f"path,name,seed\n{rows}")
    assert "12 of 12 images done" in clpipe("run", "twice.csv", "-o", "p", *RUN).stderr
    left = process_folder()
    assert left and not list(left.glob("fetched-*/**/r1.exr"))


def test_manifests_behind_urls_do_not_lead_out_of_their_bucket(bucket, clpipe, tmp_path):
    bucket.pipe_file("/b/lists/a.csv", b"path\n../renders/x0/r0.exr\n")
    clpipe("run", "flaky://b/lists/a.csv", "-o", "o", *RUN)
    sidecar = json.loads(next(Path("o").rglob("*.json")).read_text())
    assert sidecar["input"] == "flaky://b/renders/x0/r0.exr"
    for path in (b"../../../../tmp/x.exr", b"/etc/x.exr", b"..\\x.exr"):
        bucket.pipe_file("/b/lists/b.csv", b"path\n" + path + b"\n")
        stderr = clpipe("run", "flaky://b/lists/b.csv", "-o", "p", *RUN, status=2).stderr
        assert "leads out of flaky://b" in stderr or "a URL may not contain" in stderr


def test_a_listing_that_fails_is_no_empty_bucket(bucket, clpipe, monkeypatch):
    monkeypatch.setattr(transfers, "MAX_TRIES", 1)
    bucket.pipe_file("/b/set/000000.tar", b"somebody's")

    def refused(self, path, *arguments, **more):
        raise PermissionError("not allowed to list")

    command = ("run", "in", "-o", "flaky://b/set", "--webdataset", 3, *RUN)
    with monkeypatch.context() as patch:
        patch.setattr(Flaky, "find", refused)
        assert "cannot be listed: not allowed to list" in clpipe(*command, status=2).stderr
    assert bucket.cat_file("/b/set/000000.tar") == b"somebody's"
    bucket.pipe_file("/b/set/old/000000.index.json", b"{}")  # of another folder
    assert "000000.tar: has no index" in clpipe(*command, status=2).stderr


def test_a_file_system_of_several_schemes(bucket, clpipe, monkeypatch):
    monkeypatch.setattr(Flaky, "unstrip_protocol", lambda self, name: f"other:/{name}")
    clpipe("run", "flaky://b/renders", "-o", "o", *RUN)
    assert [n for n in written(Path("o")) if n.endswith(".jpg")] == [
        *(f"x0/r{n}.jpg" for n in (0, 2, 4, 6)),
        *(f"x1/r{n}.jpg" for n in (1, 3, 5)),
    ]
    clpipe("run", "flaky://b/r*s/x1/*.exr", "-o", "p", *RUN)
    assert [n for n in written(Path("p")) if n.endswith(".jpg")] == ["r1.jpg", "r3.jpg", "r5.jpg"]


def test_an_input_that_changes_while_its_tar_is_made(bucket, clpipe, monkeypatch):
    command = ("run", "in", "-o", "flaky://b/set", "--webdataset", 7, *RUN)
    put = Flaky.put_file

    def changing(self, local, remote, **more):
        if remote.endswith(".tar"):
            Path("in/x0/r0.exr").write_bytes(Path("in/x1/r1.exr").read_bytes())
        put(self, local, remote, **more)

    with monkeypatch.context() as patch:
        patch.setattr(Flaky, "put_file", changing)
        clpipe(*command)
    assert "already" not in clpipe(*command).stderr  # it is of the old input
    assert "(7 of them were there already)" in clpipe(*command).stderr


@pytest.fixture
def spaced(write_exr, clpipe):
    """A folder with a space in its name, with a render, and the URL of the folder."""
    folder = Path("a folder")
    rng = np.random.default_rng(0)
    write_exr(folder / "r 0.exr", rng.random((16, 24, 3)).astype(np.float32))
    (folder / "mine.toml").write_text(Path(built_in_cameras()["canon-6d"]).read_text())
    (folder / "set.toml").write_text("iso = 800\n")
    return folder.absolute().as_uri()


def test_file_urls_are_paths(spaced, clpipe):
    assert "%20" in spaced
    clpipe("run", "a folder", "-o", "whole", *RUN)
    expected = Path("whole/r 0.jpg").read_bytes()
    spellings = [
        f"{spaced}/r%200.exr",
        f"{spaced}/r 0.exr",
        f"{spaced}/*.exr",
        spaced,
        spaced.replace("file://", "file://localhost"),
        spaced.replace("file://", "file:"),
        spaced.replace("file", "FILE", 1),
    ]
    for number, text in enumerate(spellings):
        out = Path(f"o {number}").absolute()
        clpipe("run", text, "-o", out.as_uri(), *RUN)
        assert (out / "r 0.jpg").read_bytes() == expected
    made = json.loads((out / "r 0.json").read_text())
    assert made["input"] == str(Path("a folder/r 0.exr").absolute())
    command = ("replay", f"{out.as_uri()}/r%200.json", "-o", "again", *RUN[2:4])
    assert "the same bytes" in clpipe(*command).output


def test_file_urls_in_manifests_and_settings(spaced, clpipe, write_exr):
    camera, config = f"{spaced}/mine.toml", f"{spaced}/set.toml"
    Path("list.csv").write_text(f"path,camera\n{spaced}/r%200.exr,{camera}\n")
    clpipe("run", Path("list.csv").absolute().as_uri(), "-o", "o", *RUN)
    assert json.loads(Path("o/a folder/r 0.json").read_text())["camera"] == "canon-6d"
    clpipe("run", "a folder/r 0.exr", "-o", "p", "--camera", camera, "-c", config, *RUN[2:])
    made = json.loads(Path("p/r 0.json").read_text())
    assert (made["camera"], made["iso"]) == ("canon-6d", 800)
    write_exr("a folder/z/r 0.exr", np.ones((16, 24, 1), np.float32))
    layer = f"Depth={spaced}/z/{{name}}.exr"
    clpipe("run", "a folder/r 0.exr", "-o", "q", "--carry", layer, *RUN)
    assert Path("q/r 0.carried.exr").exists()


def test_file_urls_in_python(spaced):
    shots = package.Pipeline(f"{spaced}/set.toml", camera=f"{spaced}/mine.toml", device="numpy")
    assert (shots.settings.iso, shots.chain.camera.name) == (800, "canon-6d")
    drawn = package.Pipeline(camera={"choice": [f"{spaced}/mine.toml"]}, device="numpy")
    assert drawn.chain.camera.name == "canon-6d"
    assert package.load_camera(f"{spaced}/mine.toml").name == "canon-6d"
    out = Path("py out").absolute()
    run = package.run(f"{spaced}/r%200.exr", out.as_uri(), device="numpy", skip=["noise"])
    assert [outcome.status for outcome in run] == ["done"]
    assert (out / "r 0.jpg").exists()
    assert len(package.Dataset(spaced, device="numpy")) == 1
    with tarfile.open("a folder/r.tar", "w") as tar:
        tar.add("a folder/r 0.exr", "r.exr")
    (sample,) = package.StreamingDataset(f"{spaced}/*.tar", device="numpy")
    assert sample["key"] == "r/r.exr"


@pytest.mark.parametrize(
    ("url", "text"),
    [
        ("file://server/a.exr", "found the machine 'server'"),
        ("file://a.exr", "found the machine 'a.exr'"),
        ("file://", "this URL has no path"),
    ],
)
def test_wrong_file_urls(spaced, clpipe, url, text):
    Path("list.csv").write_text(f"path\n{url}\n")
    for arguments in (
        (url, "-o", "o"),
        ("a folder", "-o", url),
        ("a folder", "-o", "o", "--poses", url),
        ("a folder", "-o", "o", "--camera", url),
        ("a folder", "-o", "o", "-c", url),
        ("a folder", "-o", "o", "--trace", url),
        ("a folder", "-o", "o", "--set", f"tone_curve.path={url}"),
        ("list.csv", "-o", "o"),
    ):
        stderr = " ".join(clpipe("run", *arguments, status=2).stderr.split())
        assert text in stderr or (arguments[0] == "list.csv" and "found 'file://'" in stderr)
    with pytest.raises(RequestError, match=text):
        package.Pipeline(camera={"choice": [url]})


def test_file_urls_of_missing_files(clpipe):
    missing = clpipe("run", "file:///none.exr", "-o", "o", status=2).stderr
    assert "/none.exr: there is no such file or folder" in missing
    for name in ("file:///none%00.exr", "none\0.exr"):
        with pytest.raises(RequestError, match="no file can have this name"):
            package.run(name, "o")


def test_only_inputs_and_tars_are_at_other_urls(spaced, clpipe):
    url = "memory://b/x.json"
    for name in ("--poses", "--trace", "--annotations"):
        stderr = clpipe("run", "a folder", "-o", "o", name, url, status=2).stderr
        assert f"found the URL {url}" in stderr
    for name in ("--camera", "-c"):
        stderr = clpipe("run", "a folder", "-o", "o", name, "s3://b/x.toml", status=2).stderr
        assert "found the URL s3://b/x.toml, but only images" in stderr
    assert not Path("memory:").exists()
