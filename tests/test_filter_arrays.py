"""Filter arrays of any period: kernels, tiles, truth, DNGs, and how well they are demosaiced."""

from itertools import product
from pathlib import Path

import exifread
import numpy as np
import pytest
import rawpy
from PIL import Image
from scipy.ndimage import gaussian_filter

from clpipe.base.errors import KeyedError, RequestError
from clpipe.camera.profile import load_camera
from clpipe.chain.making import make_chain
from clpipe.chain.registry import all_stages
from clpipe.chain.settings import settings_from
from clpipe.dataset import Dataset
from clpipe.engine.check import ARRAYS, mosaic_parameters
from clpipe.engine.runner import Runner
from clpipe.images.dng import write_dng
from clpipe.images.raw import read_raw, read_raw_info
from clpipe.images.read import read_image
from clpipe.images.tags import Tags
from clpipe.outputs.annotation_warp import PixelMapping
from clpipe.outputs.negative import dng_of
from clpipe.outputs.patches import metadata_of
from clpipe.pipeline import Pipeline
from clpipe.reference.carried import Layer, warp
from clpipe.reference.cfa import PATTERNS
from clpipe.reference.directional_mmse import directional_mmse
from clpipe.reference.filter_array import NAMED, TRANSMISSIONS, parse_array, periodic_indices, tiled
from clpipe.reference.geometry import NO_MARGINS
from clpipe.reference.linear_mmse import linear_mmse
from clpipe.stages import DEFAULT_CHAIN
from clpipe.stages.mosaic import responses_of
from tests.conftest import STILL_LIFE
from tests.photographs import photographs

GAINS = (2.0, 1.6)
BLIND = ("mono", "RCCC")  # arrays that cannot tell all colours


def on(array: str, **settings):
    """A chain whose mosaic has that array."""
    return make_chain(settings_from({"iso": 800, "mosaic": mosaic_parameters(array), **settings}))


@pytest.fixture
def half(write_exr):
    """The still life in half its size, 480x320 pixels."""
    pixels = read_image(STILL_LIFE).pixels.astype(np.float32)
    return write_exr("half.exr", pixels.reshape(320, 2, 480, 2, 3).mean((1, 3)))


def mosaic_of(image: np.ndarray, array) -> np.ndarray:
    table = responses_of(array)
    return sum(image[..., c] * tiled(table[:, c], image.shape) for c in range(3)).astype(np.float32)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("bayer", "unknown filter array 'bayer'; allowed: RGGB, BGGR"),
        ("RG/GX", "'X'; a channel is one of R"),
        ("RG/G", "rows of the same length"),
        ("RG//GB", "rows of the same length"),
        ("/".join(["RGB"] * 9), "at most 8x8"),
        ("R" * 9, "at most 8x8"),
        ("HR/GB", "polarisers .* cannot be combined with colours"),
    ],
)
def test_what_is_no_filter_array(text, message):
    with pytest.raises(RequestError, match=message):
        parse_array(text)


def test_the_arrays_of_makers():
    counts = {name: {c: text.count(c) for c in "RGB"} for name, text in NAMED.items()}
    assert counts["x-trans"] == {"R": 8, "G": 20, "B": 8}
    assert counts["quad-RGGB"] == {"R": 4, "G": 8, "B": 4}
    xtrans = parse_array("x-trans").letters
    for axis in (0, 1):  # every row and column has all three
        assert all({*line} == {*"RGB"} for line in np.moveaxis(xtrans, axis, 0))


def test_a_clear_pixel_saturates_first(develop):
    light = np.full((8, 8, 3), 0.9, np.float32)
    kept = develop(
        light,
        numpy=True,
        keep=("normalize",),
        mosaic=mosaic_parameters("RGBW"),
        skip=["noise"],
        exposure={"ev": 1.5},
        inverse_color_matrix={"method": "none"},
    ).kept["normalize"]
    array = parse_array("RGBW", (2.77, 1.36))  # of the default camera
    letters = tiled(array.by_position({"R": 0, "G": 1, "B": 2, "W": 3}), kept.shape)
    assert (kept[letters == 3] == 1).all()
    for number, letter in enumerate("RGB"):
        expected = 0.9 * 2**0.5 * array.levels[letter]
        np.testing.assert_allclose(kept[letters == number], expected, atol=1e-4)
    assert array.levels["W"] == 1 > array.levels["G"] > array.levels["B"] > array.levels["R"]


