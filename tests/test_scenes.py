"""``clpipe dataset``: scenes and folders of renders become datasets, also resumed."""

import csv
import io
import json
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
from PIL import Image

from clpipe.base.files import sha256_of
from clpipe.scenes.members import split_of
from tests.conftest import ROOT, contents, written

NUMPY = ("--device", "numpy", "-c", "paper")


@pytest.fixture
def blender(tmp_path):
    """A stand-in for an installed Blender; see tests/fake_blender.py."""
    program = tmp_path / "blender"
    script = ROOT / "tests" / "fake_blender.py"
    program.write_text(f'#!/bin/sh\nexec "{sys.executable}" "{script}" "$@"\n')
    program.chmod(0o755)
    return ("--blender", program)


@pytest.fixture
def scene(tmp_path):
    path = tmp_path / "room.blend"
    path.write_text("a room")
    return path


def test_a_scene_becomes_a_dataset(clpipe, scene, blender, tmp_path):
    result = clpipe(
        "dataset", scene, "-o", "set", *blender, *NUMPY, "--views", 5, "--iso", "100,400"
    )
    assert "rendered view_004  5 of 5" in result.stderr
    assert "10 of 10 images done, 0 failed" in result.stderr
    made = tmp_path / "set"
    each = ("jpg", "json", "truth_clean.jpg", "truth_clean.json", "carried.exr")
    each += ("Depth.png", "IndexOB.png")
    models = ("cameras.json", "transforms.json")
    models += tuple(f"sparse/0/{name}.txt" for name in ("cameras", "images", "points3D"))
    models += tuple(f"models/truth_clean/{name}" for name in models)
    assert set(written(made)) == {
        *(f"iso{iso}/view_00{n}.{end}" for iso in (100, 400) for n in range(5) for end in each),
        *(f"iso{iso}/{name}" for iso in (100, 400) for name in models),
        *(f"renders/view_00{n}.exr" for n in range(5)),
        *("renders/cameras.json", "dataset.json", "manifest.csv", "README.md"),
        *("contact_sheet.jpg", "train.txt", "val.txt", "test.txt"),
    }
    # Pictures are those of clpipe run, and the cameras those of the renders.
    clpipe(
        "run",
        "set/renders",
        "-o",
        "out",
        *NUMPY,
        "--iso",
        400,
        "--poses",
        "set/renders/cameras.json",
    )
    assert (tmp_path / "out/view_003.jpg").read_bytes() == (
        made / "iso400/view_003.jpg"
    ).read_bytes()
    (view,) = (
        v
        for v in json.loads((made / "iso400/cameras.json").read_text())["views"]
        if v["file"] == "view_003.jpg"
    )
    assert (view["t"], view["K"][0]) == ([3, 0, 2], [40, 0, 12])
    rows = list(csv.DictReader(io.StringIO((made / "manifest.csv").read_text())))
    assert [row["split"] for row in rows] == [split_of(n) for n in range(5) for _ in range(2)]
    assert rows[7] == {
        **{"ev": "0", "gain": "1", "exposure_time": "", "f_number": ""},
        **{"Depth": "iso400/view_003.Depth.png", "IndexOB": "iso400/view_003.IndexOB.png"},
        **{"view": "view_003", "split": "val", "camera": "sony-a7r2", "iso": "400"},
        "picture": "iso400/view_003.jpg",
        "carried": "iso400/view_003.carried.exr",
        "truth_clean": "iso400/view_003.truth_clean.jpg",
        "render": "renders/view_003.exr",
    }
    assert (made / "val.txt").read_text() == "view_003\n"
    readme = (made / "README.md").read_text()
    assert "1 floor, 2 ball + ball.001" in readme
    assert "| `iso400/` | sony-a7r2 | 400 | 5 | 24x16 |" in readme
    with Image.open(made / "contact_sheet.jpg") as sheet:
        assert sheet.width > 3 * 24
        assert np.asarray(sheet).std() > 20


