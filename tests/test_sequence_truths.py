"""Ground truth of sequences: optical flow compared with a formula, times of rows, and tars."""

import csv
import json
import re
import tarfile
from pathlib import Path

import numpy as np
import pytest

import clpipe
from clpipe.base.errors import RequestError
from clpipe.images.read import read_image
from clpipe.reference.carried import Layer, between_rows
from tests.test_carry import planes

WIDTH, HEIGHT, FILES = 64, 48, 7
CENTRE = np.array([WIDTH, HEIGHT]) / 2
READOUT, EXPOSURE = 0.6, 0.2  # in frames, of 0.1 s each
ROLLING = {
    "subframes": FILES,
    "exposure_time": 0.1 * EXPOSURE,
    "line_time": 0.1 * READOUT / (HEIGHT - 1),
}
BARREL = {"method": "brown_conrady", "fx": 60.0, "k1": -0.1, "p1": 0.003, "fit": True}
PINCUSHION = {"method": "brown_conrady", "fx": 60.0, "k1": 0.15}
CARRY = ["next.flow", "previous.flow"]


def positions(points, time, plane=False):
    """Where points of a moving plane are seen at some times, or the points that are seen there."""
    turn, size = 0.02 * time, np.exp(0.02 * time)
    matrix = size * np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    matrix = np.moveaxis(matrix, (0, 1), (-2, -1))
    shift = CENTRE + np.multiply.outer(time, (4.0, -3.0))
    if plane:
        return np.linalg.solve(matrix, (points - shift)[..., None])[..., 0]
    return (matrix @ points[..., None])[..., 0] + shift


def centres(width, height):
    return np.stack(np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5), -1)


def write_frame(write_exr, name, time):
    """A frame of the plane, exact at each pixel, with its flow to the frames before and after."""
    at = centres(WIDTH, HEIGHT)
    on_plane = positions(at, np.full(at.shape[:2], time), plane=True)
    x, y = on_plane[..., 0], on_plane[..., 1]
    light = 0.3 + 0.1 * (np.sin(x / 5) + np.sin(y / 6) + 0.5 * np.sin((x + y) / 4))
    flows = [
        positions(on_plane, np.full(at.shape[:2], time + direction)) - at for direction in (1, -1)
    ]
    channels = [light, light, light, *np.moveaxis(flows[0], -1, 0), *np.moveaxis(flows[1], -1, 0)]
    names = "R,G,B,next.flow.X,next.flow.Y,previous.flow.X,previous.flow.Y"
    write_exr(name, np.stack(channels, -1), names, half=False)


@pytest.fixture
def frames(write_exr, tmp_path, monkeypatch):
    """Three frames, each at one moment."""
    monkeypatch.chdir(tmp_path)
    for number in range(3):
        write_frame(write_exr, f"in/f{number + 8}.exr", number)


@pytest.fixture
def exposures(write_exr, tmp_path, monkeypatch):
    """Three exposures of a rolling shutter, of several files each, whose names are not padded."""
    monkeypatch.chdir(tmp_path)
    for number in range(3 * FILES):
        exposure, file = divmod(number, FILES)
        time = exposure + (file + 0.5) / FILES * (READOUT + EXPOSURE)
        write_frame(write_exr, f"in/f{number + 1}.exr", time)


def run(out="out", **options):
    made = list(clpipe.run("in", out, device="numpy", sequence=True, **options))
    assert not [outcome for outcome in made if outcome.status == "failed"], made
    return out


def flow_error(out, name, readout=0.0, distortion=None):
    """The largest error of a frame's flow, px: the second one of the sequence, where it is valid.

    A vector is followed from the picture's pixel through the lens to the plane, and back.
    """
    geometry = clpipe.Pipeline(device="numpy", distortion=distortion or {}).chain.geometry
    carried = planes(f"{out}/{name}.carried.exr")
    height, width = carried["valid"].shape
    at = centres(width, height)

    def in_render(points):
        if not geometry:
            return points
        return np.stack(geometry.origins(points[..., 0], points[..., 1], WIDTH, HEIGHT), -1)

    def seen(frame, points):  # the time at which a row is exposed
        row = (points[..., 1] - 0.5) / (HEIGHT - 1)
        return frame + readout * row + (EXPOSURE / 2 if readout else 0)

    start = in_render(at)
    on_plane = positions(start, seen(1, start), plane=True)
    worst = []
    for layer, frame in zip(CARRY, (2, 0), strict=True):
        flow = np.stack([carried[f"{layer}.{axis}"] for axis in "XY"], -1)
        end = start
        for _ in range(50):  # the row and the time at which it sees a point depend on each other
            end = positions(on_plane, seen(frame, end))
        error = np.linalg.norm(in_render(at + flow) - end, axis=-1)[carried["valid"] == 1]
        worst.append(error.max())
    return max(worst)


