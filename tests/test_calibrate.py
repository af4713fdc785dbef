"""Calibration: it recovers known parameters, and rejects unsuitable frames."""

import numpy as np
import pytest

from clpipe import Pipeline
from clpipe.analysis.calibration.calibrate import ROUNDING, calibrate
from clpipe.analysis.calibration.gain_stages import gain_stages
from clpipe.analysis.calibration.line_fit import Estimate, Line
from clpipe.analysis.calibration.repeats import Sensor
from clpipe.analysis.calibration.result import Calibration
from clpipe.base.errors import ImageError
from clpipe.camera.profile import load_camera
from clpipe.reference.cfa import sites

SENSOR = Sensor("RGGB", 512, 16383)


def scene(height: int = 256, width: int = 384, top: float = 0.7) -> np.ndarray:
    """A static scene, smooth and with edges, from black to bright; signal."""
    y, x = np.mgrid[0:height, 0:width]
    light = (0.5 + 0.5 * np.sin(x / width * 7) * np.cos(y / height * 5)) ** 2 * top
    light[: height // 5] = 0.0002
    light[height // 3 : height // 2, width // 3 : width // 2] *= 0.3
    return light


def frames(
    light: np.ndarray,
    count: int = 8,
    gain: float = 2.0,
    read: float = 2.5,
    row: float = 0.0,
    brightness: np.ndarray | None = None,
    poisson: bool = False,
    seed: int = 0,
    sensor: Sensor = SENSOR,
) -> np.ndarray:
    """Frames in whole DN of a scene in signal: gain in DN/e-, read and row noise in DN."""
    random = np.random.default_rng(seed)
    dn = light * sensor.unit
    found = np.empty((count, *light.shape), np.float32)
    for k, frame in enumerate(found):
        own = dn * (1 if brightness is None else brightness[k])
        shot = (
            random.poisson(own / gain) * gain
            if poisson
            else own + random.standard_normal(own.shape) * np.sqrt(gain * own)
        )
        noise = random.standard_normal(own.shape) * read
        lines = random.standard_normal((len(own), 1)) * row
        dn_of_frame = np.rint(shot + noise + lines + sensor.black_level)
        frame[...] = np.clip(dn_of_frame, 0, sensor.white_level)
    return found


def off(estimate: Estimate | None, truth: float) -> tuple[float, float]:
    """Return the error of an estimate, relative and in standard errors."""
    assert estimate is not None
    return abs(estimate.value / truth - 1), abs(estimate.value - truth) / estimate.error


@pytest.mark.parametrize(("pattern", "iso"), [("RGGB", 100), ("GBRG", 12800)])
def test_what_clpipe_puts_in_comes_back(pattern, iso):
    camera = load_camera("sony-a7r2")
    noise = camera.noise(iso)
    sigma = noise.b**0.5
    row, column = 0.3 * sigma, 0.25 * sigma
    mosaic = scene().astype(np.float32)
    random = np.random.default_rng(iso)
    at = random.choice(mosaic.size, 20, replace=False)
    charge = 40 * np.sqrt(noise.b) * (1 + random.exponential(size=20))
    shots = {}
    for name, light in (("scene", mosaic), ("dark", mosaic * 0)):
        pipeline = Pipeline(
            iso=iso,
            device="numpy",
            start_at="sensor_noise",
            until="quantize",
            mosaic={"pattern": pattern},
            row_noise={"sigma": row},
            column_noise={"sigma": column},
            sensor_noise={"method": "gaussian", "a": noise.a, "b": noise.b},
        )
        with_hot = light.copy()
        with_hot.ravel()[at] += charge.astype(np.float32)
        shots[name] = np.stack(
            [pipeline.process(with_hot, name, noise_key=name, seed=k).image for k in range(8)]
        )
    sensor = Sensor(pattern, camera.black_level, camera.white_level)
    # The realised pattern of the columns, from the stage itself.
    columns = Pipeline(
        device="numpy", start_at="column_noise", until="column_noise", column_noise={"sigma": 1.0}
    ).process(np.zeros((1, mosaic.shape[1]), np.float32), "any")
    found = calibrate(iso, shots["scene"], shots["dark"], sensor)
    record = found.pooled.record(sensor.unit)
    for key, truth in (("a", noise.a), ("b", noise.b)):
        relative, errors = off(Estimate(**_plain(record[key])), truth)
        assert relative < 0.01 and errors < 3, key
    for name in ("R", "G1", "G2", "B"):
        assert off(found.lines[name].gain, noise.a * sensor.unit)[1] < 4.5, name
    assert off(found.row_noise, row * sensor.unit)[0] < 0.03
    assert off(found.column_noise, columns.image[0].std() * column * sensor.unit)[0] < 0.03
    hot = np.zeros(mosaic.shape, bool)
    hot[found.hot.rows, found.hot.columns] = True
    assert set(np.flatnonzero(hot)) == set(at)
    assert found.notes == ()


def _plain(record):
    return {"value": record["value"], "error": record["error"]}


@pytest.mark.slow
def test_standard_errors_are_the_scatter_of_repetitions():
    light = scene(64, 96)
    found = [calibrate(100, frames(light, 4, row=0.8, seed=s), None, SENSOR) for s in range(60)]
    for get in (
        lambda c: c.pooled.gain,
        lambda c: c.pooled.floor,
        lambda c: c.lines["G1"].gain,
        lambda c: c.row_noise,
    ):
        estimates = [get(c) for c in found]
        scatter = np.std([e.value for e in estimates], ddof=1)
        assert np.mean([e.error for e in estimates]) == pytest.approx(scatter, rel=0.15)
    gains = np.array([c.pooled.gain.value for c in found])
    assert abs(gains.mean() - 2.0) < 3 * gains.std() / len(gains) ** 0.5
    floors = np.array([c.pooled.floor.value for c in found])
    assert abs(floors.mean() - 6.25) < 3 * floors.std() / len(floors) ** 0.5


@pytest.mark.slow
def test_two_noisy_frames_give_no_flat_line():
    # The mean of two frames is as noisy as can be; a plain least-squares line through it would be
    # several per cent too flat.
    light = np.full((256, 256), 0.1)
    light[:, 128:] = 0.02
    many = [
        calibrate(100, frames(light, 2, 40.0, 40.0, poisson=True, seed=s), None, SENSOR)
        for s in range(15)
    ]
    gains = np.array([c.pooled.gain.value for c in many])
    assert abs(gains.mean() / 40 - 1) < 3 * gains.std() / 40 / len(gains) ** 0.5
    assert abs(gains.mean() / 40 - 1) < 0.01


@pytest.mark.slow
def test_b_is_the_noise_before_rounding():
    found = calibrate(100, frames(scene(), 8, 0.3, 0.7), frames(scene() * 0, 8, 0.3, 0.7, seed=1),
                      SENSOR)  # fmt: skip
    assert off(found.pooled.floor, 0.49)[0] < 0.01
    coarse = calibrate(100, frames(scene(), 8, 0.3, 0.2), frames(scene() * 0, 8, 0.3, 0.2, seed=1),
                       SENSOR)  # fmt: skip
    assert any("below 0.4 DN of noise" in note for note in coarse.notes)
    assert calibrate(100, frames(scene()), None, SENSOR, whole=False).rounding == 0
    assert found.rounding == ROUNDING


@pytest.mark.slow
def test_dark_frames_give_columns_dsnu_and_the_black_level():
    random = np.random.default_rng(1)
    light = scene()
    columns = random.standard_normal(light.shape[1])
    pixels = random.standard_normal(light.shape) * 1.5
    pattern = (columns + pixels).astype(np.float32)
    dark = np.rint(frames(light * 0, 16, seed=1) + pattern + 3)
    shots = np.rint(frames(light, 6, seed=2) + pattern + 3)
    found = calibrate(800, shots, dark, SENSOR)
    assert off(found.column_noise, columns.std())[0] < 0.03
    assert off(found.dsnu, 1.5)[0] < 0.02
    assert any("the mean of dark frames is 51" in note for note in found.notes)
    # Another rounding went over the frames: that of the pattern.
    assert off(found.pooled.floor, 2.5**2 + ROUNDING)[0] < 0.02
    assert off(found.pooled.gain, 2)[0] < 0.01
    one = calibrate(800, frames(light, 6, seed=2), dark[:1], SENSOR)
    assert off(one.column_noise, columns.std())[0] < 0.1
    assert one.row_noise is not None and one.dsnu is not None


@pytest.mark.slow
def test_prnu_of_a_flat_scene_only():
    random = np.random.default_rng(2)
    response = 1 + 0.006 * random.standard_normal((256, 384))
    flat = np.linspace(0.3, 0.4, 384) * np.ones((256, 1))
    dark = frames(flat * 0, 4, seed=9)
    found = calibrate(100, frames(flat * response, 8), dark, SENSOR)
    assert off(found.prnu, 0.006)[0] < 0.03
    assert calibrate(100, frames(flat, 8), dark, SENSOR).prnu is None
    texture = scene() * (1 + 0.1 * np.repeat(np.repeat(random.random((128, 192)), 2, 0), 2, 1))
    assert calibrate(100, frames(texture, 8), dark, SENSOR).prnu is None


def test_dead_pixels_are_found_where_there_is_light():
    light = scene()
    random = np.random.default_rng(3)
    lit = np.flatnonzero(light > 0.1)
    at = random.choice(lit, 12, replace=False)
    light.ravel()[at] = 0
    found = calibrate(100, frames(light), None, SENSOR)
    assert set(found.dead.rows * 384 + found.dead.columns) == set(at)
    assert 0.5 < found.dead.seen_on < 1


def test_hot_pixels_of_a_scene():
    light = scene()
    at = np.random.default_rng(4).choice(light.size, 12, replace=False)
    light.ravel()[at] += 0.2
    found = calibrate(100, frames(light), None, SENSOR)
    assert set(found.hot.rows * 384 + found.hot.columns) == set(at)
    assert any("found in the scene" in note for note in found.notes)


@pytest.mark.slow
def test_clipped_pixels_do_not_bend_the_line():
    found = calibrate(100, frames(scene(top=2.0)), None, SENSOR)
    assert off(found.pooled.gain, 2)[0] < 0.01 and off(found.pooled.gain, 2)[1] < 3
    assert 0.3 < found.used < 0.9
    # A sensor that clips below the white level that its files name.
    low = np.minimum(frames(scene(top=2.0)), 12000)
    found = calibrate(100, low, None, SENSOR)
    assert off(found.pooled.gain, 2)[0] < 0.01
    assert any("clip at 12000 DN" in note for note in found.notes)
    # And one that clips black: b is not pulled down.
    dim = Sensor("RGGB", 5, 4095)
    found = calibrate(100, frames(scene(), sensor=dim, read=3.0), None, dim)
    assert off(found.pooled.gain, 2)[0] < 0.01


@pytest.mark.slow
def test_a_wrong_black_level_and_a_bent_response_are_told():
    shots = frames(scene())
    wrong = calibrate(100, shots.copy(), None, Sensor("RGGB", 480, 16383))
    assert any("b is below zero" in note for note in wrong.notes)
    light = shots - 512
    bent = np.rint(512 + np.where(light > 4000, 4000 + (light - 4000) * 0.6, light))
    found = calibrate(100, bent.astype(np.float32), None, SENSOR)
    assert any("from the line at" in note for note in found.notes)


@pytest.mark.slow
def test_a_lamp_may_flicker_and_no_more():
    brightness = 1 + 0.01 * np.random.default_rng(5).standard_normal(8)
    found = calibrate(100, frames(scene(), brightness=brightness), None, SENSOR)
    assert any("flickers" in note for note in found.notes)
    assert off(found.pooled.gain, 2)[0] < 0.01 and off(found.pooled.gain, 2)[1] < 3
    assert calibrate(100, frames(scene()), None, SENSOR).notes == ()
    brightness[3] = 1.3
    with pytest.raises(ImageError, match=r"ISO 100: frame 4 of 8 is \+2\d% from the mean"):
        calibrate(100, frames(scene(), brightness=brightness), None, SENSOR)


def test_a_scene_that_moves_is_refused():
    light = scene()
    moved = [frames(np.roll(light, k // 2, axis=1), 1, seed=k)[0] for k in range(6)]
    with pytest.raises(ImageError, match=r"ISO 400: the frames do not show the same.*% of the pix"):
        calibrate(400, np.stack(moved), None, SENSOR)
    part = frames(light, 6)
    part[5, 100:120, 100:120] += 400  # something small passes by
    with pytest.raises(ImageError, match="do not show the same"):
        calibrate(400, part, None, SENSOR)


@pytest.mark.slow
def test_a_picture_without_noise_among_the_frames_is_refused():
    shots = np.concatenate([frames(scene(), 6), frames(scene(), 1, gain=1e-6, read=0.0)])
    with pytest.raises(
        ImageError, match=r"frame 7 of 7 .* has 0\.\d+ times the variance of the other"
    ):
        calibrate(100, shots, None, SENSOR)
    dark = np.concatenate([frames(scene() * 0, 4), frames(scene() * 0, 1, read=0.3)])
    with pytest.raises(ImageError, match="dark frame 5 of 5"):
        calibrate(100, frames(scene()), dark, SENSOR)


def test_frames_that_cannot_tell_are_refused():
    whole = frames(scene())
    with pytest.raises(ImageError, match="frames 1 and 3 are identical"):
        calibrate(100, whole[[0, 1, 0]], None, SENSOR)
    with pytest.raises(
        ImageError, match=r"ISO 100: \d+% of the pixels, or their noise, are clipped"
    ):
        calibrate(100, frames(scene() + 1.5), None, SENSOR)
    falling = frames(scene())
    light = scene()[sites(SENSOR.pattern)["G2"]]
    quieter = np.random.default_rng(6).standard_normal((8, *light.shape)) * (200 - 250 * light)
    falling[(slice(None), *sites(SENSOR.pattern)["G2"])] = np.rint(
        600 + light * SENSOR.unit + quieter
    )
    with pytest.raises(ImageError, match="ISO 100: channel G2: variance does not rise with light"):
        calibrate(100, falling, None, SENSOR)
    flat = frames(np.full((64, 64), 0.001), 4, gain=0.1)
    with pytest.raises(ImageError, match=r"too little light|does not rise"):
        calibrate(100, flat, None, SENSOR)


@pytest.mark.slow
def test_a_single_image_with_dark_frames():
    dark = frames(scene(384, 512) * 0, 4, 5.0, 5.3, row=2.65, seed=2)
    found = calibrate(100, frames(scene(384, 512), 1, 5.0, 5.3), dark, SENSOR)
    assert off(found.read_noise, 5.3)[0] < 0.01
    assert off(found.row_noise, 2.65)[0] < 0.05


@pytest.mark.slow
def test_a_single_image_that_clips_and_has_rows():
    found = calibrate(100, frames(scene(384, 512, top=1.5), 1, 40.0, 41.0, row=30), None, SENSOR)
    assert off(found.pooled.gain, 40)[0] < 0.08
    assert off(found.read_noise, 41)[0] < 0.15


def test_a_single_image_with_nothing_smooth_is_refused():
    noise = np.random.default_rng(0).random((1, 64, 64)).astype(np.float32) * 9000 + 600
    with pytest.raises(ImageError, match="ISO 100: the image has too few smooth areas"):
        calibrate(100, noise, None, SENSOR)


def calibration(iso: float, gain: float, read: float) -> Calibration:
    line = Line(Estimate(gain, gain * 1e-3), Estimate(read**2, read**2 * 1e-2), 1000)
    return Calibration(iso, SENSOR, 8, 0, {}, line, {}, 1000, 1.0, ROUNDING)


@pytest.mark.parametrize("every", [1, 2, 4])
def test_gain_stages_are_cut_where_the_conversion_gain_changes(every):
    stages = load_camera("sony-a7r2").gain_stages
    found = [
        calibration(*row)
        for stage in stages
        for row in list(zip(stage.iso, stage.system_gain, stage.read_noise, strict=True))[::every]
    ]
    cut = gain_stages(found[::-1])
    assert [[c.iso for c in stage] for stage in cut] == [
        list(stage.iso[::every]) for stage in stages
    ]


def test_one_gain_stage_stays_whole():
    reads = [(100, 0.3, 1.4), (200, 0.6, 1.5), (400, 1.2, 2.0), (800, 2.4, 3.3), (3200, 9.6, 12.0)]
    assert len(gain_stages([calibration(*row) for row in reads])) == 1
