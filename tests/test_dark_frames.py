"""Dark noise besides read noise: each distribution, statistically, on dark frames."""

import numpy as np
import pytest
from scipy.ndimage import map_coordinates
from scipy.stats import kurtosis

from clpipe.base.errors import RequestError
from clpipe.camera.profile import load_camera, parse_camera
from clpipe.chain.making import make_chain
from clpipe.chain.settings import settings_from
from clpipe.reference.cfa import PATTERNS
from clpipe.stage import Context

SHAPE = (301, 403)


def dark(develop, stage, key="k", shape=SHAPE, **values):
    """A dark frame through one stage, (height, width)."""
    chain = {"stages": ["mosaic", stage], stage: {"per_electron": 1e-3, **values}}
    if stage != "dark_current":
        chain[stage] = values
    return develop(np.zeros((*shape, 3), np.float32), key, numpy=True, **chain).final


@pytest.mark.parametrize("pattern", PATTERNS)
def test_each_colour_misses_the_black_level_by_its_own(develop, pattern):
    bias = {"R": 0.1, "Gr": 0.2, "Gb": 0.3, "B": 0.4}
    frame = develop(
        np.zeros((6, 8, 3), np.float32),
        "k",
        numpy=True,
        stages=["mosaic", "black_level_error"],
        mosaic={"pattern": pattern},
        black_level_error={"sigma": 0.0, "bias": list(bias.values())},
    ).final
    for k, colour in enumerate(pattern):
        y, x = divmod(k, 2)
        own = ("Gr" if "R" in pattern[2 * y : 2 * y + 2] else "Gb") if colour == "G" else colour
        assert np.all(frame[y::2, x::2] == np.float32(bias[own]))


def test_the_error_of_the_black_level_is_new_in_each_frame_and_colour(develop):
    frames = [
        dark(develop, "black_level_error", f"{k}", (6, 10), sigma=0.01, bias=[0.0] * 4)
        for k in range(400)
    ]
    found = np.array([[f[y, x] for y in (0, 1) for x in (0, 1)] for f in frames], np.float64)
    for frame, (one, two, three, four) in zip(frames, found, strict=True):
        assert np.all(frame == np.tile(np.float32([[one, two], [three, four]]), (3, 5)))
    assert abs(found.mean(0)).max() < 4 * 0.01 / 20
    assert abs(found.std(0) / 0.01 - 1).max() < 4 / np.sqrt(800)
    together = np.corrcoef(found.T) - np.eye(4)
    assert abs(together).max() < 4 / 20


def test_dark_shading_is_smooth_fixed_and_grows_with_the_iso(develop):
    def maps(key="k", camera="sony-a7r2", iso=100, **values):
        frame = np.zeros((600, 900, 3), np.float32)
        chain = {"stages": ["mosaic", "dark_shading"], "camera": camera, "iso": iso}
        return develop(frame, key, numpy=True, dark_shading=values, **chain).final

    fixed = maps(slope=0.0, offset=0.01, length=150.0)
    assert np.array_equal(fixed, maps("another", slope=0.0, offset=0.01, length=150.0))
    assert not np.array_equal(fixed, maps(camera="canon-6d", slope=0.0, offset=0.01, length=150.0))
    assert abs(np.diff(fixed, axis=0)).max() < 0.01 * 0.1 > abs(np.diff(fixed, axis=1)).max()
    low, high = (maps(iso=iso, slope=1e-5, offset=0.01, length=150.0) for iso in (100, 1600))
    slope = (high - low) / 1500
    assert np.allclose(low - 100 * slope, fixed, atol=1e-6)
    # Over many cameras the variance is what was asked for: a smooth map has few samples of its own.
    every = [maps(camera=name, slope=0.0, offset=0.01, length=30.0) for name in CAMERAS]
    assert np.std(every) == pytest.approx(0.01, rel=0.08)
    longer, shorter = (maps(slope=0.0, offset=0.01, length=n) for n in (300.0, 30.0))
    assert np.abs(np.diff(shorter)).mean() > 5 * np.abs(np.diff(longer)).mean()


@pytest.mark.parametrize("size", [(1, 1), (1, 70), (67, 83), (200, 133)])
def test_dark_shading_from_files(develop, write_exr, size):
    random = np.random.default_rng(0)
    k, b = (random.normal(size=(5, 4, 1)).astype(np.float32) for _ in range(2))
    files = {
        "slope_file": str(write_exr("k.exr", k / 100, "Y", half=False)),
        "offset_file": str(write_exr("b.exr", b, "Y", half=False)),
    }
    black = np.zeros((*size, 3), np.float32)
    settings = {"iso": 400, "stages": ["mosaic", "dark_shading"]}
    shading = {"method": "file", "block": 20.0, **files}
    one, two = (
        develop(black, numpy=numpy, dark_shading=shading, **settings).final
        for numpy in (False, True)
    )
    assert np.array_equal(one, two)
    whole = 4 * k[..., 0] + b[..., 0]
    y, x = ((np.arange(n) + 0.5) / 20 - 0.5 for n in size)
    expected = map_coordinates(whole, np.meshgrid(y, x, indexing="ij"), order=1, mode="nearest")
    assert two * 15871 == pytest.approx(expected, abs=1e-4)


