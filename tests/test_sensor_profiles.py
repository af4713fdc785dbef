"""Profiles of special sensors: the figures of their sources, measured on clpipe's output."""

import numpy as np
import pytest

from clpipe.analysis.emva.files import measure_series
from clpipe.analysis.emva.simulation import SeriesSize, simulate
from clpipe.camera.profile import load_camera

pytestmark = pytest.mark.slow

SIZE = SeriesSize(width=96, height=64, exposures=12, stack=16)
# Data sheets after EMVA 1288, by camera and ISO: K in DN/e-, dark noise and saturation in e-, SNR
# at most and dynamic range in dB. The last three of the IMX264 are its sibling's without filters,
# whose dark noise is 2.1 e-.
SHEETS = {
    ("sony-imx900", 100): (0.399, 5.560, 9458, 39.76, 63.8),
    ("sony-imx900", 419): (1.673, 1.954, 2183, 33.39, 59.0),
    ("sony-imx264", 100): (0.3676, 2.30, 10400, 40.2, 72),
}


@pytest.mark.parametrize(("name", "iso"), SHEETS)
def test_a_series_has_the_figures_of_the_data_sheet(name, iso, tmp_path):
    gain, dark, saturation, snr, dynamic_range = SHEETS[name, iso]
    simulate(name, iso, 0, tmp_path, SIZE, None)
    _, found = measure_series(tmp_path / "EMVA1288_Data.txt")
    assert found.system_gain.value == pytest.approx(gain, rel=0.03)
    assert found.dark_noise.value == pytest.approx(dark, rel=0.04)
    assert found.saturation_electrons.value == pytest.approx(saturation, rel=0.05)
    assert 20 * np.log10(found.snr_max.value) == pytest.approx(snr, abs=0.3)
    assert 20 * np.log10(found.dynamic_range.value) == pytest.approx(dynamic_range, abs=1.3)
    camera = load_camera(name)
    assert found.quantum_efficiency.value == pytest.approx(camera.quantum_efficiency, rel=0.03)
    assert found.prnu.total.value == pytest.approx(camera.prnu, abs=6e-4)


def test_the_four_readings_of_the_imx490_are_isetcams(develop):
    """120,000 e- over 4,096 DN, 64 of them black; 4 between the gains; 0.9 and 0.1 of the light."""
    camera = load_camera("sony-imx490")
    per_signal = 1 / camera.noise(100).a  # e- of the large photodiode
    assert camera.noise(100).emva().read_noise == pytest.approx(1, rel=1e-3)
    settings = {"camera": "sony-imx490", "iso": 100, "numpy": True}
    settings["stages"] = ["mosaic", "sensor_noise"]

    def made(light, part):
        noise = {"method": "split_dual_gain", "part": part}
        flat = np.full((120, 120, 3), light, np.float32)
        return develop(flat, sensor_noise=noise, **settings).final.astype(float) * per_signal

    low = 120_000 * (4095 - 64) / 4096
    for part, (share, white) in enumerate(((1, low / 4), (1, low), (1 / 9, low / 4), (1 / 9, low))):
        assert made(100, part).max() * share == pytest.approx(white, rel=1e-3)
        charge = 0.7 * white
        found = made(charge / share / per_signal, part) * share
        assert found.mean() == pytest.approx(charge, rel=2e-3)
        assert found.std() == pytest.approx(charge**0.5, rel=0.03)


def test_binned_quads_have_the_noise_that_was_measured_of_binned_raws(develop):
    binned = load_camera("sony-imx686")
    for iso in (100, 6400):
        flat = np.full((160, 160, 3), 0.5, np.float32)
        stages = ["mosaic", "sensor_noise", "remosaic"]
        settings = {"camera": "sony-imx686-quad", "iso": iso, "remosaic": {"method": "binning"}}
        found = develop(flat, numpy=True, stages=stages, **settings).final
        assert found.shape == (80, 80)
        noise = binned.noise(iso)
        assert found.std() == pytest.approx((noise.a / 2 + noise.b) ** 0.5, rel=0.03)
    quad = load_camera("sony-imx686-quad")
    assert 4 * quad.full_well == pytest.approx(binned.full_well, rel=1e-3)


def test_an_x_trans_raw_has_the_noise_of_darktables_profile(develop):
    """Its green a, 2.054e-05 at ISO 1600, times 16.5; on every filter alike."""
    camera = load_camera("fujifilm-x-t3")
    flat = np.full((180, 180, 3), 0.4, np.float32)
    settings = {"camera": "fujifilm-x-t3", "iso": 1600, "stages": ["mosaic", "sensor_noise"]}
    found = develop(flat, numpy=True, **settings).final
    read = np.exp(0.563 * np.log(16.5 * 2.054e-05 * 15361) + 0.799) / 15361
    assert found.var() == pytest.approx(16.5 * 2.054e-05 * 0.4 + read**2, rel=0.03)
    assert camera.filter_array == "x-trans" and "30 %" in camera.sources["system_gain"]
