"""Carried layers: found, warped like the pixels, and written next to the picture."""

import json
import tarfile
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
from PIL import Image

import clpipe as clpipe_api
from clpipe.base.errors import ImageError, RequestError
from clpipe.chain.carry import parse_carry
from clpipe.images.tags import upright
from clpipe.inputs.companions import owner_of
from clpipe.reference.carried import Layer, nearest, warp
from clpipe.reference.geometry import Composition, Orientation, destinations
from tests.conftest import written

HALF = ("--stages", "exposure,resize,gamma", "--set", "resize.scale=0.5")
RUN = ("run", "-o", "out", "--device", "numpy")
ALL = ("Depth", "IndexOB", "Vector", "Normal", "CryptoObject", "DiffCol")
OUT = Path("out/a.carried.exr")


class Barrel:
    """Barrel distortion about the centre, r_source = r (1 + k r^2), r = 1 at half the width."""

    def __init__(self, k=0.2):
        self.k = k

    def size(self, width, height):
        return width, height

    def origins(self, x, y, width, height):
        u, v = (x - width / 2) / (width / 2), (y - height / 2) / (width / 2)
        scale = 1 + self.k * (u**2 + v**2)
        return width / 2 * (1 + u * scale), height / 2 + width / 2 * v * scale


class Shift:
    """A stage whose result shows another place."""

    def __init__(self, x, y):
        self.by = x, y

    def size(self, width, height):
        return width - 2, height

    def origins(self, x, y, width, height):
        return x + self.by[0], y + self.by[1]


@pytest.fixture
def render(tmp_path):
    """Write a render with layers of every kind, sizes odd; its channels."""

    def write(name="in/a.exr", height=9, width=14, only=None, **header):
        rng = np.random.default_rng(0)
        normals = rng.normal(size=(3, height, width))
        normals = (normals / np.linalg.norm(normals, axis=0)).astype(np.float32)
        channels = {
            **dict(zip("RGB", rng.random((3, height, width)).astype(np.float16), strict=True)),
            "View.Depth.Z": (1 + rng.random((height, width))).astype(np.float32),
            "View.IndexOB.X": rng.integers(2**25, 2**32, (height, width), dtype=np.uint32),
            "View.CryptoObject00.r": rng.random((height, width), np.float32),
            "View.CryptoObject01.r": rng.random((height, width), np.float32),
            **{f"View.DiffCol.{c}": np.full((height, width), 0.5, np.float16) for c in "RGB"},
            **{f"View.Normal.{c}": normals[i] for i, c in enumerate("XYZ")},
            **{
                f"View.Vector.{c}": np.full((height, width), v, np.float32)
                for c, v in zip("XYZW", (1, 2, -1, -2), strict=True)
            },
        }
        channels = {k: v for k, v in channels.items() if only is None or k in only}
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        kind = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
        OpenEXR.File(kind | header, dict(channels)).write(str(path))
        return channels

    return write


def planes(path=OUT):
    """The channels of an EXR, in their own types."""
    part = OpenEXR.File(str(path), separate_channels=True).parts[0]
    return {name: channel.pixels for name, channel in part.channels.items()}


def carrying(*names):
    return [word for name in names for word in ("--carry", name)]


