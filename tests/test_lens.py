"""Lenses: distortion, lateral colour, vignetting, and lensfun's data."""

import json
import sys
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from clpipe.base.errors import ImageError, KeyedError, RequestError
from clpipe.camera import lens as by_name
from clpipe.camera.profile import load_camera
from clpipe.chain.making import make_chain
from clpipe.chain.settings import settings_from
from clpipe.engine.check import example
from clpipe.engine.runner import Runner
from clpipe.reference.radial import Radial
from clpipe.reference.warp import FILTERS, Warp
from clpipe.stage import Kind
from clpipe.stages.distortion import BrownConrady, Fisheye, PtLens
from tests.test_cuts import in_less_memory

BARREL = {"method": "brown_conrady", "focal_length": 30.0, "sensor_width": 36.0, "k1": -0.3}
BROWN = BrownConrady(
    **{"fx": 1000.0, "fy": 980.0, "cx": 610.0, "k1": -0.15, "k2": 0.03, "k4": 0.02, "k6": 0.01},
    **{"s1": 0.003, "s2": -0.002, "s3": -0.004, "s4": 0.001},
    **{"p1": 0.002, "p2": -0.001, "kr": 1.002, "vb": 0.997, "cb": 0.001, "bb": -0.0005},
)
LENSES = {
    "brown_conrady": BROWN.lens(),
    "barrel": BrownConrady(fx=900.0, fy=900.0, k1=-0.3).lens(),
    "pincushion": BrownConrady(fx=900.0, fy=900.0, k1=0.4, fit=True).lens(),
    "fisheye": Fisheye(fx=600.0, fy=600.0, k1=-0.03, k2=0.002).lens(),
    "ptlens": PtLens(a=0.0153, b=-0.0394, c=0.01).lens(),
}


def chain_of(**own):
    return make_chain(settings_from({"stages": ["distortion"], "distortion": own}))


def bent_by_opencv(x, y):
    """Where OpenCV puts places of the render through BROWN, by its documented formula."""
    x, y = (x - 610.0) / 1000.0, (y - 400.0) / 980.0
    r2 = x * x + y * y
    ratio = (1 - 0.15 * r2 + 0.03 * r2**2) / (1 + 0.02 * r2 + 0.01 * r2**3)
    bent_x = x * ratio + 2 * 0.002 * x * y - 0.001 * (r2 + 2 * x * x)
    bent_y = y * ratio + 0.002 * (r2 + 2 * y * y) - 2 * 0.001 * x * y
    bent_x += 0.003 * r2 - 0.002 * r2**2
    bent_y += -0.004 * r2 + 0.001 * r2**2
    return bent_x * 1000.0 + 610.0, bent_y * 980.0 + 400.0


def some_places(count=2000):
    random = np.random.default_rng(0)
    return random.random(count) * 1200, random.random(count) * 800


def test_the_inverse_is_exact():
    x, y = some_places()
    back = bent_by_opencv(*BROWN.lens().origins(x, y, 1200, 800))
    assert np.abs(np.subtract(back, (x, y))).max() < 1e-8


def test_the_fisheye_is_that_of_opencv():
    x, y = some_places()
    u, v = LENSES["fisheye"].origins(x, y, 1200, 800)
    radius, bent = np.hypot(u - 600, v - 400) / 600, np.hypot(x - 600, y - 400) / 600
    radius, bent = radius[radius < 1.2], bent[radius < 1.2]  # to the corners of the render
    angle = np.arctan(radius)
    assert np.abs(angle * (1 - 0.03 * angle**2 + 0.002 * angle**4) - bent).max() < 1e-9
    turned = (u - 600) * (y - 400) - (v - 400) * (x - 600)
    assert np.abs(turned).max() < 1e-6  # the same direction


def test_red_and_blue_part_from_green():
    x, y = some_places()
    lens = BROWN.lens()
    u, v = lens.source_positions(x, y, 1200, 800, lens.blue)
    green = bent_by_opencv(u, v)
    side = 799 / 2  # of r = 1, between the centres of the outermost pixels
    r = np.hypot(green[0] - 610, green[1] - 400) / side
    bent = r * (0.997 + 0.001 * r - 0.0005 * r * r)
    assert np.abs(bent - np.hypot(x - 610, y - 400) / side).max() < 1e-9


