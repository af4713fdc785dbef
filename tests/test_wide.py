"""projection: wide lenses from cubes, maps and overlapping views, against exact scenes."""

import json
from pathlib import Path

import numpy as np
import OpenEXR
import pytest

from clpipe.base.errors import ImageError, RequestError
from clpipe.chain.making import make_chain
from clpipe.chain.panorama import with_panorama
from clpipe.chain.settings import settings_from
from clpipe.engine.runner import Runner
from clpipe.images.read import read_image
from clpipe.reference.panorama import (
    CUBE,
    FRONT,
    OPENEXR_CUBE,
    LatitudeLongitude,
    View,
    Views,
)
from clpipe.reference.projection import visible_faces
from clpipe.reference.wide import WideLens
from tests.test_cuts import in_tiles

SIDE = 96
LENSES = {
    "kannala_brandt": {"fx": 60.0, "fy": 62.0, "k1": -0.02, "k2": 0.003, "cx": 93.0},
    "unified": {"fx": 60.0, "alpha": 0.6, "beta": 1.1, "field_of_view": 220.0},
    "double_sphere": {"fx": 55.0, "xi": -0.2, "alpha": 0.59, "field_of_view": 220.0},
    "f_theta": {"k1": 55.0, "k2": -3.0, "k3": 2.0, "field_of_view": 200.0},
}
STAGES = ("--stages", "shutter,projection")
RUN = ("--stages", "projection", "--format", "exr", "--device", "numpy")


def settings_of(model, **more):
    return {"stages": ["projection"], "projection": {"method": model, **LENSES[model], **more}}


def options_of(model, **more):
    values = {"method": model, **LENSES[model], **more}
    return [x for k, v in values.items() for x in ("--set", f"projection.{k}={json.dumps(v)}")]


def lens_of(model, **more):
    return make_chain(settings_from(settings_of(model, **more))).geometry.parts[0].lens


def unit(rays):
    with np.errstate(invalid="ignore"):
        return rays / np.linalg.norm(rays, axis=0)


def light(rays):
    """Return the light from a direction: waves, at least about 2 px long."""
    x, y, z = unit(rays)
    waves = np.cos(9 * x + 3 * y + 5 * z), np.sin(8 * y - 4 * z), np.cos(7 * z + 6 * x - 2 * y)
    return np.stack([0.5 + 0.4 * wave for wave in waves], -1)


def rays_of(view):
    y, x = np.mgrid[: view.height, : view.width] + 0.5
    return Views((view,), border=0).rays(x, y)


def faces(turns, angle=90.0):
    return [View.from_angle(turn, SIDE, SIDE, angle) for turn in turns]


OVERLAPPING = {
    "left": View.from_angle(
        ((0.5, 0.0, -(0.75**0.5)), (0.0, 1.0, 0.0), (0.75**0.5, 0.0, 0.5)), SIDE, SIDE, 110.0
    ),
    "middle": View.from_angle(FRONT, SIDE, SIDE, 100.0),
    "right": View.from_angle(
        ((0.5, 0.0, 0.75**0.5), (0.0, 1.0, 0.0), (-(0.75**0.5), 0.0, 0.5)), SIDE, SIDE, 110.0
    ),
}
PANORAMAS = {
    "cube": Views(tuple(faces(CUBE.values()))),
    "cube that overlaps": Views(tuple(faces(CUBE.values(), 100.0))),
    "cube of OpenEXR": Views(
        tuple(View(turn, 47.5, 47.5, 48, 48, SIDE, SIDE) for turn in OPENEXR_CUBE)
    ),
    "map": LatitudeLongitude(512, 256),
    "map of OpenEXR": LatitudeLongitude(512, 256, on_edges=True),
}


def images_of(panorama, scene=light):
    if isinstance(panorama, Views):
        return [scene(rays_of(view)).astype(np.float32) for view in panorama.views]
    width, height = panorama.width, panorama.height
    y, x = np.mgrid[:height, :width] + (0.5 + panorama.border)
    return [scene(panorama.rays(x, y)).astype(np.float32)]


