"""tools/reconstruction: its data and figures; the whole run only with OpenCV."""

import json

import numpy as np
import pytest

from tools.reconstruction import experiment as tool
from tools.reconstruction import multiview, report, stereo
from tools.reconstruction import pictures as picture_kinds
from tools.reconstruction import views as scene_views

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def views():
    return scene_views.read_views(tool.DATA)


def view_at(x, depth=4.0, size=(48, 32), texture=1):
    width, height = size
    k = np.array([[100.0, 0, width / 2], [0, 100, height / 2], [0, 0, 1]])
    plane = np.full((height, width), depth, np.float32)
    return scene_views.View(
        f"at{x}", k, np.eye(3), np.array([-x, 0.0, 0]), plane, np.full((height, width), texture)
    )


def test_the_shipped_views_are_small_and_those_of_the_rig(views):
    assert sum(path.stat().st_size for path in tool.DATA.iterdir()) <= 6_000_000
    for view, record in zip(views, scene_views.rig(), strict=True):
        assert view.name == record["name"]
        assert view.k.tolist() == record["K"]
        assert view.t.tolist() == record["t"]
        assert view.depth.shape == (scene_views.HEIGHT, scene_views.WIDTH)
        assert 1 < view.depth.min() < view.depth.max() < 10
        assert (np.bincount(view.texture.ravel())[1:] > 0.2 * view.texture.size).all()


def test_depth_and_colours_of_the_shipped_views_agree(views):
    for a, b in [(0, 1), (5, 1)]:
        colours = {
            n: scene_views.read_layers(tool.DATA / f"{views[n].name}.exr", ("R", "G", "B"))
            for n in (a, b)
        }
        seen = scene_views.visible(views[a], views[b])
        assert seen.mean() > 0.8
        places, depth = scene_views.projected(views[a], views[b])
        x, y = np.floor(places[seen]).astype(int).T
        assert abs(views[b].depth[y, x] / depth[seen] - 1).mean() < 1e-3
        assert (views[b].texture[y, x] == views[a].texture[seen]).mean() > 0.99
        off = [abs(colours[b][y, (x + dx) % 960] - colours[a][seen]).mean() for dx in (0, 2, -2)]
        assert off[0] < 0.6 * min(off[1:])  # not the neighbour, whatever the texture


def test_neighbours_are_of_one_row(views):
    assert sorted(stereo.pairs(views)) == [(0, 1), (1, 2), (3, 4), (4, 5)]
    with pytest.raises(ValueError, match="no two cameras"):
        stereo.pairs(views[::3])


def test_what_another_view_does_not_see_does_not_count():
    left, right = view_at(0.0), view_at(0.4)  # 10 px at 4 m
    assert np.allclose(stereo.true_disparities(left, right), 10)
    seen = scene_views.visible(left, right)
    assert not seen[:, :10].any()
    assert seen[:, 10:].all()
    right.depth[:, 20:24] = 2.0  # something in front of it
    assert not scene_views.visible(left, right)[:, 30:34].any()


def test_scores():
    depth = np.full((2, 5), 2.0, np.float32)
    found = np.array([[2, 2.01, 2.5, np.nan, 9], [2, 2, 2, 2, 9]], np.float32)
    places = np.ones((2, 5), bool)
    places[:, 4] = False
    one = stereo.score(found, depth, places)
    assert (one.places, one.found, one.complete) == (8, 7 / 8, 6 / 8)
    assert one.median == 0
    assert one.rms == pytest.approx(np.sqrt((0.5**2 + 0.01**2) / 7), rel=1e-4)
    none = stereo.score(np.full((2, 5), np.nan), depth, places)
    assert (none.found, none.complete) == (0, 0)
    assert np.isnan(none.rms)


def test_a_quarter_of_independent_noise_survives_and_all_of_what_2x2_pixels_share():
    rng = np.random.default_rng(1)
    fine = rng.standard_normal((128, 128, 3))
    assert picture_kinds.energy_left([fine]) == pytest.approx(0.25, abs=0.01)
    assert picture_kinds.energy_left([fine.repeat(2, 0).repeat(2, 1)]) == pytest.approx(1)
    grey = np.full((128, 128, 3), 100, np.uint8)
    noisy = picture_kinds.with_noise(grey, np.array([2.0, 4, 8]), rng).astype(float)
    assert noisy.std((0, 1)) == pytest.approx([2, 4, 8], rel=0.05)