@pytest.mark.parametrize("size", [(1200, 800), (321, 240)])
@pytest.mark.parametrize("lens", LENSES.values(), ids=LENSES)
def test_what_kernels_interpolate_is_within_a_hundredth_of_a_pixel(lens, size):
    width, height = size
    if size == (321, 240):
        scaled = None if lens.focal is None else tuple(f * 0.25 for f in lens.focal)
        lens = replace(lens, focal=scaled, centre=(None, None))
    rows, columns = np.arange(0, height, 3), np.arange(width)
    fields = Warp(lens, "bicubic").grid(width, height).fields(rows, columns)
    x, y = np.meshgrid(columns + 0.5, rows + 0.5)
    for lateral in (lens.red, Radial(), lens.blue):
        u, v = lens.source_positions(x, y, width, height, lateral)
        inside = (u > 0) & (u < width) & (v > 0) & (v < height)
        apart = np.hypot(next(fields) + x - u, next(fields) + y - v)[inside]
        assert apart.max() < 0.01


@pytest.mark.parametrize("name", FILTERS)
def test_points_are_where_the_model_says(name):
    # A quarter of the image that bent_by_opencv is about.
    own = {"fx": 250.0, "fy": 245.0, "cx": 152.5, "kr": 1.0, "vb": 1.0, "cb": 0.0, "bb": 0.0}
    method = BROWN.model_copy(update={"filter": name, **own})
    y, x = np.mgrid[:200, :300] + 0.5
    image, points = np.zeros((200, 300)), [(20.3, 22.8), (152.5, 100.0), (277.2, 181.6)]
    for px, py in points:
        image += np.exp(-((x - px) ** 2 + (y - py) ** 2) / 4.5)
    picture = method.resampling.reference(image.astype(np.float32)[..., None].repeat(3, 2))
    for px, py in points:
        to_x, to_y = (each / 4 for each in bent_by_opencv(4 * px, 4 * py))
        near = picture[..., 1] * (np.hypot(x - to_x, y - to_y) < 8)
        assert abs((near * x).sum() / near.sum() - to_x) < 0.02
        assert abs((near * y).sum() / near.sum() - to_y) < 0.02


@pytest.mark.slow
def test_what_the_lens_does_not_see_is_black_and_fit_leaves_none(device):
    image = np.ones((150, 203, 3), np.float32)
    plain, fitted = (
        Runner(chain_of(**BARREL, fit=fit), device, encode=False, final=True).run(image, "k")
        for fit in (False, True)
    )
    assert (plain.final[0, 0] == 0).all() and np.abs(plain.final[75, 100] - 1).max() < 1e-6
    assert np.abs(fitted.final - 1).max() < 1e-5
    found = fitted.estimates["distortion"]
    r = np.hypot(203, 150) / 2 / (203 * 30 / 36)  # of the corners, the last to leave the void
    assert found["focal_length_factor"] == pytest.approx(1 / (1 - 0.3 * r * r), abs=1e-5)
    assert found["fx"] == pytest.approx(found["focal_length_factor"] * 203 * 30 / 36)
    numpy = Runner(chain_of(**BARREL, fit=True), None, final=True).run(image, "k")
    assert numpy.estimates == fitted.estimates
    assert plain.estimates == {}


@pytest.mark.parametrize("k1", [-0.3, 0.6])
def test_tiles_have_the_same_bits_where_much_is_bent(device, k1):
    chain = chain_of(**{**BARREL, "k1": k1})
    runner = Runner(chain, device, encode=False, final=True)
    for size in ((650, 803), (801, 301)):
        image = example(Kind.RGB, size)
        on_device, in_numpy = (
            r.run(image, "k").final for r in (runner, Runner(chain, None, final=True))
        )
        assert np.array_equal(on_device, in_numpy)
        in_less_memory(runner, image)