def test_files_of_dark_shading_that_do_not_fit(write_exr):
    files = [str(write_exr(f"{n}.exr", np.ones((4, n, 1), np.float32), "Y")) for n in (4, 5)]
    shading = {"method": "file", "slope_file": files[0], "offset_file": files[1]}
    with pytest.raises(RequestError, match="differ in size: 4x4 and 5x4"):
        make_chain(settings_from({"dark_shading": shading}))
    shading["slope_file"] = "nowhere.exr"
    with pytest.raises(RequestError, match=r"slope_file: .*nowhere\.exr"):
        make_chain(settings_from({"dark_shading": shading}))
    nothing = make_chain(settings_from({"dark_shading": {"method": "file"}}))
    assert nothing.step_named("dark_shading").method.passes() == ()


CAMERAS = ("canon-5d2", "canon-6d", "canon-80d", "nikon-d600", "nikon-d800", "sony-a7m2")


def test_dark_current_doubles_and_its_pattern_stays(develop):
    given = {"current": 4.0, "doubling": 6.0, "reference_temperature": 20.0, "per_electron": 1e-3}

    def sigma(**values):
        return dark(develop, "dark_current", **{**given, "spread": 0.0, **values}).std()

    cold = sigma(exposure_time=10.0, temperature=20.0)
    assert cold == pytest.approx(np.sqrt(40) * 1e-3, rel=0.02)
    assert sigma(exposure_time=40.0, temperature=20.0) == pytest.approx(2 * cold, rel=0.02)
    assert sigma(exposure_time=10.0, temperature=32.0) == pytest.approx(2 * cold, rel=0.02)
    assert sigma(exposure_time=0.0) == 0
    spread = {**given, "exposure_time": 100.0, "spread": 0.5}
    one, two = (dark(develop, "dark_current", key, **spread).astype(np.float64) for key in "ab")
    pattern, shot = (one + two) / 2, (one - two) / np.sqrt(2)
    assert shot.std() == pytest.approx(np.sqrt(400) * 1e-3, rel=0.02)
    own = np.sqrt(pattern.var() - shot.var() / 2)
    assert own == pytest.approx(0.5 * 400 * 1e-3, rel=0.03)
    assert abs(pattern.mean()) < 4 * own / np.sqrt(one.size)
    assert np.median(pattern) < 0 < kurtosis(pattern.ravel())  # few pixels are much brighter


def test_dark_current_takes_the_exposure_time_that_is_known():
    metered = {"method": "photometric", "exposure_time": 4.0}
    method = make_chain(settings_from({"exposure": metered})).step_named("dark_current").method
    assert method.exposure_time == 4.0 and not method.passes()  # the camera's current is unknown
    assert make_chain(settings_from({})).step_named("dark_current").method.exposure_time == 0
    values = {"render": {"exposure_time": 2.5}}
    assert make_chain(settings_from(values)).step_named("dark_current").method.exposure_time == 2.5


def test_banding_is_a_wave_of_its_period_with_another_phase_in_each_frame(develop):
    frames = [
        dark(develop, "banding", f"{k}", (512, 3), amplitude=0.01, period=512 / 37)
        for k in range(60)
    ]
    assert all((frame == frame[:, :1]).all() for frame in frames)
    waves = [np.fft.rfft(frame[:, 0].astype(np.float64)) for frame in frames]
    assert all(np.argmax(abs(wave)) == 37 for wave in waves)
    assert np.allclose([abs(wave[37]) / 256 for wave in waves], 0.01, rtol=1e-3)
    mean_phase = abs(np.mean([wave[37] / abs(wave[37]) for wave in waves]))
    assert mean_phase < 0.4  # of 60 even phases: 0.13 in the mean


def test_a_share_of_the_pixels_jumps_between_two_levels_of_its_own(develop):
    frames = np.array(
        [dark(develop, "random_telegraph", f"{k}", share=0.02, amplitude=0.1) for k in range(8)]
    )
    jumps = frames[0] != 0
    assert jumps.mean() == pytest.approx(0.02, abs=4 * np.sqrt(0.02 / jumps.size))
    assert np.all((frames != 0) == jumps)
    levels = np.abs(frames[:, jumps])
    assert np.all(levels == levels[0])
    assert 2 * levels[0].mean() == pytest.approx(0.1, rel=4 / np.sqrt(jumps.sum()))
    assert 2 * levels[0].std() == pytest.approx(0.1, rel=0.15)  # exponential
    up = (frames[:, jumps] > 0).mean()
    assert up == pytest.approx(0.5, abs=2 / np.sqrt(8 * jumps.sum()))


