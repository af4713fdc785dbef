"""Cameras and poses of a folder: read from each form, written in each, and where points are seen.

COLMAP's and NeRF's files are read here with readers of their own, written after their formats.
"""

import json
import math
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import OpenImageIO as oiio
import pytest
from hypothesis import given
from hypothesis import strategies as st

from clpipe.base.errors import RequestError
from clpipe.reference.intrinsics import Intrinsics
from clpipe.reference.pose import from_opengl, from_quaternion, rotation, to_quaternion
from tests.conftest import ROOT
from tests.markdown import blocks

WIDTH, HEIGHT = 240, 160
FX, FY, CX, CY = 230.0, 232.0, 121.5, 79.0
POINTS = np.array([[x, y, 0.1 * x * y] for x in (-1.6, -0.5, 0.6, 1.5) for y in (-0.9, 0.1, 1.0)])
RUN = ("--device", "numpy", "--format", "exr", "--stages")
BENT = {"method": "brown_conrady", "fit": "true"}  # in the focal lengths of each render
BENT |= {"k1": -0.15, "k2": 0.03, "p1": 0.002, "p2": -0.001}


def turned(x, y, z):
    """A rotation by angles in radians about x, then y, then z."""
    (cx, cy, cz), (sx, sy, sz) = np.cos([x, y, z]), np.sin([x, y, z])
    about_x = np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]])
    about_y = np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])
    return np.array([[cz, -sz, 0], [sz, cz, 0], [0, 0, 1]]) @ about_y @ about_x


POSES = {
    "a": (turned(0.1, 0.15, 0.05), np.array([0.1, 0.0, 4.0])),
    "b": (turned(-0.1, -0.2, 2.9), np.array([-0.1, 0.2, 4.4])),
}


@pytest.fixture
def renders(write_exr):
    """Renders with a spot at each point, and their cameras in each form."""
    y, x = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    views, frames, images = [], [], []
    for number, (name, (r, t)) in enumerate(POSES.items(), 1):
        px, py, pz = (POINTS @ r.T + t).T
        image = np.zeros((HEIGHT, WIDTH))
        for u, v in zip(FX * px / pz + CX, FY * py / pz + CY, strict=True):
            image += np.exp(-((x - u) ** 2 + (y - v) ** 2) / (2 * 1.5**2))
        write_exr(f"renders/{name}.exr", np.repeat(image[..., None], 3, 2), half=False)
        k = [[FX, 0, CX], [0, FY, CY], [0, 0, 1]]
        views.append({"file": f"{name}.exr", "K": k, "R": r.tolist(), "t": t.tolist()})
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = r.T * [1, -1, -1], -r.T @ t
        frames.append({"file_path": f"./images/{name}", "transform_matrix": matrix.tolist()})
        q = " ".join(map(repr, map(float, to_quaternion(r))))
        images += [f"{number} {q} {' '.join(map(str, t))} 7 {name}.png", "1.0 2.0 -1"]
    Path("cameras.json").write_text(
        json.dumps({"width": WIDTH, "height": HEIGHT, "views": views, "note": "another's"})
    )
    own = {"fl_x": FX, "fl_y": FY, "cx": CX, "cy": CY, "w": WIDTH, "h": HEIGHT}
    Path("transforms.json").write_text(json.dumps({**own, "frames": frames}))
    Path("model/sparse/0").mkdir(parents=True)
    camera = f"# a comment\n7 PINHOLE {WIDTH} {HEIGHT} {FX} {FY} {CX} {CY}\n"
    Path("model/sparse/0/cameras.txt").write_text(camera)
    Path("model/sparse/0/images.txt").write_text("\n".join(["# a comment", *images, ""]))
    return Path("renders")


def changed(**changes):
    """Write a cameras.json with changes to the view of a.exr or to all views."""
    values = json.loads(Path("cameras.json").read_text())
    common = {"width", "height"} & changes.keys()
    values |= {name: changes[name] for name in common}
    values["views"][0] |= {k: v for k, v in changes.items() if k not in common}
    Path("changed.json").write_text(json.dumps(values))
    return "changed.json"


def rotated(w, x, y, z):
    """Return the rotation of a unit quaternion by the Rodrigues formula."""
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + 2 * w * cross + 2 * cross @ cross