def test_tables_have_the_deviation_of_seeds_and_kinds_without_isos_one_value():
    rows = [("clean", 100, 50.0)]
    for iso, costs in ((100, (0, 0, 0)), (800, (30, 10, 20))):
        for kind, cost in zip(("camera", "IID", picture_kinds.HALF), costs, strict=True):
            rows += [(kind, iso, 50 - cost - 1.0), (kind, iso, 50 - cost + 1.0)]
    table = report.Table(rows)
    assert table.rows(".1f")[:2] == [
        ["clean", "50.0", "50.0"],
        ["camera", "50.0 ± 1.4", "20.0 ± 1.4"],
    ]
    *_, first, second = report.costs_of({"here": table}).splitlines()
    assert first.split(" | ")[2:5] == ["0.0 %", "0.0 %", "0.0 %"]
    assert second == "| here | 800 | 60.0 % | 20.0 % | 40.0 % | 50 % |"


def test_pmvs_gets_cameras_whose_first_pixel_is_at_0(tmp_path):
    program = tmp_path / "pmvs2"
    ply = "ply\\nformat ascii 1.0\\nelement vertex 1\\nproperty float x\\nproperty float y\\n"
    ply += "property float z\\nproperty uchar diffuse_red\\nproperty uchar diffuse_green\\n"
    ply += "property uchar diffuse_blue\\nend_header\\n0.1 -0.2 4 9 8 7\\n"
    program.write_text(f"#!/bin/sh\nprintf '{ply}' > \"$1models/$2.ply\"\n")
    program.chmod(0o755)
    views = [view_at(0.0), view_at(0.4)]
    pictures = [np.full((32, 48, 3), n, np.uint8) for n in (0, 1)]
    options = {"level": 1, "threshold": 0.7, "threads": 1}
    points, colours = multiview.run_pmvs(program, tmp_path / "p", views, pictures, **options)
    assert colours.tolist() == [[9, 8, 7]]
    head, *rows = (tmp_path / "p/txt/00000001.txt").read_text().splitlines()
    assert head == "CONTOUR"
    matrix = np.array([row.split() for row in rows], float)
    x, y, w = matrix @ [*points[0], 1]
    assert (x / w + 0.5, y / w + 0.5) == pytest.approx((24 + 100 * -0.3 / 4, 16 - 100 * 0.2 / 4))
    assert (tmp_path / "p/option").read_text().startswith("level 1\n")
    assert multiview.true_of(points, views)[0].tolist() == [True]
    assert multiview.true_of(np.add(points, (0, 0, 0.1)), views)[0].tolist() == [False]
    assert multiview.true_of(np.subtract(points, (0, 0, 9)), views)[1].tolist() == [0]
    with pytest.raises(multiview.ProgramError, match=r"nothing: No such file"):
        multiview.run_pmvs(tmp_path / "nothing", tmp_path / "q", views, pictures, **options)
    program.write_text("#!/bin/sh\nexit 3\n")
    with pytest.raises(multiview.ProgramError, match=r"status 3; see .*log\.txt"):
        multiview.run_pmvs(program, tmp_path / "q", views, pictures, **options)


@pytest.mark.parametrize("body", ["1 2 3 4 5", "", "1 2 3 4 5 x"])
def test_a_ply_without_whole_coloured_points_is_named(tmp_path, body):
    names = ("x", "y", "z", "diffuse_red", "diffuse_green")
    names += ("diffuse_blue",) if body else ()
    head = "".join(f"property float {name}\n" for name in names)
    (tmp_path / "a.ply").write_text(f"ply\nformat ascii 1.0\n{head}end_header\n{body}\n")
    with pytest.raises(multiview.ProgramError, match=r"a\.ply: expected coloured points"):
        multiview.read_ply(tmp_path / "a.ply")


def test_points_are_drawn_the_nearest_on_top():
    view = view_at(0.0)
    depth = np.full((32, 48), 4.0, np.float32)
    points, colours = report.points_of(view, depth, np.full((32, 48, 3), 200, np.uint8))
    assert points[:, 2] == pytest.approx(4)
    near = np.array([[0, 0, 3.0]])
    image = report.cloud_picture(
        np.concatenate([near, points]), np.concatenate([[[255, 0, 0]], colours]).astype("u1"), view
    )
    assert (image == (255, 0, 0)).all(2).sum() == report.POINT**2
    assert (image == 200).all(2).sum() > 50