@pytest.mark.slow
def test_it_goes_on_where_it_was_and_makes_the_same(clpipe, scene, blender, tmp_path):
    command = ("dataset", scene, *blender, *NUMPY, "--path", "arc", "--views", 4, "--iso", 800)
    clpipe(*command, "-o", "whole")
    scene.write_text("die after 2")
    stderr = clpipe(*command, "-o", "set", status=2).stderr
    assert "Blender ended with status 11. Its last output:" in stderr
    assert "Segmentation fault (not really)" in stderr
    assert "2 of 4 images done, 0 failed, 2 not begun" in stderr
    assert not (tmp_path / "set/README.md").exists()
    record = tmp_path / "set/dataset.json"
    record.write_text(record.read_text().replace(sha256_of(scene)[0], "0" * 64))
    assert "has a dataset with sha256" in clpipe(*command, "-o", "set", status=2).stderr
    scene.write_text("a room")
    record.write_text(record.read_text().replace("0" * 64, sha256_of(scene)[0]))
    assert (
        "4 of 4 images done (2 of them were there already)" in clpipe(*command, "-o", "set").stderr
    )
    whole, resumed = contents(tmp_path / "whole"), contents(tmp_path / "set")
    assert whole.keys() == resumed.keys()
    pictures = [name for name in whole if name.endswith((".jpg", ".exr", ".txt", "cameras.json"))]
    assert all(whole[name] == resumed[name] for name in pictures)
    # Where all renders are there, other ISOs need no Blender.
    gone = ("--blender", tmp_path / "gone")
    clpipe(*command[:2], *gone, *command[4:-1], "100,800", "-o", "set")
    assert (tmp_path / "set/iso100/view_003.jpg").exists()


@pytest.mark.slow
def test_frames_have_flow_and_may_become_more(clpipe, scene, blender, tmp_path):
    command = ("dataset", scene, "-o", "set", *blender, *NUMPY)
    clpipe(*command, "--frames", "1,3")
    again = clpipe(*command, "--frames", "1-3").stderr
    assert "rendered frame_0002  2 of 3" in again
    assert "rendered frame_0001" not in again
    layers = json.loads((tmp_path / "set/iso100/frame_0002.json").read_text())["carried"]
    assert [each["layer"] for each in layers] == ["Depth", "Normal", "IndexOB", "Vector"]
    assert 'with views "frames"' in clpipe(*command, "--views", 2, status=2).stderr


@pytest.mark.slow
def test_a_dataset_grows(clpipe, scene, blender, tmp_path):
    command = ("dataset", scene, "-o", "set", *blender, *NUMPY, "--views", 9)
    clpipe(*command, "--iso", 800, "--licence", "CC-BY-4.0", "--author", "A. Maker")
    first = {name: (tmp_path / "set" / name).stat().st_mtime_ns for name in written(Path("set"))}
    stderr = clpipe(*command, "--iso", "800,3200").stderr
    assert "18 of 18 images done (9 of them were there already)" in stderr
    clpipe(*command, "--iso", 100)
    clpipe(*command, "--iso", 100, "--camera", "canon-5d2", "-c", "default")
    made = written(Path("set"))
    pictures = [name for name in made if name.endswith(".jpg") and "truth" not in name]
    folders = ("canon-5d2/iso100", "iso100", "iso3200", "iso800")
    expected = {f"{f}/view_00{n}.jpg" for f in folders for n in range(9)}
    assert set(pictures) == expected | {"contact_sheet.jpg"}
    old = [name for name in first if name.startswith("iso800/view_")]
    assert all((tmp_path / "set" / name).stat().st_mtime_ns == first[name] for name in old)
    rows = list(csv.DictReader(io.StringIO((tmp_path / "set/manifest.csv").read_text())))
    assert {row["picture"] for row in rows} == expected
    (tmp_path / "set").rename(tmp_path / "moved")
    clpipe(command[0], scene, "-o", "moved", *command[4:], "--iso", "100,200")
    moved = list(csv.DictReader(io.StringIO((tmp_path / "moved/manifest.csv").read_text())))
    assert {row["render"] for row in moved} == {f"renders/view_00{n}.exr" for n in range(9)}
    (tmp_path / "moved").rename(tmp_path / "set")
    readme = (tmp_path / "set/README.md").read_text()
    assert all(f"| `{folder}/` |" in readme for folder in folders)
    assert "**Licence:** CC-BY-4.0" in readme and "**Author:** A. Maker" in readme
    named = [part.strip("`") for part in re.findall(r"`[\w./]+\.(?:txt|csv|json)`", readme)]
    assert all(any(f.endswith(name) for f in made) for name in named if "NAME" not in name)
    for folder in folders:
        record = json.loads((tmp_path / "set" / folder / "transforms.json").read_text())
        assert len(record["frames"]) == 9
        assert record["val_filenames"] == ["view_003.jpg"]
        assert record["test_filenames"] == ["view_007.jpg"]
        assert len(record["train_filenames"]) == 7
        assert (
            len(json.loads((tmp_path / "set" / folder / "cameras.json").read_text())["views"]) == 9
        )


@pytest.mark.slow
def test_views_that_see_too_little_are_told(clpipe, scene, blender, tmp_path):
    scene.write_text("a maze")
    stderr = clpipe("dataset", scene, "-o", "set", *blender, *NUMPY, "--views", 2).stderr
    assert "note: 3 of 9 places see too little" in stderr
    assert "**Which views:** 3 of 9 places" in (tmp_path / "set/README.md").read_text()


