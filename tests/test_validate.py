"""tools/validate: known noise comes back, and finished pictures are like a real camera's."""

import sys
from dataclasses import replace
from importlib.machinery import SourceFileLoader
from importlib.util import module_from_spec, spec_from_loader

import pytest

from clpipe.camera.profile import load_camera
from tests.conftest import ROOT

LOADER = SourceFileLoader("validate", str(ROOT / "tools" / "validate"))
validate = module_from_spec(spec_from_loader("validate", LOADER))
sys.modules["validate"] = validate  # its dataclasses look themselves up there
LOADER.exec_module(validate)

# Every camera, pattern and method, ISOs from end to end; tools/validate closes all 68 loops.
LOOPS = [
    ("sony-a7r2", 100, "RGGB", "poisson"),
    ("sony-a7r2", 12800, "GRBG", "gaussian"),
    ("sony-a7s2", 1600, "BGGR", "poisson"),
    ("sony-a7s2", 100, "GBRG", "gaussian"),
    ("canon-5d2", 6400, "RGGB", "poisson"),
]


@pytest.mark.parametrize(("camera", "iso", "pattern", "method"), LOOPS)
def test_noise_that_goes_in_comes_back(camera, iso, pattern, method):
    # The Canon's row noise is a thirtieth of its read noise: only long rows tell it to 3 %.
    width = 3072 if camera == "canon-5d2" else 1024
    loop = validate.close_loop(camera, iso, pattern, 800, width, method)
    assert loop.good, loop


@pytest.fixture(scope="module")
def jpegs():
    return validate.finished("canon-5d2-jpeg", 3200)


@pytest.mark.parametrize("what", validate.REAL)
def test_canon_5d2_jpegs_are_like_the_real_ones(jpegs, what):
    assert jpegs[what] == pytest.approx(validate.REAL[what], abs=validate.ALLOWED)


def test_the_configuration_is_for_the_camera():
    assert load_camera("canon-5d2").noise(3200).a == pytest.approx(6.6667 / (15600 - 1024))


def test_poisson_numbers_agree_with_the_exact_law():
    assert validate.poisson_p(9.9, 200_000) > 0.001


def test_the_page(monkeypatch, capsys, jpegs):
    # One loop and one picture stand for all: others are the tests above.
    loop = validate.close_loop("sony-a7r2", 3200, "RGGB", 800, 1024, "gaussian")
    monkeypatch.setattr(validate, "close_loop", lambda *_: loop)
    monkeypatch.setattr(validate, "finished", lambda *_: jpegs)
    monkeypatch.setattr(validate, "CAMERAS", ("sony-a7r2",))
    monkeypatch.setattr(validate, "ISOS", (3200,))
    monkeypatch.setattr(validate, "MEANS", (5,))
    monkeypatch.setattr("sys.argv", ["validate", "--size", "1024x800", "--draws", "100000"])
    status = validate.main()
    out = capsys.readouterr().out
    assert status == 0, out
    assert "| sony-a7r2 | 3200 | " in out
    for heading in ("Known noise in", "Photo-electrons", "A real camera's finished pictures"):
        assert heading in out
    monkeypatch.setattr(validate, "close_loop", lambda *_: replace(loop, a=0.5))
    assert validate.main() == 1