def test_a_lens_that_folds_the_image_is_refused(clpipe, write_exr):
    write_exr("a.exr", np.full((40, 60, 3), 0.5))
    fold = ("--set", "distortion.method=brown_conrady", "--set", "distortion.fx=25")
    run = ("run", "a.exr", "-o", "o", "--stages", "distortion", "--device", "numpy")
    stderr = clpipe(*run, *fold, "--set", "distortion.k1=-0.5", status=1).stderr
    assert "The distortion folds at r = 0.8165, 20 px from the principal point" in stderr
    assert "the corner of 60x40 pixels is at r = 1.442" in stderr
    stderr = clpipe(*run, "--set", "distortion.method=fisheye", status=2).stderr
    assert "set fx (px), or focal_length and sensor_width (mm)" in stderr
    both = ("--set", "distortion.focal_length=20", "--set", "distortion.sensor_width=30")
    stderr = clpipe(*run, *fold, *both, status=1).stderr
    assert "distortion.fx makes the focal length of this render of 60x40 pixels 25 px" in stderr
    assert "but distortion.focal_length and distortion.sensor_width 40 px" in stderr
    lateral = PtLens(vr=1.0, br=-0.9)
    with pytest.raises(ImageError, match="The lateral colour folds"):
        lateral.resampling.grid(60, 40)
    shifted = PtLens(a=0.001, cx=-1e6, fit=True)
    with pytest.raises(ImageError, match="distortion: "):
        shifted.resampling.grid(60, 40)


def test_a_lens_costs_one_launch_and_vignetting_none():
    def launches(**own):
        return [x.name for x in Runner(make_chain(settings_from(own)), None).plan().launches]

    vignetting = {"vignetting": {"method": "pa", "k1": -0.3}}
    plain = launches()
    assert len(launches(**vignetting)) == len(plain)
    assert len(launches(distortion=BARREL, **vignetting)) == len(plain) + 1
    assert not any("distortion" in name for name in plain)


@pytest.mark.parametrize(
    ("camera", "name", "setting", "size"),
    [
        ("canon-5d3", "Canon EF 24-70mm f/2.8L", {"focal_length": 24, "aperture": 2.8}, (601, 400)),
        ("canon-80d", "Canon EF-S 18-55mm f/3.5-5.6 IS", {"focal_length": 18}, (401, 600)),
        ("sony-a7r2", "M.Zuiko Digital 12-50mm f/3.5-6.3", {"focal_length": 20}, (641, 480)),
        ("canon-80d", "canon ef 24-70 2.8 L", {"focal_length": 35, "aperture": 4}, (501, 501)),
    ],
)
def test_lensfun_says_the_same(camera, name, setting, size):
    lensfunpy = pytest.importorskip("lensfunpy", reason="needs lensfunpy, in the extra lens")
    steps = make_chain(settings_from({"camera": camera, "lens": name, **setting})).steps
    (bend,) = (s.method.lens() for s in steps if s.name == "distortion")
    vignetting = next(s for s in steps if s.name == "vignetting")
    database, profile = lensfunpy.Database(), load_camera(camera)
    crop = by_name._crop_factor(database, profile.make, profile.model)
    lens = by_name._find_lens(database, name, crop)
    modifier = lensfunpy.Modifier(lens, crop or lens.crop_factor, *size)
    arguments = setting["focal_length"], setting.get("aperture", 8), by_name.INFINITY_DISTANCE
    modifier.initialize(*arguments, scale=1.0, pixel_format=np.float32)
    places = modifier.apply_subpixel_geometry_distortion()
    if places is None:  # without lateral colour
        places = modifier.apply_geometry_distortion()[:, :, None].repeat(3, 2)
    assert np.hypot(*np.moveaxis(places[..., 1, :] - places[::-1, ::-1, 1, :], -1, 0)).max() > 100
    # Other rows go through lensfun's SSE code, which approximates roots and is 0.1 px off.
    exact = (np.arange(size[1]) * places.strides[0] + places.ctypes.data) % 16 != 0
    y, x = np.mgrid[: size[1], : size[0]]
    for channel, lateral in enumerate((bend.red, Radial(), bend.blue)):
        across, down = places[..., channel, 0] + 0.5, places[..., channel, 1] + 0.5
        inside = (across > 0) & (across < size[0]) & (down > 0) & (down < size[1])
        inside &= exact[:, None]
        u, v = bend.source_positions(
            across[inside].astype(float), down[inside].astype(float), *size, lateral
        )
        assert np.hypot(u - 0.5 - x[inside], v - 0.5 - y[inside]).max() < 0.02
    if "aperture" in setting:
        white = np.ones((size[1], size[0], 3), np.float32)
        ours = Runner(make_chain(settings_from({
            "stages": ["vignetting"],
            "vignetting": {"method": "pa", **vignetting.method.model_dump()},
        })), None, final=True).run(white, "k").final  # fmt: skip
        modifier.apply_color_modification(ours)
        assert np.abs(ours - 1).max() < 1e-4


