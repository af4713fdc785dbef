"""What dark frames show comes back from frames that clpipe made, within its standard errors."""

from types import SimpleNamespace

import numpy as np
import pytest

from clpipe.analysis.calibration.calibrate import calibrate
from clpipe.analysis.calibration.dark_current import dark_current
from clpipe.analysis.calibration.dark_figures import (
    Shading,
    dark_figures,
    slope_and_offset,
)
from clpipe.analysis.calibration.fixed_pattern import NO_PIXELS
from clpipe.analysis.calibration.groups import by_time
from clpipe.analysis.calibration.line_fit import Estimate
from clpipe.analysis.calibration.profile import calibrated_profile
from clpipe.analysis.calibration.repeats import Sensor
from clpipe.camera.profile import parse_camera
from clpipe.pipeline import Pipeline

UNIT = 16383 - 512
READ = 3.0  # DN


def dark_frames(count, shape=(225, 259), pattern="RGGB", iso=800, light=0.0, **stages):
    """Dark frames of sony-a7r2's levels in DN, (frame, height, width)."""
    own = {
        "sensor_noise": {"a": 1e-5, "b": (READ / UNIT) ** 2},
        "row_noise": {"sigma": 0.4 / UNIT},
        "mosaic": {"pattern": pattern},
    }
    pipeline = Pipeline(
        iso=iso, device="numpy", start_at="crosstalk", until="quantize", **{**own, **stages}
    )
    black = np.full(shape, light, np.float32)
    return np.stack([pipeline.process(black, f"{light} {k}").image for k in range(count)])


def figures(dark, pattern="RGGB"):
    return dark_figures(dark, Sensor(pattern, 512.0, 16383.0), NO_PIXELS)


def within(estimate, truth, sigmas=4.0):
    return abs(estimate.value - truth) <= sigmas * estimate.error


@pytest.mark.slow
@pytest.mark.parametrize("pattern", ["RGGB", "GBRG"])
def test_errors_of_the_black_level(pattern):
    bias, sigma = (1.5, -0.5, 0.25, 2.0), 0.3
    error = {"bias": [each / UNIT for each in bias], "sigma": sigma / UNIT}
    found = figures(dark_frames(24, (63, 70), pattern, black_level_error=error), pattern)
    for estimate, truth in zip(found.color_bias, bias, strict=True):
        assert within(estimate, truth)
        assert estimate.error < 2.5 * sigma / 24**0.5
    assert found.black_level_error is not None
    assert within(found.black_level_error, sigma)
    assert found.black_level_error.error < 0.2 * sigma
    none = figures(dark_frames(24, (63, 70), pattern), pattern).black_level_error
    assert none is not None and none.value < 3 * none.error + 0.03


@pytest.mark.slow
@pytest.mark.parametrize("shape", [-0.2, 0.0, 0.14])
@pytest.mark.parametrize("frames", [2, 6])
def test_the_shape_of_read_noise(shape, frames):
    noise = {"a": 1e-5, "b": (READ / UNIT) ** 2, "tukey_lambda": shape}
    found = figures(dark_frames(frames, sensor_noise=noise)).tukey_lambda
    assert found is not None
    assert within(found, shape, 5.0)
    assert found.error < 0.03


@pytest.mark.slow
def test_a_wave_over_the_rows():
    wave = {"amplitude": 0.5 / UNIT, "period": 13.7}
    found = figures(dark_frames(6, banding=wave)).banding
    assert found is not None
    assert within(found.amplitude, 0.5) and found.amplitude.error < 0.1
    assert found.period == pytest.approx(13.7, rel=0.01)
    assert figures(dark_frames(6)).banding is None


@pytest.mark.slow
def test_pixels_that_jump():
    given = {"share": 0.01, "amplitude": 40 / UNIT}
    found = figures(dark_frames(16, random_telegraph=given))
    assert found.rts_share is not None and found.rts_amplitude is not None
    assert within(found.rts_share, 0.01) and found.rts_share.error < 0.002
    assert within(found.rts_amplitude, 40) and found.rts_amplitude.error < 5
    none = figures(dark_frames(16))
    assert none.rts_share is None
    assert figures(dark_frames(4, random_telegraph=given)).rts_share is None


