"""Pulsed light: rows, light layers and staggered exposures against the square wave."""

from pathlib import Path

import numpy as np
import pytest

from clpipe import Pipeline
from clpipe.base.errors import RequestError
from clpipe.images.read import read_image
from clpipe.stage import run_reference
from clpipe.stages.shutter import Rows

LAMPS = [
    {"flicker_frequency": 90.0, "flicker_duty": 0.1, "exposure_time": 1e-3, "line_time": 3e-4},
    {"flicker_frequency": 90.0, "flicker_duty": 0.4, "exposure_time": 0.03, "line_time": 1e-4},
    {"flicker_frequency": 250.0, "flicker_duty": 0.75, "exposure_time": 3e-3, "line_time": 7e-4},
]
MORE = {"flicker_depth": 0.6, "flicker_phase": -77.0}


def on_share(start, length, lamp, samples=40_000):
    """The share of some time in which a pulsed light is on, by counting."""
    time = start + (np.arange(samples) + 0.5) / samples * length
    cycles = lamp["flicker_frequency"] * time + lamp.get("flicker_phase", 0) / 360
    return float((cycles % 1 < lamp["flicker_duty"]).mean())


def gains(lamp, rows):
    """What rows get of pulsed light, over its mean, by counting."""
    time, depth = lamp["exposure_time"], lamp.get("flicker_depth", 1.0)
    shares = [on_share(row * lamp["line_time"], time, lamp) for row in range(rows)]
    return 1 + depth * (np.array(shares) / lamp["flicker_duty"] - 1)


@pytest.mark.parametrize("lamp", LAMPS)
def test_rows_get_what_the_square_wave_gives(develop, lamp):
    for own in (lamp, lamp | MORE):
        light = np.ones((60, 3, 3), np.float32)
        found = develop(light, stages=["shutter"], shutter=own).final
        expected = gains(own, 60)
        near = 2e-4 / own["flicker_duty"]  # as it was counted
        assert found[:, 1, 2] == pytest.approx(expected, abs=near)
        assert Rows(**own).weights(1, 60, weighted=True)[0] == pytest.approx(expected, abs=near)
    assert np.ptp(found) > 0.05


def test_there_are_bands_and_the_mean_stays(develop):
    # A fifth of a period is exposed, and the light is on for a tenth; 25 rows are a period.
    lamp = {"flicker_frequency": 100.0, "flicker_duty": 0.1, "exposure_time": 2e-3}
    light = np.full((400, 2, 3), 0.5, np.float32)
    found = develop(light, stages=["shutter"], shutter={**lamp, "line_time": 4e-4}).final[:, 0, 0]
    assert found.mean() == pytest.approx(0.5, rel=1e-3)
    assert found.max() == pytest.approx(0.5 * 5, rel=1e-4)  # the whole pulse in a fifth of the time
    assert found.min() == 0
    assert found[:375] == pytest.approx(found[25:], abs=1e-4)
    whole = {**lamp, "line_time": 4e-4, "exposure_time": 0.03}
    assert np.ptp(develop(light, stages=["shutter"], shutter=whole).final) < 1e-5


def test_phases_stay_exact_in_the_last_of_many_rows():
    lamp = {"flicker_frequency": 97.0, "flicker_duty": 0.3, "exposure_time": 1e-3}
    shutter = Rows(**lamp, line_time=9.1e-3)
    found = run_reference(shutter, np.ones((30_000, 1, 3), np.float32))[:, 0, 0]
    expected = shutter.weights(1, 30_000, weighted=True)[0]
    assert np.abs(found - expected).max() < 2e-4  # of up to 3.3


@pytest.fixture
def lit(clpipe, write_exr):
    """Four frames of a scene with a lamp whose light has a layer: 0.1 and, in columns 8 on, 0.2."""
    for number in range(4):
        pixels = np.full((20, 16, 6), 0.1, np.float32)
        pixels[:, :, 3:] = 0
        pixels[:, 8:, 3:] = 0.2
        pixels[:, 8:, :3] += 0.2
        pixels[:, 0, :3] = number  # which frame it was
        names = "R,G,B,Lamp.R,Lamp.G,Lamp.B"
        write_exr(f"in/f{number}.exr", pixels, names, half=False)
    return clpipe