def bent(x, y, k):
    """Brown and Conrady's formula from OpenCV's documentation."""
    r2 = x * x + y * y
    grown = 1 + k.get("k1", 0) * r2 + k.get("k2", 0) * r2**2 + k.get("k3", 0) * r2**3
    p1, p2 = k.get("p1", 0), k.get("p2", 0)
    dx, dy = 2 * p1 * x * y + p2 * (r2 + 2 * x * x), p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    return x * grown + dx, y * grown + dy


def places(r, t, fx, fy, cx, cy, k):
    x, y, z = (POINTS @ np.array(r).T + t).T
    x, y = bent(x / z, y / z, k)
    return np.stack([fx * x + cx, fy * y + cy], 1)


def written_poses(folder):
    """Return the points that each file of a folder predicts, by the name of the picture."""
    by_form = {"cameras": {}, "nerf": {}, "colmap": {}}
    for view in json.loads((folder / "cameras.json").read_text())["views"]:
        (fx, _, cx), (_, fy, cy), _ = view["K"]
        where = places(view["R"], view["t"], fx, fy, cx, cy, view["distortion"])
        by_form["cameras"][view["file"]] = where
    nerf = json.loads((folder / "transforms.json").read_text())
    for frame in nerf["frames"]:
        own = {**nerf, **frame}
        matrix = np.array(own["transform_matrix"]) @ np.diag([1, -1, -1, 1])
        r, t = matrix[:3, :3].T, -matrix[:3, :3].T @ matrix[:3, 3]
        camera = [own[name] for name in ("fl_x", "fl_y", "cx", "cy")]
        by_form["nerf"][own["file_path"]] = places(r, t, *camera, own)
    cameras = {}
    for line in (folder / "sparse/0/cameras.txt").read_text().splitlines()[1:]:
        number, model, _, _, *values = line.split()
        names = {"PINHOLE": (), "OPENCV": ("k1", "k2", "p1", "p2")}[model]
        values = [float(value) for value in values]
        cameras[number] = (*values[:4], dict(zip(names, values[4:], strict=True)))
    lines = (folder / "sparse/0/images.txt").read_text().splitlines()[1:]
    assert not any(lines[1::2])
    for line in lines[::2]:
        _, *numbers, camera, name = line.split(" ")
        q, t = np.split(np.array(numbers, float), [4])
        by_form["colmap"][name] = places(rotated(*q), t, *cameras[camera])
    return by_form


def seen(path, near):
    """Where the spots of a picture are: the centroid about each place nearby."""
    image = oiio.ImageBuf(str(path)).get_pixels(oiio.FLOAT)[..., 1].astype(float)
    y, x = np.mgrid[: image.shape[0], : image.shape[1]] + 0.5
    found = []
    for at in near:
        weights = image * ((x - at[0]) ** 2 + (y - at[1]) ** 2 < 6**2)
        found.append([(weights * x).sum() / weights.sum(), (weights * y).sum() / weights.sum()])
    return np.array(found)


def sets(table, **parameters):
    return [text for k, v in parameters.items() for text in ("--set", f"{table}.{k}={v}")]


@pytest.mark.parametrize("is_bent", [False, True])
def test_points_are_where_each_file_says(clpipe, renders, is_bent):
    stages, options = "exposure", []
    if is_bent:
        stages, options = "distortion,resize", [*sets("distortion", **BENT)]
        options += sets("resize", scale=0.75)
    clpipe("run", renders, "-o", "o", "--poses", "cameras.json", *RUN, stages, *options)
    for by_name in written_poses(Path("o")).values():
        assert by_name.keys() == {"a.exr", "b.exr"}
        for name, where in by_name.items():
            assert np.abs(seen(f"o/{name}", where) - where).max() < 0.05


def test_a_thin_prism_is_only_in_cameras_json(clpipe, renders):
    """Neither COLMAP nor nerfstudio has a model of perspective pictures with a thin prism."""
    options = sets("distortion", **BENT, s1=0.004, s4=-0.002)
    run = ("run", renders, "-o", "o", "--poses", "cameras.json", *RUN, "distortion", *options)
    stderr = clpipe(*run).stderr
    for file in ("sparse/0", "transforms.json"):
        assert f"and 1 more are not in {file}, which has no model with a thin prism" in stderr
    views = json.loads(Path("o/cameras.json").read_text())["views"]
    assert {view["model"] for view in views} == {"OPENCV_THIN_PRISM"}
    assert views[0]["distortion"]["s4"] == -0.002
    assert not Path("o/sparse").exists() and not Path("o/transforms.json").exists()