def stokes(image):
    """S0, S1 and S2 of what polarisers at 0, 60 and 120 degrees pass, by the law of Malus."""
    angles = np.deg2rad([0, 60, 120])
    law = np.stack([np.ones(3), np.cos(2 * angles), np.sin(2 * angles)], axis=1)
    return image @ np.linalg.inv(law).T


@pytest.mark.slow
@pytest.mark.parametrize("method", ["linear_mmse", "directional_mmse"])
def test_a_polarised_array_measures_degree_and_angle(device, method):
    y, x = np.mgrid[0:60, 0:80]
    s0 = 0.3 + 0.1 * np.sin(x / 9)
    degree, angle = 0.1 + 0.5 * x / 80, np.deg2rad(180 * y / 60 - 90)  # of linear polarisation
    s1, s2 = (s0 * degree * part(2 * angle) for part in (np.cos, np.sin))
    passed = [s0 + s1 * np.cos(2 * t) + s2 * np.sin(2 * t) for t in np.deg2rad([0, 60, 120])]
    image = np.stack(passed, axis=-1).astype(np.float32)
    stages = ["mosaic", "inverse_white_balance", "white_balance", "demosaic"]
    chain = on("polarised", stages=stages, demosaic={"method": method})
    assert chain.camera.white_balance_gains != (1, 1)  # which colours have, and polarisers not
    found = stokes(Runner(chain, device, final=True, encode=False).run(image, "k").final)
    inside = np.s_[6:-6, 6:-6]
    measured = np.hypot(found[..., 1], found[..., 2]) / found[..., 0]
    assert np.abs(measured - degree)[inside].max() < 0.02
    off = np.arctan2(found[..., 2], found[..., 1]) / 2 - angle
    off = np.rad2deg((off + np.pi / 2) % np.pi - np.pi / 2)
    assert np.abs(off)[inside].max() < 1.5
    # Each pixel by itself, written down once more: 90, 45 / 135, 0 degrees.
    mosaic = Runner(chain.up_to(["mosaic"]), device, final=True, encode=False).run(image, "k")
    for (row, column), degrees in {(0, 0): 90, (0, 1): 45, (1, 0): 135, (1, 1): 0}.items():
        turn = 2 * np.deg2rad(degrees)
        expected = s0 + s1 * np.cos(turn) + s2 * np.sin(turn)
        cell = np.s_[row::2, column::2]
        np.testing.assert_allclose(mosaic.final[cell], expected[cell], atol=1e-6)


def test_a_polarised_array_has_no_colours():
    with pytest.raises(KeyedError, match=r"mosaic.array: .*polarised.*; skip inverse_color_matrix"):
        on("polarised")
    with pytest.raises(
        RequestError,
        match=r"method=camera needs channels that are colours, and .* of mosaic polarised",
    ):
        on("polarised", skip=["inverse_color_matrix"], color_matrix={"method": "camera"})
    chain = on("polarised", skip=["inverse_color_matrix"])
    assert chain.filter_array.name == "polarised"
    flat = np.full((12, 12, 3), 0.2, np.float32)  # unpolarised light is gray
    stages = ["mosaic", "inverse_white_balance", "white_balance", "demosaic"]
    gray = Runner(on("polarised", stages=stages), None, final=True, encode=False).run(flat, "k")
    np.testing.assert_allclose(gray.final, 0.2, atol=1e-6)


@pytest.mark.parametrize("array", [*NAMED, "RG/GB", "RGB/GBR/BRG"])
def test_flat_colours_stay(array):
    own = parse_array(array, GAINS)
    colours = [(0.5, 0.5, 0.5)]
    colours += [(0.8, 0.3, 0.2), (0.1, 0.6, 0.9)] if array not in BLIND else []
    if own.is_gray:
        assert on(array).step_named("demosaic").method.method == "gray"
        return
    for colour in colours:
        flat = np.ones((13, 17, 1), np.float32) * np.float32(colour)
        for method in (linear_mmse, directional_mmse):
            np.testing.assert_allclose(method(mosaic_of(flat, own), own), flat, atol=2e-6)


MIXING = ("RGBW", "RYYB", "CMYG", "RGGB-IR")  # arrays with W, Y, C, M and I
LIGHTS = [{}, {"red_gain": 2.0, "blue_gain": 1.6}, {"red_gain": {"uniform": [1.2, 3.0]}}]