def test_after_ctrl_c_what_was_run_for_all_pictures_is_reported(monkeypatch, capsys, tmp_path):
    pictures = tool.Pictures(tmp_path, ["a"], [100], range(1))
    textures = (tool.ALL, *tool.TEXTURES)

    def stopped(program, views, pictures, setting, job):
        if setting != ("half", 0.7) and job != pictures.all()[0]:
            raise KeyboardInterrupt
        return [tool.PointsRow(*setting, *job, texture, 5, 4) for texture in textures]

    monkeypatch.setattr(tool, "points_of_picture", stopped)
    rows = tool.compare_points("pmvs2", [], pictures)
    assert {row.threshold for row in rows} == {0.7}
    assert len(rows) == len(pictures.all()) * len(textures)
    text = []
    tool.report_points(tmp_path, rows, text)
    assert "Points: PMVS2, half resolution, threshold 0.7" in "".join(text)
    assert (tmp_path / "points.csv").is_file() and (tmp_path / "points.svg").is_file()
    assert "stopped" in capsys.readouterr().err


def test_what_is_missing_or_wrong_is_named(monkeypatch, capsys, tmp_path):
    monkeypatch.setattr(tool, "NEEDED", ("numpy", "no_such_module"))
    monkeypatch.setattr("sys.argv", ["reconstruction", "-o", str(tmp_path)])
    assert tool.main() == 1
    message = "no_such_module: missing; .venv/bin/pip install -e '.[compare]'\n"
    assert capsys.readouterr().err == message
    monkeypatch.setattr(tool, "NEEDED", ())
    monkeypatch.setattr(
        "sys.argv", ["reconstruction", "-o", str(tmp_path), "--data", str(tmp_path)]
    )
    assert tool.main() == 1
    assert capsys.readouterr().err.startswith(f"{tmp_path}/cameras.json: No such file")


def shifted(rng, disparity):
    """A pair of pictures whose second sees everything so much further left."""
    texture = rng.integers(0, 256, (96, 256), np.uint8)
    wide = np.repeat(np.repeat(texture, 2, 0), 2, 1)[:128, :, None].repeat(3, 2)
    return wide[:, 64:320], wide[:, 64 + disparity : 320 + disparity]


@pytest.mark.parametrize("half", [False, True])
def test_matching_finds_the_depth(half):
    pytest.importorskip("cv2", reason="needs OpenCV, in the extra compare")
    left, right = (view_at(x, size=(256, 128)) for x in (0.0, 0.4))
    pair = stereo.Pair(left, right, half)
    found = pair.find(*shifted(np.random.default_rng(2), 10))
    one = stereo.score(found, pair.depth, pair.seen)
    assert one.places == (256 - 10) * 128 / (4 if half else 1)
    assert one.complete > 0.9
    assert one.median < 0.02
    noise = np.random.default_rng(3).integers(0, 256, (2, 128, 256, 3), np.uint8)
    assert stereo.score(pair.find(*noise), pair.depth, pair.seen).complete < 0.1


def test_the_experiment_at_thumbnail_scale(tmp_path, monkeypatch, capsys, views):
    pytest.importorskip("cv2", reason="needs OpenCV, in the extra compare")
    pytest.importorskip("matplotlib", reason="needs Matplotlib, in the extra calibrate")
    data, factor, records = tmp_path / "data", 5, scene_views.rig()
    data.mkdir()
    for record in records:
        layers = scene_views.read_layers(tool.DATA / record["file"], scene_views.CHANNELS)
        scene_views.write_view(data / record["file"], layers[::factor, ::factor])
        record["K"] = (np.diag([1 / factor, 1 / factor, 1]) @ record["K"]).tolist()
    (data / "cameras.json").write_text(json.dumps({"views": records}))
    out = tmp_path / "out"
    arguments = ["-o", str(out), "--data", str(data), "--iso", "100", "12800", "--seeds", "1"]
    monkeypatch.setattr("sys.argv", ["reconstruction", *arguments])
    assert tool.main() == 0
    assert capsys.readouterr().out.startswith("### Variance that survives")
    names = {"tables.md", "stereo.csv", "stereo.svg", "depth.png", "points.png"}
    made = {name: (out / name).read_bytes() for name in names}
    assert tool.main() == 0
    assert made == {name: (out / name).read_bytes() for name in names}