@pytest.mark.parametrize(
    "form", ["transforms.json", "model", "model/sparse/0", "o", "o/cameras.json"]
)
def test_each_form_says_the_same(clpipe, renders, form):
    clpipe("run", renders, "-o", "o", "--poses", "cameras.json", *RUN, "exposure")
    clpipe("run", renders, "-o", "p", "--poses", form, *RUN, "exposure")
    for name, (r, t) in POSES.items():
        made = json.loads(Path("p", f"{name}.json").read_text())
        assert made["intrinsics"] | {"model": ""} == {
            **{"width": WIDTH, "height": HEIGHT, "fx": FX, "fy": FY, "cx": CX, "cy": CY},
            **{"model": "", "distortion": {}, "residual": 0.0},
        }
        assert np.allclose(made["pose"]["R"], r, atol=1e-12)
        assert np.allclose(made["pose"]["t"], t, atol=1e-12)


def test_an_angle_of_view_and_a_row_of_a_manifest(clpipe, renders):
    values = json.loads(Path("transforms.json").read_text())
    angle = 2 * math.atan(WIDTH / 2 / FX)
    frames = {"camera_angle_x": angle, "frames": values["frames"]}  # as NeRF's Blender scenes have
    Path("nerf.json").write_text(json.dumps(frames))
    clpipe("run", renders, "-o", "o", "--poses", "nerf.json", *RUN, "exposure")
    made = json.loads(Path("o/a.json").read_text())
    assert made["intrinsics"]["fx"] == pytest.approx(FX)
    assert made["intrinsics"]["fy"] == pytest.approx(FX)
    # A lens needs the focal length in px, and takes the size from the renders themselves.
    lens = ("--set", "distortion.method=brown_conrady", "--set", "distortion.k1=-0.1")
    clpipe("run", renders, "-o", "l", "--poses", "nerf.json", *RUN, "distortion", *lens)
    made = json.loads(Path("l/a.json").read_text())
    assert made["intrinsics"]["fx"] == pytest.approx(FX)
    r = POSES["a"][0].tolist()
    row = {"render": {"fx": 9, "rotation": r, "translation": [1, 2, 3]}}
    Path("list.jsonl").write_text(json.dumps({"path": "renders/a.exr", "name": "a", **row}))
    clpipe("run", "list.jsonl", "-o", "p", *RUN, "exposure")
    assert json.loads(Path("p/a.json").read_text())["pose"] == {"R": r, "t": [1, 2, 3]}
    assert "1 picture" in clpipe("poses", "p").stdout


def test_a_run_in_parts_makes_the_same_bytes(clpipe, renders):
    run = ("run", renders, "--poses", "cameras.json", *RUN, "exposure")
    clpipe(*run, "-o", "o")
    files = [
        "cameras.json",
        "transforms.json",
        *(f"sparse/0/{n}.txt" for n in ("cameras", "images")),
    ]
    clpipe(*run, "-o", "p", "--shard", "2/2")
    assert not Path("p/cameras.json").exists()
    clpipe("poses", "p")
    half = json.loads(Path("p/cameras.json").read_text())
    assert [view["file"] for view in half["views"]] == ["b.exr"]
    clpipe(*run, "-o", "p", "--shard", "1/2")
    clpipe("poses", "p")
    assert all(Path("o", f).read_bytes() == Path("p", f).read_bytes() for f in files)
    # A second run makes nothing but the files; another pose makes its picture again.
    assert "(2 of them were there already)" in clpipe(*run, "-o", "o").stderr
    again = clpipe("run", renders, "-o", "o", "--poses", changed(t=[0, 0, 9.0]), *RUN, "exposure")
    assert "(1 of them was there already)" in again.stderr
    assert json.loads(Path("o/cameras.json").read_text())["views"][0]["t"] == [0, 0, 9.0]


@pytest.mark.slow
def test_each_kind_of_picture_is_a_model_of_its_own(clpipe, renders):
    roles = {"": "", "truth": ".truth", "truth_clean": ".truth_clean", "iid": ".iid"}
    run = ("run", renders, "--poses", "cameras.json", "--device", "numpy", "--format", "png")
    clpipe(*run, "-o", "o", "--truth", "clean", "--truth", "iid", "--truth", "variance")
    for model, suffix in roles.items():
        folder = Path("o/models", model) if model else Path("o")
        views = json.loads((folder / "cameras.json").read_text())["views"]
        frames = json.loads((folder / "transforms.json").read_text())["frames"]
        for names in ([v["file"] for v in views], [f["file_path"] for f in frames]):
            found = [(folder / name).resolve(strict=True) for name in names]
            assert found == [Path("o", f"{name}{suffix}.png").resolve() for name in "ab"]
        lines = (folder / "sparse/0/images.txt").read_text().splitlines()[1::2]
        assert [line.split()[9] for line in lines] == [f"{name}{suffix}.png" for name in "ab"]
    for path in Path("o").glob("*.iid.*"):
        path.unlink()
    clpipe("poses", "o")  # a kind that is not there any more leaves no model
    assert not Path("o/models/iid/cameras.json").exists()
    assert Path("o/models/truth_clean/cameras.json").exists()


