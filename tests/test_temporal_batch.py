"""Runs of sequences with temporal denoising: their order, resuming and failures."""

import threading
from itertools import pairwise

import numpy as np
import OpenImageIO as oiio
import pytest

import clpipe
from clpipe.base.errors import RequestError
from clpipe.inputs.loader import ImageLoader
from tests.conftest import cli_output, contents

STAGES = ["exposure", "mosaic", "sensor_noise", "demosaic", "temporal_denoise", "tone_curve"]
OPTIONS = {"sequence": True, "iso": 6400, "stages": [*STAGES, "gamma"], "format": "png"}
WAIT = 120  # s; only a hang takes so long


@pytest.fixture
def frames(write_exr, tmp_path):
    """Two static sequences of five frames, which only their noise distinguishes."""
    scene = np.random.default_rng(0).random((40, 60, 3)).astype(np.float32) * 0.5
    for name in (f"{camera}/{number}" for camera in "ab" for number in range(5)):
        write_exr(f"frames/{name}.exr", scene)
    return tmp_path


def run(folder, out, **options):
    made = clpipe.run(folder / "frames", folder / out, **{**OPTIONS, **options})
    return {outcome.job.key: outcome for outcome in made}


def pictures(folder):
    return {name: data for name, data in contents(folder).items() if name.endswith(".png")}


def pixels(path):
    return oiio.ImageBuf(str(path)).get_pixels(oiio.FLOAT)


def test_frames_are_averaged_in_order_whatever_their_threads_do(frames, monkeypatch):
    """A frame whose file is read last is still developed before those after it."""
    run(frames, "expected", jobs=1)
    last_is_read, read = threading.Event(), ImageLoader.read

    def held(self, job):
        if job.key == "a/1.exr":
            assert last_is_read.wait(WAIT)
        source = read(self, job)
        if job.key == "a/3.exr":
            last_is_read.set()
        return source

    monkeypatch.setattr(ImageLoader, "read", held)
    run(frames, "out", jobs=4)
    assert pictures(frames / "out") == pictures(frames / "expected")
    assert len(pictures(frames / "out")) == 10


def test_noise_falls_from_frame_to_frame_in_each_sequence(frames):
    run(frames, "out", truth="development")
    for camera in "ab":
        noise = [
            (
                pixels(frames / f"out/{camera}/{n}.png")
                - pixels(frames / f"out/{camera}/{n}.truth.png")
            ).std()
            for n in range(5)
        ]
        assert noise[4] < 0.7 * noise[0]
        assert all(later < 1.03 * earlier for earlier, later in pairwise(noise))


def test_a_missing_frame_recomputes_its_sequence_and_no_other(frames):
    run(frames, "out")
    first = pictures(frames / "out")
    assert {outcome.status for outcome in run(frames, "out").values()} == {"skipped"}
    (frames / "out/a/3.png").unlink()
    statuses = {key: outcome.status for key, outcome in run(frames, "out").items()}
    assert {status for key, status in statuses.items() if key[0] == "a"} == {"done"}
    assert {status for key, status in statuses.items() if key[0] == "b"} == {"skipped"}
    assert pictures(frames / "out") == first


def test_an_edited_picture_is_kept_when_its_sequence_is_recomputed(frames):
    run(frames, "out")
    edited = frames / "out/a/3.png"
    edited.write_bytes((frames / "out/b/0.png").read_bytes())
    before = pictures(frames / "out")
    outcomes = run(frames, "out")
    assert {outcome.status for key, outcome in outcomes.items() if key != "a/3.exr"} == {"skipped"}
    assert outcomes["a/3.exr"].status == "failed"
    (frames / "out/a/1.png").unlink()
    assert run(frames, "out")["a/3.exr"].status == "failed"
    assert edited.read_bytes() == before["a/3.png"]


def test_a_frame_cannot_be_replayed_without_those_before(frames):
    run(frames, "out")
    text = cli_output("replay", frames / "out/a/3.json", "-o", frames / "again", status=2)
    assert "depends on the frames before it" in text


def test_a_frame_that_cannot_be_read_is_like_a_missing_one(frames):
    damaged = frames / "frames/a/2.exr"
    damaged.write_bytes(b"no picture")
    outcomes = run(frames, "out")
    assert [key for key, outcome in outcomes.items() if outcome.status == "failed"] == ["a/2.exr"]
    damaged.unlink()
    run(frames, "expected")
    assert pictures(frames / "out") == pictures(frames / "expected")


def test_patches_of_frames_are_parts_of_the_pictures(frames):
    run(frames, "out")
    run(frames, "patches", patch=16)
    whole = pixels(frames / "out/a/4.png")
    found = [pixels(frames / "patches" / n) for n in pictures(frames / "patches") if "a/4" in n]
    assert found
    places = [whole[y : y + 16, x : x + 16] for y in range(25) for x in range(45)]
    for patch in found:
        assert any(np.array_equal(patch, place) for place in places)


def test_several_processes_are_rejected_and_single_images_warn(frames, caplog):
    with pytest.raises(RequestError, match="processes: temporal_denoise needs the frames"):
        run(frames, "out", processes=2)
    with pytest.raises(RequestError, match="dask: temporal_denoise needs the frames"):
        run(frames, "out", dask="tcp://localhost:1")
    run(frames, "out", sequence=False)
    assert "temporal_denoise changes only frames of sequences; add sequence" in caplog.text
