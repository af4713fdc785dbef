"""tools/pages/validate.py: known noise is recovered; pictures resemble a real camera's."""

import doctest
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image
from scipy import ndimage

from clpipe.analysis.crops import WIDTH
from clpipe.analysis.matching.columns import ValidPixels, figures_of, noise_of_frames
from clpipe.analysis.signature import flat_mask
from clpipe.camera.profile import load_camera
from clpipe.images.read import read_image
from clpipe.pipeline import Pipeline
from clpipe.reference.colour import luma
from clpipe.reference.transfer import srgb_curve
from tools.pages import real_cameras, validate

pytestmark = pytest.mark.slow


def test_noise_that_goes_in_comes_back():
    """One of the 68 loops that the tool closes; test_the_page closes one with Gaussian noise."""
    loop = validate.close_loop("sony-a7s2", 1600, "BGGR", 800, 1024, "poisson")
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


def camera_like(seed=0):
    """A ramp of grey, and the same with noise that is correlated as a camera's."""
    random = np.random.default_rng(seed)
    clean = np.repeat(np.linspace(60, 200, 240)[None, :, None], 3, 2).repeat(180, 0)
    own = ndimage.gaussian_filter(random.normal(0, 16, clean.shape), (1.2, 1.2, 0))
    shared = ndimage.gaussian_filter(random.laplace(0, 8, clean.shape[:2]), 0.64)
    noisy = clean + own + shared[..., None]
    return real_cameras.Pair(*(np.rint(image).astype(np.uint8) for image in (noisy, clean)))


def test_the_default_chain_is_like_a_camera():
    pair = real_cameras.develop(read_image(validate.RENDER).pixels, 1600)
    record = pair.signature()
    assert not real_cameras.outside(record), record


@pytest.mark.parametrize("iso", [1600, 6400])
def test_noise_by_intensity_and_chroma_are_a_cameras(iso):
    """As of five cameras: quieter in shadows and highlights, no dark pits, coarse chroma."""
    pair = real_cameras.develop(read_image(validate.RENDER).pixels, iso)
    clean = pair.clean.astype(np.float64)
    noise = noise_of_frames([pair.noisy.astype(np.float32)], clean)
    found = figures_of(noise, ValidPixels(flat_mask(clean, 12), luma(clean)))
    middle = found["sigma_64"]
    assert 0.45 < found["sigma_12"] / middle < 0.84
    assert 0.60 < found["sigma_24"] / middle < 0.92
    assert 0.77 < found["sigma_40"] / middle < 0.98
    assert 0.33 < found["sigma_160"] / middle < 0.78
    assert -0.07 < found["skew_24"] < 0.26
    assert 3.2 < found["kurtosis"] < 5.3
    assert 0.57 < found["chroma_two_right"] < 0.77
    assert found["chroma_right_4"] > 0.14
    assert abs(found["right_3"]) < 0.08


def test_a_render_as_in_srgb_has_one_word():
    grey = np.repeat(np.linspace(0.002, 0.98, 64, dtype=np.float32)[None, :, None], 3, 2)
    image = grey.repeat(32, 0)
    settings = {"tone_curve": {"method": "linear"}, "skip": ["noise", "denoise", "sharpen"]}
    plain = np.rint(255 * srgb_curve(image.astype(np.float64)))
    made = Pipeline(**settings, device="numpy").process(image, "k").image
    assert np.abs(made.astype(float) - plain)[:, 2:-2].max() <= 2


def test_the_cameras_that_were_measured_are_in_the_range():
    for name, record in real_cameras.MEASURED.items():
        assert not real_cameras.outside(record), name


def test_the_examples():
    assert doctest.testmod(real_cameras).failed == 0


def test_real_pairs_are_found_by_camera_and_measured_by_their_median(tmp_path):
    pairs = [camera_like(seed) for seed in range(3)]
    for number, pair in enumerate(pairs, 1):
        Image.fromarray(pair.noisy).save(tmp_path / f"x_iso3200_{number}_real.png")
        Image.fromarray(pair.clean).save(tmp_path / f"x_iso3200_{number}_mean.png")
    found = real_cameras.read_pairs(tmp_path)
    assert {name: len(each) for name, each in found.items()} == {"x, ISO 3200": 3}
    middle = sorted(pair.signature()["rms"] for pair in pairs)[1]
    assert real_cameras.medians(found["x, ISO 3200"])["rms"] == middle
    (tmp_path / "x_iso3200_2_mean.png").unlink()
    with pytest.raises(SystemExit, match=r"2_real.png has no x_iso3200_2_mean.png"):
        real_cameras.read_pairs(tmp_path)


def test_the_section_of_cameras(monkeypatch, capsys, tmp_path):
    pair = camera_like()
    real = tmp_path / "real"
    real.mkdir()
    Image.fromarray(pair.noisy).save(real / "x_1_real.png")
    Image.fromarray(pair.clean).save(real / "x_1_mean.png")
    out = tmp_path / "out"
    command = ["validate", "--only", "cameras", "--real", str(real), "-o", str(out)]
    monkeypatch.setattr("sys.argv", command)
    monkeypatch.setattr(validate, "DOCS", tmp_path)
    monkeypatch.setattr(real_cameras, "develop", lambda *_: pair)
    status = validate.main()
    printed = capsys.readouterr().out
    assert status == 0, printed
    assert "| Nikon D800, ISO 3200 | 5.3 | 3.4 |" in printed
    assert "| x, 1 measured here | " in printed
    assert "Photo-electrons" not in printed
    assert "**" not in printed.partition("| target |")[2]
    assert "ISO 6400" in (tmp_path / "real_cameras.svg").read_text()
    for crops, columns in ((tmp_path, 4), (out, 5)):
        with Image.open(crops / "real_cameras_crops.png") as image:
            assert image.width // (WIDTH * real_cameras.SCALE) == columns
    independent = np.random.default_rng(0).normal(0, 5, pair.clean.shape)
    other = replace(pair, noisy=np.rint(pair.clean + independent).astype(np.uint8))
    monkeypatch.setattr(real_cameras, "develop", lambda *_: other)
    monkeypatch.setattr("sys.argv", command[:3])
    assert validate.main() == 1
    assert "| clpipe, ISO 800 | " in (printed := capsys.readouterr().out)
    assert "| **-0.0" in printed or "| **0.0" in printed  # the autocorrelation


def test_the_page(monkeypatch, capsys, tmp_path, jpegs):
    # One loop and one picture stand for all: others are the tests above.
    loop = validate.close_loop("sony-a7r2", 3200, "RGGB", 800, 1024, "gaussian")
    monkeypatch.setattr(validate, "close_loop", lambda *_: loop)
    monkeypatch.setattr(validate, "finished", lambda *_: jpegs)
    monkeypatch.setattr(validate, "CAMERAS", ("sony-a7r2",))
    monkeypatch.setattr(validate, "ISOS", (3200,))
    monkeypatch.setattr(validate, "MEANS", (5,))
    monkeypatch.setattr(validate, "DOCS", tmp_path)
    monkeypatch.setattr(real_cameras, "develop", lambda *_: camera_like())
    monkeypatch.setattr("sys.argv", ["validate", "--size", "1024x800", "--draws", "100000"])
    status = validate.main()
    out = capsys.readouterr().out
    assert status == 0, out
    assert "| sony-a7r2 | 3200 | " in out
    for heading in (
        "Calibration of known noise",
        "Photo-electrons",
        "A real camera's finished",
        "Comparison with real cameras",
    ):
        assert heading in out
    monkeypatch.setattr(validate, "close_loop", lambda *_: replace(loop, a=0.5))
    assert validate.main() == 1