@pytest.mark.parametrize("distortion", [{}, BARREL, PINCUSHION])
def test_flow_of_frames_is_that_of_the_formula(frames, distortion):
    out = run(carry=CARRY, distortion=distortion)
    assert flow_error(out, "f9", distortion=distortion) < 0.01


@pytest.mark.parametrize("distortion", [{}, PINCUSHION])
def test_flow_of_a_rolling_shutter_leads_to_the_row_that_sees_the_surface(exposures, distortion):
    options = {"carry": CARRY, "distortion": distortion}
    shutter = ROLLING | {"frame_time": 0.1}
    out = run("rows", truth_at="rows", shutter=shutter, **options)
    assert flow_error(out, f"f{FILES + 1}", READOUT, distortion) < 0.02
    run("middle", shutter=ROLLING, **options)
    assert flow_error("middle", f"f{FILES + 1}", READOUT, distortion) > 0.2


def test_flow_of_a_rolling_shutter_is_that_of_its_pictures(exposures):
    shutter = ROLLING | {"frame_time": 0.1}
    plain = {"until": "exposure", "format": "exr", "skip": ["optical_blur"]}
    moved = {}
    for moment in ("rows", "middle"):
        run(moment, truth_at=moment, shutter=shutter, carry=CARRY, **plain)
        first, second = (
            read_image(Path(f"{moment}/f{1 + FILES * n}.exr")).pixels[..., 1].astype(np.float64)
            for n in (1, 2)
        )
        carried = planes(f"{moment}/f{FILES + 1}.carried.exr")
        ends = centres(WIDTH, HEIGHT) - 0.5
        ends += np.stack([carried["next.flow.X"], carried["next.flow.Y"]], -1)
        inside = ((ends > 1) & (ends < [WIDTH - 2, HEIGHT - 2])).all(-1)
        left, top = np.floor(ends[inside]).astype(int).T
        right, down = (ends[inside] - np.stack([left, top], -1)).T
        other = sum(
            (right if dx else 1 - right) * (down if dy else 1 - down) * second[top + dy, left + dx]
            for dx in (0, 1)
            for dy in (0, 1)
        )
        slopes = np.stack([each[inside] for each in np.gradient(first)[::-1]], -1)
        moved[moment] = np.linalg.lstsq(slopes, first[inside] - other, rcond=None)[0]
    assert np.abs(moved["rows"]).max() < 0.02
    assert np.abs(moved["middle"]).max() > 0.05


def test_vectors_between_rows_follow_their_direction_in_time():
    # Down by 10 rows in a frame, in a shutter that takes 0.01 frames for a row. Y of Blender's
    # Vector points up, and its second vector comes from the next frame.
    vector = np.array([[[-5.0, 10.0, -5.0, 10.0]]])
    layer = Layer("flow", vector, vectors=(((0, 1), (1, -1)), ((2, -1), (3, 1))))
    rows = between_rows(layer, (-1, 1), 0.01).pixels[0, 0]
    # Back by -10 rows, so the other frame's row is 0.1 frames and more earlier.
    assert rows == pytest.approx(vector[0, 0] / [1 - 0.1, 1 - 0.1, 1 - 0.1, 1 - 0.1])
    fast = Layer("flow", np.array([[[0.0, 100.0]]]), vectors=(((0, 1), (1, 1)),))
    assert np.isnan(between_rows(fast, (1,), 0.01).pixels).all()
    assert between_rows(fast, (-1,), 0.01).pixels[0, 0].tolist() == [0, 50]


def test_flow_of_rows_needs_the_time_between_frames(exposures):
    made = list(
        clpipe.run("in", "out", device="numpy", truth_at="rows", carry=CARRY, shutter=ROLLING)
    )
    assert {outcome.status for outcome in made} == {"failed"}
    assert "optical flow needs shutter.frame_time, the time from frame" in str(made[0].error)