@pytest.mark.slow
def test_a_lens_takes_the_focal_length_of_the_scenes_cameras(clpipe, scene, blender, tmp_path):
    lens = ("--set", "distortion.method=brown_conrady", "--set", "distortion.k1=-0.1")
    clpipe("dataset", scene, "-o", "set", *blender, *NUMPY[:2], "--views", 1, *lens)
    record = json.loads((tmp_path / "set/iso100/view_000.json").read_text())
    assert record["intrinsics"]["fx"] == 40
    wrong = ("--set", "distortion.method=brown")
    assert "unknown" in clpipe("dataset", scene, "-o", "n", *blender, *wrong, status=2).stderr


@pytest.mark.slow
def test_cameras_of_a_file_are_rendered(clpipe, scene, blender, tmp_path):
    clpipe("dataset", scene, "-o", "a", *blender, *NUMPY, "--views", 2)
    poses = tmp_path / "a/renders/cameras.json"
    clpipe("dataset", scene, "-o", "b", *blender, *NUMPY, "--poses", poses)
    record = json.loads((tmp_path / "b/dataset.json").read_text())["views"]["cameras"]
    view = json.loads(poses.read_text())["views"][1]
    assert record[1] == {"name": "view_001", **{k: v for k, v in view.items() if k != "file"}}


def test_renders_that_exist_become_a_dataset(clpipe, write_exr, tmp_path):
    for name in ("a", "sub/b"):
        pixels = np.full((12, 16, 4), 0.3, np.float32)
        pixels[..., 3] = 2.5
        write_exr(f"renders/{name}.exr", pixels, "R,G,B,View.Depth.Z", half=False)
    cameras = {
        "K": [[20, 0, 8], [0, 20, 6], [0, 0, 1]],
        **{"R": np.eye(3).tolist(), "t": [0, 0, 1], "width": 16, "height": 12},
    }
    views = [{"file": name, **cameras} for name in ("a.exr", "sub/b.exr")]
    (tmp_path / "renders/cameras.json").write_text(json.dumps({"views": views}))
    clpipe("dataset", "renders", "-o", "set", *NUMPY, "--truth", "development", "--format", "png")
    made = written(tmp_path / "set")
    own = {f"iso100/{n}" for n in ("a.png", "sub/b.truth.png", "cameras.json", "a.carried.exr")}
    assert own | {"README.md", "contact_sheet.jpg"} <= {*made}
    depth = np.asarray(Image.open(tmp_path / "set/iso100/sub/b.Depth.png"))
    assert (depth == 2500).all()
    readme = (tmp_path / "set/README.md").read_text()
    assert str(tmp_path) not in readme + (tmp_path / "set/manifest.csv").read_text()
    assert "`Depth` (depth): along the viewing axis" in readme
    transforms = json.loads((tmp_path / "set/iso100/transforms.json").read_text())
    frame = transforms["frames"][1]
    assert (tmp_path / "set/iso100" / frame["depth_file_path"]).exists()
    assert transforms["train_filenames"] == ["a.png", "sub/b.png"]
    assert (tmp_path / "set/train.txt").read_text() == "a\nsub/b\n"
    write_exr("others/a.exr", np.zeros((12, 16, 3), np.float32))
    stderr = clpipe("dataset", "others", "-o", "set", *NUMPY, status=2).stderr
    assert 'has a dataset with renders "renders", but the request has "others"' in stderr


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--views", 3, "--frames", "1-3"], "each of them sets the views, so use only one"),
        (["--frames", "3-1"], "which contains no frame"),
        (["--frames", "a"], "--frames: found 'a'; expected frames, such as 1-24"),
        (["--resolution", "96"], "--resolution: found '96'; expected WIDTHxHEIGHT"),
        (["--box", "1,2,3"], "--box: found '1,2,3'; expected two corners"),
        (["--box", "0,0,0,1,1,1"], "--box: this option needs --path random"),
        (["--iso", "1"], "camera sony-a7r2 goes from 100 to 25600"),
        (["--poses", "cameras.json"], "width, height, focal length or pose is missing"),
    ],
)
def test_what_is_refused(clpipe, scene, blender, tmp_path, options, message):
    (tmp_path / "cameras.json").write_text('{"views": [{"file": "a.exr"}]}')
    stderr = clpipe("dataset", scene, "-o", "set", *blender, *options, status=2).stderr
    assert message in stderr
    assert not (tmp_path / "set/dataset.json").exists()