def exposed(clpipe, lamp, *options, source="in/f0.exr", stages="shutter", out="o", **more):
    own = {**{f"shutter.{name}": value for name, value in lamp.items()}, **more}
    sets = [x for key, value in own.items() for x in ("--set", f"{key}={value}")]
    layer = ("--set", "shutter.flicker_layer=Lamp")
    form = ("--format", "exr" if stages == "shutter" else "npy", "--iso", "400")
    clpipe("run", source, "-o", out, "--stages", stages, *form, *sets, *layer, *options)
    (path,) = (p for p in Path(out).iterdir() if p.suffix in (".exr", ".npy"))
    return read_image(path).pixels[..., 1] if stages == "shutter" else np.load(path)


def test_a_layer_of_light_flickers_alone(lit):
    lamp = LAMPS[0] | MORE
    found = exposed(lit, lamp)
    expected = gains(lamp, 20)
    assert found[:, 1:8] == pytest.approx(np.full((20, 7), 0.1), rel=1e-3)
    lit_part = 0.1 + 0.2 * np.tile(expected[:, None], (1, 8))
    assert found[:, 8:] == pytest.approx(lit_part, abs=1e-3)
    assert np.ptp(expected) > 1


def test_each_frame_has_the_light_of_its_time(lit):
    lamp = {**LAMPS[2], "flicker_depth": 1.0, "subframes": 4}
    found = exposed(lit, lamp, source="in")
    whole = 19 * lamp["line_time"] + lamp["exposure_time"]
    for row in (0, 7, 19):
        start = row * lamp["line_time"]
        assert found[row, 9] == pytest.approx(0.1 + 0.2 * gains(lamp, 20)[row], abs=1e-3)
        seen = np.clip(np.linspace(0, whole, 5), start, start + lamp["exposure_time"])
        frame = np.diff(seen) @ np.arange(4) / lamp["exposure_time"]
        assert found[row, 0] == pytest.approx(frame, abs=2e-3)


@pytest.mark.slow
def test_a_short_exposure_misses_the_pulse(lit):
    # The lamp is on for 2 of each 10 ms. Exposures of 8, 2 and 0.5 ms follow each other.
    lamp = {"flicker_frequency": 100.0, "flicker_duty": 0.2, "exposure_time": 8e-3}
    noise = {"method": "staggered", "ratio": 4.0, "a": 0.0, "b": 0.0}
    given = {f"sensor_noise.{name}": value for name, value in noise.items()}
    stages = "shutter,mosaic,sensor_noise"
    by_phase = {0: (1.25, 0, 5), -270: (0.3125, 3.75, 0), -300: (1 / 4.8, 4 + 1 / 6, 10 / 3)}
    for phase, expected in by_phase.items():
        own = lamp | {"flicker_phase": phase}
        for part, gain in enumerate(expected):
            given["sensor_noise.part"] = part
            out = f"o{phase}{part}"
            found = exposed(lit, own, "--device", "numpy", stages=stages, out=out, **given)
            assert found[:, 9] == pytest.approx(np.full(20, 0.1 + 0.2 * gain), abs=2e-3)
            assert found[:, 3] == pytest.approx(np.full(20, 0.1), abs=1e-3)


def test_what_is_refused(lit):
    stderr = lit(
        "run",
        "in/f0.exr",
        "-o",
        "x",
        "--set",
        "shutter.flicker_duty=0.2",
        "--set",
        "shutter.flicker_layer=Sun",
        status=1,
    ).stderr
    assert "no layer 'Sun' with a picture; its layers: " in stderr and "Lamp" in stderr
    pipeline = Pipeline(device="numpy", shutter={"flicker_duty": 0.5, "flicker_layer": "Lamp"})
    with pytest.raises(RequestError, match="which an array does not have"):
        pipeline.process(np.ones((4, 4, 3), np.float32), "a")
    wide = ("--set", "projection.method=kannala_brandt", "--set", "shutter.flicker_layer=Lamp")
    wide += ("--set", "shutter.flicker_duty=0.2", "--set", "projection.fx=10")
    stderr = lit("run", "in", "-o", "x", *wide, status=2).stderr
    assert "panoramas have no light layers" in stderr