def places_of(lens):
    width, height = lens.picture
    y, x = np.mgrid[:height, :width] + 0.5
    return x, y, lens.rays(x, y)


def off_by(picture, lens, scene=light):
    """Return a lower bound of the error of a picture's positions, in px."""
    x, y, rays = places_of(lens)
    step = 1e-3
    slopes = [
        (scene(lens.rays(x + dx, y + dy)) - scene(lens.rays(x - dx, y - dy))) / (2 * step)
        for dx, dy in ((step, 0), (0, step))
    ]
    steepest = np.sqrt((np.stack(slopes) ** 2).sum((0, 3)))
    error = np.sqrt(((picture - scene(rays)) ** 2).sum(-1))
    clear = np.isfinite(steepest) & (steepest > 0.02)
    assert clear.mean() > 0.3
    return error[clear] / steepest[clear]


@pytest.mark.parametrize("model", LENSES)
@pytest.mark.parametrize("kind", PANORAMAS)
def test_a_wide_picture_is_where_the_scene_is(device, kind, model):
    panorama = PANORAMAS[kind]
    chain = with_panorama(make_chain(settings_from(settings_of(model))), panorama)
    atlas = panorama.atlas(images_of(panorama), "bicubic")
    seen = Runner(chain, device, encode=False, final=True).run(atlas, "k").final
    lens = lens_of(model)
    assert seen.shape[1::-1] == lens.picture
    assert off_by(seen, lens).max() < 0.03
    beyond = ~np.isfinite(places_of(lens)[2][0])
    assert beyond.mean() == pytest.approx(1 - np.pi / 4, abs=0.03)
    assert not seen[beyond].any()


@pytest.mark.slow
def test_tiles_have_the_same_bits(device):
    panorama = PANORAMAS["cube"]
    chain = make_chain(settings_from(settings_of("unified", fx=240.0, fy=240.0)))
    chain = with_panorama(chain, panorama)
    atlas = panorama.atlas(images_of(panorama), "bicubic")
    runner = Runner(chain, device, encode=False, final=True)
    assert in_tiles(runner, atlas, 160, 120)[1] >= 2


def opencv(rays, fx, fy, cx, cy, k):
    """OpenCV's fisheye::projectPoints, by its documentation."""
    a, b = rays[0] / rays[2], rays[1] / rays[2]
    r = np.hypot(a, b)
    theta = np.arctan(r)
    bent = theta * (1 + k[0] * theta**2 + k[1] * theta**4 + k[2] * theta**6 + k[3] * theta**8)
    return fx * bent / r * a + cx, fy * bent / r * b + cy


def test_the_models_are_those_of_their_papers():
    rng = np.random.default_rng(0)
    rays = unit(rng.normal(size=(3, 500)))
    ahead = rays[:, rays[2] > 0.1]
    lens = lens_of("kannala_brandt")
    (cx, cy) = lens.principal_point
    assert np.allclose(lens.project(ahead), opencv(ahead, 60, 62, cx, cy, (-0.02, 0.003, 0, 0)))
    x, y, z = rays
    wide = np.arccos(z) < np.radians(110)
    lens = lens_of("unified")
    depth = np.sqrt(1.1 * (x * x + y * y) + z * z)
    across = 60 * x / (0.6 * depth + 0.4 * z) + lens.principal_point[0]
    assert np.allclose(lens.project(rays)[0][wide], across[wide])
    lens = lens_of("double_sphere")
    second = np.sqrt(x * x + y * y + (-0.2 + z) ** 2)
    across = 55 * x / (0.59 * second + 0.41 * (-0.2 + z)) + lens.principal_point[0]
    assert np.allclose(lens.project(rays)[0][wide], across[wide])
    assert not np.isfinite(lens.project(rays)[0][~wide]).any()


@pytest.mark.parametrize("model", LENSES)
def test_rays_and_places_are_inverse(model):
    lens = lens_of(model)
    x, y, rays = places_of(lens)
    back = lens.project(rays)
    known = np.isfinite(rays[0])
    assert np.abs(back[0] - x)[known].max() < 1e-5
    assert np.abs(back[1] - y)[known].max() < 1e-5


