"""Camera raws and dumps: the correct picture, or the correct error."""

import json

import numpy as np
import OpenImageIO as oiio
import pytest
from PIL import Image

from clpipe.camera.colorimetry import BRADFORD
from clpipe.camera.profile import SRGB_TO_XYZ
from clpipe.images.raw import Exif, read_raw, read_raw_info
from clpipe.images.read import read_image
from clpipe.images.tags import upright
from clpipe.images.two_lights import camera_to_srgb
from clpipe.images.write import write_exr
from clpipe.outputs.record import whole_step
from clpipe.reference.cfa import PATTERNS, by_site
from tests.conftest import STILL_LIFE, written
from tests.conftest import cli_output as clpipe
from tests.dng import field, write_dng

MEASURE = ("--device", "numpy", "--skip", "denoise")  # so that colours can be compared exactly


def colours(height=48, width=64):
    """Linear camera RGB after white balance: smooth, every colour different, no symmetry."""
    y, x = np.mgrid[:height, :width] / np.float64((height, width)).reshape(2, 1, 1)
    return np.stack([0.1 + 0.4 * x, 0.3 + 0.2 * y * x, 0.45 - 0.3 * y], axis=-1)


def mosaic(pattern="RGGB", black=512, white=16383, gains=(2.0, 1.6), image=None):
    """The DN in which a camera with these gains sees the colours; exact but for rounding."""
    image = colours() if image is None else image
    red, green, blue = np.moveaxis(image / (gains[0], 1, gains[1]), -1, 0)
    plane = by_site(image.shape, pattern, red, green, blue)
    return np.rint(plane * (white - black) + black)


def developed(path):
    return oiio.ImageBuf(str(path)).get_pixels(oiio.FLOAT)


def exif(path):
    """The tags of a picture, and those of its EXIF part."""
    with Image.open(path) as image:
        tags = image.getexif()
        return dict(tags), dict(tags.get_ifd(0x8769))


def sidecar(path):
    return json.loads(path.read_text())


def parameters(path):
    return {stage["name"]: whole_step(stage)["parameters"] for stage in sidecar(path)["stages"]}


LAMP_WHITE, DAYLIGHT = np.array([1.0985, 1.0, 0.3558]), SRGB_TO_XYZ.sum(1)  # XYZ of A and D65
LAMP = np.array([[0.62, -0.02, -0.07], [-0.68, 1.36, 0.36], [-0.16, 0.28, 0.72]])
DAY = np.array([[0.60, -0.06, -0.04], [-0.86, 1.59, 0.28], [-0.24, 0.39, 0.74]])


def two_light_tags(changes):
    tags = {50778: (17,), 50779: (21,), 50721: (*LAMP.ravel(),), 50722: (*DAY.ravel(),)}
    return Exif([tags | changes])


@pytest.mark.parametrize(
    ("matrix", "white", "kelvin"), [(LAMP, LAMP_WHITE, 2856), (DAY, DAYLIGHT, 6504)]
)
def test_a_dng_for_two_lights_has_the_colours_of_its_own(matrix, white, kelvin):
    lights = two_light_tags({}).lights()
    neutral = matrix @ white
    to_srgb, temperature = camera_to_srgb(*lights, neutral)
    assert temperature == pytest.approx(kelvin, rel=0.02)
    assert to_srgb @ np.ones(3) == pytest.approx(np.ones(3), abs=1e-6)
    # A surface of known reflectance in the light: its colour relative to the white is adapted.
    seen = np.array([0.35, 0.2, 0.05]) * white
    cones = BRADFORD @ seen * (BRADFORD @ DAYLIGHT) / (BRADFORD @ white)
    expected = np.linalg.inv(SRGB_TO_XYZ) @ np.linalg.inv(BRADFORD) @ cones
    assert to_srgb @ (matrix @ seen / neutral) == pytest.approx(expected, abs=0.01)