@pytest.mark.parametrize("light", LIGHTS, ids=["camera", "set", "drawn"])
def test_filters_of_several_colours_add_up_what_the_light_gives_each(device, light):
    flat = np.full((8, 8, 3), 1, np.float32) * np.float32([0.2, 0.3, 0.4])
    for array in MIXING if light else MIXING[:1]:
        chain = on(array, stages=["mosaic", "inverse_white_balance"], inverse_white_balance=light)
        chain = make_chain(chain.settings.drawn("k")) if chain.draws else chain
        red, blue = chain.steps[-1].method.gains
        if not light:
            assert (red, blue) == chain.camera.white_balance_gains
        own = parse_array(array)
        white, seen = ((np.array(each) / (red, 1, blue)) for each in ((1, 1, 1), (0.2, 0.3, 0.4)))
        passed = {letter: np.array(TRANSMISSIONS[letter]) for letter in own.channels}
        largest = max(row @ white for row in passed.values())
        expected = own.spread({k: row @ seen / largest for k, row in passed.items()}, (8, 8))
        for each in (None, *([device] if array == "RGBW" else [])):
            raw = Runner(chain, each, encode=False, final=True).run(flat, "k").final
            np.testing.assert_allclose(raw, expected, rtol=1e-6)


@pytest.mark.parametrize(
    ("stages", "settings"),
    [
        ("inverse_white_balance white_balance", {"white_balance": {"method": "gains"}}),
        ("inverse_white_balance white_balance", {"white_balance": {"method": "none"}}),
        ("inverse_white_balance", {}),
        ("white_balance", {}),  # of a mosaic in which white is 1 already
        ("remosaic", {"remosaic": {"method": "linear_mmse"}}),
        ("inverse_white_balance remosaic", {"remosaic": {"method": "linear_mmse"}}),
    ],
)
def test_flat_colours_stay_under_any_white_balance(stages, settings):
    """Like on a Bayer pattern, except that clear filters reduce the exposure by a factor."""
    flat = np.full((24, 24, 3), 1, np.float32) * np.float32([0.2, 0.3, 0.4])
    light = {"red_gain": 1.2, "blue_gain": 3.0}
    if "inverse" in stages:
        settings = {**settings, "inverse_white_balance": light}
    made = {}
    for array in ("RGGB", *MIXING, "RCCB"):
        chain = on(array, stages=["mosaic", *stages.split(), "demosaic"], **settings)
        made[array] = Runner(chain, None, encode=False, final=True).run(flat, "k").final
    colour = made["RGGB"][12, 12]
    for array in (*MIXING, "RCCB"):
        factor = made[array][12, 12, 1] / colour[1]
        assert made[array][8:16, 8:16] == pytest.approx(
            np.broadcast_to(factor * colour, (8, 8, 3)), abs=1e-5
        ), array


@pytest.mark.parametrize("method", all_stages()["demosaic"].methods, ids=lambda each: each.method)
def test_flat_gray_stays_in_strips(method):
    """A row or a column of a Bayer pattern lacks a colour, and a single pixel lacks two."""
    for array in method.only_arrays or (*PATTERNS, *(ARRAYS if method.any_array else ())):
        chain = on(array, stages=["mosaic", "demosaic"], demosaic={"method": method.method})
        runner = Runner(chain, None, encode=False, final=True)
        for size in ((1, 1), (1, 2), (2, 1), (1, 33), (33, 1)):
            found = runner.run(np.full((*size, 3), 0.4, np.float32), "k").final
            assert found == pytest.approx(0.4, abs=1e-5), (array, size)


def test_beyond_an_edge_an_array_goes_on():
    array = parse_array("x-trans")
    for size, period in product((6, 7, 11), (3, 6)):
        place = periodic_indices(size, period, 5)
        assert ((place - np.arange(-5, size + 5)) % period == 0).all()
        assert place.min() >= 0
        assert place.max() < size
    assert array.needs_border
    assert not parse_array("RW/WB").needs_border