def test_every_layer_goes_through_the_pictures_geometry(clpipe, render):
    given = render(height=10, width=14, **{"cryptomatte/ab12/name": "CryptoObject"})
    clpipe(*RUN, "in", *HALF, *carrying(*(f"{n}:png" if n == "Depth" else n for n in ALL)))
    got = planes()
    assert got.keys() == given.keys() - set("RGB") | {"valid"}
    row, column = np.mgrid[:5, :7]  # the centre of a pixel of the half picture is a corner of four
    at = 2 * row + column % 2, 2 * column + row % 2
    for name in ("Depth.Z", "IndexOB.X", "CryptoObject00.r", "CryptoObject01.r"):
        np.testing.assert_array_equal(got[f"View.{name}"], given[f"View.{name}"][at])
        assert got[f"View.{name}"].dtype == given[f"View.{name}"].dtype
    for channel, value in zip("XYZW", (0.5, 1, -0.5, -1), strict=True):  # half as many px
        np.testing.assert_allclose(got[f"View.Vector.{channel}"], value, atol=1e-6)
    normals = np.stack([got[f"View.Normal.{c}"] for c in "XYZ"])
    own = np.stack([given[f"View.Normal.{c}"][at] for c in "XYZ"])
    np.testing.assert_allclose(normals, own, atol=1e-6)
    assert (got["valid"] == 1).all()
    millimetres = np.asarray(Image.open("out/a.Depth.png"))
    np.testing.assert_array_equal(millimetres, np.rint(got["View.Depth.Z"] * 1000.0))
    header = OpenEXR.File(str(OUT), header_only=True).parts[0].header
    assert header["cryptomatte/ab12/name"] == "CryptoObject"
    listed = json.loads(Path("out/a.json").read_text())["carried"]
    assert [(each["layer"], each["kind"], each["file"]) for each in listed][:3] == [
        ("Depth", "depth", "a.exr"),
        ("IndexOB", "label", "a.exr"),
        ("Vector", "flow", "a.exr"),
    ]


def test_without_geometry_layers_stay_as_they_are(clpipe, render):
    given = render()
    given["View.Depth.Z"][0, 0] = np.inf
    kind = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    OpenEXR.File(kind, dict(given)).write("in/a.exr")
    clpipe(*RUN, "in", "--until", "exposure", *carrying(*ALL))
    for name, plane in planes().items():
        if name != "valid":
            np.testing.assert_array_equal(plane, given[name])


def test_a_chain_of_geometries_goes_back_from_the_last_to_the_first():
    chain = Composition((Shift(1, 0), Orientation(False, False, True), Shift(0, 2)))
    assert chain.size(10, 6) == (4, 8)
    x, y = chain.origins(np.array([0.5]), np.array([1.5]), 10, 6)
    assert (x.tolist(), y.tolist()) == ([4.5], [0.5])


@pytest.mark.parametrize("number", range(1, 9))
def test_orientation_is_that_of_the_picture(number):
    from clpipe.images.tags import FLIPS

    pixels = np.arange(15).reshape(3, 5, 1)
    (turned,), _ = warp([Layer("label", pixels)], Orientation(*FLIPS[number]), 5, 3)
    np.testing.assert_array_equal(turned, upright(pixels, number))


def test_flow_ends_where_the_picture_has_its_ends():
    """A point moves through a lens as the closed form states."""
    lens, width, height = Barrel(), 41, 31
    y, x = np.mgrid[0:height, 0:width] + 0.5
    flow = np.stack([np.full(x.shape, 3.0), np.full(x.shape, -2.0)], -1)
    blender = np.stack([flow[..., 0], -flow[..., 1], -flow[..., 0], flow[..., 1]], -1)
    plain = Layer("flow", flow, vectors=(((0, 1), (1, 1)),))
    signed = Layer("flow", blender, vectors=(((0, 1), (1, -1)), ((2, -1), (3, 1))))
    (got, other), valid = warp([plain, signed], lens, width, height)
    ends = lens.origins(x + got[..., 0], y + got[..., 1], width, height)
    starts = lens.origins(x, y, width, height)
    known = valid == 1
    assert known.any() and not known.all()  # the corners come from outside
    np.testing.assert_allclose((ends[0] - starts[0])[known], 3, atol=1e-4)
    np.testing.assert_allclose((ends[1] - starts[1])[known], -2, atol=1e-4)
    assert np.abs(got[known] - [3, -2]).max() > 0.2  # it is not the same vector
    np.testing.assert_allclose(other[..., :2][known], got[known] * [1, -1], atol=1e-5)
    np.testing.assert_allclose(other[..., 2:][known], got[known] * [-1, 1], atol=1e-5)
    assert (got[~known] == 0).all()


