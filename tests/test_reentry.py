"""Resuming from a kept image, an edited image, and a foreign mosaic."""

import itertools
import json
import re
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest

from clpipe.images.read import read_image
from clpipe.images.write import write_exr
from clpipe.stages import DEFAULT_CHAIN
from tests.conftest import STILL_LIFE, written
from tests.conftest import cli_output as clpipe

NUMPY = ("--device", "numpy")  # where a test is not about kernels
OPTIONS = ("--iso", "3200", "--seed", "5", "--set", "mosaic.pattern=GBRG")
OPTIONS += ("--set", "white_balance.method=gray_world", "--set", "row_noise.sigma=0.01")
OPTIONS += ("--set", "sharpen.radius=2.1", "--set", "gamma.method=power")


def crop(folder: Path, name: str = "crop.exr") -> Path:
    pixels = read_image(STILL_LIFE).pixels[200:301, 300:437].astype(np.float32)
    write_exr(folder / name, pixels, ("R", "G", "B"), {})
    return folder / name


@pytest.fixture(scope="module")
def kept(tmp_path_factory):
    """A folder with a picture and all kept images."""
    folder = tmp_path_factory.mktemp("kept")
    clpipe("run", crop(folder), "-o", folder / "out", *OPTIONS, *NUMPY, "--keep", "all")
    return folder / "out"


def edited(path: Path, to: Path, change) -> Path:
    """Copy a file with other pixels and the same attributes, like an image editor."""
    image = oiio.ImageBuf(str(path))
    pixels = change(image.get_pixels(oiio.FLOAT))
    copy = oiio.ImageBuf(image.spec())
    copy.set_pixels(oiio.ROI(), pixels)
    assert copy.write(str(to))
    return to


@pytest.mark.parametrize(("after", "start_at"), [*itertools.pairwise(DEFAULT_CHAIN)])
def test_going_on_gives_the_same_picture(kept, tmp_path, after, start_at):
    clpipe("run", kept / f"crop.{after}.exr", "-o", tmp_path, "--start-at", start_at, *NUMPY)
    assert (tmp_path / f"crop.{after}.jpg").read_bytes() == (kept / "crop.jpg").read_bytes()


def test_going_on_gives_the_same_picture_on_the_device(tmp_path):
    enter = {"quantize": "normalize", "demosaic": "denoise"}
    keep = [word for after in enter for word in ("--keep", after)]
    clpipe("run", crop(tmp_path), "-o", tmp_path, "--iso", 3200, *keep)
    for after, start_at in enter.items():
        clpipe("run", tmp_path / f"crop.{after}.exr", "-o", tmp_path, "--start-at", start_at)
        again = tmp_path / f"crop.{after}.jpg"
        assert again.read_bytes() == (tmp_path / "crop.jpg").read_bytes()


def test_going_on_with_some_stages_gives_the_same_images(kept, tmp_path):
    part = ("--start-at", "quantize", "--until", "demosaic", "--keep", "normalize", *NUMPY)
    clpipe("run", kept / "crop.column_noise.exr", "-o", tmp_path, *part)
    for made, name in (("column_noise", "demosaic"), ("column_noise.normalize", "normalize")):
        one = read_image(tmp_path / f"crop.{made}.exr", mosaic=name == "normalize")
        two = read_image(kept / f"crop.{name}.exr", mosaic=name == "normalize")
        assert np.array_equal(one.pixels, two.pixels)
        assert one.attributes == two.attributes


def test_options_given_again_win_over_those_of_the_kept_image(kept, tmp_path):
    entry = (kept / "crop.color_matrix.exr", "--start-at", "sharpen", "--format", "png", *NUMPY)
    clpipe("run", *entry, "-o", tmp_path / "a")
    clpipe("run", *entry, "-o", tmp_path / "b", "--set", "sharpen.radius=2.0")
    clpipe("run", *entry, "-o", tmp_path / "c", "-c", "default")
    names = [tmp_path / folder / "crop.color_matrix.json" for folder in "abc"]
    stages = [{s["name"]: s for s in json.loads(n.read_text())["stages"]} for n in names]
    assert [s["sharpen"]["parameters"].get("radius") for s in stages] == [2.1, 2.0, None]
    assert [s["gamma"]["method"] for s in stages] == ["power", "power", "srgb"]