@pytest.mark.parametrize(
    ("array", "settings", "message"),
    [
        (
            "x-trans",
            {"demosaic": {"method": "menon2007"}},
            "demosaic.method=menon2007: this method supports only Bayer patterns, but the "
            "mosaic is x-trans; use demosaic.method=linear_mmse$",
        ),
        ("mono", {"demosaic": {"method": "menon2007"}}, "use demosaic.method=gray$"),
        (
            "x-trans",
            {"white_balance": {"method": "gray_world"}},
            "white_balance.method=gray_world: .*use white_balance.method=as_shot or gains or none",
        ),
        (
            "x-trans",
            {"demosaic": {"method": "gray"}},
            "one channel, but the mosaic is x-trans; rem",
        ),
        (
            "GRBG",
            {"demosaic": {"method": "gray"}},
            "of one channel, but the mosaic is GRBG; remove",
        ),
        ("q", {}, "unknown filter array 'q'"),
    ],
)
def test_what_knows_bayer_patterns_alone(array, settings, message):
    with pytest.raises(RequestError, match=message):
        on(array, **settings)


@pytest.mark.slow
def test_a_camera_says_its_array(clpipe, half, tmp_path):
    profile = tmp_path / "mono.toml"
    own = ("--camera", profile, "--device", "numpy")
    text = next(Path(__file__).parents[1].glob("clpipe/camera/profiles/sony-a7r2.toml")).read_text()
    profile.write_text(text.replace("iso_range", 'filter_array = "mono"\niso_range', 1))
    clpipe("run", half, "-o", "out", *own, "--until", "demosaic")
    image = read_image(Path("out/half.exr")).pixels
    assert (image[..., 0] == image[..., 1]).all()
    clpipe("run", half, "-o", "bayer", *own, "--set", "mosaic.pattern=GRBG")
    profile.write_text(text.replace("iso_range", 'filter_array = "RG/G"\niso_range', 1))
    result = clpipe("run", half, "-o", "bad", *own, status=2)
    assert "rows of the same length" in result.stderr
    assert not Path("bad").exists()
    profile.write_text(text.replace("iso_range", 'filter_array = "GBRG"\niso_range', 1))
    (step,) = Pipeline(camera=str(profile), stages=["mosaic"]).chain.steps
    assert (step.method.method, step.method.pattern) == ("bayer", "GBRG")


@pytest.mark.slow
def test_an_image_kept_on_the_way_goes_on(clpipe, half):
    run = ("run", half, "--set", "mosaic.method=array", "--iso", "1600", "--device", "numpy")
    clpipe(*run, "-o", "whole", "--keep", "normalize")
    enter = ("--start-at", "white_balance", "--device", "numpy")
    clpipe("run", "whole/half.normalize.exr", "-o", "again", *enter)
    one, two = (Path(p) for p in ("whole/half.jpg", "again/half.normalize.jpg"))
    assert np.array_equal(Image.open(one), Image.open(two))
    report = clpipe("measure", "whole/half.normalize.exr", "--truth", *["whole/half.normalize.exr"])
    assert "G20" in report.stdout


@pytest.mark.slow
@pytest.mark.parametrize("array", ["x-trans", "mono", "quad-RGGB", "RCCB"])
def test_a_dng_of_another_array(clpipe, half, array):
    clpipe(
        *("run", half, "-o", "out", "--format", "dng", "--format", "png", "--device", "numpy"),
        *("--keep", "quantize", "--set", "mosaic.method=array", "--set", f"mosaic.array={array}"),
    )
    path = Path("out/half.dng")
    kept = read_image(Path("out/half.quantize.exr"), mosaic=True).pixels
    with rawpy.imread(str(path)) as raw:
        assert np.array_equal(raw.raw_image, kept)
        if array == "x-trans":
            letters = np.array(list(raw.color_desc.decode()))[raw.raw_pattern]
            assert np.array_equal(letters, parse_array(array).letters)
        if array in ("x-trans", "RCCB"):
            linear = rawpy.DemosaicAlgorithm.LINEAR  # its other one wants larger pictures
            options = {"use_camera_wb": True, "no_auto_bright": True}
            developed = raw.postprocess(demosaic_algorithm=linear, **options).astype(float)
            ours = np.asarray(Image.open("out/half.png"), float)
            blocks = [x.reshape(40, 8, 60, 8, 3).mean((1, 3)) for x in (developed, ours)]
            for channel in range(3):
                both = [each[..., channel].ravel() for each in blocks]
                assert np.corrcoef(both)[0, 1] > 0.97
        assert raw.num_colors == (1 if array == "mono" else 3)
    if array == "RCCB":  # LibRaw takes what is clear for green
        result = clpipe("run", path, "-o", "again", "--device", "numpy", status=1)
        assert "its filter array is RW/WB" in result.stderr
        return
    facts = read_raw_info(path)
    assert facts.pattern == "/".join(parse_array(array).rows)
    assert np.array_equal(read_raw(path, facts), kept)
    clpipe("run", path, "-o", "again", "--format", "png", "--device", "numpy")
    one, two = (np.asarray(Image.open(f"{f}/half.png"), int) for f in ("out", "again"))
    assert np.abs(one - two).mean() < 0.5