@pytest.mark.parametrize("model", LENSES)
def test_intrinsics_are_opencvs_with_what_they_leave(model):
    lens = lens_of(model)
    found = lens.intrinsics()
    k = [found.distortion[f"k{i}"] for i in (1, 2, 3, 4)]
    own = WideLens("kannala_brandt", tuple(k), found.fx, found.fy, lens.field_of_view)
    angles = np.linspace(0.01, np.radians(lens.field_of_view / 2) - 1e-6, 200)
    rays = np.stack([np.sin(angles), np.zeros(200), np.cos(angles)])
    middles = [each.principal_point[0] for each in (own, lens)]
    off = (own.project(rays)[0] - middles[0]) - (lens.project(rays)[0] - middles[1])
    assert np.abs(off).max() <= found.residual * 1.02 + 1e-6
    assert found.residual == 0 if model == "kannala_brandt" else 0 < found.residual < 0.1


@pytest.fixture
def write(tmp_path, monkeypatch):
    """Write an EXR of these channels in the working directory."""
    monkeypatch.chdir(tmp_path)

    def write(name, header=None, **channels):
        kind = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
        own = {k: np.ascontiguousarray(v) for k, v in channels.items()}
        Path(name).parent.mkdir(exist_ok=True)
        OpenEXR.File({**kind, **(header or {})}, own).write(name)

    return write


def colours(image):
    return dict(zip("RGB", np.moveaxis(np.float32(image), 2, 0), strict=True))


@pytest.mark.slow
def test_six_files_a_cube_map_and_a_map_become_a_picture(write, clpipe):
    cube = PANORAMAS["cube"]
    for name, image in zip(CUBE, images_of(cube), strict=True):
        write(f"in/room_{name}.exr", **colours(image))
    strip = np.concatenate(images_of(PANORAMAS["cube of OpenEXR"]))
    write("in/strip.exr", {"envmap": OpenEXR.ENVMAP_CUBE}, **colours(strip))
    around = images_of(PANORAMAS["map of OpenEXR"])[0]
    write("in/around.exr", {"envmap": OpenEXR.ENVMAP_LATLONG}, **colours(around))
    clpipe("run", "in", "-o", "o", *RUN, *options_of("unified"))
    lens = lens_of("unified")
    for name in ("room", "strip", "around"):
        assert off_by(read_image(Path(f"o/{name}.exr")).pixels, lens).max() < 0.03
    record = json.loads(Path("o/room.json").read_text())
    assert [each["file"] for each in record["subframes"]] == [f"room_{name}.exr" for name in CUBE]
    assert record["output"].get("focal_length") is None
    assert "3 of them" in clpipe("run", "in", "-o", "o", *RUN, *options_of("unified")).output
    assert clpipe("run", "in/strip.exr", "-o", "p", "--stages", "exposure", status=1).output.count(
        "a cube map, not a picture. To view it through a wide lens"
    )
    write("in/room_up.exr", **colours(np.zeros((9, 9, 3))))
    output = clpipe("run", "in", "-o", "o", *RUN, *options_of("unified"), status=1).output
    assert "room_up.exr: this view has 9x9" in " ".join(output.split())


def test_overlapping_views_and_what_no_view_shows(write, clpipe):
    views = []
    for name, view in OVERLAPPING.items():
        write(f"in/a-{name}.exr", **colours(light(rays_of(view))))
        k = [[view.fx, 0, view.cx], [0, view.fy, view.cy], [0, 0, 1]]
        turn = np.array(view.rotation).T.tolist()
        views.append({"file": f"{name}.exr", "width": SIDE, "height": SIDE, "K": k, "R": turn})
        views[-1]["t"] = [0, 0, 0]
    Path("rig.json").write_text(json.dumps({"views": views}))
    options = options_of("kannala_brandt", views="rig.json")
    output = clpipe("run", "in", "-o", "o", *RUN, *options).output
    assert "of the lens's field of view is black, because no view covers it" in " ".join(
        output.split()
    )
    seen, lens = read_image(Path("o/a.exr")).pixels, lens_of("kannala_brandt")
    rays = places_of(lens)[2]
    shown = seen.any(-1)
    assert 0.55 < shown.mean() < 0.7
    band = np.abs(rays[1]) < 0.6
    assert shown[np.isfinite(rays[0]) & band].all()
    off = np.abs(seen - light(rays))[shown]
    assert np.percentile(off, 99) < 0.004
    assert off.max() < 0.02  # next to the outermost half pixels of a view
    views[1]["t"] = [0, 0, 1]
    Path("rig.json").write_text(json.dumps({"views": views}))
    output = clpipe("run", "in", "-o", "q", *RUN, *options, status=2).output
    assert "up to 1 apart" in " ".join(output.split())