def test_what_was_edited_is_honoured(kept, tmp_path):
    def darken(pixels):
        pixels[:, : pixels.shape[1] // 2] = 0
        return pixels

    path = edited(kept / "crop.denoise.exr", tmp_path / "crop.exr", darken)
    out = tmp_path / "out"
    clpipe("run", path, "-o", out, "--start-at", "color_matrix", "--format", "png", *NUMPY)
    made, whole = (
        oiio.ImageBuf(str(p)).get_pixels() for p in (out / "crop.png", kept / "crop.jpg")
    )
    assert made[:, :60].max() == 0
    assert np.abs(made[:, 80:] - whole[:, 80:]).mean() < 0.02


@pytest.mark.parametrize("stored", [oiio.HALF, oiio.FLOAT, oiio.UINT32])
@pytest.mark.parametrize("channel", ["Y", "Raw"])
def test_a_mosaic_from_elsewhere_enters_with_pattern_and_levels(kept, tmp_path, stored, channel):
    dn = np.rint(read_image(kept / "crop.quantize.exr", mosaic=True).pixels / 8)  # fits half
    spec = oiio.ImageSpec(dn.shape[1], dn.shape[0], 1, stored)
    spec.channelnames = (channel,)
    path = tmp_path / "raw.exr"
    file = oiio.ImageOutput.create(str(path))
    values = dn.astype(np.uint32 if stored == oiio.UINT32 else np.float32)
    assert file.open(str(path), spec) and file.write_image(values[..., None]) and file.close()
    settings = ("mosaic.pattern=GBRG", "normalize.black_level=64", "normalize.white_level=2047")
    options = [o for s in settings for o in ("--set", s)]
    out = tmp_path / "out"
    enter = (*NUMPY, "--start-at", "normalize", "--keep", "normalize")
    clpipe("run", path, "-o", out, *enter, *options)
    expected = (dn - np.float32(64)) * np.float32(1 / (2047 - 64))
    kept_image = read_image(out / "raw.normalize.exr", mosaic=True).pixels
    assert np.array_equal(kept_image, expected.astype(np.float32))
    record = json.loads((out / "raw.json").read_text())
    assert record["starts_on"] == "raw"
    assert record["stages"][0]["name"] == "normalize"
    picture = oiio.ImageBuf(str(out / "raw.jpg")).get_pixels().mean((0, 1))
    whole = oiio.ImageBuf(str(kept / "crop.jpg")).get_pixels().mean((0, 1))
    assert np.abs(picture / picture[1] - whole / whole[1]).max() < 0.2


@pytest.mark.parametrize(
    ("after", "start_at", "message"),
    [
        (
            "quantize",
            "white_balance",
            "holds raw, kept after quantize, but white_balance reads mosaic; raw can .* normalize",
        ),
        ("mosaic", "denoise", "but denoise reads rgb; mosaic can enter with --start-at inverse_"),
        (
            "demosaic",
            "normalize",
            f"but normalize reads raw; rgb can enter with --start-at {DEFAULT_CHAIN[0][:4]}",
        ),
        (
            "gamma",
            "denoise",
            "holds display, kept after gamma, .* display can enter with --start-at picture_noise",
        ),
    ],
)
def test_an_image_of_another_kind_is_refused_and_the_others_go_on(
    kept, tmp_path, after, start_at, message
):
    right = DEFAULT_CHAIN[DEFAULT_CHAIN.index(start_at) - 1]
    files = (kept / f"crop.{after}.exr", kept / f"crop.{right}.exr")
    output = clpipe("run", *files, "-o", tmp_path, "--start-at", start_at, *NUMPY, status=1)
    assert f"crop.{after}.exr: " in output
    assert re.search(message, output), output
    assert (tmp_path / f"crop.{right}.jpg").is_file()
    assert not (tmp_path / f"crop.{after}.jpg").exists()


def test_a_folder_gives_what_was_kept_right_before(kept, tmp_path):
    output = clpipe("run", kept, "-o", tmp_path, "--start-at", "denoise", *NUMPY)
    assert written(tmp_path) == ["crop.demosaic.jpg", "crop.demosaic.json"]
    assert f"{len(DEFAULT_CHAIN) - 1} images in directories were kept after other stages" in output
    assert f"1 of {len(DEFAULT_CHAIN)} images done, 0 failed" in output


def test_entering_elsewhere_than_right_after_is_told(kept, tmp_path):
    enter = ("--start-at", "denoise", *NUMPY)
    output = clpipe("run", kept / "crop.denoise.exr", "-o", tmp_path, *enter)
    assert "was kept after denoise; entering at denoise repeats or skips stages" in output


def test_a_kept_mosaic_is_no_render(kept, tmp_path):
    output = clpipe("run", kept / "crop.quantize.exr", "-o", tmp_path, status=1)
    assert "holds raw, kept after quantize; raw can enter with --start-at normalize" in output


@pytest.mark.parametrize(
    ("level", "start_at", "options", "messages"),
    [
        (0.4, "normalize", (), ("not above the black level of 512", "RGGB", "levels", "ISO")),
        (
            900,
            "white_balance",
            (),
            ("white level is 1 here", "its CFA pattern", "its ISO", "are clipped"),
        ),
        (0.1, "white_balance", ("--set", "mosaic.pattern=RGGB", "--iso", 800), ()),
        (
            0.1,
            "white_balance",
            ("--set", "mosaic.pattern=RGGB"),
            ("state its ISO; clpipe assumes 100",),
        ),
    ],
)
def test_what_looks_wrong_with_a_mosaic_is_told(tmp_path, level, start_at, options, messages):
    write_exr(tmp_path / "m.exr", np.full((8, 8), level, np.float32), ("Y",), {})
    output = clpipe(
        *("run", tmp_path / "m.exr", "-o", tmp_path / "out", "--start-at", start_at),
        *(*options, *NUMPY),
    )
    assert output.count("warning: ") == len(messages)
    for message in messages:
        assert message in output


def test_an_image_of_two_channels_is_no_mosaic(tmp_path):
    write_exr(tmp_path / "m.exr", np.zeros((8, 8, 2), np.float32), ("X", "Y"), {})
    output = clpipe(
        "run", tmp_path / "m.exr", "-o", tmp_path / "o", "--start-at", "normalize", status=1
    )
    assert "several channels, but a mosaic has one; found X, Y" in output


def test_settings_that_an_image_carries_may_be_of_no_use(kept, tmp_path):
    image = read_image(kept / "crop.denoise.exr")
    (tmp_path / "evil.py").write_text("raise SystemExit(7)")
    evil = json.dumps({"stage_files": [str(tmp_path / "evil.py")]})
    useless = (evil, '{"iso": 1}', '{"nonsense": 1}', "{", "[1]", '{"camera": "x"}')
    for number, settings in enumerate(useless):
        attributes = {**image.attributes, "settings": settings}
        path = tmp_path / f"{number}.exr"
        write_exr(path, image.pixels, ("R", "G", "B"), attributes)
        enter = ("--start-at", "tone_curve", *NUMPY)
        output = clpipe("run", path, "-o", tmp_path / "out", *enter, status=1)
        assert f"{number}.exr: the settings in its attributes cannot be used" in output


def test_until_gives_a_float_image_unless_it_is_the_end(tmp_path):
    image = crop(tmp_path)
    clpipe("run", image, "-o", tmp_path / "a", "--until", "white_balance", *NUMPY)
    assert written(tmp_path / "a") == ["crop.exr", "crop.json"]
    assert read_image(tmp_path / "a" / "crop.exr", mosaic=True).attributes["kind"] == "mosaic"
    clpipe("run", image, "-o", tmp_path / "b", "--until", "gamma", *NUMPY)
    assert (tmp_path / "b" / "crop.jpg").is_file()


def test_a_kept_image_that_is_taken_for_a_render_is_told(kept, tmp_path):
    output = clpipe("run", kept / "crop.demosaic.exr", "-o", tmp_path, *NUMPY)
    assert "was kept after demosaic, but is processed as a render" in output


@pytest.mark.slow
def test_a_repeated_stage_can_be_entered(tmp_path):
    image = crop(tmp_path)
    chain = "mosaic,demosaic,denoise,denoise,gamma"
    clpipe("run", image, "-o", tmp_path / "a", "--stages", chain, "--keep", "denoise")
    kept_image = tmp_path / "a" / "crop.denoise.exr"
    clpipe("run", kept_image, "-o", tmp_path / "b", "--start-at", "denoise_2")
    whole, again = tmp_path / "a" / "crop.jpg", tmp_path / "b" / "crop.denoise.jpg"
    assert whole.read_bytes() == again.read_bytes()