def test_a_place_that_a_lens_does_not_show_has_no_destination():
    lens = Barrel(-0.2)  # r (1 - 0.2 r^2) is at most 0.8607 at r = 1.29
    to = np.array([20.0, 37.0, 50.0, np.nan]), np.full(4, 15.5)
    x, y = destinations(lens, to, (np.full(4, 20.0), np.full(4, 15.0)), 41, 31)
    back = lens.origins(x, y, 41, 31)
    assert np.isnan(x).tolist() == [False, False, True, True]
    np.testing.assert_allclose(back[0][:2], to[0][:2], atol=1e-6)


def test_what_lies_outside_the_data_window_is_not_known(clpipe, write_exr):
    write_exr("in/a.exr", np.ones((4, 6, 3)))
    write_exr("in/a_depth.exr", np.full((2, 3, 1), 2), "Z", x=1, y=1, full_width=6, full_height=4)
    clpipe(*RUN, "in", "--until", "exposure", "--carry", "depth")
    inside = np.zeros((4, 6))
    inside[1:3, 1:4] = 1
    np.testing.assert_array_equal(planes()["valid"], inside)
    np.testing.assert_array_equal(planes()["depth.Z"], 2 * inside)


def test_places_at_edges_and_without_weight():
    pixels = np.array([[[1.0], [np.nan], [3.0], [4.0]]])
    (same,), _ = warp([Layer("colour", pixels)], Composition((Shift(0, 0),)), 4, 1)
    np.testing.assert_array_equal(same[0, :, 0], [1, np.nan])
    assert nearest(pixels, np.array([-1.0, 0.999]), np.array([5.0, 0.0]))[:, 0].tolist() == [1, 1]


@pytest.mark.parametrize(
    ("file", "pattern", "channel"),
    [
        ("in/a_depth.exr", "", "depth.Z"),
        ("in/a.Depth.exr", "", "depth.Z"),
        ("in/a_aux.exr", "", "depth.Z"),  # by its layers
        ("depth/a.exr", "=../depth/{name}.exr", "depth.Z"),
    ],
)
def test_companions(clpipe, write_exr, file, pattern, channel):
    for name in ("a", "ab"):
        write_exr(f"in/{name}.exr", np.ones((4, 6, 3)))
    depth = np.arange(24.0).reshape(4, 6, 1)
    write_exr(file, depth, "Z", half=False)
    write_exr("in/ab_depth.exr", depth + 1, "Z", half=False)
    clpipe(*RUN, "in/a.exr", "--until", "exposure", "--carry", f"depth{pattern}")
    np.testing.assert_array_equal(planes()[channel], depth[..., 0])
    assert json.loads(Path("out/a.json").read_text())["carried"][0]["file"] in (
        Path(file).name,
        f"../{file}",
    )


@pytest.mark.parametrize("names", [("a_depth.exr", "a.depth.exr"), ("a_one.exr", "a_two.exr")])
def test_of_two_companions_none_is_taken(clpipe, write_exr, names):
    write_exr("in/a.exr", np.ones((4, 6, 3)))
    for name in names:
        write_exr(f"in/{name}", np.ones((4, 6, 1)), "depth.Z")
    refused = clpipe(*RUN, "in/a.exr", "--carry", "depth", status=1).output
    assert all(name in refused for name in names)
    clpipe(*RUN, "in/a.exr", "--until", "exposure", "--carry", f"depth={{name}}{names[1][1:]}")


def test_a_run_resumes_with_carried_files(clpipe, render):
    render(only=["R", "G", "B"])
    render("in/a_aux.exr", only=["View.Depth.Z", "View.IndexOB.X"])
    run = (*RUN, "in/a.exr", *HALF, *carrying("Depth:png"))
    there = "was there already"
    clpipe(*run)
    files, before = written(Path("out")), OUT.read_bytes()
    assert files == ["a.Depth.png", "a.carried.exr", "a.jpg", "a.json"]
    assert there in clpipe(*run).output
    for name in ("a.Depth.png", "a.carried.exr"):
        Path("out", name).unlink()
        assert there not in clpipe(*run).output
        assert (written(Path("out")), OUT.read_bytes()) == (files, before)
    assert there in clpipe(*run, "--redo", "damaged").output
    assert there not in clpipe(*run, *carrying("IndexOB")).output
    clpipe(*run)
    render("in/a_aux.exr", only=["View.Depth.Z"])  # another companion
    assert there not in clpipe(*run).output
    assert there in clpipe(*run).output
    OUT.write_bytes(b"mine")
    refused = clpipe(*run, status=1).output
    assert "a.carried.exr: clpipe did not write this file" in refused


