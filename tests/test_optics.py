"""Optics: facts about the camera from any source reach all stages consistently."""

import json
from itertools import combinations
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
from PIL import Image

import clpipe as clpipe_api
from clpipe.base.cache import BoundedCache
from clpipe.base.errors import ImageError, RequestError
from clpipe.camera import lens as by_name
from clpipe.camera.optics import Optics
from clpipe.chain.layers import layer_of_array, layer_steps, with_layers
from clpipe.chain.making import make_chain
from clpipe.chain.settings import overlay, settings_from
from clpipe.images.read import read_image
from clpipe.stage import Resample

SIZE = 60, 40
# Stages that need optics, each with what makes it need them.
ALL = {
    "stages": [
        *("shutter", "defocus", "motion_blur", "distortion", "vignetting", "exposure"),
        *("mosaic", "dark_current"),
    ],
    "shutter": {"flicker_depth": 0.5},
    "dark_current": {"current": 9.0, "reference_temperature": 20.0, "spread": 0.1},
    "exposure": {"method": "photometric"},
    "defocus": {"method": "thin_lens"},
    "motion_blur": {"method": "perspective", "rotation": 1.0},
    "distortion": {"method": "brown_conrady", "k1": -0.1},
    "vignetting": {"method": "cosine_fourth"},
}
# By what they state: the places that may, with the key of each and a value; the last is another.
PLACES = {
    "focal_length": (
        [
            ("", "focal_length"),
            ("render", "focal_length"),
            ("distortion", "focal_length"),
            ("vignetting", "focal_length"),
            ("motion_blur", "focal_length"),
            ("defocus", "focal_length"),
        ],
        (35.0, 50.0),
    ),
    "fx": (
        [(table, "fx") for table in ("render", "distortion", "vignetting", "motion_blur")]
        + [("defocus", "fx")],
        (58.0, 70.0),
    ),
    "f_number": (
        [("", "aperture"), ("exposure", "f_number"), ("defocus", "f_number")],
        (2.0, 2.8),
    ),
    "sensor_width": (
        [(table, "sensor_width") for table in ("render", "distortion", "vignetting")]
        + [("motion_blur", "sensor_width"), ("defocus", "sensor_width")],
        (36.0, 24.0),
    ),
    "exposure_time": (
        [(table, "exposure_time") for table in ("render", "exposure", "shutter", "dark_current")],
        (0.02, 0.5),
    ),
    "cx": (
        [(table, "cx") for table in ("render", "distortion", "vignetting", "motion_blur")],
        (31.5, 29.0),
    ),
}
CASES = [(fact, place) for fact, (places, _) in PLACES.items() for place in places]
PAIRS = [(fact, pair) for fact, (places, _) in PLACES.items() for pair in combinations(places, 2)]


def stated(*places, **others):
    """Settings in which each (table, key, value) is set; the rest is what all stages need."""
    values = {**others}
    for table, key, value in places:
        at = values.setdefault(table, {}) if table else values
        at[key] = value
    return overlay(settings_from(ALL), values)


def others_for(fact):
    """Return the focal length that is also needed, in px or mm."""
    lengths = {"render": {"focal_length": 35.0, "sensor_width": 36.0}}
    return {
        "fx": {"render": {"sensor_width": 36.0}},
        "focal_length": {"render": {"sensor_width": 36.0}},
        "sensor_width": {"render": {"focal_length": 35.0}},
    }.get(fact, lengths)


def arguments(settings):
    """The arguments of all kernels for an image, and where they gather it."""
    chain = make_chain(settings)
    depth = np.linspace(1, 9, SIZE[0] * SIZE[1]).reshape(SIZE[::-1])
    layers = {name: layer_of_array(chain, name, depth, *SIZE) for name in layer_steps(chain)}
    chain = with_layers(chain, layers)
    found = {}
    for step in chain.steps:
        found |= {(step.name, k): v for k, v in step.method.arguments(step.context).items()}
        for each in step.method.passes():
            if isinstance(each.access, Resample):
                values = each.access.resampler.values(*SIZE)
                found |= {(step.name, each.function, k): v for k, v in values.items()}
    return {key: np.asarray(v, object if isinstance(v, str) else None) for key, v in found.items()}


def same(one, other):
    return one.keys() == other.keys() and all(
        np.array_equal(one[k], other[k]) if one[k].dtype != object else one[k] == other[k]
        for k in one
    )


@pytest.mark.parametrize(("fact", "place"), CASES, ids=str)
def test_a_fact_that_one_place_states_reaches_all_stages(fact, place):
    places, (value, another) = PLACES[fact]
    everywhere = arguments(stated(*((*each, value) for each in places), **others_for(fact)))
    assert same(arguments(stated((*place, value), **others_for(fact))), everywhere)
    different = arguments(stated((*place, another), **others_for(fact)))
    assert not same(different, everywhere)


