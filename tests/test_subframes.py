"""shutter.subframes: exposures from several frames of a renderer."""

import json
import os
import tracemalloc
import weakref
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
from PIL import Image

from clpipe.chain.request import Request
from clpipe.dataset import Dataset
from clpipe.inputs import loader
from clpipe.inputs.find import find_jobs
from clpipe.stages.shutter import Rows
from tests.conftest import written

PLAIN = ("--skip", "optical_blur", "--device", "numpy", "--until", "exposure", "--format", "exr")
EIGHT = {"subframes": 8, "exposure_time": 0.02, "line_time": 0.0}


@pytest.fixture
def frames(tmp_path, write_exr, monkeypatch):
    """A bar that moves four columns a frame through eight frames of 24 rows, in a folder."""
    monkeypatch.chdir(tmp_path)
    Path("in").mkdir()
    for number in range(8):
        image = np.full((24, 40, 3), 0.1, np.float16)
        image[:, 4 * number : 4 * number + 4] = 0.9
        write_exr(f"in/f{number:02}.exr", image)
    return tmp_path / "in"


def exposed(clpipe, *options, out="o"):
    """What falls on the sensor of a run over the frames, (24, 40), and the run's sidecar."""
    from clpipe.images.read import read_image

    clpipe("run", "in", "-o", out, *PLAIN, *options)
    (path,) = Path(out).glob("*.exr")
    record = json.loads(path.with_suffix(".json").read_text())
    return 2 * read_image(path).pixels[..., 0].astype(np.float32), record  # less headroom


def test_frames_of_an_exposure_are_averaged(frames, clpipe):
    seen, record = exposed(clpipe, "--set", "shutter.subframes=8")
    assert written(Path("o")) == ["f00.exr", "f00.json"]
    assert seen[:, :32] == pytest.approx(np.full((24, 32), 0.1 * 7 / 8 + 0.9 / 8), abs=1e-3)
    assert [each["file"] for each in record["subframes"]] == [f"f{k:02}.exr" for k in range(8)]
    for some, names in ((4, ["f00.exr", "f04.exr"]), (2, None)):
        clpipe("run", "in", "-o", f"o{some}", *PLAIN, "--set", f"shutter.subframes={some}")
        made = [name for name in written(Path(f"o{some}")) if name.endswith("exr")]
        assert len(made) == 8 / some and (names is None or made == names)


def test_rows_of_a_rolling_shutter_see_later_frames(frames, clpipe):
    # The first row is exposed during the first frame, the last during the last, and each as long.
    rolling = {"subframes": 8, "exposure_time": 1.0, "line_time": 7 / 23}
    sets = [x for k, v in rolling.items() for x in ("--set", f"shutter.{k}={v}")]
    seen, _ = exposed(clpipe, *sets)
    middles = (seen - 0.1) @ np.arange(40) / (seen - 0.1).sum(1)
    assert middles == pytest.approx(1.5 + 4 * np.arange(24) * 7 / 23, abs=0.05)


def test_shares_of_frames_are_whole_exposures():
    for shutter in (Rows(**EIGHT), Rows(subframes=3, exposure_time=0.01, line_time=1e-3)):
        weights = shutter.weights(shutter.subframes, 30)
        assert weights.sum(0) == pytest.approx(1)
        assert weights.min() >= 0
    assert Rows(**EIGHT).weights(8, 5) == pytest.approx(np.full((8, 5), 1 / 8))


def test_a_run_is_resumed_and_replayed_with_all_frames(frames, clpipe, write_exr):
    options = ("--set", "shutter.subframes=8", "--device", "numpy")
    clpipe("run", "in", "-o", "o", *options)
    assert "there already" in clpipe("run", "in", "-o", "o", *options).stderr
    clpipe("replay", "o/f00.json", "-o", "r", "--device", "numpy")
    assert Path("r/f00.jpg").read_bytes() == Path("o/f00.jpg").read_bytes()
    write_exr("in/f05.exr", np.full((24, 40, 3), 0.3, np.float16))
    again = clpipe("replay", "o/f00.json", "-o", "r2", status=2)
    assert "f05.exr" in again.stderr and "changed" in again.stderr
    assert "there already" not in clpipe("run", "in", "-o", "o", *options).stderr