NO_DNG = {
    "RGGB-IR": "RGGB-IR has the channel I, but DNG only allows R, G, B, C",
    "RCCC": "RCCC has only the channels R and W, but LibRaw opens no DNG of two channels",
    "RG": "RG has only the channels R and G",
}


@pytest.mark.parametrize("array", NO_DNG)
def test_an_array_that_no_dng_holds(clpipe, array):
    options = ("--set", "mosaic.method=array", "--set", f"mosaic.array={array}")
    result = clpipe("run", STILL_LIFE, "-o", "out", "--format", "dng", *options, status=2)
    assert NO_DNG[array] in result.stderr
    assert "cfa" in metadata_of(on(array)) or array == "RGGB-IR"


@pytest.mark.parametrize("array", [each for each in NAMED if each not in (*NO_DNG, "polarised")])
def test_libraw_opens_the_dng_of_an_array(tmp_path, array):
    negative = dng_of(make_chain(settings_from({"mosaic": {"method": "array", "array": array}})))
    dn = np.random.default_rng(0).integers(512, 16000, (36, 48)).astype(np.float32)
    write_dng(tmp_path / "a.dng", dn, negative, Tags("a", "b", 100))
    with rawpy.imread(str(tmp_path / "a.dng")) as raw:
        assert np.array_equal(raw.raw_image, dn)


@pytest.mark.slow
def test_a_dataset_of_another_array(half):
    options = {"mosaic": mosaic_parameters("quad-RGGB"), "iso": 800, "device": "numpy"}
    data = Dataset(half, patch=32, raw="mosaic", variance=True, **options)
    sample = data[3]
    assert sample["cfa"] == "RRGG/RRGG/GGBB/GGBB"
    assert (sample["place"] % 4 == 0).all()
    assert sample["raw"].shape == (32, 32) == sample["variance"].shape
    with pytest.raises(RequestError, match="raw='packed': planes need a Bayer pattern"):
        Dataset(half, patch=32, raw="packed", **options)


def cpsnr(image: np.ndarray, truth: np.ndarray) -> float:
    inside = np.s_[10:-10, 10:-10]
    levels = [np.rint(np.clip(each, 0, 1) * 255)[inside] for each in (image, truth)]
    return float(10 * np.log10(255**2 / ((levels[0] - levels[1]) ** 2).mean()))


def fitted(mosaic: np.ndarray, array) -> np.ndarray:
    """The baseline: at each pixel, the colour that best fits the samples, with Gaussian weights."""
    table = responses_of(array)
    seen = np.stack([tiled(table[:, c], mosaic.shape) for c in range(3)], -1).astype(float)
    products = gaussian_filter(seen[..., :, None] * seen[..., None, :], (0.7, 0.7, 0, 0))
    sums = gaussian_filter(seen * mosaic[..., None], (0.7, 0.7, 0))
    return np.linalg.solve(products + 1e-9 * np.eye(3), sums[..., None])[..., 0]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "over_baseline", "over_linear"),
    [
        ("RG/GB", 3, 1.5),
        ("x-trans", 3.5, 1.5),
        ("RCCB", 3.5, 1.5),
        ("RGBW", 5, 0.8),
        ("quad-RGGB", 4, 1.5),
    ],
)
def test_how_well_arrays_are_demosaiced(name, over_baseline, over_linear):
    """CPSNR on photographs, in dB; docs/quality.md lists that on the Kodak set."""
    array = parse_array(name, GAINS)
    images = [image[64:160, 128:224] / np.float32(255) for image in photographs()]
    baseline, linear, directional = (
        np.mean([cpsnr(method(mosaic_of(image, array), array), image) for image in images])
        for method in (fitted, linear_mmse, directional_mmse)
    )
    assert linear > baseline + over_baseline
    assert directional > linear + over_linear


