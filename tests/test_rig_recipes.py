"""The recipes for rigs: the layouts of KITTI and nuScenes, and the poses of a rolling shutter."""

import json

import numpy as np
import pytest
from PIL import Image

import clpipe
from tests.conftest import ROOT
from tests.markdown import blocks

PAGE = ROOT / "docs" / "robotics.md"
K = [[110, 0, 63.5], [0, 110, 35.5], [0, 0, 1]]


@pytest.fixture
def run(tmp_path, monkeypatch):
    def run(word):
        monkeypatch.chdir(tmp_path)
        [recipe] = [block.text for block in blocks(PAGE) if word in block.text]
        assert len(recipe.splitlines()) < 80
        exec(compile(recipe, str(PAGE), "exec"), {"np": np, "clpipe": clpipe})

    return run


def picture(path):
    with Image.open(path) as file:
        return np.asarray(file)


def shots_of(*views):
    lens = {"method": "brown_conrady", "fx": 110}
    cameras = zip(views, ("sony-a7r2", "nikon-d850"), strict=True)
    rig = {view: {"camera": camera} for view, camera in cameras}
    with clpipe.Stream(views=rig, iso=400, distortion=lens) as stream:
        for _ in range(5):
            stream.put_many(np.full((2, 72, 128, 3), 0.1, np.float32))
            for _ in range(2):
                yield stream.get()


def test_a_sequence_of_kitti_has_a_stereo_rig(run, tmp_path):
    run("calib.txt")
    folder = tmp_path / "kitti" / "sequences" / "00"
    for shot in shots_of("image_2", "image_3"):
        found = picture(folder / shot.view / f"{shot.index:06}.png")
        assert np.array_equal(found, shot.image)
    lines = (folder / "calib.txt").read_text().splitlines()
    calibration = {
        name: [float(each) for each in values.split()]
        for name, values in (line.split(":") for line in lines)
    }
    left, right = (np.reshape(calibration[name], (3, 4)) for name in ("P2", "P3"))
    assert left[:, :3].tolist() == right[:, :3].tolist() == K
    assert not left[:, 3].any()
    assert np.linalg.solve(K, right[:, 3]).round(9).tolist() == [-0.54, 0, 0]
    times = [float(line) for line in (folder / "times.txt").read_text().splitlines()]
    assert times == [0.0, 0.1, 0.2, 0.3, 0.4]


def test_the_tables_of_nuscenes_refer_to_each_other(run, tmp_path):
    run("sample_data")
    root = tmp_path / "nuscenes"
    tables = {
        path.stem: {row["token"]: row for row in json.loads(path.read_text())}
        for path in (root / "v1.0-mini").iterdir()
    }
    assert len(tables) == 13
    for rows in tables.values():
        for row in rows.values():
            for name, token in row.items():
                if name.endswith("_token"):
                    table = "sample" if name.startswith(("first", "last")) else name[:-6]
                    assert token in tables[table]
                if name in ("prev", "next") and token:
                    back = rows[token]["next" if name == "prev" else "prev"]
                    assert back == row["token"]
    for shot in shots_of("CAM_FRONT_LEFT", "CAM_FRONT_RIGHT"):
        row = tables["sample_data"][f"{shot.view}{shot.index}"]
        assert np.array_equal(picture(root / row["filename"]), shot.image)
        assert row["timestamp"] == shot.index * 500_000
        assert tables["calibrated_sensor"][shot.view]["camera_intrinsic"] == K


def test_the_bar_is_where_the_poses_of_the_rows_put_it(run, tmp_path):
    run("rolling_shutter_time")
    views = json.loads((tmp_path / "rig" / "transforms.json").read_text())["frames"]
    assert len(views) == 4
    for view in views:
        linear = (picture(tmp_path / "rig" / view["file_path"]).mean(2) / 255) ** 2.2
        light = (linear - np.median(linear, 1, keepdims=True) - 0.02).clip(min=0)
        columns = np.arange(view["w"]) + 0.5
        seen = (light * columns).sum(1) / light.sum(1)
        part = np.linspace(0, 1, view["h"])
        first, last = (
            np.array(view[f"transform_matrix_{row}_row"])[0, 3] for row in ("first", "last")
        )
        assert abs(last - first) * view["fl_x"] / 2 > 3  # px that the rows differ by
        x = -(first + part * (last - first)) / 2
        y = (np.arange(view["h"]) + 0.5 - view["cy"]) / view["fl_y"]
        expected = view["fl_x"] * x * (1 + view["k1"] * (x * x + y * y)) + view["cx"]
        assert np.abs(seen - expected).max() < 0.25
        assert abs((seen - expected).mean()) < 0.03