def test_one_file_for_an_image_and_its_replay(clpipe, render):
    render()
    stages = ("--stages", "exposure,mosaic,sensor_noise,demosaic,resize,gamma", *HALF[2:])
    clpipe(*RUN, "in", *stages, "--carry", "Depth", "--frames", 2)
    names = [name for name in written(Path("out")) if "carried" in name]
    assert names == ["a.carried.exr"]
    listing = {
        name: json.loads(Path(f"out/a.{name}.json").read_text())
        for name in ("frame0", "frame1", "truth")
    }
    assert ["carried" in each for each in listing.values()] == [True, False, False]
    bracket = ("--truth", "development", "--bracket", "-1,1")
    clpipe("run", "in", "-o", "bracket", "--device", "numpy", *stages, *bracket, "--carry", "Depth")
    assert Path("bracket/a.carried.exr").read_bytes() == OUT.read_bytes()
    assert "carried" in json.loads(Path("bracket/a.ev-1.json").read_text())
    clpipe("replay", "out/a.frame0.json", "-o", "again", "--device", "numpy")
    assert Path("again/a.carried.exr").read_bytes() == OUT.read_bytes()
    clpipe("replay", "out/a.frame1.json", "-o", "other", "--device", "numpy")
    assert not Path("other/a.carried.exr").exists()


def test_carried_files_go_into_tars(clpipe, render):
    for name in ("a", "b"):
        render(f"in/{name}.exr")
    run = (*RUN, "in", *HALF, "--carry", "Depth", "--webdataset", 2)
    clpipe(*run)
    with tarfile.open("out/000000.tar") as tar:
        names = tar.getnames()
    assert names == [f"{n}.{e}" for n in "ab" for e in ("jpg", "carried.exr", "json")]
    assert "2 of them were there already" in clpipe(*run).output
    assert "already" not in clpipe(*run, "--carry", "IndexOB").output


def test_a_dataset_has_carried_layers(render, tmp_path):
    given = render()
    samples = clpipe_api.Dataset(
        tmp_path / "in", device="numpy", carry=["Depth", "CryptoObject"], until="exposure"
    )
    sample = samples[0]
    np.testing.assert_array_equal(sample["carried.Depth"][..., 0], given["View.Depth.Z"])
    assert sample["carried.CryptoObject"].shape == (9, 14, 2)
    assert sample["carried.valid"].shape == (9, 14) == sample["image"].shape[:2]