def test_scenes_that_cannot_be_rendered(clpipe, scene, blender, tmp_path, monkeypatch):
    scene.write_text("refuse: it has no camera; add one")
    stderr = clpipe("dataset", scene, "-o", "set", *blender, status=2).stderr
    assert stderr == f"clpipe: {scene}: it has no camera; add one\n"
    assert "no such file" in clpipe("dataset", "no.blend", "-o", "set", *blender, status=2).stderr
    Path("no").touch()
    assert "neither a .blend nor a folder" in clpipe("dataset", "no", "-o", "s", status=2).stderr
    monkeypatch.setitem(sys.modules, "bpy", None)
    stderr = clpipe("dataset", scene, "-o", "set", status=2).stderr
    assert "pass an installed Blender, or a Python that has bpy, with --blender PATH" in stderr
    none = ("--blender", tmp_path / "none")
    assert "No such file" in clpipe("dataset", scene, "-o", "set", *none, status=2).stderr
    (tmp_path / "renders").mkdir()
    stderr = clpipe("dataset", "renders", "-o", "set", "--samples", 3, status=2).stderr
    assert "--samples: this option applies only to a .blend" in stderr


def example(folder, name, *words):
    """Run one of tools/examples in a folder."""
    script = ROOT / "tools" / "examples" / name
    subprocess.run([sys.executable, script, *words], cwd=folder, check=True)


def test_views_of_mitsuba_become_a_dataset(clpipe, tmp_path):
    """A floor seen twice: its points are where the other view's depth and camera say."""
    pytest.importorskip("mitsuba", reason="needs the package mitsuba")
    example(
        tmp_path,
        "mitsuba_views.py",
        "renders",
        *["--views", "2", "--size", "48", "32", "--samples", "8"],
    )
    clpipe("dataset", "renders", "-o", "set", "--device", "numpy", "--carry", "Depth")
    views = json.loads((tmp_path / "set/cameras.json").read_text())["views"]
    assert seen_again(tmp_path / "set", *views) > 0.6  # the rest is hidden


def seen_again(folder, one, two):
    """The share of one view's points that the other view sees at the depth where they are."""
    depths = []
    for view in (one, two):
        with OpenEXR.File(str(folder / view["file"].replace(".jpg", ".carried.exr"))) as file:
            (depth,) = (c for name, c in file.channels().items() if name.endswith("Depth.Z"))
            depths.append(depth.pixels.astype(float))
    y, x = np.indices(depths[0].shape) + 0.5
    places = np.stack([x, y, np.ones_like(x)], -1) @ np.linalg.inv(one["K"]).T
    with np.errstate(invalid="ignore"):
        points = (places * depths[0][..., None] - one["t"]) @ np.array(one["R"])
        seen = points @ np.array(two["R"]).T + two["t"]
        u, v, z = np.moveaxis(seen @ np.array(two["K"]).T, -1, 0)
        u, v = u / z, v / z
    inside = (u >= 0) & (u < x.shape[1]) & (v >= 0) & (v < x.shape[0])
    found = depths[1][v[inside].astype(int), u[inside].astype(int)]
    return np.mean(abs(found / z[inside] - 1) < 0.03)


def test_views_of_a_room_see_what_the_camera_looks_at(clpipe, tmp_path):
    """An orbit passes outside the walls, but no view is there, and each view sees most objects."""
    pytest.importorskip("bpy", reason="needs bpy, in the extra blender")
    example(tmp_path, "room_scene.py", "room.blend")
    small = ("--resolution", "48x32", "--samples", 1, "--device", "numpy", "--no-denoise")
    stderr = clpipe("dataset", "room.blend", "-o", "set", "--views", 8, *small).stderr
    assert "places on the orbit see too little" in stderr
    for path in sorted(Path("set/renders").glob("*.exr")):
        parts = OpenEXR.File(str(path), separate_channels=True).parts
        channels = {name: c for part in parts for name, c in part.channels.items()}
        (own,) = (c for name, c in channels.items() if "Index" in name)
        numbers, counts = np.unique(own.pixels, return_counts=True)
        assert len(numbers) >= 4 and counts.max() < 0.7 * 48 * 32
    stderr = clpipe("dataset", "room.blend", "-o", "box", "--path", "random", *small).stderr
    assert "24 of 24 images done" in stderr


def test_blender_itself_renders_a_scene(clpipe, tmp_path):
    """Depth, cameras and object numbers of the example agree, and it is reproducible."""
    pytest.importorskip("bpy", reason="needs bpy, in the extra blender")
    example(tmp_path, "room_scene.py", "room.blend")
    small = ("--resolution", "48x32", "--samples", 4, "--device", "numpy", "--path", "arc")
    for name in ("one", "two"):
        clpipe("dataset", "room.blend", "-o", name, "--views", 2, *small)
    views = json.loads(Path("one/iso100/cameras.json").read_text())["views"]
    assert seen_again(Path("one/iso100"), *views) > 0.5  # an arc's ends are far apart
    one, two = (contents(Path(name) / "renders") for name in ("one", "two"))
    assert {k: v for k, v in one.items() if k[0] != "."} == {
        k: v for k, v in two.items() if k[0] != "."
    }
