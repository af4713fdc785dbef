"""tools/pages/quality.py: its figures match independent implementations."""

import numpy as np
import pytest

import clpipe
from clpipe.images.read import read_image
from tests.conftest import ROOT, STILL_LIFE
from tests.photographs import photographs
from tools.pages import quality

pytestmark = pytest.mark.slow


# CPSNR on the photographs of tests/data, in dB. The package colour-demosaicing 0.2.7 computed the
# figures of bilinear, malvar2004 and menon2007. A NumPy program written from the papers computed
# the others. On the Kodak set, both agree with quality.DEMOSAIC within 0.02 dB.
INDEPENDENT = {
    "bilinear": 30.47,
    "edge_directed, hibbard": 32.32,
    "edge_directed, laroche_prescott": 32.82,
    "edge_directed, hamilton_adams": 34.00,
    "median, 3": 34.10,
    "edge_directed_median, 3": 34.60,
    "malvar2004": 33.25,
    "menon2007": 34.63,
}


def test_every_published_method_is_compared():
    assert {*INDEPENDENT} == {name for name, (_, kodak) in quality.DEMOSAIC.items() if kodak}


@pytest.mark.parametrize(("name", "figure"), INDEPENDENT.items())
def test_demosaicing_is_as_good_as_independent_implementations(name, figure):
    choice, _ = quality.DEMOSAIC[name]
    assert quality.demosaicing(photographs(), choice) == pytest.approx(figure, abs=0.02)


@pytest.mark.parametrize("name", ["linear_mmse", "malvar2004", "directional_mmse"])
def test_the_page_says_what_the_photographs_show(name):
    found = quality.demosaicing(photographs(), {"method": name})
    assert f"{found:.2f} dB" in (ROOT / "docs/quality.md").read_text()


def test_cpsnr():
    one = np.zeros((40, 40, 3), np.uint8)
    two = one.copy()
    two[10:-10, 10:-10] = 5
    two[:10] = 99  # the border does not count
    assert quality.cpsnr(one, two) == pytest.approx(20 * np.log10(255 / 5))


def test_the_tables(tmp_path, capsys, monkeypatch):
    for table in (quality.DEMOSAIC, quality.DENOISE):
        for name in [*table][1:-1]:  # the first and the last are enough
            monkeypatch.delitem(table, name)
    monkeypatch.setattr(quality, "ISOS", (1600,))
    monkeypatch.setattr("sys.argv", ["quality", "--pictures", str(tmp_path)])
    crop = np.ascontiguousarray(read_image(STILL_LIFE).pixels[200:330, 300:460])
    monkeypatch.setattr(quality, "read_image", lambda path: type("S", (), {"pixels": crop}))
    assert quality.main() == 0
    out = capsys.readouterr().out
    assert "does not contain the Kodak pictures; skipped" in out
    for name in (*quality.DEMOSAIC, *quality.DENOISE):
        assert name in out


def test_every_chain_can_be_made():
    for choice, _ in quality.DEMOSAIC.values():
        assert quality.camera_of(choice).chain
    for settings in quality.DENOISE.values():
        assert clpipe.Pipeline(**settings).chain
