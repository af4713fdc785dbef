"""tools/compare/converters.py and tools/pages/comparison_page.py, without missing converters."""

import doctest
import shutil

import numpy as np
import pytest
from PIL import Image

from clpipe.analysis.crops import HEIGHT, WIDTH
from tests.conftest import cli_output
from tools.compare import charts, fidelity
from tools.compare import converters as tool
from tools.compare.charts import chart_image, chart_patches, patch_means, saturated_image
from tools.compare.fidelity import colour_errors
from tools.pages import comparison_page

pytestmark = pytest.mark.slow

COPY = tool.Converter("copy", "none", "cp DNG PICTURE")
PRINT = tool.Converter("print", "none", "cat DNG")
FAIL = tool.Converter("fail", "none", "cat HOME/missing")


def comparison(folder, *converters):
    return tool.Comparison(folder, ("default",), converters)


def save(folder, maker, iso, name, pixels):
    path = folder / maker / f"iso{iso}" / name
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(pixels).save(path)
    return path


@pytest.mark.parametrize("converter", [COPY, PRINT])
def test_a_picture_is_what_the_converter_writes_or_prints(tmp_path, converter):
    negative = tmp_path / "a.dng"
    negative.write_bytes(b"raw")
    picture = tmp_path / "out" / "a.png"
    comparison(tmp_path, converter).convert(converter, negative, picture)
    assert picture.read_bytes() == b"raw"


def test_a_converter_that_fails_is_named_with_its_reason(tmp_path):
    with pytest.raises(tool.ComparisonError, match=r"^cat failed: .*No such file"):
        comparison(tmp_path, FAIL).convert(FAIL, tmp_path / "a.dng", tmp_path / "a.png")


def test_a_converter_that_writes_nothing_is_an_error(tmp_path):
    silent = tool.Converter("silent", "none", "true DNG PICTURE")
    stale = save(tmp_path, "silent", 100, "a.png", np.zeros((4, 4, 3), np.uint8))
    with pytest.raises(tool.ComparisonError, match="silent wrote no picture"):
        comparison(tmp_path, silent).convert(silent, tmp_path / "a.dng", stale)


def test_a_border_that_a_converter_cuts_off_does_not_shift_the_picture(tmp_path):
    pixels = np.random.default_rng(0).integers(0, 256, (40, 60, 3), dtype=np.uint8)
    save(tmp_path, "clpipe-default", 100, "a.png", pixels)
    save(tmp_path, "copy", 100, "a.png", pixels[4:-4, 4:-4])
    found = comparison(tmp_path, COPY).picture("copy", 100, "a")
    assert found.shape == pixels.shape
    assert np.array_equal(found[4:-4, 4:-4], pixels[4:-4, 4:-4])
    save(tmp_path, "copy", 100, "a.png", pixels[:, :-20])
    with pytest.raises(tool.ComparisonError, match="is 40x40; expected 60x40"):
        comparison(tmp_path, COPY).picture("copy", 100, "a")


def test_reducing_an_enlarged_image_restores_it():
    image = np.random.default_rng(0).random((6, 4, 3)).astype(np.float32)
    assert np.array_equal(tool.reduced(tool.enlarged(image)), image)


def test_a_sheet_holds_the_crops_at_400_percent():
    crop = np.random.default_rng(0).integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)
    page = np.asarray(comparison_page.sheet(["one", "two"], {"a, b": [crop, 255 - crop]}))
    high, wide = (side * 4 for side in (HEIGHT, WIDTH))
    top, left = comparison_page.HEAD, comparison_page.SIDE
    assert np.array_equal(page[top : top + high : 4, left : left + wide : 4], crop)


@pytest.mark.parametrize("module", [charts, fidelity])
def test_the_examples_in_docstrings(module):
    assert doctest.testmod(module).failed == 0


def test_the_charts_fit_the_sensor():
    for image in (chart_image(), saturated_image()):
        assert 0 <= image.min() < image.max() <= 1
        assert image.shape[0] % 2 == image.shape[1] % 2 == 0


def test_errors_of_grey_hue_and_chroma_are_independent():
    true = chart_patches()
    brighter = colour_errors(true * 1.05, true)
    assert brighter.grey == pytest.approx(128.1)
    assert brighter.lightness > 2 > 1 > brighter.hue
    grey = true.mean(1, keepdims=True)
    assert colour_errors(grey + (true - grey) / 2, true).chroma == pytest.approx(0.5, abs=0.05)
    only_red = true.copy()
    only_red[14] = only_red[14, [0, 2, 1]] + (0, 60, 0)  # red towards orange
    turned = colour_errors(only_red, true)
    assert turned.hue == 0
    assert 20 < turned.largest_hue < 60
    assert turned.chroma == 1


def test_missing_converters_are_named_and_skipped(monkeypatch, capsys, tmp_path):
    seen = []
    monkeypatch.setattr(tool, "compare", lambda comparison, *_: seen.append(comparison))
    monkeypatch.setattr(tool.shutil, "which", lambda name: name if name == "dcraw" else None)
    monkeypatch.setattr("sys.argv", ["compare_converters", "-c", "paper", "-o", str(tmp_path)])
    assert tool.main() == 0
    assert list(seen[0].developers) == ["clpipe, default", "clpipe, paper", "dcraw", "dcraw -W"]
    assert seen[0].steady == ["clpipe, default", "clpipe, paper", "dcraw -W"]
    printed = capsys.readouterr().err
    assert "darktable is skipped: apt-get install darktable" in printed
    assert "RawTherapee is skipped: apt-get install rawtherapee" in printed


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
    has_ramp = (
        not noisy and converter.name != "dcraw"
    )  # dcraw darkens the picture for brighter light
    chart = chart_image()
    if has_ramp:
        ramp = np.linspace(0, 1.9, chart.shape[1], dtype=np.float32)
        chart = np.concatenate([chart, np.broadcast_to(ramp[None, :, None], chart.shape)])
    made = comparison(tmp_path, converter)
    folder, name = made.folder("clpipe, default", iso), "chart" if noisy else "chart.truth"
    formats = ("--format", "dng", "--format", "png", "--truth", "development")
    render = write_exr("chart.exr", chart.repeat(4, 0).repeat(4, 1))
    cli_output("run", render, "-o", folder, "--iso", iso, *formats)
    picture = made.folder(converter.name, iso) / f"{name}.png"
    made.convert(converter, folder / f"{name}.dng", picture)
    pixels = made.picture(converter.name, iso, "chart", noisy)
    small = pixels.reshape(-1, 4, 384, 4, 3).mean((1, 3))
    found = colour_errors(patch_means(small[:256]), chart_patches())
    assert 100 <= found.grey <= 140
    assert found.hue < 3
    if has_ramp:
        bright = small[320:448, 200::40].mean((0, 2))
        assert (np.diff(bright) > 0.5).all(), bright