@pytest.mark.parametrize(("fact", "pair"), PAIRS, ids=str)
def test_places_that_contradict_each_other_are_named(fact, pair):
    _, values = PLACES[fact]
    names = [f"{table}.{key}" if table else key for table, key in pair]
    both = stated(*((*place, v) for place, v in zip(pair, values, strict=True)), **others_for(fact))
    with pytest.raises(RequestError, match="set one") as refused:
        make_chain(both)
    assert all(f"{name}: " in str(refused.value) for name in names)
    near = stated((*pair[0], values[0]), (*pair[1], values[0] * 1.00001), **others_for(fact))
    assert make_chain(near)


def test_px_and_mm_that_contradict_each_other_are_named(clpipe, write_exr):
    write_exr("a.exr", np.full((40, 60, 3), 0.5))
    run = ("run", "a.exr", "-o", "o", "--device", "numpy", "--set", "motion_blur.fx=90")
    stderr = clpipe(*run, "--focal-length", 35, "--set", "render.sensor_width=36", status=1).stderr
    assert "motion_blur.fx makes the focal length of this render of 60x40 pixels 90 px" in stderr
    assert "but focal_length and render.sensor_width 58.3333 px" in stderr
    pipeline = clpipe_api.Pipeline(
        focal_length=35, render={"sensor_width": 36}, motion_blur={"fx": 90.0}, device="numpy"
    )
    with pytest.raises(RequestError, match=r"but focal_length and render\.sensor_width"):
        pipeline.process(np.ones((40, 60, 3), np.float32), "a")


@pytest.mark.parametrize(
    ("later", "parameter"),
    [
        ({"vignetting": {"method": "cosine_fourth"}}, "fx"),
        ({"distortion": {"method": "poly3", "k1": -0.03}}, "cx"),
        ({"motion_blur": {"method": "linear", "rotation": 1.0}}, "fx"),
        ({"motion_blur": {"method": "perspective", "rotation": 1.0}}, "fx"),
    ],
)
def test_what_counts_in_the_renders_pixels_comes_before_a_smaller_picture(later, parameter):
    (name,) = later
    settings = {"render": {"fx": 300.0, "cx": 90.0}, "resize": {"scale": 0.5}, **later}
    message = f"{name}.{parameter}: found .*; list {name} before resize$"
    with pytest.raises(RequestError, match=message):
        make_chain(settings_from({**settings, "stages": ["resize", name]}))
    make_chain(settings_from({**settings, "stages": [name, "resize"]}))
    make_chain(settings_from({**settings, "stages": ["resize", name], "resize": {"scale": 1.0}}))


# A point that is 1.5 m away, with a focus at 3 m: f^2 (3 - 1.5) / (N 1.5 (3 - f)), and its square.
def disc(focal_length, f_number, pitch):
    return focal_length**2 * 1500 / (f_number * 1500 * (3000 - focal_length)) / pitch


def spread_of(path):
    """The diameter of the disc that a point in the middle became: its mean square is d^2 / 8."""
    seen = read_image(path).pixels[..., 1].astype(np.float64)
    y, x = np.indices(seen.shape) - np.array([24, 180])[:, None, None]
    return np.sqrt(8 * (seen * (x**2 + y**2)).sum() / seen.sum())


@pytest.fixture
def point(write_exr):
    """A render of a point at 1.5 m: 360 px across, of 36 mm, so 0.1 mm apart."""
    image = np.zeros((48, 360, 3), np.float32)
    image[24, 180] = 1
    write_exr("in/a.exr", image)
    write_exr("in/a_depth.exr", np.full((48, 360, 1), 1.5), "Z")


RUN = ("run", "in/a.exr", "--stages", "defocus", "--format", "exr", "--device", "numpy")
THIN = ("--set", "defocus.method=thin_lens")
ZOOM = ("--lens", "Canon EF 24-70mm f/2.8L", "--focal-length", 70, "--aperture", 2.8)
FOCAL = ("--set", "motion_blur.method=perspective", "--set", "motion_blur.focal_length=35")
DEFOCUS = (*THIN, "--aperture", 0.5)
POSE = {"R": [[1, 0, 0], [0, 1, 0], [0, 0, 1]], "t": [0, 0, 0]}
VIEW = {"file": "a.exr", "K": [[350, 0, 180], [0, 350, 24], [0, 0, 1]], **POSE}