@pytest.mark.slow
def test_frames_and_exposures_are_in_it(clpipe, write_exr):
    write_exr("in/x/a b.exr", np.full((6, 8, 3), 0.2))
    write_exr("in/x/c.exr", np.full((6, 8, 3), 0.2))
    lens = sets("render", fx=9)
    pose = sets("render", rotation="[[1, 0, 0], [0, 1, 0], [0, 0, 1]]", translation="[0, 0, 1]")
    run = ("run", "in", "-o", "o", "--device", "numpy", "--frames", 2, "--bracket=-1,0", *lens)
    clpipe(*run, "--format", "dng", "--format", "png", "--truth", "clean")
    stdout = clpipe("poses", "o", "--json").stdout
    assert json.loads(stdout)["files"][:2] == [
        "cameras.json",
        "sparse/0/cameras.txt",
    ]  # without poses
    clpipe(*run, *pose, "--format", "dng", "--format", "png")
    stdout = clpipe("poses", "o").stdout
    expected = (
        "a b.ev+0.frame0.png and 5 more are not in images.txt, which allows no spaces in names"
    )
    assert expected in stdout
    views = json.loads(Path("o/cameras.json").read_text())["views"]
    names = [
        f"x/{n}.ev{e}.frame{f}.png" for n in ("a b", "c") for e in ("+0", "-1") for f in (0, 1)
    ]
    assert [view["file"] for view in views] == names
    assert [
        line.split(" ")[9] for line in Path("o/sparse/0/images.txt").read_text().splitlines()[1::2]
    ] == names[4:]
    assert Path("o/sparse/0/cameras.txt").read_text().count("\n") == 2  # all share one
    # Where no picture has a pose any more, nothing is left of those files.
    clpipe(*run, "--format", "dng", "--format", "png")
    clpipe("poses", "o")
    assert not Path("o/transforms.json").exists() and not Path("o/sparse/0/images.txt").exists()


def test_a_lens_that_is_fitted_for_nerfstudio(clpipe, renders):
    lens = sets("distortion", **BENT | {"k4": 0.3, "k5": -0.1})
    clpipe("run", renders, "-o", "o", "--poses", "cameras.json", *RUN, "distortion", *lens)
    assert "FULL_OPENCV" in Path("o/sparse/0/cameras.txt").read_text()
    record = json.loads(Path("o/transforms.json").read_text())
    exact = json.loads(Path("o/a.json").read_text())["intrinsics"]
    width, height, d = record["w"], record["h"], exact["distortion"]
    # Compare nerfstudio's and OpenCV's models for points in the picture.
    x, y = np.mgrid[-1:1:41j, -1:1:41j] * np.array([width, height])[:, None, None] / exact["fx"]
    r2 = x * x + y * y
    k = sum(record[f"k{i}"] * r2**i for i in (1, 2, 3, 4))
    above = 1 + sum(d[f"k{i}"] * r2**i for i in (1, 2, 3))
    factor = above / (1 + sum(d[f"k{i + 3}"] * r2**i for i in (1, 2, 3)))
    off = np.hypot(x, y) * abs((1 + k) * record["fl_x"] - factor * exact["fx"])
    bent = np.hypot(x, y) * factor * exact["fx"]
    inside = bent < np.hypot(width, height) / 2
    assert 0 < record["distortion_residual"] < 0.5
    assert off[inside].max() <= record["distortion_residual"] * 1.01 + 1e-6
    for name in ("p1", "p2"):
        assert record[name] * record["fl_x"] == pytest.approx(d[name] * exact["fx"])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"file": "ab.exr"}, "this file has no view a; the most similar names are ab, b"),
        ({"R": [[2, 0, 0], [0, 2, 0], [0, 0, 2]]}, "its rows have the lengths 2, 2, 2"),
        ({"R": [[-1, 0, 0], [0, 1, 0], [0, 0, 1]]}, "its determinant is -1"),
        ({"t": [1, 2]}, "t: found [1, 2], but expected 3 numbers"),
        ({"t": [1, 2, float("nan")]}, "but expected 3 numbers"),
        ({"K": [[9, 1, 3], [0, 9, 3], [0, 0, 1]]}, "[[fx, 0, cx], [0, fy, cy], [0, 0, 1]]"),
        ({"K": [[-9, 0, 3], [0, 9, 3], [0, 0, 1]]}, "render.fx: found -9.0"),
        (
            {"distortion": {"k1": 0.1}},
            "has distortion (k1 0.1), but renders have no lens distortion",
        ),
        ({"model": "OPENCV_FISHEYE"}, "has the model OPENCV_FISHEYE"),
        ({"width": WIDTH / 2, "height": HEIGHT / 2}, "its camera in --poses has 120x80"),
    ],
)
def test_a_view_that_is_wrong_fails_alone(clpipe, renders, changes, message):
    poses = changed(**changes)
    is_alone = "width" not in changes
    run = (
        "run",
        renders,
        "-o",
        "o",
        "--poses",
        poses,
        *RUN,
        "distortion",
        *sets("distortion", **BENT),
    )
    stderr = clpipe(*run, status=1).stderr
    assert message in stderr
    assert Path("o/b.exr").exists() == is_alone
    assert not Path("o/a.exr").exists()