@pytest.mark.parametrize("angle", [0, 45, 90, 135])
def test_stripes_of_any_direction_stay(angle):
    """Gray stripes of 4 px, the period of quad arrays: linear filters make zippers of them."""
    y, x = np.indices((48, 48))
    across = x * np.sin(np.radians(angle)) - y * np.cos(np.radians(angle))
    stripes = np.repeat(0.5 + 0.4 * np.sin(across * np.pi / 2)[..., None], 3, axis=2)
    array, inside = parse_array("quad-RGGB", GAINS), np.s_[8:-8, 8:-8]
    error = {
        method: np.sqrt(np.mean((method(mosaic_of(stripes, array), array) - stripes)[inside] ** 2))
        for method in (linear_mmse, directional_mmse)
    }
    assert error[directional_mmse] < error[linear_mmse] / 3, error


@pytest.mark.parametrize("array", ["GBRG", "GB/RG"])
def test_a_bayer_pattern_as_an_array_is_one(array):
    laid_as_array = {"method": "array", "array": array}
    settings = {"white_balance": {"method": "gray_world"}, "demosaic": {"method": "menon2007"}}
    for each in ({}, settings):
        chains = [
            on(array, **each, mosaic=own) for own in (laid_as_array, mosaic_parameters("GBRG"))
        ]
        image = np.random.default_rng(0).random((12, 14, 3)).astype(np.float32)
        one, two = (Runner(chain, None, final=True).run(image, "k").final for chain in chains)
        np.testing.assert_allclose(one, two, rtol=1e-6)


def test_settings_that_draw_an_array(clpipe):
    choices = "{choice=['x-trans','RCCB']}"
    options = ("--set", "mosaic.method=array", "--set", f"mosaic.array={choices}")
    clpipe("run", STILL_LIFE, "-o", "out", *options, "--device", "numpy", "--until", "mosaic")
    assert Path("out/still_life.exr").exists()
    assert ARRAYS  # the arrays of clpipe check
    with pytest.raises(KeyedError):
        settings_from({"mosaic": {"method": "array", "pattern": "RGGB"}})


WITH_REMOSAIC = [*DEFAULT_CHAIN]
WITH_REMOSAIC.insert(WITH_REMOSAIC.index("demosaic"), "remosaic")


def remosaiced(array, method, **settings):
    return on(array, stages=WITH_REMOSAIC, remosaic={"method": method}, **settings)


@pytest.mark.slow
def test_cells_are_binned_to_a_bayer_pattern(device):
    chain = remosaiced("quad-RGGB", "binning")
    assert chain.step_named("demosaic").context.pattern == "RGGB"
    assert chain.step_named("demosaic").method.method == "bounded"
    flat = np.full((203, 300, 3), 0.4, np.float32)
    runner = Runner(chain, device, keep=("white_balance", "remosaic"), encode=False, final=True)
    result = runner.run(flat, "bins")
    assert result.final.shape == (101, 150, 3)
    whole, binned = result.kept["white_balance"], result.kept["remosaic"]
    cells = whole[:202].reshape(101, 2, 150, 2).mean((1, 3))
    np.testing.assert_allclose(binned, cells, atol=1e-6)
    green = (whole[0:202:4, 2::4], binned[0::2, 1::2])
    assert green[1].std() == pytest.approx(green[0].std() / 2, rel=0.06)  # a mean of four
    noise = chain.step_named("demosaic").context.noise
    assert noise.a == pytest.approx(chain.camera.noise(800).a / 4)