@pytest.mark.slow
def test_the_poses_of_a_35_mm_render_are_those_of_its_depth_of_field(clpipe, point):
    Path("cameras.json").write_text(json.dumps({"views": [VIEW]}))
    posed = (*RUN, *DEFOCUS, "--poses", "cameras.json")
    clpipe(*posed, "-o", "o", "--set", "render.sensor_width=36")
    assert spread_of(Path("o/a.exr")) == pytest.approx(disc(35, 0.5, 0.1), abs=0.3)
    clpipe(*posed, "-o", "p", "--focal-length", 35)
    assert spread_of(Path("p/a.exr")) == pytest.approx(disc(35, 0.5, 0.1), abs=0.3)
    stderr = clpipe(*posed, "-o", "q", status=2).stderr
    assert "the focal length is 350 px, but this stage needs it in mm; set" in stderr


def test_a_lens_is_that_of_the_depth_of_field(clpipe, point):
    set_ = ("--focal-length", 50, "--focus-distance", 3, "--set", "render.sensor_width=36")
    clpipe(*RUN, *DEFOCUS, *set_, "-o", "o")
    assert spread_of(Path("o/a.exr")) == pytest.approx(disc(50, 0.5, 0.1), abs=0.3)


def test_a_lens_by_name_is_that_of_the_depth_of_field(clpipe, point):
    pytest.importorskip("lensfunpy", reason="needs lensfunpy, in the extra lens")
    run = [each if each != "defocus" else "defocus,vignetting" for each in (*RUN, *THIN)]
    clpipe(*run, *ZOOM, "--set", "render.sensor_width=36", "-o", "o")
    assert spread_of(Path("o/a.exr")) == pytest.approx(disc(70, 2.8, 0.1), abs=0.3)
    stderr = clpipe(*run, *ZOOM, "--set", "render.focal_length=35", "-o", "p", status=2).stderr
    assert "render.focal_length: 35 contradicts focal_length: 70; set one" in stderr


@pytest.mark.slow
@pytest.mark.parametrize(
    "stated",
    [("--focal-length", 35, "--aperture", 4), (*FOCAL, "--set", "defocus.f_number=4", *THIN)],
)
def test_exif_has_it_wherever_it_is_stated(clpipe, point, stated):
    clpipe("run", "in/a.exr", "-o", "o", "--device", "numpy", *stated)
    with Image.open("o/a.jpg") as image:
        inner = image.getexif().get_ifd(0x8769)
    assert (inner[0x829D], inner[0x920A]) == (4, 35)


@pytest.mark.slow
def test_what_an_exr_says_of_its_camera_is_taken_where_nothing_else_is_said(clpipe, point):
    with OpenEXR.File("in/a.exr", separate_channels=True) as file:
        attributes = {"effectiveFocalLength": 35.0, "sensorOverallDimensions": np.float32([36, 24])}
        header, channels = (
            file.header() | attributes,
            {n: c.pixels for n, c in file.channels().items()},
        )
    OpenEXR.File(header, channels).write("in/a.exr")
    clpipe(*RUN, *DEFOCUS, "-o", "o")
    assert spread_of(Path("o/a.exr")) == pytest.approx(disc(35, 0.5, 0.1), abs=0.3)
    clpipe(*RUN, *DEFOCUS, "-o", "p", "--focal-length", 50)
    assert spread_of(Path("p/a.exr")) == pytest.approx(disc(50, 0.5, 0.1), abs=0.3)


CALIBRATED = by_name.LensCalibration(
    "Maker 24mm",
    24.0,
    {"method": "ptlens", "b": -0.03, "unit": 0.5},
    {"method": "pa", "k1": -0.5},
)


@pytest.fixture
def lensfun(monkeypatch):
    """A database of one lens."""

    def use(calibration):
        monkeypatch.setattr("clpipe.chain.families.FAMILIES", BoundedCache(8))  # of other lenses
        monkeypatch.setattr("clpipe.chain.making.calibration_of", lambda *given: calibration)

    use(CALIBRATED)
    return use


def test_a_lens_by_name_states_its_focal_length(lensfun):
    steps = make_chain(settings_from({"lens": "a", "render": {"sensor_width": 36.0}})).steps
    assert steps[0].context.optics.focal_length == 24.0
    assert {s.name: s.method.method for s in steps}["distortion"] == "ptlens"


def test_a_lens_that_no_step_takes_is_refused(lensfun):
    without = {"skip": ["distortion", "vignetting"]}
    replaced = {"distortion": {"method": "none"}, "vignetting": {"method": "none"}}
    for each in (without, replaced):
        with pytest.raises(RequestError, match="lens: found a, but no step uses it"):
            make_chain(settings_from({"lens": "a", **each}))
        assert make_chain(settings_from(each))
    assert make_chain(settings_from({"lens": "a", "skip": ["vignetting"]}))