def test_what_is_wrong_with_all_is_refused(clpipe, renders):
    run = ("run", renders, "-o", "o", *RUN, "exposure", "--poses")

    def refused(*arguments, status=2):
        return clpipe(*run, *arguments, status=status).stderr

    message = refused("cameras.json", *sets("render", fx=1000))
    assert f"has fx {FX}, but the configuration has render.fx 1000" in message
    message = refused("cameras.json", *sets("render", focal_length=50, sensor_width=36), status=1)
    assert "render.fx makes the focal length of this render of 240x160 pixels 230 px" in message
    assert "no such file" in refused("missing.json").lower()
    assert "there is no images.txt" in refused("renders")
    Path("other.json").write_text('{"frames": 3}')
    assert "has neither the list 'views'" in refused("other.json")
    Path("model/sparse/0/images.txt").write_text("1 0 0 0 0 0 0 0 7 a.exr\n\n1 2 3\n")
    assert "found the line '1 2 3'" in refused("model")
    Path("o").mkdir(exist_ok=True)
    Path("o/transforms.json").write_text("{}")
    assert "transforms.json: clpipe did not write this file" in refused("cameras.json", status=1)
    assert Path("o/transforms.json").read_text() == "{}"


def test_renders_that_are_named_as_the_files_of_cameras(clpipe, write_exr):
    for name in ("cameras", "transforms", "a"):
        write_exr(f"in/{name}.exr", np.full((8, 8, 3), 0.25))
    run = ("run", "in", "-o", "out", "--device", "numpy", *sets("render", fx=30, fy=30))
    clpipe(*run)
    before = {path: path.read_bytes() for path in Path("out").glob("*.json")}
    for _ in range(2):
        output = clpipe("poses", "out").output
        assert "wrote out/sparse/0: 3 pictures" in output
        assert "warning: out/cameras.json is the sidecar of a picture" in output
        assert {path: path.read_bytes() for path in Path("out").glob("*.json")} == before
    assert "there already" in clpipe(*run).stderr


def test_views_are_found_by_paths_and_by_names_that_are_unique(clpipe, write_exr):
    for name in ("a/1", "b/1", "b/2"):
        write_exr(f"in/{name}.exr", np.full((6, 8, 3), 0.2))

    def found(*names, status=0):
        k = [[9, 0, 4], [0, 9, 3], [0, 0, 1]]
        r = [[1, 0, 0], [0, 1, 0], [0, 0, 1]]
        views = [{"file": n, "K": k, "R": r, "t": [i, 0, 0]} for i, n in enumerate(names)]
        Path("v.json").write_text(json.dumps({"views": views}))
        stderr = clpipe(
            "run", "in", "-o", "o", "--poses", "v.json", *RUN, "exposure", status=status
        ).stderr
        made = json.loads(Path("o/cameras.json").read_text())["views"]
        return {view["file"]: view["t"][0] for view in made}, stderr

    all_found = {"a/1.exr": 1, "b/1.exr": 0, "b/2.exr": 2}
    assert found("b/1.png", "a/1.png", "2")[0] == all_found
    assert found("x/y/b/1", "./x/y/a/1", "elsewhere/2.0.png", "c/2.exr")[0] == all_found | {
        "b/2.exr": 3
    }
    _, stderr = found("1.png", "b/2.exr", status=1)
    assert "in/a/1.exr: --poses v.json: this file has no view a/1, and its view 1 may" in stderr
    _, stderr = found("b/1", "a/1", "c/2", "d/2", status=1)
    assert "b/2 may be any of the views c/2, d/2" in stderr