@pytest.mark.parametrize(
    ("setting", "said"),
    [
        (
            {"lens": "Cannon EF 24-71mm"},
            "has no lens 'Cannon EF 24-71mm'; the nearest are Canon EF",
        ),
        ({"lens": "24-70"}, "'24-70' may mean .*, or [0-9]+ more; use the full name of one"),
        ({"lens": "Canon EF 24-70mm f/2.8L"}, "is a zoom; set 24 to 70 mm"),
        (
            {"lens": "Canon EF 24-70mm f/2.8L", "focal_length": 85},
            "85 mm is not possible, because Canon EF 24-70mm f/2.8L USM has 24 to 70 mm",
        ),
        (
            {"lens": "Canon EF 24-70mm f/2.8L", "focal_length": 24, "aperture": 1.4},
            "f/1.4 is not possible, because Canon EF 24-70mm f/2.8L USM has f/2.8 to f/22",
        ),
        ({"lens": "Samyang 8mm f/3.5 Fish-Eye CS"}, "is not rectilinear"),
    ],
)
def test_lenses_that_lensfun_does_not_have_or_not_so(setting, said):
    pytest.importorskip("lensfunpy", reason="needs lensfunpy, in the extra lens")
    with pytest.raises(RequestError, match=said):
        make_chain(settings_from(setting))


def test_a_lens_is_set_as_a_camera_is(clpipe, write_exr):
    pytest.importorskip("lensfunpy", reason="needs lensfunpy, in the extra lens")
    write_exr("a.exr", np.full((20, 30, 3), 0.5))
    Path("m.csv").write_text(
        "path,lens,focal_length,aperture\na.exr,Canon EF 24-70mm f/2.8L,24,2.8\n"
    )
    Path("c.toml").write_text("[distortion]\nfit = true\n[focal_length]\nuniform = [24, 70]\n")
    clpipe("run", "m.csv", "-o", "o", "-c", "c.toml", "--device", "numpy")
    record = {s["name"]: s for s in json.loads(Path("o/a.json").read_text())["stages"]}
    assert record["distortion"]["method"] == "ptlens" and record["vignetting"]["method"] == "pa"
    assert record["distortion"]["parameters"]["a"] == pytest.approx(0.0153, abs=1e-5)
    assert record["distortion"]["estimates"]["focal_length_factor"] > 1.0
    lens = ("--lens", "Canon EF 24-70mm f/2.8L", "--focal-length", 24)
    Path("printed.toml").write_text(clpipe("plan", *lens, "--toml").stdout)
    assert 'method = "lens"' in Path("printed.toml").read_text()
    again = clpipe("plan", "-c", "printed.toml", "--json").stdout
    assert again == clpipe("plan", *lens, "--json").stdout