def test_a_lens_that_does_not_fit_is_refused(lensfun):
    behind = {"stages": ["mosaic", "vignetting", "demosaic"]}
    with pytest.raises(RequestError, match="stage vignetting reads rgb, but mosaic gives mosaic"):
        make_chain(settings_from({"lens": "a", **behind}))
    assert [s.name for s in make_chain(settings_from(behind)).steps] == ["mosaic", "demosaic"]


def test_a_lens_for_a_smaller_sensor_is_said_as_such(lensfun):
    folding = {"method": "ptlens", "b": -0.3, "unit": 0.3}
    image = np.ones((40, 60, 3), np.float32)
    for smaller, message in (
        (True, "Maker 16mm was calibrated on a smaller sensor than"),
        (False, "fold the image over"),
    ):
        lensfun(by_name.LensCalibration("Maker 16mm", 16.0, folding, {}, 1.0, smaller))
        pipeline = clpipe_api.Pipeline(lens="a", device="numpy")
        with pytest.raises(ImageError, match=message):
            pipeline.process(image, "a")


def test_a_lens_of_which_nothing_is_known_is_refused(lensfun):
    lensfun(by_name.LensCalibration("a", 24.0, {}, {}))
    with pytest.raises(RequestError, match="has neither distortion nor vignetting for it"):
        make_chain(settings_from({"lens": "a"}))


CANON = ("--lens", "Canon EF 24-70mm f/2.8L", "--focal-length", 24, "--skip", "noise")


@pytest.mark.parametrize("size", [(60, 40), (80, 45)])
def test_a_lens_by_name_says_how_wide_its_sensor_is(clpipe, write_exr, size):
    width, height = size
    write_exr("in/a.exr", np.full((height, width, 3), 0.3, np.float32))
    cosine = ("--set", "vignetting.method=cosine_fourth", "--aperture", 2.8)
    clpipe("run", "in", "-o", "o", "--device", "numpy", *CANON, *cosine)
    record = json.loads(Path("o/a.json").read_text())
    # By the diagonal, as lensfun's crop factors are.
    sensor = np.hypot(36, 24) * width / np.hypot(*size)
    fx = 24 / sensor * width
    assert record["intrinsics"]["fx"] == pytest.approx(fx, rel=0.03)  # ptlens has a linear term
    falloff = record["photometry"]["falloff"]["parameters"]
    assert falloff["focal_length"] == 24
    assert falloff["sensor_width"] == pytest.approx(sensor, rel=1e-6)
    stated = ("--set", "render.sensor_width=22.3")
    clpipe("run", "in", "-o", "p", "--device", "numpy", *CANON, *cosine, *stated)
    record = json.loads(Path("p/a.json").read_text())
    assert record["photometry"]["falloff"]["parameters"]["sensor_width"] == 22.3


def test_a_lens_by_name_is_not_that_of_other_poses(clpipe, write_exr):
    write_exr("in/a.exr", np.full((40, 60, 3), 0.3, np.float32))
    view = {"file": "a.exr", "width": 60, "height": 40, "R": np.eye(3).tolist(), "t": [0, 0, 0]}
    for fx, status in ((40.0, 0), (42.0, 0), (83.0, 1)):
        k = [[fx, 0, 30], [0, fx, 20], [0, 0, 1]]
        Path("cameras.json").write_text(json.dumps({"views": [{**view, "K": k}]}))
        stderr = clpipe(
            *("run", "in", "-o", f"o{fx}", "--device", "numpy", "--poses", "cameras.json"),
            *CANON,
            status=status,
        ).stderr
        text = "render.fx: the focal length of this render of 60x40 pixels is 83 px, but lens: "
        assert (text in stderr) == bool(status)


def test_a_pixel_pitch_says_how_wide_the_sensor_is():
    lens = by_name.LensCalibration("a", 50.0, {}, {})
    # 50 mm on pixels of 500 um, which is not the sensor of the lens's camera.
    Optics(fx=100.0, pixel_pitch=500.0).with_lens(lens).for_image(60, 40)
    with pytest.raises(RequestError, match="gives 83 px on its camera's sensor"):
        Optics(fx=100.0, places={"fx": "render.fx"}).with_lens(lens).for_image(60, 40)


def test_a_stage_that_does_not_fit_is_told_by_its_kinds():
    with pytest.raises(RequestError, match="stage optical_blur reads rgb, but mosaic gives mosaic"):
        make_chain(settings_from({"stages": ["exposure", "mosaic", "optical_blur", "demosaic"]}))