def test_the_size_of_a_render_with_overscan_is_without_it(clpipe, write_exr):
    around = {"x": -2, "y": -3, "full_x": 0, "full_y": 0, "full_width": 8, "full_height": 6}
    write_exr("in/a.exr", np.full((12, 12, 3), 0.2), **around)
    view = {"file": "a", "K": [[9, 0, 4], [0, 9, 3], [0, 0, 1]], "width": 8, "height": 6}
    Path("v.json").write_text(json.dumps({"views": [view]}))
    lens = sets("distortion", method="brown_conrady", k1=-0.1)
    clpipe("run", "in", "-o", "o", "--poses", "v.json", *RUN, "distortion", *lens)
    made = json.loads(Path("o/a.json").read_text())
    assert made["overscan"] and (made["intrinsics"]["width"], made["intrinsics"]["height"]) == (
        8,
        6,
    )


def test_focal_lengths_that_contradict_each_other():
    shot = {"fx": 500.0, "focal_length": 50.0, "sensor_width": 40.0}
    assert Intrinsics.of_render(400, 300, shot).fx == 500
    with pytest.raises(RequestError, match="px, but camera_angle_x 200 px"):
        Intrinsics.of_render(400, 300, {**shot, "camera_angle_x": math.pi / 2})


@given(st.tuples(*[st.floats(-1, 1)] * 4).filter(lambda q: np.linalg.norm(q) > 1e-3))
def test_quaternions_are_those_of_rotations(q):
    unit = np.array(q) / np.linalg.norm(q)
    r = from_quaternion(q)
    assert np.allclose(r, rotated(*unit), atol=1e-12)
    again = to_quaternion(rotation(r.tolist()))
    assert again[0] >= 0 and np.allclose(np.abs(again @ unit), 1, atol=1e-12)


def test_pictures_without_a_focal_length_are_named(clpipe, write_exr):
    for name in "abc":
        write_exr(f"in/{name}.exr", np.full((6, 8, 3), 0.2))
    run = ("run", "-o", "o", "--device", "numpy", "--stages", "exposure")
    clpipe(*run, "in/a.exr", "in/b.exr")
    reason = "a.jpg and 1 more are not in these files, because they need the focal length"
    assert reason in clpipe("poses", "o", status=2).stderr
    clpipe(*run, "in/c.exr", "--set", "render.fx=9")
    assert f"warning: {reason}" in clpipe("poses", "o").stdout


def test_the_script_of_the_page_writes_cameras_that_the_page_can_use(
    clpipe, write_exr, monkeypatch
):
    """The recipe's script for Blender, with a scene of two frames in place of Blender's."""
    page = ROOT / "docs" / "recipes" / "views.md"
    (script,) = (block.text for block in blocks(page) if "import bpy" in block.text)
    (command,) = (block.text for block in blocks(page) if "--poses cameras.json" in block.text)

    class Matrix(list):
        def normalized(self):
            return self

    matrices = [np.eye(4), np.eye(4)]
    matrices[1][0, 3] = 0.2
    camera = SimpleNamespace(matrix_world=None, data=SimpleNamespace(angle_x=0.98))
    scene = SimpleNamespace(frame_start=1, frame_end=2, camera=camera)
    scene.frame_set = lambda number: setattr(
        camera, "matrix_world", Matrix(matrices[number - 1].tolist())
    )
    bpy = SimpleNamespace(context=SimpleNamespace(scene=scene))
    monkeypatch.setitem(sys.modules, "bpy", bpy)
    for number in (1, 2):
        write_exr(f"renders/000{number}.exr", np.full((64, 96, 3), 0.2))
    exec(compile(script, "views.md", "exec"), {})
    words = command.replace("\\\n", " ").replace("cameras.json", "renders/transforms.json").split()
    clpipe(*words[1:], "--device", "numpy")
    views = json.loads(Path("views/cameras.json").read_text())["views"]
    assert [view["file"] for view in views] == ["0001.png", "0002.png"]
    assert np.allclose(views[1]["t"], from_opengl(matrices[1])[1])
    assert views[0]["K"][0][0] == pytest.approx(48 / math.tan(0.49), rel=0.2)