def test_one_render_is_a_view_of_its_own_focal_length(write, clpipe):
    view = View.from_angle(FRONT, SIDE, SIDE, 100.0)
    write("a.exr", **colours(light(rays_of(view))))
    narrow = options_of("kannala_brandt", field_of_view=90.0)
    output = clpipe("run", "a.exr", "-o", "o", *RUN, *narrow, status=1).output
    assert "the focal length of the render is not known" in " ".join(output.split())
    clpipe("run", "a.exr", "-o", "o", *RUN, *narrow, "--set", f"render.fx={view.fx}")
    seen = read_image(Path("o/a.exr")).pixels
    assert off_by(seen, lens_of("kannala_brandt", field_of_view=90.0)).max() < 0.03


@pytest.mark.parametrize(
    ("options", "status", "message"),
    [
        (("--set", "projection.method=kannala_brandt"), 2, "needs the lens's focal length in px"),
        (("--set", "projection.method=f_theta"), 2, "projection.k1"),
        (options_of("kannala_brandt", k1=-0.5), 1, "sees at most"),
        (options_of("unified", views="none.json"), 2, "projection.views none.json: cannot be read"),
    ],
)
def test_lenses_that_cannot_be(write, clpipe, options, status, message):
    for name, image in zip(CUBE, images_of(PANORAMAS["cube"]), strict=True):
        write(f"in/room_{name}.exr", **colours(image))
    output = clpipe("run", "in", "-o", "o", *RUN, *options, status=status).output
    assert message in " ".join(output.split())
    assert "Traceback" not in output


@pytest.mark.parametrize(
    ("more", "message"),
    [
        (
            {"vignetting": {"method": "cosine_fourth"}},
            "vignetting.method=cosine_fourth: this method",
        ),
        (
            {"vignetting": {"method": "cosine_fourth", "fx": 60.0}},
            "makes the picture of a wide lens",
        ),
        (
            {"distortion": {"method": "brown_conrady", "k1": -0.1}},
            "distortion.method=brown_conrady",
        ),
        ({"motion_blur": {"rotation": 1.0}}, "motion_blur.method=linear"),
        ({"defocus": {"method": "thin_lens"}}, "defocus.method=thin_lens"),
        (
            {"lens": "Canon EF 24-70mm f/2.8L", "focal_length": 24.0},
            "lens: a lens from lensfun needs a picture in",
        ),
    ],
)
def test_what_is_of_perspective_pictures_is_refused_behind_a_wide_lens(more, message):
    wide = {"projection": {"method": "kannala_brandt", **LENSES["kannala_brandt"]}}
    with pytest.raises(RequestError) as error:
        make_chain(settings_from({**wide, **more}))
    assert message in str(error.value)
    make_chain(settings_from({**wide, "vignetting": {"method": "pa", "k1": -0.2}}))


def test_a_view_has_one_focal_length(write, clpipe):
    write("in/room.exr", **colours(light(rays_of(faces([FRONT])[0]))))
    wide = options_of("kannala_brandt", face_angle=90.0)
    for said, of_view in ((SIDE / 2, 0), (1.4 * SIDE, 1)):
        options = (*RUN, *wide, "--set", f"render.fx={said}")
        output = clpipe("run", "in", "-o", "o", *options, status=of_view).output
        assert ("remove the focal length or the angle" in " ".join(output.split())) == bool(of_view)
    for name, image in zip(CUBE, images_of(PANORAMAS["cube"]), strict=True):
        write(f"cube/room_{name}.exr", **colours(image))
    lengths = ("--focal-length", 35, "--set", "render.sensor_width=36")
    output = clpipe("run", "cube", "-o", "o", *RUN, *wide, *lengths, status=1).output
    assert (
        "render's focal length is 93.33 px, but a view of 96x96 pixels with this angle has 48 px"
        in (" ".join(output.split()))
    )


