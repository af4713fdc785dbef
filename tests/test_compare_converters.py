"""tools/compare/converters.py, without missing converters, and what several tools share."""

import doctest
import shutil

import numpy as np
import pytest
from PIL import Image

from clpipe.analysis.quality.charts import CHECKER, checker, patch_image, patches_of
from clpipe.analysis.quality.colour import checker_errors
from tests.conftest import cli_output
from tools.compare import converters as tool
from tools.compare import fidelity
from tools.shared import options, pictures, tables

pytestmark = pytest.mark.slow

COPY = tool.Converter("copy", "none", "cp DNG PICTURE")
PRINT = tool.Converter("print", "none", "cat DNG")
FAIL = tool.Converter("fail", "none", "cat HOME/missing")


@pytest.mark.parametrize("converter", [COPY, PRINT])
def test_a_picture_is_what_the_converter_writes_or_prints(tmp_path, converter):
    negative = tmp_path / "a.dng"
    negative.write_bytes(b"raw")
    picture = tmp_path / "out" / "a.png"
    tool.convert(converter, negative, picture)
    assert picture.read_bytes() == b"raw"


def test_a_converter_that_fails_is_named_with_its_reason(tmp_path):
    with pytest.raises(tool.ComparisonError, match=r"^cat failed: .*No such file"):
        tool.convert(FAIL, tmp_path / "a.dng", tmp_path / "a.png")


def test_a_converter_that_writes_nothing_is_an_error(tmp_path):
    silent = tool.Converter("silent", "none", "true DNG PICTURE")
    (stale := tmp_path / "a.png").touch()
    with pytest.raises(tool.ComparisonError, match="silent wrote no picture"):
        tool.convert(silent, tmp_path / "a.dng", stale)


def test_a_border_that_a_converter_cuts_off_does_not_shift_the_picture(tmp_path):
    pixels = np.random.default_rng(0).integers(0, 256, (40, 60, 3), dtype=np.uint8)
    path = tmp_path / "a.png"
    Image.fromarray(pixels[4:-4, 4:-4]).save(path)
    found = tool.read_picture(path, 40, 60)
    assert found.shape == pixels.shape
    assert np.array_equal(found[4:-4, 4:-4], pixels[4:-4, 4:-4])
    Image.fromarray(pixels[:, :-20]).save(path)
    with pytest.raises(tool.ComparisonError, match="is 40x40; expected 60x40"):
        tool.read_picture(path, 40, 60)


def test_a_sheet_holds_the_pictures_between_their_captions():
    crop = np.random.default_rng(0).integers(0, 256, (20, 30, 3), dtype=np.uint8)
    large = pictures.enlarged(crop, 4)
    assert np.array_equal(large[::4, ::4], crop) and large.shape == (80, 120, 3)
    rows = [[("one", large), ("two", 255 - large)], [("", large), ("", large)]]
    page = np.asarray(pictures.sheet(rows))
    step = 80 + pictures.GAP
    assert page.shape == (pictures.HEAD + 2 * step, 2 * (120 + pictures.GAP), 3)
    assert np.array_equal(page[pictures.HEAD :][:80, :120], large)
    assert np.array_equal(page[pictures.HEAD + step :][:80, :120], large)
    named = np.asarray(pictures.sheet(rows, ["first", "second"]))
    assert np.array_equal(named[:, -page.shape[1] :], page)


@pytest.mark.parametrize("module", [fidelity, options, tables])
def test_the_examples_in_docstrings(module):
    assert doctest.testmod(module).failed == 0


def test_errors_of_grey_hue_and_chroma_are_independent():
    true = np.array(CHECKER, float)
    brighter = checker_errors(true * 1.05, true)
    assert brighter.grey_level == pytest.approx(128.1)
    assert brighter.lightness > 2 > 1 > brighter.hue
    grey = true.mean(1, keepdims=True)
    assert checker_errors(grey + (true - grey) / 2, true).chroma == pytest.approx(0.5, abs=0.05)
    only_red = true.copy()
    only_red[14] = only_red[14, [0, 2, 1]] + (0, 60, 0)  # red towards orange
    turned = checker_errors(only_red, true)
    assert turned.hue == 0
    assert 20 < turned.most_hue < 60
    assert turned.chroma == 1


def test_missing_converters_are_named_and_skipped(monkeypatch, capsys, tmp_path):
    monkeypatch.setattr(tool.shutil, "which", lambda name: None)
    monkeypatch.setattr("sys.argv", ["converters", "-c", "paper", "-o", str(tmp_path)])
    assert tool.main() == 0
    found = capsys.readouterr()
    assert "| clpipe, default | 122 | 234 | " in found.out and "| clpipe, paper | " in found.out
    assert "darktable is skipped: apt-get install darktable" in found.err
    assert "RawTherapee is skipped: apt-get install rawtherapee" in found.err


@pytest.mark.parametrize("iso", [100, 6400])
@pytest.mark.parametrize(
    "converter",
    [c for c in tool.CONVERTERS if c.name in ("dcraw", "darktable", "RawTherapee")],
    ids=lambda c: c.name,
)
def test_our_dng_is_as_bright_as_our_picture_in_other_converters(
    tmp_path, write_exr, converter, iso
):
    """18 % grey is at 100 to 140 of 255, and light above white is not clipped."""
    program = converter.command.split()[0]
    if shutil.which(program) is None:
        pytest.skip(f"needs {program}")
    noisy = iso > 100
    # dcraw darkens the picture for brighter light.
    has_ramp = not noisy and converter.name != "dcraw"
    chart = patch_image(checker())
    if has_ramp:
        ramp = np.linspace(0, 1.9, chart.shape[1], dtype=np.float32)
        chart = np.concatenate([chart, np.broadcast_to(ramp[None, :, None], chart.shape)])
    formats = ("--format", "dng", "--format", "png", "--truth", "development")
    large = pictures.enlarged(chart, 2)
    cli_output("run", write_exr("chart.exr", large), "-o", tmp_path, "--iso", iso, *formats)
    picture = tmp_path / "made" / "chart.png"
    tool.convert(converter, tmp_path / f"chart{'' if noisy else '.truth'}.dng", picture)
    pixels = tool.read_picture(picture, *large.shape[:2])
    small = pixels.reshape(-1, 2, 768, 2, 3).mean((1, 3))
    means = patches_of(small[None, :512]).mean((1, 2, 3))
    found = checker_errors(means, np.array(CHECKER))
    assert 100 <= found.grey_level <= 140
    assert found.hue < 3
    if has_ramp:
        bright = small[640:896, 400::80].mean((0, 2))
        assert (np.diff(bright) > 0.5).all(), bright