def test_a_dng_without_two_lights_has_one_matrix():
    assert two_light_tags({}).lights() is not None
    for changes in (
        {50778: (255,)},
        {50778: (21,)},
        {50722: ()},
        {50722: (0.0,) * 9},
        {50722: (1.0, 2.0)},
    ):
        assert two_light_tags(changes).lights() is None
    balanced = two_light_tags({50727: (2.0, 1.0, 1.0)}).lights()
    assert balanced[1].matrix[0] == pytest.approx(2 * DAY[0])


@pytest.mark.parametrize("pattern", PATTERNS)
def test_a_raw_is_developed_with_what_it_says(tmp_path, pattern):
    write_dng(tmp_path / "a.dng", mosaic(pattern), pattern)
    options = (*MEASURE, "--until", "demosaic", "--keep", "normalize")
    output = clpipe("run", tmp_path / "a.dng", "-o", tmp_path / "out", *options)
    assert "warning" not in output
    found = developed(tmp_path / "out" / "a.exr")
    assert np.abs(found - colours())[4:-4, 4:-4].max() < 2e-3
    record = sidecar(tmp_path / "out" / "a.json")
    names = [stage["name"] for stage in record["stages"]]
    assert names == ["normalize", "white_balance", "demosaic"]
    assert record["noise"] is None and record["camera"] == "canon-5d2" and record["iso"] == 400
    assert record["raw"]["pattern"] == pattern and record["raw"]["exposure"] == 0.02
    known = parameters(tmp_path / "out" / "a.json")
    assert known["normalize"] == {"black_level": 512, "white_level": 16383}
    assert known["white_balance"] == pytest.approx({"red_gain": 2, "blue_gain": 1.6}, rel=1e-4)


def test_the_matrix_of_the_file_takes_its_colours_to_srgb(tmp_path):
    srgb = np.broadcast_to((0.3, 0.2, 0.1), (48, 64, 3))
    xyz = [[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]]
    to_camera = np.array(((0.7, -0.1, -0.05), (-0.4, 1.2, 0.2), (-0.05, 0.15, 0.6))) @ xyz
    to_camera /= to_camera.sum(1, keepdims=True)
    matrix = ((0.7, -0.1, -0.05), (-0.4, 1.2, 0.2), (-0.05, 0.15, 0.6))
    write_dng(tmp_path / "a.dng", mosaic(image=srgb @ to_camera.T), matrix=matrix)
    clpipe("run", tmp_path / "a.dng", "-o", tmp_path, *MEASURE, "--until", "color_matrix")
    assert np.abs(developed(tmp_path / "a.exr") - srgb)[4:-4, 4:-4].max() < 2e-3


@pytest.mark.slow
def test_without_a_matrix_the_profile_has_one_or_colours_stay(tmp_path):
    write_dng(tmp_path / "a.dng", mosaic(), matrix=None)
    assert "warning" not in clpipe("run", tmp_path / "a.dng", "-o", tmp_path)
    known = read_raw_info(write_dng(tmp_path / "b.dng", mosaic())).camera_to_srgb
    assert np.allclose(parameters(tmp_path / "a.json")["color_matrix"]["matrix"], known, atol=2e-3)
    write_dng(tmp_path / "c.dng", mosaic(), matrix=None, model=b"Nonesuch")
    output = clpipe("run", tmp_path / "c.dng", "-o", tmp_path)
    assert "its colour matrix is unknown" in output
    assert "there is no profile of Canon Nonesuch; denoising uses the noise of sony-a7r2" in output
    output = clpipe("run", tmp_path / "c.dng", "-o", tmp_path, "--camera", "canon-5d2")
    assert "profile" not in output


def test_each_channel_has_its_own_black_level_and_what_lies_below_stays(tmp_path):
    black = (500, 520, 540, 480)
    dn = mosaic(black=512) + np.tile(np.reshape(black, (2, 2)) - 512, (24, 32))
    dn[10, 10] = 100
    facts = read_raw_info(write_dng(tmp_path / "a.dng", dn, black=black))
    assert (facts.black_levels, facts.black_level) == (black, 510)
    assert np.array_equal(read_raw(tmp_path / "a.dng", facts)[11:], mosaic(black=512)[11:] - 2)
    clpipe("run", tmp_path / "a.dng", "-o", tmp_path, *MEASURE, "--until", "normalize")
    assert developed(tmp_path / "a.exr")[10, 10, 0] == pytest.approx((110 - 510) / (16383 - 510))