def test_each_frame_is_compared_with_what_it_was(frames, clpipe):
    run = ("run", "in", "-o", "o", "--set", "shutter.subframes=8", "--device", "numpy")

    def is_made_again():
        is_made = "there already" not in clpipe(*run).stderr
        assert "there already" in clpipe(*run).stderr
        return is_made

    for path in Path("in").iterdir():
        path.write_bytes(path.read_bytes().ljust(1000, b"\0"))  # all are of one size
    assert is_made_again()
    second, fifth = Path("in/f02.exr"), Path("in/f05.exr")
    second.rename("other")
    fifth.rename(second)
    Path("other").rename(fifth)
    assert is_made_again()
    fifth.write_bytes(Path("in/f03.exr").read_bytes())
    os.utime(fifth, (1e9, 1e9))  # of the same size, and older than all
    assert is_made_again()
    record = json.loads(Path("o/f00.json").read_text())
    recorded = [(each["size"], each["modified"]) for each in record["subframes"]]
    found = [Path(f"in/f{number:02}.exr").stat() for number in range(8)]
    assert recorded == [(status.st_size, status.st_mtime_ns) for status in found]


def test_a_dataset_and_a_manifest_group_frames_too(frames, write_exr):
    (sample,) = Dataset("in", shutter={"subframes": 8}, device="numpy")
    assert sample["image"].shape == (24, 40, 3)
    Path("list.csv").write_text(
        "path,iso\n" + "".join(f"in/f{k:02}.exr,{100 * (1 + k // 4)}\n" for k in range(8))
    )
    assert len(Dataset("list.csv", shutter={"subframes": 4}, device="numpy")) == 2


def test_rows_that_differ_are_no_exposure(frames, clpipe):
    Path("list.csv").write_text("path,iso\nin/f00.exr,100\nin/f01.exr,200\n")
    again = clpipe("run", "list.csv", "-o", "o", "--set", "shutter.subframes=2", status=2)
    assert "its values differ from those of in/f00.exr" in again.stderr


def test_a_frame_of_another_size_fails_alone(frames, clpipe, write_exr):
    write_exr("in/f03.exr", np.zeros((24, 39, 3), np.float16))
    options = ("--set", "shutter.subframes=4", "--device", "numpy")
    stderr = clpipe("run", "in", "-o", "o", *options, status=1).stderr
    assert "this frame is 39x24, but in/f00.exr, in the same exposure, has 40x24" in stderr
    with Image.open("o/f04.jpg") as picture:
        assert picture.size == (40, 24)