def plane_and_sky(rays):
    """The distance of a floor 1 below, and of a wall 2 behind; the sky is 1000 away."""
    _, y, z = unit(rays)
    with np.errstate(divide="ignore"):
        floor = np.where(y > 0, 1 / np.where(y > 0, y, 1), np.inf)
        wall = np.where(z < 0, -2 / np.where(z < 0, z, -1), np.inf)
    nearest = np.minimum(np.minimum(floor, wall), 1000)
    label = np.select([nearest == 1000, floor < wall], [0, 1], 2)
    return nearest, label


def moved(rays, distance, by):
    """Return the directions of the same points after the camera has moved."""
    return unit(rays) * distance - np.array(by).reshape(3, *[1] * (rays.ndim - 1))


MOVE = (0.02, 0.0, 0.05)
NORMALS = np.array([[0, 1, 0], [0, 0, 1], [1, 0, 0]], np.float32)  # by label


@pytest.mark.slow
def test_layers_of_faces_go_along(write, clpipe):
    for name, view in zip(CUBE, PANORAMAS["cube"].views, strict=True):
        rays = rays_of(view)
        distance, label = plane_and_sky(rays)
        ahead = unit(rays) * distance
        along = np.tensordot(np.array(view.rotation).T, ahead, 1)
        later = np.tensordot(np.array(view.rotation).T, moved(rays, distance, MOVE), 1)
        flow = [np.float32(view.fx * (later[i] / later[2] - along[i] / along[2])) for i in (0, 1)]
        normal = NORMALS[label]
        write(
            f"in/a_{name}.exr",
            **colours(light(rays)),
            **{"Depth.Z": np.float32(along[2]), "ID.V": np.float32(label)},
            **{f"N.{c}": normal[..., i] for i, c in enumerate("XYZ")},
            **{"Flow.X": flow[0], "Flow.Y": flow[1]},
        )
    carried = ("Depth", "ID:label", "N:normal", "Flow:flow")
    options = [x for each in carried for x in ("--carry", each)]
    clpipe("run", "in", "-o", "o", *RUN, *options_of("double_sphere"), *options)
    with OpenEXR.File("o/a.carried.exr", separate_channels=True) as file:
        found = {k: np.float64(c.pixels) for k, c in file.channels().items()}
    lens = lens_of("double_sphere")
    x, y, rays = places_of(lens)
    seen = np.isfinite(rays[0])
    distance, label = plane_and_sky(rays)
    # Nothing is known of a pixel's own surface nearer to an edge than the source's pixels.
    inner = seen.copy()
    for dy in range(-3, 4):
        for dx in range(-3, 4):
            other = np.roll(label, (dy, dx), (0, 1))
            inner &= (other == label) & np.roll(seen, (dy, dx), (0, 1))
    assert inner.mean() > 0.5
    assert np.array_equal(found["valid"] > 0, seen)
    assert np.array_equal(found["ID.V"][inner], label[inner])
    off = np.abs(found["Depth.Distance"] / distance - 1)[inner]
    assert np.percentile(off, 99) < 0.001
    assert off.max() < 0.02
    assert found["Depth.Z"] == pytest.approx(found["Depth.Distance"] * np.nan_to_num(rays[2]))
    assert (found["Depth.Z"][inner] < 0).any()
    for i, c in enumerate("XYZ"):
        assert found[f"N.{c}"][inner] == pytest.approx(NORMALS[label][..., i][inner], abs=1e-6)
    ends = lens.project(moved(rays, distance, MOVE))
    for name, start, end in zip("XY", (x, y), ends, strict=True):
        known = inner & np.isfinite(end) & np.isfinite(found[f"Flow.{name}"])
        assert known.mean() > 0.5
        off = np.abs(found[f"Flow.{name}"] - (end - start))[known]
        assert np.percentile(off, 99) < 0.03