def test_a_lens_by_a_part_of_its_name_is_named(clpipe, write_exr):
    pytest.importorskip("lensfunpy", reason="needs lensfunpy, in the extra lens")
    pytest.importorskip("jinja2", reason="needs jinja2, in the extra report")
    run = ("run", write_exr("a.exr", np.full((20, 30, 3), 0.5)), "--device", "numpy")
    taken = "warning: lens: 'Canon 50mm' is a part of a name, and clpipe uses Canon EF 50mm f/1.8"
    assert taken in clpipe(*run, "-o", "o", "--lens", "Canon 50mm").stderr
    assert json.loads(Path("o/a.json").read_text())["lens"] == "Canon EF 50mm f/1.8"
    clpipe("report", "o")
    assert "sony-a7r2 with Canon EF 50mm f/1.8, ISO 100" in Path("o/report.html").read_text()
    whole = clpipe(*run, "-o", "p", "--lens", "EF 50mm f/1.8")  # the maker is not needed
    assert "is a part of a name" not in whole.stderr
    Path("m.csv").write_text("path,lens\na.exr,Canon 50mm\n")
    assert taken in clpipe("run", "m.csv", "-o", "q", "--device", "numpy").stderr


def test_every_lens_of_the_database_takes_an_aperture_or_says_its_range():
    """lensfun knows no range, or half of one, for most."""
    lensfunpy = pytest.importorskip("lensfunpy", reason="needs lensfunpy, in the extra lens")
    database = lensfunpy.Database()
    checked = 0
    for camera in database.cameras[::20]:
        for lens in database.find_lenses(camera):
            checked += 1
            with suppress(KeyedError):
                by_name._check_aperture(lens, 8.0)
    assert checked > 100


@pytest.mark.parametrize(
    ("low", "high", "aperture", "said"),
    [
        (None, None, 1.0, None),
        (2.8, None, 8.0, None),
        (2.8, None, 1.4, "has f/2.8 and above"),
        (None, 22.0, 32.0, "has f/0 to f/22"),
    ],
)
def test_an_aperture_of_a_lens_whose_range_is_not_all_known(low, high, aperture, said):
    lens = SimpleNamespace(
        maker="Canon", model="EF 1", min_aperture=low, max_aperture=high, min_focal=1, max_focal=1
    )
    if said is None:
        by_name._check_aperture(lens, aperture)
    else:
        with pytest.raises(KeyedError, match=said):
            by_name._check_aperture(lens, aperture)


def test_what_is_said_without_lensfunpy(clpipe, monkeypatch):
    by_name._load_database.cache_clear()
    monkeypatch.setitem(sys.modules, "lensfunpy", None)
    stderr = clpipe("plan", "--lens", "any", status=2).stderr
    assert "lensfun's database needs lensfunpy, which is in the extra 'lens'." in stderr
    assert "Run: pip install lensfunpy" in stderr


def test_kernels_are_not_refused_for_the_image_that_compiles_them(device):
    chain = chain_of(method="brown_conrady", fx=700.0, k1=-0.3, cx=740.0)
    Runner(chain, device, encode=False, final=True).compile()  # 8x8 pixels far from the axis
    with pytest.raises(ImageError, match="the corner of 8x8 pixels"):
        Runner(chain, None, final=True).run(np.ones((8, 8, 3), np.float32), "k")


def test_the_table_of_parameters_has_no_message_where_a_focal_length_is_to_be_set(clpipe):
    shown = clpipe("stages", "distortion").stdout
    assert "the centre" in shown and "set fx (px)" not in " ".join(shown.split())


@pytest.mark.parametrize(
    ("name", "stage"),
    [("fisheye", "distortion"), ("Brown-Conrady", "distortion"), ("kannala_brandt", "projection")],
)
def test_a_lens_model_is_not_a_lens(clpipe, monkeypatch, name, stage):
    model = name.lower().replace("-", "_")
    expected = f"lens: '{name}' is a model, not the name of a lens"
    for is_installed in (True, False):
        by_name._load_database.cache_clear()
        if not is_installed:
            monkeypatch.setitem(sys.modules, "lensfunpy", None)
        stderr = " ".join(clpipe("plan", "--lens", name, status=2).stderr.split())
        assert expected in stderr and f"set {stage}.method={model}" in stderr