@pytest.mark.parametrize("orientation", range(1, 9))
def test_orientation_is_applied_once(tmp_path, orientation):
    write_dng(tmp_path / "a.dng", mosaic(), orientation=orientation)
    options = ("--format", "png", "--format", "exr", "--keep", "demosaic", "--keep", "normalize")
    clpipe("run", tmp_path / "a.dng", "-o", tmp_path, *MEASURE, *options)
    write_dng(tmp_path / "b.dng", mosaic())
    clpipe("run", tmp_path / "b.dng", "-o", tmp_path, *MEASURE, *options)
    # As Pillow turns it, which has its own code for that.
    with Image.open(tmp_path / "b.png") as image:
        plain = image.copy()
    turn = {
        **{2: "FLIP_LEFT_RIGHT", 3: "ROTATE_180", 4: "FLIP_TOP_BOTTOM", 5: "TRANSPOSE"},
        **{6: "ROTATE_270", 7: "TRANSVERSE", 8: "ROTATE_90"},
    }.get(orientation)
    expected = plain.transpose(Image.Transpose[turn]) if turn else plain
    with Image.open(tmp_path / "a.png") as found:
        assert np.array_equal(np.asarray(found), np.asarray(expected))
    assert exif(tmp_path / "a.png")[0].get(0x0112, 1) == 1
    as_float = developed(tmp_path / "a.exr")
    assert np.array_equal(as_float, upright(developed(tmp_path / "b.exr"), orientation))
    for kept in ("demosaic", "normalize"):  # stays as the sensor saw it
        one, other = (developed(tmp_path / f"{name}.{kept}.exr") for name in "ab")
        assert np.array_equal(one, other)
    # Going on from there turns it, and from the last image, which is turned, does not again.
    again = tmp_path / "again"
    go_on = ("--device", "numpy", "-o", again, "--format", "png")
    clpipe("run", tmp_path / "a.demosaic.exr", "--start-at", "color_matrix", *go_on)
    assert np.array_equal(developed(again / "a.demosaic.png"), developed(tmp_path / "a.png"))
    assert read_image(tmp_path / "a.exr").attributes["orientation"] == "1"


def test_exif_goes_through_also_by_way_of_a_kept_image(tmp_path):
    write_dng(tmp_path / "a.dng", mosaic())
    clpipe("run", tmp_path / "a.dng", "-o", tmp_path / "out", "--keep", "demosaic")
    kept = tmp_path / "out" / "a.demosaic.exr"
    clpipe("run", kept, "-o", tmp_path / "again", "--start-at", "denoise")
    one, other = tmp_path / "out" / "a.jpg", tmp_path / "again" / "a.demosaic.jpg"
    assert one.read_bytes() == other.read_bytes()
    tags, own = exif(one)
    assert (tags[0x010F], tags[0x0110]) == ("Canon", "Canon EOS 5D Mark II")
    assert tags[0x0132] == "2024:05:06 07:08:09"
    assert own[0x8827] == 400 and own[0x829A] == 0.02
    assert own[0x829D] == pytest.approx(2.8) and own[0x920A] == 35
    assert own[0x9003] == "2024:05:06 07:08:09"


def test_exif_that_a_kept_image_carries_may_be_damaged(tmp_path):
    write_dng(tmp_path / "a.dng", mosaic())
    clpipe("run", tmp_path / "a.dng", "-o", tmp_path / "out", "--keep", "demosaic")
    image = read_image(tmp_path / "out" / "a.demosaic.exr")
    for name, value in (("exif", "{"), ("exif", '{"iso": -1}'), ("orientation", "9")):
        attributes = {**image.attributes, name: value}
        write_exr(tmp_path / "b.exr", image.pixels, ("R", "G", "B"), attributes)
        output = clpipe(
            "run", tmp_path / "b.exr", "-o", tmp_path, "--start-at", "denoise", status=1
        )
        assert "clpipe:exif and clpipe:orientation are damaged" in output