@pytest.mark.parametrize(
    ("array", "factor", "size"),
    [("quad-RGGB", 2, (101, 67)), ("nona-RGGB", 3, (101, 67)), ("nona-RGGB", 3, (100, 2))],
)
def test_places_follow_the_cells_that_are_binned(array, factor, size):
    """Test sizes that are no multiple of a cell; brightness encodes the position of each pixel."""
    width, height = size
    chain = on(array, stages=["mosaic", "remosaic"], remosaic={"method": "binning"})
    runner = Runner(chain, None, encode=False, final=True)
    y, x = np.mgrid[:height, :width].astype(np.float32) + 0.5
    seen = [runner.run(np.repeat(each[..., None], 3, 2), "k").final for each in (x, y)]
    rows, columns = seen[0].shape
    picture_y, picture_x = np.mgrid[:rows, :columns] + 0.5
    origins = chain.geometry.origins(picture_x, picture_y, width, height)
    np.testing.assert_allclose(origins, seen, rtol=1e-6)
    layer = Layer("colour", np.stack([x, y], -1))
    (carried,), _ = warp([layer], chain.geometry, width, height)
    np.testing.assert_allclose(np.moveaxis(carried, -1, 0), seen, rtol=1e-6)
    down = min(factor, height)  # a side that is shorter than a cell is one
    camera = chain.intrinsics(width, height, {"fx": 90.0, "cx": 48.5})
    assert (camera.width, camera.height) == (width // factor, height // down)
    found = camera.fx, camera.fy, camera.cx, camera.cy
    assert found == pytest.approx((90 / factor, 90 / down, 48.5 / factor, height / 2 / down))
    mapping = PixelMapping(chain.geometry, width, height, NO_MARGINS, (columns, rows))
    assert mapping.map_points([[31.7, 1.3]]) == pytest.approx(
        np.array([[31.7 / factor, 1.3 / down]])
    )
    corner = [[float(columns * factor), float(rows * down)]]  # the last one that is not cut off
    assert mapping.map_points(corner).tolist() == [[columns, rows]]


def test_exif_tells_of_the_pixels_that_are_left(clpipe, write_exr):
    write_exr("a.exr", np.full((67, 101, 3), 0.2, np.float16))
    Path("bins.toml").write_text(f"stages = {WITH_REMOSAIC}\n[remosaic]\nmethod = 'binning'\n")
    options = ("--set", "mosaic.method=array", "--set", "mosaic.array=nona-RGGB", "-c", "bins.toml")
    shot = ("--set", "render.focal_length=50", "--set", "render.sensor_width=10.1")
    formats = ("--format", "jpg", "--format", "dng")
    clpipe("run", "a.exr", "-o", "o", *options, *shot, *formats, "--device", "numpy")
    for name, pitch in (("jpg", 0.3), ("dng", 0.1)):  # mm; the DNG is written before the binning
        with Path(f"o/a.{name}").open("rb") as file:
            exif = exifread.process_file(file, details=False)
        per_cm = float(exif["EXIF FocalPlaneXResolution"].values[0])
        assert per_cm == pytest.approx(10 / pitch)


@pytest.mark.slow
def test_charge_is_read_once_where_it_is_binned_before_the_noise(device):
    """The sum of four pixels: the shot noise is the same, the read noise that of one or of four."""
    light, a, b = 0.05, 1e-3, 2e-4
    noise = {"method": "gaussian", "a": a, "b": b}
    variance = {}
    for binned, stages, signal in (
        ("charge", ["mosaic", "remosaic", "sensor_noise"], 4 * light),
        ("DN", ["mosaic", "sensor_noise", "remosaic"], light),
    ):
        chain = on("quad-RGGB", stages=stages, remosaic={"method": "binning"}, sensor_noise=noise)
        flat = np.full((400, 400, 3), signal, np.float32)
        cells = Runner(chain, device, encode=False, final=True).run(flat, "charge").final
        total = cells * (4 * light / signal)
        assert total.mean() == pytest.approx(4 * light, rel=2e-3)
        variance[binned] = total.var()
    assert variance["charge"] == pytest.approx(4 * light * a + b, rel=0.03)
    assert variance["DN"] == pytest.approx(4 * light * a + 4 * b, rel=0.03)


def test_a_cell_of_charge_saturates_as_one_readout(develop):
    stages = [*DEFAULT_CHAIN]
    stages.insert(stages.index("mosaic") + 1, "remosaic")
    light = np.full((16, 16, 3), 0.3, np.float32)
    options = {
        "mosaic": mosaic_parameters("quad-RGGB"),
        "remosaic": {"method": "binning"},
        "skip": ["noise"],
    }
    result = develop(
        light, numpy=True, stages=stages, keep=("normalize",), exposure={"ev": 3}, **options
    )
    kept = result.kept["normalize"]
    assert kept.shape == (8, 8)
    assert kept[0::2, 1::2] == pytest.approx(1)  # green has 1.2 of its white
    assert (kept[0::2, 0::2] < 0.5).all()  # red has not


def test_a_remosaiced_picture_is_as_the_array_saw_it(develop):
    light = read_image(STILL_LIFE).pixels.astype(np.float32)[100:356, 200:520]
    options = {"stages": ["mosaic", "remosaic", "demosaic"], "demosaic": {"method": "menon2007"}}
    for array, least in (("x-trans", 32.5), ("RGBW", 29), ("quad-RGGB", 26)):
        mosaic, remosaic = mosaic_parameters(array), {"method": "linear_mmse", "pattern": "GBRG"}
        result = develop(light, mosaic=mosaic, remosaic=remosaic, numpy=True, **options).final
        error = np.mean((np.clip(result, 0, 1) - np.clip(light, 0, 1)) ** 2)
        assert -10 * np.log10(error) > least, array


def test_the_array_of_a_raw_is_that_of_its_pixels():
    quad, remosaic = "RRGG/RRGG/GGBB/GGBB", {"method": "linear_mmse", "pattern": "GBRG"}
    assert remosaiced("quad-RGGB", "binning").filter_array.pattern == quad
    assert remosaiced("quad-RGGB", "linear_mmse").filter_array.pattern == quad
    assert on("RGGB", stages=WITH_REMOSAIC, remosaic=remosaic).filter_array.pattern == "RGGB"
    charge = [*DEFAULT_CHAIN]
    charge.insert(charge.index("mosaic") + 1, "remosaic")
    assert (
        on("quad-RGGB", stages=charge, remosaic={"method": "binning"}).filter_array.pattern
        == "RGGB"
    )


@pytest.mark.parametrize("array", ["x-trans", "RGGB"])
def test_what_has_no_cells(array):
    with pytest.raises(RequestError, match=f"the mosaic is {array}; binning needs cells of 2x2"):
        remosaiced(array, "binning")


@pytest.mark.slow
def test_the_variance_of_each_channel_is_that_of_its_noise(write_exr):
    flat = write_exr("flat.exr", np.full((240, 240, 3), 0.5, np.float32))
    settings = {"mosaic": mosaic_parameters("RGBW"), "iso": 1600}
    options = {"raw": "mosaic", "variance": True, "dtype": "float32", "truth": "clean"}
    sample = Dataset(flat, **options, **settings)[0]
    noise, array = sample["raw"] - sample["truth.raw"], parse_array("RGBW")
    for letter in array.channels:
        own = array.spread({each: float(each == letter) for each in "RGBW"}, noise.shape) > 0
        assert noise[own].var() == pytest.approx(sample["variance"][own].mean(), rel=0.06)


@pytest.mark.slow
def test_a_sensor_without_filters_is_calibrated(clpipe, write_exr):
    ramp = np.geomspace(0.002, 0.8, 320, dtype=np.float32)
    path = write_exr("ramp.exr", np.tile(ramp[None, :, None], (200, 1, 3)), half=False)
    own = ("--camera", "emva-ccd-12bit", "--set", "prnu.sigma=0", "--until", "quantize")
    for seed in range(4):
        out = ("-o", f"out/{seed}", "--seed", seed, "--set", "exposure.headroom=0")
        clpipe("run", path, *out, *own, "--format", "exr")
    clpipe("calibrate", *(f"out/{seed}/ramp.exr" for seed in range(4)), "-o", "found.toml")
    found, known = (load_camera(name) for name in ("found.toml", "emva-ccd-12bit"))
    assert found.filter_array == "mono"
    gains = [camera.gain_stages[0].system_gain[0] for camera in (found, known)]
    assert gains[0] == pytest.approx(gains[1], rel=0.05)


@pytest.mark.slow
@pytest.mark.parametrize("array", ["quad-RGGB", "x-trans", "RCCB"])
def test_a_sensor_of_any_array_is_calibrated(clpipe, write_exr, array):
    ramp = np.geomspace(0.002, 0.8, 480, dtype=np.float32)
    colours = np.float32([0.6, 1, 0.5])  # so that filters next to each other differ
    path = write_exr("ramp.exr", ramp[None, :, None] * colours * np.ones((240, 1, 1)), half=False)
    own = ("--set", "mosaic.method=array", "--set", f"mosaic.array={array}", "--iso", 1600)
    own += ("--until", "quantize", "--skip", "inverse_color_matrix", "--device", "numpy")
    own += ("--set", "prnu.sigma=0.006", "--set", "exposure.headroom=0", "--format", "exr")
    for seed in range(4):
        clpipe("run", path, "-o", f"out/{seed}", "--seed", seed, *own)
    clpipe("calibrate", *(f"out/{seed}/ramp.exr" for seed in range(4)), "-o", "found.toml")
    found, known = load_camera("found.toml"), load_camera("sony-a7r2")
    assert found.filter_array == array
    gain, other = found.gain_stages[0], known.noise(1600)
    unit = known.signal_range
    assert gain.system_gain[0] == pytest.approx(other.a * unit, rel=0.03)
    assert gain.read_noise[0] == pytest.approx(other.b**0.5 * unit, rel=0.1)