def test_crosstalk_moves_charge_and_keeps_it(develop):
    light = np.random.default_rng(0).random((64, 64, 3), np.float32)
    chain = {"stages": ["mosaic", "crosstalk"], "keep": ("mosaic",)}
    result = develop(light, numpy=True, crosstalk={"share": 0.03}, **chain)
    before, after = result.kept["mosaic"], result.final
    inner = np.s_[1:-1, 1:-1]
    around = before[:-2, 1:-1] + before[2:, 1:-1] + before[1:-1, :-2] + before[1:-1, 2:]
    assert after[inner] == pytest.approx(0.88 * before[inner] + 0.03 * around, abs=1e-6)
    assert after.mean() == pytest.approx(before.mean(), rel=2e-3)


def test_blooming_is_a_streak_along_the_column_and_off_by_default(develop):
    light = np.zeros((41, 21, 3), np.float32)
    light[20, 10] = 8
    chain = {"stages": ["mosaic", "blooming"], "keep": ("mosaic",)}
    result = develop(light, numpy=True, blooming={"method": "column", "full_signal": 1.0}, **chain)
    lit = result.final > 0
    assert lit[:, 10].sum() == 33 and not lit[:, [9, 11]].any()
    assert result.final.max() == 1 and np.all(np.diff(result.final[20:37, 10]) <= 0)
    off = develop(light, numpy=True, **chain)
    assert np.array_equal(off.final, off.kept["mosaic"])


PROFILE = """
name = "mine"
make = "M"
model = "N"
black_level = 64
white_level = 1087
white_balance_gains = [2.0, 1.5]
iso_range = [100, 400]
crosstalk = 0.01
rts_share = 0.01
rts_amplitude = 20.0
dark_current = 3.0
dark_current_doubling = 8.0
dark_shading_slope = 0.001
dark_shading_offset = 0.2
banding_amplitude = 2.0
banding_period = 12.5

[[gain_stages]]
iso = [100, 400]
system_gain = [0.1, 0.4]
read_noise = [1.0, 2.0]
tukey_lambda = [0.1, -0.1]
color_bias = [[1, 0, -1, 0.5], [4, 0, -4, 2]]
black_level_error = [0.1, 0.4]

[sources]
all = "made up"
"""


def test_a_profile_reaches_every_stage():
    camera = parse_camera(PROFILE, "mine.toml")
    context, unit = Context(camera, 200), 1023
    methods = {step.name: step.stage.methods[0]() for step in make_chain(settings_from({})).steps}

    def resolved(stage):
        return methods[stage].resolve(context)

    error = resolved("black_level_error")
    assert error.bias == pytest.approx((2.5 / unit, 0, -2.5 / unit, 1.25 / unit))
    assert error.sigma == pytest.approx(0.2 / unit)
    assert resolved("sensor_noise").tukey_lambda == pytest.approx(0.0, abs=1e-12)
    assert resolved("crosstalk").share == 0.01
    current = resolved("dark_current")
    assert (current.current, current.doubling) == (3.0, 8.0)
    assert current.per_electron == pytest.approx(0.2 / unit)
    shading = resolved("dark_shading")
    assert (shading.slope * unit, shading.offset * unit) == pytest.approx((0.001, 0.2))
    assert resolved("banding").amplitude == pytest.approx(2 * 0.2 / unit)
    assert resolved("banding").period == 12.5
    telegraph = resolved("random_telegraph")
    assert (telegraph.share, telegraph.amplitude) == pytest.approx((0.01, 20 * 0.2 / unit))


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("iso_range", "tukey_lambda = 0.1\niso_range", "set both for every ISO"),
        ("banding_period = 12.5", "", "banding_amplitude needs banding_period"),
        ("rts_amplitude = 20.0", "", "rts_share needs rts_amplitude"),
        ("[0.1, 0.4]\n\n[sources]", "[0.1]\n\n[sources]", "black_level_error must be as long as"),
        ("[1, 0, -1, 0.5]", "[1, 0, -1]", "color_bias"),
    ],
)
def test_a_profile_that_cannot_be_is_refused(old, new, message):
    assert old in PROFILE
    with pytest.raises(RequestError, match=message):
        parse_camera(PROFILE.replace(old, new, 1), "mine.toml")


def test_what_a_profile_does_not_know_costs_nothing():
    chain = make_chain(settings_from({"camera": "sony-a7r2"}))
    names = ("crosstalk", "dark_current", "blooming", "random_telegraph", "dark_shading")
    for name in (*names, "banding", "black_level_error"):
        assert chain.step_named(name).method.passes() == ()
    assert load_camera("sony-a7r2").tukey_lambda_at(3200) is None