@pytest.mark.slow
def test_options_and_configuration_win_over_the_file(tmp_path):
    write_dng(tmp_path / "a.dng", mosaic("GRBG"), "GRBG")
    (tmp_path / "c.toml").write_text("iso = 1600\n[normalize]\nblack_level = 600\n")
    options = ("-c", tmp_path / "c.toml", "--set", "white_balance.red_gain=3")
    clpipe("run", tmp_path / "a.dng", "-o", tmp_path, *options)
    known = parameters(tmp_path / "a.json")
    assert known["normalize"] == {"black_level": 600, "white_level": 16383}
    assert known["white_balance"]["red_gain"] == 3
    assert known["white_balance"]["blue_gain"] == pytest.approx(1.6, rel=1e-4)
    record = sidecar(tmp_path / "a.json")
    assert (record["iso"], record["camera"]) == (1600, "canon-5d2")
    assert exif(tmp_path / "a.jpg")[1][0x8827] == 1600
    # A configuration that says nothing of the ISO leaves the file's; one of 100 is one of 100.
    clpipe("run", tmp_path / "a.dng", "-o", tmp_path, "-c", "paper")
    record = sidecar(tmp_path / "a.json")
    assert (record["iso"], record["camera"]) == (400, "sony-a7r2")
    assert [s["method"] for s in record["stages"] if s["name"] == "white_balance"] == ["gray_world"]
    (tmp_path / "c.toml").write_text("iso = 100\n")
    clpipe("run", tmp_path / "a.dng", "-o", tmp_path, "-c", tmp_path / "c.toml")
    assert sidecar(tmp_path / "a.json")["iso"] == 100


def test_a_curve_for_the_dn_of_renders_is_not_that_of_a_camera(tmp_path):
    write_dng(tmp_path / "a.dng", mosaic())
    for folder, options in (("plain", ()), ("curve", ("--set", "quantize.method=pwl"))):
        clpipe("run", tmp_path / "a.dng", "-o", tmp_path / folder, *MEASURE, *options)
    one, two = (np.asarray(Image.open(tmp_path / each / "a.jpg")) for each in ("plain", "curve"))
    assert np.array_equal(one, two)


@pytest.mark.slow
def test_raws_and_renders_of_a_folder_go_their_own_ways(tmp_path):
    folder = tmp_path / "in"
    folder.mkdir()
    render = read_image(STILL_LIFE).pixels[200:248, 300:364].astype(np.float32)
    for name in ("a", "z"):
        write_exr(folder / f"{name}.exr", render, ("R", "G", "B"), {})
    write_dng(folder / "b.dng", mosaic("GBRG"), "GBRG", orientation=6)
    write_dng(folder / "c.DNG", mosaic("BGGR"), "BGGR")
    (folder / "d.nef").write_bytes(b"\xff\xd8\xff\xe0 nothing")
    out = tmp_path / "out"
    output = clpipe("run", folder, "-o", out, "--keep", "all", "--iso", 800, status=1)
    assert "d.nef: this is a JPEG, not a camera raw" in output
    assert "4 of 5 images done, 1 failed" in output
    alone = tmp_path / "alone"
    clpipe("run", folder / "b.dng", folder / "c.DNG", "-o", alone, "--iso", 800)
    clpipe("run", folder / "a.exr", folder / "z.exr", "-o", alone, "--iso", 800)
    for name in "abcz":
        assert (out / f"{name}.jpg").read_bytes() == (alone / f"{name}.jpg").read_bytes()
    assert not (out / "b.sensor_noise.exr").exists() and (out / "a.sensor_noise.exr").exists()


