"""tools/pages/quality.py: the figures it measures are those of independent implementations."""

import numpy as np
import pytest

import clpipe
from clpipe.images.read import read_image
from tests.conftest import STILL_LIFE
from tools.pages import quality

pytestmark = pytest.mark.tools


@pytest.mark.parametrize("name", [n for n, (_, figure) in quality.DEMOSAIC.items() if figure])
def test_demosaicing_is_as_good_as_published(shared_data, name):
    choice, figure = quality.DEMOSAIC[name]
    found = quality.demosaicing(quality.kodak(shared_data / "kodak"), choice)
    assert found == pytest.approx(figure, abs=quality.TOLERANCE)


def test_cpsnr():
    one = np.zeros((40, 40, 3), np.uint8)
    two = one.copy()
    two[10:-10, 10:-10] = 5
    two[:10] = 99  # the border does not count
    assert quality.cpsnr(one, two) == pytest.approx(20 * np.log10(255 / 5))


def test_the_tables(tmp_path, capsys, monkeypatch):
    for table in (quality.DEMOSAIC, quality.DENOISE, quality.SHARPNESS):
        for name in [*table][1:-1]:  # test_demosaicing runs those of demosaicing
            monkeypatch.delitem(table, name)
    monkeypatch.setattr(quality, "ISOS", (1600,))
    monkeypatch.setattr("sys.argv", ["quality", "--pictures", str(tmp_path)])
    crop = np.ascontiguousarray(read_image(STILL_LIFE).pixels[200:330, 300:460])
    monkeypatch.setattr(quality, "read_image", lambda path: type("S", (), {"pixels": crop}))
    assert quality.main() == 0
    out = capsys.readouterr().out
    assert "Kodak pictures are not there; skipped" in out
    for name in (*quality.DEMOSAIC, *quality.DENOISE, *quality.SHARPNESS):
        assert name in out


def test_every_chain_can_be_made():
    for choice, _ in quality.DEMOSAIC.values():
        assert quality.camera_of(choice).chain
    for settings in (*quality.DENOISE.values(), *quality.SHARPNESS.values()):
        assert clpipe.Pipeline(**settings).chain