def test_layers_of_rows_are_of_the_file_in_the_middle_of_their_exposure(write_exr, tmp_path):
    for number in range(4):
        write_exr(f"in/f{number}.exr", np.full((8, 4, 3), 0.2))
        write_exr(f"in/f{number}_depth.exr", np.full((8, 4, 1), 1.0 + number), "Z", half=False)
    shutter = {"subframes": 4, "exposure_time": 0.008, "line_time": 0.001}
    options = {"shutter": shutter, "carry": ["depth"], "truth_at": "rows", "device": "numpy"}
    (made,) = clpipe.run(tmp_path / "in", tmp_path / "out", **options)
    carried = planes(tmp_path / "out/f0.carried.exr")
    # 15 ms in four parts: the middles of rows 0 to 3 are in the second one, until 7.5 ms.
    assert carried["depth.Z"][:, 0].tolist() == [2] * 4 + [3] * 4
    record = json.loads((tmp_path / "out/f0.json").read_text())
    assert [each["file"] for each in record["carried"]] == ["f1_depth.exr", "f2_depth.exr"]
    (made,) = clpipe.run(tmp_path / "in", tmp_path / "out", **options)
    assert made.status == "skipped"
    write_exr("in/f2_depth.exr", np.full((8, 4, 1), 9.5), "Z", half=False)
    (made,) = clpipe.run(tmp_path / "in", tmp_path / "out", **options)
    assert made.status == "done"


def test_frames_of_different_lenses_have_no_flow(frames, write_exr):
    drift = {"method": "brown_conrady", "fx": 60.0, "k1": {"drift": [-0.1, 0.1], "frames": 3}}
    with pytest.raises(RequestError, match=r"in/f9.exr has another lens, zoom or crop than in/f8"):
        run(carry=CARRY, distortion=drift)
    run("plain", distortion=drift)
    run("drawn", carry=CARRY, distortion=drift | {"k1": {"uniform": [-0.1, 0.1]}})


def test_frames_that_zoom_have_no_flow(frames):
    rows = "".join(f"in/f{n}.exr,{60 + 5 * (n == 10)}\n" for n in (8, 9, 10))
    Path("list.csv").write_text(f"path,distortion.fx\n{rows}")
    options = {"device": "numpy", "sequence": True, "distortion": PINCUSHION | {"fx": 50.0}}
    with pytest.raises(RequestError, match=r"f10.exr .* has another lens, zoom or crop than in/f8"):
        clpipe.run("list.csv", "out", carry=CARRY, **options)


def test_sub_frames_of_a_sequence_are_in_the_order_of_their_numbers(exposures):
    out = run(shutter=ROLLING)
    record = json.loads(Path(out, "f8.json").read_text())
    assert [each["file"] for each in record["subframes"]] == [f"f{n}.exr" for n in range(8, 15)]
    Path("in/f10.exr").rename("in/f30.exr")
    with pytest.raises(RequestError, match=r"in/f8.exr to in/f15.exr: shutter.subframes is 7"):
        run("gap", shutter=ROLLING)


def test_a_sidecar_has_the_times_of_rows(exposures):
    run(shutter=ROLLING)
    times = json.loads(Path("out/f1.json").read_text())["row_times"]
    assert times["rows"] == HEIGHT
    assert times["step"] == pytest.approx(ROLLING["line_time"])
    assert times["exposures"] == [pytest.approx([0, 0.02])]
    run("global", shutter=ROLLING | {"line_time": 0.0})
    assert "row_times" not in json.loads(Path("global/f1.json").read_text())
    merged = {"method": "staggered", "ratio": 4.0}
    run("merged", shutter=ROLLING, sensor_noise=merged)
    times = json.loads(Path("merged/f1.json").read_text())["row_times"]
    assert times["exposures"][0] == pytest.approx([0, 0.02])
    assert times["exposures"][1] == pytest.approx([0.02, 0.025])


def members(folder):
    """The names and bytes in the tars of a folder, in their order."""
    found = []
    for path in sorted(Path(folder).glob("*.tar")):
        with tarfile.open(path) as tar:
            found += [(member.name, tar.extractfile(member).read()) for member in tar]
    return found


def test_pairs_in_tars_are_in_temporal_order_and_resumed(frames):
    options = {"truth": "clean", "webdataset": 2, "exposure": {"method": "auto"}}
    options |= {"iso": 800, "control": {"iso_max": 3200.0}}
    run(**options)
    found = members("out")
    ends = ("jpg", "json", "truth_clean.jpg", "truth_clean.json")
    assert [name for name, _ in found] == [f"f{n}.{end}" for n in (8, 9, 10) for end in ends]
    pictures = [item for item in found if item[0].endswith("jpg")]
    Path("out/000000.tar").unlink()
    run(**options)
    assert [item for item in members("out") if item[0].endswith("jpg")] == pictures
    # The exposure of each frame is in its sidecars, and in the table of the run.
    with open("out/run.csv") as file:
        rows = {row["name"]: row for row in csv.DictReader(file)}
    assert list(rows) == ["f8", "f9", "f10"]
    for name, text in found:
        if name.endswith("json"):
            record = json.loads(text)
            row = rows[re.sub(r"\..*", "", name)]
            assert record["photometry"]["ev"] == pytest.approx(float(row["exposure.ev"]))
            assert record["iso"] == float(row["iso"])