@pytest.mark.slow
def test_noise_can_be_added_to_a_raw_where_that_is_asked_for(tmp_path):
    write_dng(tmp_path / "a.dng", mosaic())
    stages = "mosaic,quantize,normalize,sensor_noise,white_balance,demosaic,gamma"
    clpipe("run", tmp_path / "a.dng", "-o", tmp_path, "--stages", stages, "--iso", 6400)
    record = sidecar(tmp_path / "a.json")
    assert record["stages"][1]["name"] == "sensor_noise" and record["noise"] is not None


@pytest.mark.parametrize(
    ("neutral", "has_matrix", "multipliers"),
    [
        ((-0.5, 1, 0.6), True, "-2, 1, 1.667"),
        ((0.1, 1, 0.6), True, "10, 1, 1.667"),
        ((0.5, 1, 9), True, "2, 1, 0.1111"),
        ((0.5, 1, -3), False, "0, 1, -0.3333"),
    ],
)
def test_gains_that_cannot_be(tmp_path, neutral, has_matrix, multipliers):
    kind = {} if has_matrix else {"matrix": None, "model": b"Nonesuch"}
    write_dng(tmp_path / "a.dng", mosaic(), neutral=neutral, **kind)
    message = f"is impossible, with multipliers {multipliers}; gray_world estimates it"
    assert message in clpipe("run", tmp_path / "a.dng", "-o", tmp_path)
    record = sidecar(tmp_path / "a.json")
    step = next(s for s in record["stages"] if s["name"] == "white_balance")
    assert step["method"] == "gray_world" and any(message in w for w in record["warnings"])
    fixed = ("white_balance.red_gain=2", "white_balance.blue_gain=1.5")
    options = [o for text in fixed for o in ("--set", text)]
    assert message not in clpipe("run", tmp_path / "a.dng", "-o", tmp_path, *options)


def test_levels_that_cannot_be(tmp_path):
    write_dng(tmp_path / "a.dng", mosaic(), white=300)
    output = clpipe("run", tmp_path / "a.dng", "-o", tmp_path, status=1)
    assert "its levels are impossible: black 512, white 300" in output
    levels = ("--set", "normalize.black_level=512", "--set", "normalize.white_level=16383")
    clpipe("run", tmp_path / "a.dng", "-o", tmp_path, *levels)
    write_dng(tmp_path / "b.dng", mosaic(), white=1000)
    output = clpipe("run", tmp_path / "b.dng", "-o", tmp_path)
    assert "most samples are at or above the white level of 1000 DN" in output
    write_dng(tmp_path / "c.dng", mosaic(), black=(12000,) * 4)
    output = clpipe("run", tmp_path / "c.dng", "-o", tmp_path)
    assert "not above the black level of 12000 DN" in output


def test_an_iso_that_is_not_said_or_is_beyond_the_camera(tmp_path):
    write_dng(tmp_path / "a.dng", mosaic(), iso=0)
    assert "does not state its ISO; denoising uses 100" in clpipe(
        "run", tmp_path / "a.dng", "-o", tmp_path
    )
    assert "ISO" not in clpipe("run", tmp_path / "a.dng", "-o", tmp_path, "--iso", 200)
    write_dng(tmp_path / "b.dng", mosaic(), iso=50)
    output = clpipe("run", tmp_path / "b.dng", "-o", tmp_path)
    assert (
        "its ISO of 50 is outside the range of camera canon-5d2, 100 to 6400; denoising uses 100"
        in output
    )
    assert exif(tmp_path / "b.jpg")[1][0x8827] == 50