def test_poses_and_camera_files_are_the_wide_cameras(write, clpipe):
    for name, image in zip(CUBE, images_of(PANORAMAS["cube"]), strict=True):
        write(f"in/room_{name}.exr", **colours(image))
    k = [[48, 0, 48], [0, 48, 48], [0, 0, 1]]
    view = {"file": "room.exr", "K": k, "R": np.eye(3).tolist(), "t": [1, 2, 3]}
    Path("poses.json").write_text(json.dumps({"views": [view]}))
    options = options_of("unified")
    clpipe("run", "in", "-o", "o", *RUN, *options, "--poses", "poses.json")
    (camera,) = json.loads(Path("o/cameras.json").read_text())["views"]
    assert camera["t"] == [1, 2, 3]
    assert camera["model"] == "OPENCV_FISHEYE"
    assert camera["width"], camera["height"] == lens_of("unified").picture
    frames = json.loads(Path("o/transforms.json").read_text())
    assert frames["camera_model"] == "OPENCV_FISHEYE"
    assert frames["distortion_residual"] == pytest.approx(lens_of("unified").intrinsics().residual)


@pytest.mark.slow
def test_a_dataset_of_faces_that_exist(write, clpipe):
    for view in ("one", "two"):
        for name, image in zip(CUBE, images_of(PANORAMAS["cube"]), strict=True):
            depth = np.full(image.shape[:2], 2, np.float32)
            write(f"in/{view}_{name}.exr", **colours(image), **{"Depth.Z": depth})
    _, _, *rest = options_of("unified")
    chosen = ("--lens-model", "unified", *rest, "--device", "numpy", "--stages", "projection,gamma")
    clpipe("dataset", "in", "-o", "set", "--iso", "100", *chosen, "--truth", "clean", status=2)
    clpipe("dataset", "in", "-o", "set", "--iso", "100", *chosen[:-2])
    made = {path.name for path in Path("set/iso100").iterdir()}
    assert {"one.jpg", "two.jpg", "one.Depth.png", "one.truth_clean.jpg"} <= made
    readme = Path("set/README.md").read_text()
    assert "2 in `train.txt`" in readme
    assert "`Depth` (depth): along the viewing axis" in readme
    assert "`Depth.Distance` (depth): the distance from the camera" in readme
    other = (*chosen[:-2], "--set", "projection.method=double_sphere")
    assert "use only one of them" in clpipe("dataset", "in", "-o", "n", *other, status=2).output
    record = json.loads(Path("set/iso100/one.json").read_text())
    turns = [view["rotation"] for view in record["panorama"]["views"]]
    assert turns == [np.array(turn).tolist() for turn in CUBE.values()]
    replayed = clpipe("replay", "set/iso100/one.json", "-o", "again", "--device", "numpy").output
    assert "the same bytes" in replayed


def test_only_faces_that_a_lens_sees_are_rendered():
    side, names = visible_faces(lens_of("kannala_brandt", field_of_view=80.0))
    assert names == ["front"]
    assert side == 2 * 62
    assert visible_faces(lens_of("unified", field_of_view=170.0))[1] == [
        "front",
        "right",
        "left",
        "up",
        "down",
    ]
    assert len(visible_faces(lens_of("unified", field_of_view=220.0))[1]) == 5
    assert len(visible_faces(lens_of("unified", field_of_view=200.0))[1]) == 5


def test_a_cube_map_that_is_none(write, clpipe):
    write("a.exr", {"envmap": OpenEXR.ENVMAP_CUBE}, **colours(np.zeros((40, 9, 3))))
    output = clpipe("run", "a.exr", "-o", "o", *RUN, *options_of("unified"), status=1).output
    assert "this cube map has 9x40 pixels, but its height must be 6 times" in " ".join(
        output.split()
    )


def test_a_map_without_a_border_is_an_image_as_well(device):
    panorama = PANORAMAS["map"]
    chain = make_chain(settings_from(settings_of("unified", source="map", field_of_view=100.0)))
    (image,) = images_of(panorama)
    seen = Runner(chain, device, encode=False, final=True).run(image, "k").final
    assert off_by(seen, lens_of("unified", field_of_view=100.0)).max() < 0.03
    with pytest.raises(ImageError, match="focal length of the render"):
        Runner(make_chain(settings_from(settings_of("unified"))), None).run(image, "k")