def turned(degrees, x):
    """A view of a camera at (x, 0, 0) that has turned about its axis of view."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    r = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    return {"R": r.tolist(), "t": (-r @ [x, 0, 0]).tolist()}


@pytest.fixture
def moving(write_exr):
    """Seven files of an exposure: depth, label and pose of each say its number."""
    views = []
    for k in range(7):
        write_exr(f"in/f{k}.exr", np.full((24, 40, 3), 0.2, np.float32))
        write_exr(f"in/f{k}_depth.exr", np.full((24, 40, 1), 1.0 + k), "Z")
        views.append({"file": f"f{k}.exr", "K": K, **turned(2 * k, k)})
    Path("cameras.json").write_text(json.dumps({"views": views}))


K = [[50, 0, 20], [0, 50, 12], [0, 0, 1]]
SEVEN = ("run", "in", "--device", "numpy", "--poses", "cameras.json", "--carry", "depth")
SEVEN += ("--set", "shutter.subframes=7")


def depths(folder):
    part = OpenEXR.File(f"{folder}/f0.carried.exr", separate_channels=True).parts[0]
    return {name: float(c.pixels[3, 3]) for name, c in part.channels.items() if name != "valid"}


@pytest.mark.parametrize(("moment", "number"), [("start", 0), ("middle", 3), ("end", 6)])
def test_what_goes_with_an_exposure_is_that_of_a_moment(clpipe, moving, moment, number):
    options = () if moment == "middle" else ("--truth-at", moment)
    clpipe(*SEVEN, "-o", "o", *options)
    assert list(depths("o").values()) == [1 + number]
    pose = json.loads(Path("o/f0.json").read_text())["pose"]
    np.testing.assert_allclose(pose["t"], turned(2 * number, number)["t"], atol=1e-12)
    again = clpipe(*SEVEN, "-o", "o", *options).stderr
    assert "there already" in again
    again = clpipe(*SEVEN, "-o", "o", "--truth-at", "start" if number else "end").stderr
    assert "there already" not in again


def test_all_moments_go_along(clpipe, moving):
    clpipe(*SEVEN, "-o", "o", "--truth-at", "all")
    assert depths("o") == {"depth.Z": 4, "start.depth.Z": 1, "end.depth.Z": 7}
    listed = json.loads(Path("o/f0.json").read_text())["carried"]
    assert [(each["moment"], each["file"]) for each in listed] == [
        ("middle", "f3_depth.exr"),
        ("start", "f0_depth.exr"),
        ("end", "f6_depth.exr"),
    ]


def test_rows_of_a_rolling_shutter_have_poses(clpipe, moving):
    given = ("--set", "shutter.exposure_time=0.01", "--set", "shutter.line_time=0.001")
    clpipe(*SEVEN, "-o", "o", *given)
    motion = json.loads(Path("o/f0.json").read_text())["motion"]
    assert len(motion["files"]) == 7 and motion["readout_time"] == pytest.approx(0.023)
    # 33 ms in seven parts, of which the one of number k has turned by 2 k degrees in its middle.
    for row, time in (("first_row", 0.005), ("last_row", 0.028)):
        number = time / 0.033 * 7 - 0.5
        expected = turned(2 * number, number)
        np.testing.assert_allclose(motion[row]["R"], expected["R"], atol=1e-9)
        np.testing.assert_allclose(motion[row]["t"], expected["t"], atol=1e-9)
    (frame,) = json.loads(Path("o/transforms.json").read_text())["frames"]
    assert frame["rolling_shutter_time"] == motion["readout_time"]
    x = [np.array(frame[f"transform_matrix{n}"])[0, 3] for n in ("_first_row", "", "_last_row")]
    np.testing.assert_allclose(x, [0.5606, 3, 5.4394], atol=1e-3)
    (view,) = json.loads(Path("o/cameras.json").read_text())["views"]
    assert view["motion"] == motion


def test_a_camera_that_stands_still_has_no_motion(clpipe, moving):
    views = [{"file": f"f{k}.exr", "K": K, **turned(0, 1)} for k in range(7)]
    Path("cameras.json").write_text(json.dumps({"views": views}))
    clpipe(*SEVEN, "-o", "o")
    assert "motion" not in json.loads(Path("o/f0.json").read_text())


def test_a_sequence_that_does_not_divide_is_named(clpipe, write_exr):
    for number in range(4):
        write_exr(f"in/r{number}.exr", np.full((6, 8, 3), 0.2))
    command = ("run", "in", "-o", "o", "--sequence", "--set", "shutter.subframes=3")
    stderr = clpipe(*command, status=2).stderr
    assert "in/r0.exr and others: shutter.subframes is 3, but this sequence has 4 images" in stderr


def test_one_frame_at_a_time_is_in_memory(write_exr, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for number in range(8):
        write_exr(f"in/f{number}.exr", np.full((300, 400, 3), number / 8, np.float16))
    arrays, alive, read = [], [], loader.read_source

    def noted(*arguments):
        alive.append(sum(array() is not None for array in arrays))
        source = read(*arguments)
        arrays.append(weakref.ref(source.pixels))
        return source

    monkeypatch.setattr(loader, "read_source", noted)
    images = loader.ImageLoader(Request({"shutter": {"subframes": 8}}))
    (job,) = images.exposures(find_jobs(["in"], Path("out"), images.endings()))
    images.read(job)  # the chain is made here, and not counted below
    assert alive == [0] * 8
    tracemalloc.start()
    try:
        sum_bytes = images.read(job).pixels.nbytes
        # The sum in floats, a frame in halves, and a few rows.
        assert tracemalloc.get_traced_memory()[1] < 1.9 * sum_bytes
    finally:
        tracemalloc.stop()