@pytest.mark.slow
def test_smooth_maps_over_the_iso():
    shading = {"slope": 0.002 / UNIT, "offset": 1.0 / UNIT, "length": 120.0}
    by_iso, maps = {}, {}
    for iso in (100, 800, 3200):
        frames = dark_frames(4, (480, 640), iso=iso, dark_shading=shading)
        by_iso[iso] = figures(frames).shading
        clean = Pipeline(
            iso=iso,
            device="numpy",
            start_at="dark_shading",
            until="dark_shading",
            dark_shading=shading,
        )
        maps[iso] = clean.process(np.zeros((480, 640), np.float32), "k").image * UNIT
        assert by_iso[iso].variance.root().value == pytest.approx(maps[iso].std(), rel=0.12)
        assert 60 < by_iso[iso].length < 240
    slope, offset = slope_and_offset(by_iso)
    true_slope = (maps[3200] - maps[100]) / 3100
    assert slope.value == pytest.approx(true_slope.std(), rel=0.12)
    assert offset.value == pytest.approx((maps[100] - 100 * true_slope).std(), rel=0.12)
    flat = figures(dark_frames(4, (480, 640))).shading
    assert flat.variance.value < 3 * flat.variance.error + 1e-4
    assert figures(dark_frames(2, (63, 640))).shading is None


@pytest.mark.slow
def test_a_profile_of_dark_frames_makes_such_frames_again():
    stages = {
        "black_level_error": {"bias": [2 / UNIT, 0.0, 0.0, -1 / UNIT], "sigma": 0.3 / UNIT},
        "banding": {"amplitude": 0.6 / UNIT, "period": 9.0},
        "random_telegraph": {"share": 0.01, "amplitude": 40 / UNIT},
    }
    sensor = Sensor("RGGB", 512.0, 16383.0)
    ramp = np.linspace(0.0, 0.5, 259, dtype=np.float32)[None].repeat(225, 0)
    noise = {"a": 1e-4, "b": (READ / UNIT) ** 2}
    scene = Pipeline(
        iso=800, device="numpy", start_at="sensor_noise", until="quantize", sensor_noise=noise
    )
    shots = np.stack([scene.process(ramp, f"{k}").image for k in range(6)])
    dark = dark_frames(16, sensor_noise=noise, **stages)
    found = calibrate(800, shots, dark, sensor)
    assert found.dark is not None
    assert found.record()["dark"]["rts_share"]["value"] > 0
    camera = parse_camera(calibrated_profile("mine", "M", "N", [found]), "mine.toml")
    assert np.multiply(camera.color_bias(800), UNIT) == pytest.approx([2, 0, 0, -1], abs=0.4)
    assert camera.black_level_error(800) * UNIT == pytest.approx(0.3, rel=0.5)
    electron = camera.signal_of(1.0, 800) * UNIT
    assert camera.banding_amplitude * electron == pytest.approx(0.6, rel=0.3)
    assert camera.banding_period == pytest.approx(9, rel=0.01)
    assert camera.rts_share == pytest.approx(0.01, rel=0.4)
    assert camera.tukey_lambda_at(800) is not None
    assert "two or more exposure times" in camera.sources["dark_current"]


@pytest.mark.parametrize("counts", [(2, 2), (6, 3, 6)])
def test_dark_current_from_frames_of_several_times(counts):
    times = (0.01, 5.0, 30.0)[-len(counts) :]
    sensor, gain = Sensor("RGGB", 512.0, 16383.0), Estimate(1.0, 0.002)
    stacks = {
        t: dark_frames(
            n,
            (120, 150),
            dark_current={
                "current": 6.0,
                "spread": 0.5,
                "per_electron": 1 / UNIT,
                "exposure_time": t,
            },
        )
        for t, n in zip(times, counts, strict=True)
    }
    found = dark_current(stacks, gain, sensor)
    assert found is not None and found.spread is not None
    assert within(found.current, 6.0) and found.current.error < 0.6
    assert within(found.spread, 0.5) and found.spread.error < 0.1
    none = dark_current({t: dark_frames(3, (63, 70)) for t in (1.0, 30.0)}, gain, sensor)
    assert none is not None and not none.current.value > 4 * none.current.error
    assert dark_current({1.0: stacks[times[-1]]}, gain, sensor) is None


def test_dark_frames_are_grouped_by_their_times():
    dark = [SimpleNamespace(seconds=t, name=n) for n, t in enumerate((8.0, 0.5, 8.0, 2.0, None))]

    def names(seconds):
        return [[f.name for f in group] for group in by_time(dark, seconds)]

    assert names(2.0) == [[3], [4], [1], [0, 2]]
    assert names(None) == [[4], [1], [3], [0, 2]]
    assert by_time([], 1.0) == [()]


def test_one_iso_gives_an_offset_alone():
    blocks = np.add.outer(np.arange(8.0), np.arange(8.0)).astype(np.float32)
    one = Shading(blocks, Estimate(1.0, 0.1), 100.0)
    slope, offset = slope_and_offset({100.0: one, 200.0: one})
    assert slope.value < 1e-3 and offset.value > 1