def test_a_single_render_may_have_subframes_and_annotations(write_exr, clpipe):
    """The page on lenses says so; panoramas may not."""
    one, two = (np.full((32, 48, 3), value, np.float32) for value in (0.1, 0.3))
    for name, pixels in (("in/f1", one), ("in/f2", two), ("mean/f1", (one + two) / 2)):
        write_exr(f"{name}.exr", pixels, half=False)
    wide = {"method": "kannala_brandt", "fx": 40, "field_of_view": 30}
    lens = [x for k, v in wide.items() for x in ("--set", f"projection.{k}={v}")]
    lens += ["--set", "render.fx=60", "--device", "numpy"]
    subframes = ("--set", "shutter.subframes=2", *STAGES)
    clpipe("run", "in", "-o", "o", *lens, *subframes, "--format", "exr")
    clpipe("run", "mean", "-o", "p", *lens, *STAGES, "--format", "exr")
    assert np.allclose(
        read_image(Path("o/f1.exr")).pixels, read_image(Path("p/f1.exr")).pixels, atol=1e-3
    )
    box = {"id": 1, "image_id": 1, "category_id": 1, "bbox": [20, 12, 8, 8], "area": 64}
    images = [{"id": 1, "file_name": "f1.exr", "width": 48, "height": 32}]
    coco = {"images": images, "categories": [{"id": 1, "name": "a"}], "annotations": [box]}
    Path("coco.json").write_text(json.dumps(coco))
    pytest.importorskip("pycocotools", reason="needs pycocotools, in the extra annotations")
    clpipe(
        "run", "mean", "-o", "q", *lens, *STAGES, "--format", "exr", "--annotations", "coco.json"
    )
    (made,) = json.loads(Path("q/annotations.json").read_text())["annotations"]
    x, y, width, height = made["bbox"]
    size = json.loads(Path("q/annotations.json").read_text())["images"][0]
    centre = size["width"] / 2, size["height"] / 2
    assert (x + width / 2, y + height / 2) == pytest.approx(centre, abs=0.1)
    assert width == pytest.approx(8 * 40 / 60, rel=0.02)


def test_panoramas_have_no_subframes_annotations_or_rolling_shutter(write, write_exr, clpipe):
    for name, image in zip(CUBE, images_of(PANORAMAS["cube"]), strict=True):
        write(f"in/room_{name}.exr", **colours(image))
    wide = options_of("kannala_brandt")
    two = ("--set", "shutter.subframes=2", *wide, "--device", "numpy", *STAGES, "--format", "exr")
    assert "also be a sub-frame" in clpipe("run", "in", "-o", "a", *two, status=2).output
    pytest.importorskip("pycocotools", reason="needs pycocotools, in the extra annotations")
    box = {"id": 1, "image_id": 1, "category_id": 1, "bbox": [20, 12, 8, 8], "area": 64}
    images = [{"id": 1, "file_name": "room_front.exr", "width": SIDE, "height": SIDE}]
    coco = {"images": images, "categories": [{"id": 1, "name": "a"}], "annotations": [box]}
    Path("coco.json").write_text(json.dumps(coco))
    run = ("run", "in", "-o", "b", *wide, *RUN, "--annotations", "coco.json")
    assert "annotations of panoramas cannot be warped by a wide lens" in clpipe(*run).output
    for number in range(2):
        write_exr(f"one/f{number}.exr", np.full((32, 48, 3), 0.1))
    lens = {"method": "kannala_brandt", "fx": 40, "field_of_view": 30}
    lens = [x for k, v in lens.items() for x in ("--set", f"projection.{k}={v}")]
    rolling = ("--set", "shutter.line_time=1e-4", "--set", "render.fx=60", *two[:2], *STAGES)
    output = clpipe("run", "one", "-o", "c", *lens, *rolling, "--device", "numpy", status=(1, 2))
    assert "rolling shutter" in " ".join(output.output.split())