def test_a_pipeline_moves_arrays():
    stages = ["exposure", "resize", "gamma"]
    half = clpipe_api.Pipeline(device="numpy", stages=stages, resize={"scale": 0.5})
    depth, flow = np.arange(24.0).reshape(4, 6), np.full((4, 6, 2), 4.0)
    moved, valid = half.carry(depth, "depth")
    row, column = np.mgrid[:2, :3]
    nearest = depth[2 * row + column % 2, 2 * column + row % 2]
    np.testing.assert_array_equal(moved[0], nearest[0])  # a depth of 0 is no surface
    assert valid.tolist() == [[0, 1, 1], [1, 1, 1]]
    np.testing.assert_allclose(half.carry(flow, "flow")[0], np.full((2, 3, 2), 2.0), atol=1e-6)
    whole, _ = half.carry(depth, "depth", resize={"scale": 1.0})
    np.testing.assert_array_equal(whole, depth)
    with pytest.raises(RequestError, match="unknown kind 'deep'"):
        half.carry(depth, "deep")
    with pytest.raises(ImageError, match="found 1 channels; flow has 2 or more"):
        half.carry(depth, "flow")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--carry", "Dpeth"), "no layer 'Dpeth' (did you mean 'Depth'?); the file and a_"),
        (
            ("--carry", "Depth:flow"),
            "its layer Depth has 1 channel, but a layer of flow needs 2 or more",
        ),
        (
            ("--carry", "odd"),
            "the kind of its layer odd is not known from the name. Add it: --carry odd:KIND",
        ),
        (
            ("--carry", "small:depth"),
            "its layer small has 3x2 pixels, but the picture in/a.exr has 14x9",
        ),
        (("--carry", "two"), "has no layer 'two'. It has the layers b, c; name one of"),
        (("--carry", "Depth", "--carry", "View.Depth"), "both contain the channel View.Depth.Z"),
        (("--carry", "seg={name}_no.exr"), "its companion in/a_no.exr does not exist"),
        (("--carry", "broken"), "a_broken.exr: cannot be read as an image"),
    ],
)
def test_what_cannot_be_carried_fails_alone(clpipe, render, write_exr, options, message):
    for name in ("in/a.exr", "in/b.exr"):
        render(name)
    write_exr("in/a_odd.exr", np.ones((9, 14, 2)), "p.a,p.b")
    write_exr("in/a_small.exr", np.ones((2, 3, 1)), "small.Z")
    write_exr("in/a_two.exr", np.ones((9, 14, 2)), "b.Z,c.Z")
    Path("in/a_broken.exr").write_bytes(b"v/1\x01" + bytes(50))
    arguments = ["in/a.exr", *HALF, *options]
    assert message in clpipe(*RUN, *arguments, status=1).output
    assert not Path("out/a.jpg").exists()
    if "small:depth" in options:
        write_exr("in/b_small.exr", np.ones((9, 14, 1)), "small.Z")
        done = clpipe(*RUN, "in/a.exr", "in/b.exr", *HALF, "--carry", "small:depth", status=1)
        assert "1 of 2 images done" in done.output


def test_names_that_say_what_they_belong_to():
    assert owner_of(Path("in/view00_IndexOB.exr")) == "in/view00"
    assert owner_of(Path("in/a.carried.exr")) == "in/a"
    assert owner_of(Path("in/table_top.exr")) is None
    with pytest.raises(RequestError, match="twice"):
        parse_carry(["a:depth", "A:label"])


@pytest.mark.parametrize("turned", [(), ("--augment",)])
def test_patches_have_their_layers(clpipe, render, turned):
    """Layers of a patch are the picture's layers at its position and rotation."""
    render(height=40, width=56, only=("R", "G", "B", "View.Depth.Z", "View.IndexOB.X"))
    given = (*RUN, "in", *HALF, *carrying("Depth:png", "IndexOB"))
    clpipe(*given)
    whole, depth = planes(), np.asarray(Image.open("out/a.Depth.png"))
    patches = ("--patch", 12, "--patches-per-image", 4, *turned)
    clpipe(*[each if each != "out" else "patches" for each in given], *patches, "--format", "png")
    places = json.loads(Path("patches/a.json").read_text())["patches"]
    for number, patch in enumerate(places):
        left, top = patch["place"]

        def cut(image, left=left, top=top, turn=patch["turn"]):
            return upright(image[top : top + 12, left : left + 12], turn)

        own = planes(Path(f"patches/a_{number:04}.carried.exr"))
        assert own.keys() == whole.keys()
        for name, plane in own.items():
            np.testing.assert_array_equal(plane, cut(whole[name]))
        png = np.asarray(Image.open(f"patches/a_{number:04}.Depth.png"))
        np.testing.assert_array_equal(png, cut(depth))
    again = [each if each != "out" else "patches" for each in given]
    assert "there already" in clpipe(*again, *patches, "--format", "png").stderr


def test_patches_that_are_turned_have_no_vectors(clpipe, render):
    render(height=40, width=56)
    given = (*RUN, "in", *carrying("Normal"), "--patch", 12, "--format", "png")
    assert "augment flips and rotates patches" in clpipe(*given, "--augment", status=1).stderr
