"""Training samples: the same as a run's, independent of order and worker."""

import gc
import itertools
import multiprocessing
import os
import pickle
import shutil
import tarfile
import threading
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import clpipe as api
from clpipe.base.errors import DeviceError, ImageError, RequestError
from clpipe.base.process_folder import process_folder
from clpipe.dataset.render_cache import RenderCache
from clpipe.engine.buffers import is_planar
from clpipe.images.read import SourceImage
from clpipe.inputs.loader import ImageLoader
from tests.conftest import file_limit, run_python
from tests.conftest import same_samples as same

ISO = 3200  # a chain that other tests compile too


@pytest.fixture
def renders(write_exr, tmp_path, monkeypatch):
    """Five small renders of two sizes."""
    monkeypatch.chdir(tmp_path)
    rng = np.random.default_rng(0)
    for i in range(5):
        size = (24, 32) if i % 2 else (17, 40)
        write_exr(f"in/r{i}.exr", rng.random((*size, 3)).astype(np.float32) * 0.6)
    return Path("in")


@pytest.fixture
def dataset(renders):
    return api.Dataset(renders, iso=ISO)


def test_a_sample_is_what_a_run_makes(clpipe, renders):
    clpipe("run", renders, "-o", "out", "--iso", ISO, "--frames", 3, "--format", "png")
    many = api.Dataset(renders, iso=ISO, truth=True, keep="quantize", epochs=3)
    assert len(many) == 15
    for number, sample in enumerate(many):
        key, epoch = sample["key"], sample["epoch"]
        assert (key, epoch) == (f"r{number % 5}.exr", number // 5)
        stem = Path("out", key).with_suffix("")
        for name, file in (("image", f"frame{epoch}"), ("truth", "truth")):
            picture = np.asarray(Image.open(f"{stem}.{file}.png"))
            assert sample[name].dtype == np.uint8 and np.array_equal(sample[name], picture)
        raw = sample["quantize"]
        assert raw.dtype == np.float32 and np.array_equal(raw, np.rint(raw))
        assert sample["truth.quantize"].shape == raw.shape
        assert sample["iso"] == ISO


def test_truths_with_and_without_denoising(renders):
    values = {"device": "numpy", "sharpen": {"amount": 0.5}}
    truths = [
        next(iter(api.Dataset(renders, iso=iso, truth=truth, **values)))["truth"]
        for iso, truth in ((100, "clean"), (ISO, "clean"), (ISO, "development"), (ISO, True))
    ]
    assert np.array_equal(truths[0], truths[1])
    assert np.array_equal(truths[2], truths[3])
    assert not np.array_equal(truths[1], truths[2])


@pytest.mark.slow
def test_the_noise_is_as_the_sample_says(write_exr, tmp_path):
    write_exr("flat.exr", np.full((256, 256, 3), 0.2, np.float32))
    (sample,) = api.Dataset(
        tmp_path / "flat.exr", iso=ISO, truth=True, until="normalize", skip=["row_noise"]
    )
    assert sample["image"].dtype == np.float32
    green = (slice(None, None, 2), slice(1, None, 2))
    signal = sample["truth"][green].mean()
    found = (sample["image"] - sample["truth"])[green].var()
    assert found == pytest.approx(sample["a"] * signal + sample["b"], rel=0.05)


def test_by_number_and_one_after_the_other(dataset):
    whole = list(dataset)
    assert [s["key"] for s in whole] == [f"r{i}.exr" for i in range(5)]
    for i in (3, 0, -1):
        same(dataset[i], whole[i])
    for i in (5, -6):
        with pytest.raises(IndexError, match=f"found sample {i}; there are 5"):
            dataset[i]


def test_epochs_repeat_and_differ(dataset, renders):
    three = list(api.Dataset(renders, iso=ISO, epochs=3, threads=1))
    dataset.set_epoch(2)
    for one, two in zip(dataset, three[10:], strict=True):
        same(one, two)
    assert not np.array_equal(three[0]["image"], three[5]["image"])
    endless = api.Dataset(renders, iso=ISO, epochs=None)
    for one, two in zip(itertools.islice(endless, 12), three, strict=False):
        same(one, two)
    with pytest.raises(TypeError, match="endless"):
        len(endless)
    same(endless[11], three[11])
    with pytest.raises(RequestError, match="found epoch -1"):
        dataset.set_epoch(-1)


def test_parts_for_workers(dataset):
    whole = list(dataset)
    parts = [list(dataset.shard(i, 2)) for i in range(2)]
    for one, two in zip(
        whole, itertools.chain(*zip(*parts, strict=False), parts[0][2:]), strict=True
    ):
        same(one, two)
    assert list(dataset.shard(6, 7)) == []
    with pytest.raises(RequestError, match="found shard 2 of 2; expected 0 to 1"):
        dataset.shard(2, 2)


def test_only_a_few_are_ahead(renders):
    for number in range(5, 20):
        shutil.copy("in/r0.exr", f"in/s{number:02}.exr")
    before = set(threading.enumerate())
    samples = iter(api.Dataset("in", iso=ISO, threads=2))
    for _ in range(3):
        next(samples)
    for number in range(8, 20):  # two are decoded, and two more wait
        Path(f"in/s{number:02}.exr").unlink()
    with pytest.raises(ImageError, match=r"s08\.exr"):
        list(samples)
    del samples
    gc.collect()  # of the error that holds the data set
    for thread in {*threading.enumerate()} - before:
        thread.join(1)  # one that would have announced slow compiling may still be ending
        assert not thread.is_alive()


def test_samples_do_not_share_memory(dataset):
    one, two = dataset[0], dataset[0]
    one["image"][:] = 0
    assert two["image"].any() and two["image"].flags.writeable


def test_a_damaged_image_is_named(dataset):
    Path("in/r2.exr").write_bytes(b"no image")
    with pytest.raises(ImageError, match=r"in/r2\.exr"):
        dataset[2]
    samples = iter(dataset)
    assert [next(samples)["key"], next(samples)["key"]] == ["r0.exr", "r1.exr"]
    with pytest.raises(ImageError, match=r"in/r2\.exr"):
        next(samples)
    assert dataset[3]["key"] == "r3.exr"


def test_a_damaged_image_is_skipped_where_that_is_asked_for(renders):
    data = Path("in/r2.exr").read_bytes()
    Path("in/r2.exr").write_bytes(data[: len(data) // 2])  # its header is whole
    skipping = api.Dataset(renders, iso=ISO, on_error="skip")
    with pytest.warns(UserWarning, match="skipped: in/r2.exr"):
        assert [sample["key"] for sample in skipping] == [f"r{i}.exr" for i in (0, 1, 3, 4)]
    with pytest.warns(UserWarning, match="skipped: in/r2.exr"):
        assert [s["key"] for s in skipping.__getitems__([1, 2])] == ["r1.exr", "r3.exr"]
    with pytest.raises(ImageError, match=r"in/r2.exr"):
        list(api.Dataset(renders, iso=ISO))
    Path("in/r2.exr").write_bytes(b"no image")
    with pytest.raises(
        RequestError, match=r"in/r2.exr: cannot be read .*\. Remove such files, or set on_error="
    ):
        api.Dataset(renders, iso=ISO)
    with pytest.warns(UserWarning, match="skipped: in/r2.exr: cannot be read"):
        assert len(api.Dataset(renders, iso=ISO, on_error="skip")) == 4


@pytest.mark.slow
def test_samples_of_a_batch_go_through_together_and_are_the_same(renders, launches):
    drawn = {"iso": {"log_uniform": [400, ISO]}, "patch": api.Patches(16, 4), "raw": "packed"}
    samples = api.Dataset(renders, **drawn, on_error="skip")
    numbers = [0, 7, 5, 18, 2, 13, 8]  # of two sizes of renders, each with an ISO of its own
    alone = [samples[number] for number in numbers]
    launches.clear()
    for one, two in zip(samples.__getitems__(numbers), alone, strict=True):
        same(one, two)
    assert {size[2:] for size in launches} == {(7,)}
    in_order = list(samples)
    for number, one in zip(numbers, alone, strict=True):
        same(in_order[number], one)
    data = Path("in/r1.exr").read_bytes()
    Path("in/r1.exr").write_bytes(data[: len(data) // 2])
    again = api.Dataset(renders, **drawn, on_error="skip")
    with pytest.warns(UserWarning, match="skipped: in/r1.exr"):
        found = again.__getitems__([0, 5, 18])
    same(found[0], alone[0])
    same(found[2], alone[3])
    assert found[1]["key"] == "r2.exr"


@pytest.mark.slow
def test_kept_images_enter(clpipe, renders, dataset):
    clpipe("run", renders, "-o", "kept", "--iso", ISO, "--keep", "normalize")
    again = api.Dataset("kept/*.normalize.exr", start_at="white_balance")
    for one, two in zip(dataset, again, strict=True):
        assert np.array_equal(one["image"], two["image"])


def test_a_manifest_and_draws(renders):
    Path("m.csv").write_text("path,iso\nin/r2.exr,100\nin/r0.exr,\n")
    Path("drawn.toml").write_text("[iso]\nlog_uniform = [200, 6400]\n")
    drawn = api.Dataset("m.csv", "drawn.toml", epochs=3)
    isos = [sample["iso"] for sample in drawn]
    assert isos[0::2] == [100, 100, 100] and len(set(isos[1::2])) == 3
    assert isos == [drawn[i]["iso"] for i in range(6)]
    Path("m.csv").write_text("path,isos\nin/r2.exr,100\n")
    with pytest.raises(RequestError, match=r"m\.csv"):
        api.Dataset("m.csv")


class Loader:
    """What torch's DataLoader does with a map-style dataset: numbers to workers, in order."""

    def __init__(self, dataset, workers, context):
        self.dataset, self.workers = dataset, workers
        self.context = multiprocessing.get_context(context)

    def __iter__(self):
        with ProcessPoolExecutor(self.workers, mp_context=self.context) as pool:
            yield from pool.map(self.dataset.__getitem__, range(len(self.dataset)))


@pytest.mark.slow
def test_workers_that_are_spawned_make_the_same(renders):
    patches = api.Dataset(renders, iso=ISO, patch=api.Patches(16, 2), truth=False)
    whole = list(patches)
    for one, two in zip(Loader(patches, 1, "spawn"), whole, strict=True):
        same(one, two)


@pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")
def test_a_worker_that_is_forked_says_so_and_does_not_hang(dataset):
    dataset[0]
    pool = multiprocessing.get_context("fork").Pool(1)
    with pool, pytest.raises(DeviceError, match="forked from one that had used OpenCL"):
        pool.apply_async(dataset.__getitem__, (1,)).get(timeout=600)


def test_it_pickles_before_and_after_it_was_used(dataset):
    before = pickle.dumps(dataset)
    one = dataset[1]
    for data in (before, pickle.dumps(dataset)):
        same(pickle.loads(data)[1], one)


def test_copies_in_other_processes_read_what_one_has_decoded(renders, monkeypatch):
    samples = api.Dataset(renders, iso=ISO, truth=True)
    other = pickle.loads(pickle.dumps(samples))
    decoded, read = [], ImageLoader.read

    def counted(loader, job):
        decoded.append(job.key)
        return read(loader, job)

    monkeypatch.setattr(ImageLoader, "read", counted)
    whole = [samples[number] for number in range(5)]
    assert len(decoded) == 5
    for number, one in enumerate(whole):
        same(other[number], one)
        same(samples[number], one)
    assert len(decoded) == 5
    os.utime("in/r2.exr", (1, 1))  # another file, for all that is known
    same(other[2], whole[2])
    assert decoded[5:] == ["r2.exr"]
    decoded_files = {*process_folder().rglob("*.npy")}
    assert len(decoded_files) >= 5
    del samples, other
    gc.collect()
    assert len({*process_folder().rglob("*.npy")}) <= len(decoded_files) - 5


def test_a_render_in_planes_stays_in_planes(tmp_path):
    planes = np.arange(24, dtype=np.float16).reshape(3, 2, 4)
    image = SourceImage(planes.transpose(1, 2, 0), "", "", (), {})
    kept = RenderCache(1000)
    found = [kept.get("a", lambda: image).pixels, pickle.loads(pickle.dumps(kept)).get("a", None)]
    for pixels in (found[0], found[1].pixels):
        assert is_planar(pixels) and np.array_equal(pixels, image.pixels)
        assert not pixels.flags.writeable


def test_a_render_that_cannot_be_written_does_not_count():
    image = SourceImage(np.ones((200, 300, 3), np.float16), "", "", (), {})
    kept = RenderCache(10**6)
    with file_limit(1000):
        assert kept.get("a", lambda: image) is image
    assert kept.size_in_bytes == 0
    assert kept.get("a", lambda: image).pixels.flags.writeable is False  # mapped now


@pytest.mark.parametrize(("ending", "size"), [(".npy", 100), (".npy", 3), (".pickle", 20)])
def test_a_kept_image_that_a_full_disk_cut_off_is_decoded_again(ending, size):
    image = SourceImage(np.ones((64, 64, 3), np.float16), "", "", (), {})
    kept = RenderCache(10**6)
    kept.get("a", lambda: image)
    (path,) = kept._folder.glob(f"*{ending}")
    path.write_bytes(path.read_bytes()[:size])
    worker = pickle.loads(pickle.dumps(kept))  # it has not opened the file
    assert np.array_equal(worker.get("a", lambda: image).pixels, image.pixels)


def test_a_header_that_python_3_11_fails_to_parse_costs_only_a_decoding(monkeypatch):
    image = SourceImage(np.ones((64, 64, 3), np.float16), "", "", (), {})
    kept = RenderCache(10**6)
    kept.get("a", lambda: image)
    worker = pickle.loads(pickle.dumps(kept))  # it has not opened the file

    def fail(*_, **__):
        raise SystemError("AST constructor recursion depth mismatch (before=42, after=41)")

    monkeypatch.setattr(np, "load", fail)
    assert np.array_equal(worker.get("a", lambda: image).pixels, image.pixels)


KILLED = """
import os, signal, clpipe
data = clpipe.StreamingDataset("a.tar", device="numpy", stages=["exposure"])
samples = iter(data)
next(samples)
for folder, _, names in os.walk(os.environ["TMPDIR"]):
    print(folder, names)
os.kill(os.getpid(), signal.SIGKILL)
"""


@pytest.mark.slow
def test_what_a_killed_process_leaves_the_next_one_removes(renders, tmp_path):
    with tarfile.open("a.tar", "w") as tar:
        tar.add("in/r0.exr", "r0.exr")
    temporary = tmp_path / "temporary"
    temporary.mkdir()
    left = run_python("-c", KILLED, TMPDIR=temporary, status=-9).stdout
    assert "r0.exr" in left and ".npy" in left
    assert [path for path in temporary.rglob("*") if path.suffix in (".exr", ".npy")]
    following = "from clpipe.base.process_folder import process_folder; process_folder()"
    run_python("-c", following, TMPDIR=temporary)
    assert [path for path in temporary.rglob("*") if path.is_file()] == []


def test_tars_are_streamed(renders):
    for name, numbers in (("a", (0, 1)), ("b", (2,)), ("c", (3, 4))):
        with tarfile.open(f"{name}.tar", "w") as tar:
            for number in numbers:
                tar.add(f"in/r{number}.exr", f"sub/r{number}.exr")
            tar.addfile(tarfile.TarInfo("../outside.exr"))
    streamed = api.StreamingDataset("?.tar", iso=ISO, truth=True)
    first, second = list(streamed), list(streamed)
    keys = ["a/sub/r0.exr", "a/sub/r1.exr", "b/sub/r2.exr", "c/sub/r3.exr", "c/sub/r4.exr"]
    assert [sample["key"] for sample in first] == keys
    assert [sample["epoch"] for sample in second] == [1] * 5
    for sample, number in zip(first, range(5), strict=True):
        single = api.Dataset(f"in/r{number}.exr", iso=ISO, truth=True)[0]
        assert np.array_equal(sample["truth"], single["truth"])
        assert not np.array_equal(sample["image"], single["image"])  # another key, other noise
    assert not np.array_equal(first[0]["image"], second[0]["image"])
    assert not Path("outside.exr").exists()


def test_tars_that_cannot_be_streamed(renders):
    with pytest.raises(RequestError, match=r"no\*.tar: no such tar exists"):
        api.StreamingDataset("no*.tar")
    with pytest.raises(RequestError, match="each pass over a StreamingDataset is an epoch"):
        api.StreamingDataset("no*.tar", epochs=2)
    Path("bad.tar").write_bytes(b"no tar at all")
    with pytest.raises(ImageError, match=r"bad\.tar: cannot be read; it is damaged"):
        list(api.StreamingDataset("bad.tar"))
