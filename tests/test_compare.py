"""clpipe compare: labels, crops, noise figures and rejected inputs."""

import base64
import io
import re

import numpy as np
import pytest
from PIL import Image

from clpipe.analysis.comparison import compare, displayed
from clpipe.analysis.crops import FOUND, choose_crops
from clpipe.analysis.pictures import Picture
from clpipe.reference.transfer import srgb_curve

pytestmark = pytest.mark.slow


@pytest.fixture
def write_png(tmp_path):
    """Write (height, width, 3) display values of 0..1 as a PNG."""

    def write(name, pixels):
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(np.rint(np.clip(pixels, 0, 1) * 255).astype(np.uint8)).save(path)
        return path

    return write


@pytest.fixture
def scene():
    """Return a noise-free picture of 320x320 with a place of each kind."""
    picture = np.full((320, 320, 3), 0.5)
    picture += np.linspace(-0.1, 0.1, 320)[:, None]  # nowhere flat but there
    picture[20:100, 20:130] = 0.6
    picture[20:100, 180:300] = np.where(np.indices((80, 120)).sum(0)[..., None] // 8 % 2, 0.2, 0.8)
    picture[130:210, 20:130] = 0.8, 0.1, 0.1
    picture[130:210, 180:300] = 0.15
    picture[230:310, 20:300] = 0  # darker, but it shows nothing
    return picture


def crops_of(figure, crop, zoom):
    """Find the position of an enlarged crop in a figure, (height, width, 3)."""
    large = crop.repeat(zoom, 0).repeat(zoom, 1)
    height, width = large.shape[:2]
    starts = np.argwhere((figure == large[0, 0]).all(-1))
    return [
        (x, y) for y, x in starts if np.array_equal(figure[y : y + height, x : x + width], large)
    ]


def test_a_pixel_of_a_crop_is_a_square_of_the_figure(clpipe, write_png):
    random = np.random.default_rng(0)
    paths = [write_png(f"{name}.png", random.random((40, 60, 3))) for name in "ab"]
    boxes = ((3, 5, 20, 16), (30, 8, 25, 30))
    crops = [f"--crop={x},{y},{width}x{height}" for x, y, width, height in boxes]
    clpipe("compare", *paths, "-o", "new/figure.png", *crops, "--zoom", 3)
    with Image.open("new/figure.png") as file:
        assert file.info["dpi"] == pytest.approx((300, 300), abs=0.1)
        figure = np.asarray(file.convert("RGB"))
    found = {}
    for column, path in enumerate(paths):
        picture = np.asarray(Image.open(path))
        for row, (x, y, width, height) in enumerate(boxes):
            (found[row, column],) = crops_of(figure, picture[y : y + height, x : x + width], 3)
    assert found[0, 0][0] == found[1, 0][0] < found[0, 1][0] == found[1, 1][0]
    assert found[0, 0][1] == found[0, 1][1] < found[1, 0][1] == found[1, 1][1]


def test_text_is_text_and_pictures_are_whole_in_vector_files(clpipe, write_png):
    random = np.random.default_rng(1)
    paths = [write_png(f"{name}/x.png", random.random((40, 60, 3))) for name in ("iso100", "$n_1$")]
    options = ("--crop", "sky=1,2,20x32", "--zoom", 2)
    for name in ("one.svg", "two.svg", "one.pdf", "two.pdf"):
        clpipe("compare", *paths, "-o", name, *options)
    with open("one.svg", encoding="utf-8") as file:
        svg = file.read()
    for text in ("iso100", "$n_1$", "sky"):
        assert f">{text}</text>" in svg
    for path, data in zip(paths, re.findall(r"base64,\s*([^\"]+)", svg), strict=True):
        shown = np.asarray(Image.open(io.BytesIO(base64.b64decode(data))).convert("RGB"))
        crop = np.asarray(Image.open(path))[2:34, 1:21]
        assert np.array_equal(shown, crop.repeat(2, 0).repeat(2, 1))
    with open("one.pdf", "rb") as file:
        pdf = file.read()
    assert b"/FontFile2" in pdf  # TrueType, embedded
    for ending in ("svg", "pdf"):
        with open(f"one.{ending}", "rb") as one, open(f"two.{ending}", "rb") as two:
            assert one.read() == two.read()


def test_each_kind_of_place_is_found_through_noise(scene):
    noise = np.random.default_rng(2).normal(0, 0.05, scene.shape)
    noisy = np.clip(scene + noise, 0, 1).astype(np.float32)
    corners = {"flat": (20, 20), "textured": (20, 180), "saturated": (130, 20), "dark": (130, 180)}
    for place in choose_crops((), noisy):
        top, left = corners[place.name]
        inside = top <= place.top + 3 and place.top + place.height <= top + 83
        assert inside, place
        assert left - 3 <= place.left, place
        assert place.left + place.width <= left + 123, place


def test_neither_order_nor_labels_change_the_places(scene, write_png):
    random = np.random.default_rng(3)
    paths = [write_png(f"{n}.png", scene + random.normal(0, 0.05, scene.shape)) for n in "abc"]
    places = compare(paths).places
    assert [place.name for place in places] == list(FOUND)
    assert compare(paths[::-1], labels=["x", "y", "z"]).places == places


def test_places_that_are_found_do_not_overlap():
    grey = np.full((150, 200, 3), 0.5, np.float32)  # all places are alike, and four fit
    boxes = [(place.left, place.top) for place in choose_crops((), grey)]
    for i, (x, y) in enumerate(boxes):
        assert all(abs(x - u) >= 96 or abs(y - v) >= 64 for u, v in boxes[:i])


def test_noise_is_what_was_put_in(scene, write_png):
    random = np.random.default_rng(4)
    white = random.normal(0, 4 / 255, scene.shape)
    smooth = sum(np.roll(white, (i, j), (0, 1)) for i in (0, 1) for j in (0, 1)) / 2
    truth = write_png("truth.png", scene / 2 + 0.2)
    paths = [write_png(f"{n}.png", scene / 2 + 0.2 + x) for n, x in (("w", white), ("s", smooth))]
    luma = 4 * np.hypot.reduce([0.299, 0.587, 0.114])
    against = compare([*paths, truth], truths=[truth]).noise
    for one, left in zip(against, (0.25, 0.5625), strict=False):
        assert one.rms == pytest.approx(4, rel=0.02)
        assert one.sigma == pytest.approx(luma, rel=0.03)
        assert one.left == pytest.approx(left, abs=0.02)
    assert against[2].rms == against[2].sigma == 0
    for one, left in zip(compare(paths, ["flat"]).noise, (0.25, 0.5625), strict=True):
        assert np.isnan(one.rms)
        assert one.sigma == pytest.approx(luma, rel=0.05)
        assert one.left == pytest.approx(left, abs=0.04)
    assert compare(paths, ["textured", "0,0,9x9"]).noise == ()


def test_differences_are_from_the_truth_or_else_from_the_first(scene, write_png):
    base = scene / 2 + 0.2
    a, b, truth = (
        write_png(f"{n}.png", base + level / 255) for n, level in (("a", 8), ("b", 12), ("t", 0))
    )
    place, difference = compare([a, b], ["0,0,8x6"], difference=True).rows
    assert place.name == "0,0,8x6"
    assert difference.name == "difference x16"  # 4 levels become 64, and 16 more would be 160
    assert np.allclose(difference.crops[0], 0.5)
    assert np.allclose(difference.crops[1], 0.5 + 16 * 4 / 255, atol=1e-5)
    _, difference = compare([a, b], ["0,0,8x6"], truths=[truth], difference=True).rows
    for crop, level in zip(difference.crops, (8, 12), strict=True):
        gain = int(difference.name.removeprefix("difference x"))
        assert np.allclose(crop, 0.5 + gain * level / 255, atol=1e-5)


def test_names_are_text(clpipe, write_png, caplog):
    # No markup, no control characters; letters that the font lacks are said.
    paths = [write_png(f"{n}.png", np.full((40, 60, 3), 0.5)) for n in ("[red]a", "b\n\x1b[31m")]
    report = ("--truth", paths[0], "--crop", "0,0,30x20")
    text = clpipe("compare", *paths, *report, "-o", "a.svg").stdout
    assert "[red]a " in text
    assert "b\\n\\x1b[31m" in text
    assert not caplog.records
    clpipe("compare", *paths, *report, "-o", "a.png", "--label", "a", "--label", "\u4e2d")
    assert "the font lacks letters" in caplog.text


def test_light_is_shown_through_the_curve_of_srgb(clpipe, scene, write_exr, write_png):
    render = write_exr("render.exr", scene)
    shown = write_png("shown.png", srgb_curve(scene))
    text = clpipe("compare", render, shown, "-o", "a.png").stdout
    assert "linear, shown through sRGB's curve: render" in text
    _, difference = compare([shown, render], ["flat"], difference=True).rows
    gain = int(difference.name.removeprefix("difference x"))
    assert np.abs(difference.crops[1] - 0.5).max() / gain < 1 / 255


def test_mosaics_are_grey(tmp_path):
    mosaic = np.float32([[-0.1, 0.5], [1.5, 0.2]])
    shown = displayed(Picture(tmp_path, "mosaic", mosaic))
    expected = srgb_curve(np.clip(mosaic.astype(np.float64), 0, 1))
    assert np.allclose(shown.pixels, expected[..., None])
    assert shown.kind == "display"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("a.png", "-o", "f.png"), "a.png: there is nothing to compare this picture with"),
        (("a.png", "no.png", "-o", "f.png"), "no.png: there is no such file"),
        (("a.png", "small.png", "-o", "f.png"), "small.png has 50x40, but a.png has 120x80"),
        (("a.png", "b.png", "-o", "f.gif"), "-o: found f.gif; expected a name that ends in .png,"),
        (("a.png", "b.png", "-o", "./b.png"), "b.png is one of the pictures"),
        (("a.png", "b.png", "--truth", "a.png", "-o", "a.png"), "a.png is one of the pictures"),
        (
            ("a.png", "b.png", "--crop", "60,0,96x64", "-o", "f.png"),
            "choose a crop inside 120x80 pixels",
        ),
        (
            ("a.png", "b.png", "--crop", "0,0,0x4", "-o", "f.png"),
            "this crop is empty or extends outside",
        ),
        (("a.png", "b.png", "--crop", "sky", "-o", "f.png"), "found 'sky'; expected X,Y,WxH"),
        (
            ("small.png", "small.png", "-o", "f.png"),
            "--crop flat: the pictures are 50x40, but an automatic crop",
        ),
        (("a.png", "b.png", "--label", "x", "-o", "f.png"), "found 1 for 2 pictures"),
        (("a.png", "b.png", *["--truth", "c.png"] * 3, "-o", "f.png"), "found 3 for 2 pictures"),
        (
            ("a.png", "b.png", *["--crop", "0,0,120x80"] * 4, "--zoom", 32, "-o", "f.png"),
            "more than 67,108,864; give smaller crops",
        ),
        (("a.png", "mosaic.exr", "-o", "f.png"), "mosaic without known levels"),
        (
            ("a.png", "shot.DNG", "-o", "f.png"),
            "shot.DNG: this command does not read camera raws",
        ),
        (("a.png", "loop.png", "-o", "f.png"), "loop.png: cannot be read: Too many levels of"),
    ],
)
def test_what_is_refused(arguments, message, clpipe, tmp_path, write_png, write_exr):
    for name in "abc":
        write_png(f"{name}.png", np.full((80, 120, 3), 0.5))
    write_png("small.png", np.full((40, 50, 3), 0.5))
    write_exr("mosaic.exr", np.full((80, 120, 1), 500), "Y")
    (tmp_path / "shot.DNG").write_bytes(b"II*\0")
    (tmp_path / "loop.png").symlink_to("loop.png")
    before = (tmp_path / "b.png").read_bytes()
    assert message in clpipe("compare", *arguments, status=(1, 2)).output
    assert not (tmp_path / "f.png").exists()
    assert (tmp_path / "b.png").read_bytes() == before