XTRANS = "GGRGGBGGBGGRBRGRBGGGBGGRGGRGGBRBGBRG"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("linear", "this file has all colours at each pixel"),
        ("half", "the file is damaged, or LibRaw does not support it"),
        ("no pixels", "this raw has only metadata and no pixels"),
        ("empty", "the file is empty"),
        ("jpeg", "this is a JPEG, not a camera raw"),
        ("text", "the file is damaged, or LibRaw does not support it"),
    ],
)
def test_what_only_looks_like_a_raw(tmp_path, change, message):
    path = tmp_path / "a.dng"
    if change == "linear":
        write_dng(path, np.rint(colours() * 16383))
    elif change == "no pixels":
        write_dng(path, mosaic() * 0)
    else:
        data = write_dng(path, mosaic()).read_bytes()
        cut = {"half": data[: len(data) // 2], "empty": b"", "text": b"a raw, honestly " * 99}
        path.write_bytes(cut.get(change, b"\xff\xd8\xff\xe1" + data))
    output = clpipe("run", path, "-o", tmp_path / "out", status=1)
    assert f"{path}: {message}" in output
    assert not written(tmp_path / "out")


@pytest.mark.slow
def test_an_x_trans_raw_of_another_program(tmp_path):
    letters = np.array(list(XTRANS)).reshape(6, 6)
    light = colours()
    height, width = light.shape[:2]
    which = np.vectorize("RGB".index)(np.tile(letters, (height // 6 + 1, width // 6 + 1)))
    own = np.take_along_axis(light / (2.0, 1, 1.6), which[:height, :width, None], -1)[..., 0]
    own = np.rint(own * (16383 - 512) + 512)
    cfa = field(33422, 1, *("RGB".index(c) for c in XTRANS))
    path = write_dng(tmp_path / "a.dng", own, changes=(field(33421, 3, 6, 6), cfa))
    facts = read_raw_info(path)
    assert facts.pattern == "/".join("".join(row) for row in letters)
    assert np.array_equal(read_raw(path, facts), own)
    clpipe("run", path, "-o", tmp_path / "out", "--keep", "demosaic")
    inside = np.s_[6:-6, 6:-6]  # a steep slope does not go on as periods do
    image = read_image(tmp_path / "out" / "a.demosaic.exr").pixels
    assert image[inside] == pytest.approx(light[inside], abs=0.002)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            ("--start-at", "denoise"),
            "a camera raw starts at normalize, but --start-at denoise reads rgb",
        ),
        (("--keep", "sensor_noise"), "unknown stage in this chain 'sensor_noise'"),
        (("--stages", "mosaic,demosaic,gamma"), "no stage of the chain reads a raw"),
        (("--until", "quantize"), "normalize comes after quantize"),
        (("--frames", "2"), "no stage of this chain adds noise"),
        (("--dump", "10x10"), "dump: found '10x10'; expected WIDTHxHEIGHT:TYPE"),
        (("--iso", "7"), "iso: found 7"),
    ],
)
def test_a_request_that_a_raw_cannot_fulfil(tmp_path, options, message):
    write_dng(tmp_path / "a.dng", mosaic("GRBG"), "GRBG")
    status = 1 if "denoise" in options else 2
    output = clpipe("run", tmp_path / "a.dng", "-o", tmp_path / "out", *options, status=status)
    assert message in output


def test_a_chain_without_mosaic_cannot_know_the_pattern(tmp_path):
    write_dng(tmp_path / "a.dng", mosaic("GRBG"), "GRBG")
    options = ("--stages", "normalize,white_balance,demosaic,gamma")
    output = clpipe("run", tmp_path / "a.dng", "-o", tmp_path, *options, status=1)
    assert "its CFA pattern is GRBG, but the chain has no mosaic stage" in output


def test_exif_is_found_in_files_that_are_no_tiff(tmp_path):
    from clpipe.images.raw import read_exif

    tiff = write_dng(tmp_path / "a.dng", mosaic()).read_bytes()
    for start in (b"\0\0\0\x18ftypcrx " + bytes(60) + b"CMT1", b"FUJIFILM" * 9 + b"Exif\0\0"):
        (tmp_path / "b.raf").write_bytes(start + tiff)
        exif = read_exif(tmp_path / "b.raf")
        assert exif.text(272) == "Canon EOS 5D Mark II"
        assert exif.number(34855, 0) == 400


def test_a_uniform_raw_is_a_raw(tmp_path):
    uniform = np.full_like(mosaic(), 512)  # black, like a clean picture of darkness
    path = write_dng(tmp_path / "a.dng", uniform)
    assert np.array_equal(read_raw(path, read_raw_info(path)), uniform)
    clpipe("run", path, "-o", tmp_path, "--device", "numpy")
