"""shutter, motion_blur and optical_blur: what light falls where, measured on what comes out."""

import numpy as np
import pytest

from clpipe.base.errors import RequestError
from clpipe.chain.files import load_settings
from clpipe.chain.making import make_chain
from clpipe.chain.settings import settings_from
from clpipe.engine.runner import Runner
from clpipe.stages.motion_blur import streak
from clpipe.stages.optical_blur import diffraction_psf, lens_taps, line_spread


def blurred(image, device=None, **stages):
    """Process an image with stages and parameters."""
    chain = make_chain(settings_from({"stages": list(stages), **stages}))
    return Runner(chain, device, encode=False, final=True).run(image, "k").final


def dot(size=65):
    """One bright pixel in the middle."""
    image = np.zeros((size, size, 3), np.float32)
    image[size // 2, size // 2] = 1
    return image


def edge_mtf(picture, slope):
    """The modulation transfer of an almost upright edge at 0.05 to 0.5 cycles a pixel (ISO 12233).

    ``slope`` is how far the edge moves to the right with each row, in px.
    """
    rows, columns = picture.shape
    x = np.arange(columns) - slope * np.arange(rows)[:, None]
    bins = np.round((x - x.mean()) * 4).astype(int)
    bins -= bins.min()
    profile = np.bincount(bins.ravel(), picture.ravel()) / np.bincount(bins.ravel())
    middle = len(profile) // 2
    spread = np.diff(profile[middle - 80 : middle + 81])
    frequency = np.arange(0.05, 0.51, 0.05)
    place = np.arange(len(spread)) / 4
    response = abs(np.exp(-2j * np.pi * frequency[:, None] * place) @ spread) / spread.sum()
    # The edge itself was sampled by pixels' areas, and the profile in bins of a quarter pixel.
    return frequency, response / np.sinc(frequency) / np.sinc(frequency / 4) ** 2


@pytest.mark.parametrize(
    "lens", [{}, {"sigma": 1.3}, {"sigma": 0.5, "low_pass": 0.8, "pixel_area": 1.0}]
)
def test_a_slanted_edge_is_as_sharp_as_the_lens_says(lens):
    slope = 0.117
    # Shares of pixels beyond the edge, worked out on a grid 16 times as fine.
    y, x = (np.arange(200 * 16) + 0.5) / 16, (np.arange(96 * 16) + 0.5) / 16
    beyond = (x > 48 + slope * (y[:, None] - 100)).astype(np.float32)
    edge = beyond.reshape(200, 16, 96, 16).mean((1, 3))[..., None].repeat(3, 2)
    frequency, sharp = edge_mtf(edge[..., 1], slope)
    _, found = edge_mtf(blurred(edge, None, optical_blur=lens)[..., 1], slope)
    light = line_spread(lens.get("sigma", 0.65), lens.get("low_pass", 0), lens.get("pixel_area", 0))
    places = np.arange(len(light)) - len(light) // 2
    expected = np.cos(2 * np.pi * frequency[:, None] * places) @ light
    assert found / sharp == pytest.approx(expected, abs=0.02)


@pytest.mark.slow
def test_light_is_moved_and_none_is_lost(device):
    image = np.random.default_rng(5).random((90, 110, 3), np.float32) ** 4
    image[:40] = image[-40:] = image[:, :40] = image[:, -40:] = 0.25
    for stages in (
        {"optical_blur": {}},
        {"optical_blur": {"sigma": 2.5}},
        {"optical_blur": {"f_number": 16.0}},
        {"motion_blur": {"length": 31.0, "angle": 70.0}},
    ):
        after = blurred(image, device, **stages)
        assert not np.array_equal(after, image)
        assert after.mean((0, 1)) == pytest.approx(image.mean((0, 1)), rel=1e-4)


def test_diffraction_is_widest_in_red_and_has_the_transfer_of_an_aperture():
    spread = diffraction_psf(0, 0, 0, 16.0, 4.5)
    peaks = spread.max((0, 1))
    assert peaks[0] < peaks[1] < peaks[2]
    line = spread[..., 1].sum(0)
    places = np.arange(len(line)) - len(line) // 2
    v = 0.2 * 0.54 * 16 / 4.5
    expected = 2 / np.pi * (np.arccos(v) - v * np.sqrt(1 - v**2)) * np.sinc(0.2)
    assert np.cos(2 * np.pi * 0.2 * places) @ line == pytest.approx(expected, abs=0.02)


def test_a_measured_function_is_seen_around_a_point_of_light(device, write_exr):
    spread = np.random.default_rng(6).random((5, 7, 3)).astype(np.float32)
    spread[..., 2] *= 3  # each channel is scaled to the sum 1
    path = str(write_exr("psf.exr", spread))
    seen = blurred(dot(), device, optical_blur={"psf": path})[30:35, 29:36]
    assert seen == pytest.approx(spread / spread.sum((0, 1)), abs=2e-3)  # but for the thinnest
    assert lens_taps(0.6, 0, 0, 0, 0, path)[:, 2:].sum(0) == pytest.approx(1)


def test_a_streak_is_as_long_and_lies_as_is_said(device):
    seen = blurred(dot(), device, motion_blur={"length": 24.0, "angle": 30.0})[..., 0]
    y, x = np.indices(seen.shape) - 32.0
    along_it = x * np.cos(np.deg2rad(30)) - y * np.sin(np.deg2rad(30))
    across = x * np.sin(np.deg2rad(30)) + y * np.cos(np.deg2rad(30))
    assert (seen * along_it).sum() == pytest.approx(0, abs=0.01)
    assert (seen * along_it**2).sum() == pytest.approx(24**2 / 12, rel=0.02)
    assert (seen * across**2).sum() < 0.4  # bilinear shares
    turned = {"rotation": 1.2, "fx": 24 / np.tan(np.deg2rad(1.2)), "angle": 30.0}
    assert blurred(dot(), None, motion_blur=turned)[..., 0] == pytest.approx(seen, abs=5e-4)
    assert len(streak(200.0, 45.0)) < 600


@pytest.mark.slow
def test_streaks_in_perspective_follow_the_turned_camera(device):
    image = np.zeros((121, 161, 3), np.float32)
    places = [(80, 60), (20, 20), (140, 30), (30, 100)]
    for x, y in places:
        image[y, x] = 1
    turn = {"rotation": 8.0, "angle": 25.0, "fx": 90.0}
    seen = blurred(image, device, motion_blur={"method": "perspective", **turn})[..., 0]
    a = np.deg2rad(25.0)
    way = np.array([np.cos(a), -np.sin(a), 0])
    axis = np.cross(way, [0, 0, 1])
    for x, y in places:
        ray = np.array([x + 0.5 - 80.5, y + 0.5 - 60.5, 90.0])
        angles = np.deg2rad(8.0) * ((np.arange(500) + 0.5) / 500 - 0.5)[:, None]
        # Rodrigues' formula, the ray turning towards `way`.
        turned = ray * np.cos(angles) - np.cross(axis, ray) * np.sin(angles)
        turned += axis * (axis @ ray) * (1 - np.cos(angles))
        path = turned[:, :2] / turned[:, 2:] * 90.0 - ray[:2]
        area = (90.0 / turned[:, 2]) ** 3  # of what is a pixel in the middle of the exposure
        near = seen[y - 18 : y + 19, x - 18 : x + 19]
        dy, dx = np.indices(near.shape) - 18.0
        mean = [np.average(each, weights=near) for each in (dx, dy)]
        assert mean == pytest.approx(np.average(path, 0, area), abs=0.05)
        seconds = [np.average(each, weights=near) for each in (dx**2, dy**2, dx * dy)]
        moments = [(path[:, 0] ** 2), (path[:, 1] ** 2), path[:, 0] * path[:, 1]]
        expected = np.average(moments, 1, area) + np.array([1 / 6, 1 / 6, 0])  # between pixels
        assert seconds == pytest.approx(expected, rel=0.02, abs=0.05)
    straight = {"length": 90 * np.tan(np.deg2rad(8.0)), "angle": 25.0}
    near = np.s_[45:76, 65:96]
    assert seen[near] == pytest.approx(
        blurred(image, motion_blur=straight)[..., 0][near], abs=0.004
    )


@pytest.mark.parametrize("direction", [0.0, 90.0])
def test_a_streak_along_a_line_stays_on_it(direction):
    seen = blurred(dot(9), motion_blur={"length": 4.0, "angle": direction})[..., 0]
    line = seen[4] if direction == 0 else seen[:, 4]
    assert line.sum() == pytest.approx(1)


def test_the_default_has_a_good_lens_and_the_paper_none():
    image = dot()
    assert make_chain(settings_from({})).step_named("optical_blur").method.sigma == 0.65
    paper = make_chain(load_settings("paper"))
    kept = Runner(paper, None, ["exposure"], encode=False).run(image, "k").kept["exposure"]
    assert np.array_equal(kept, image)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("even.exr", "odd sides up to 65 px.*this image is 4x5"),
        ("dark.exr", "dark.exr: every pixel of a channel is 0"),
        ("minus.exr", "minus.exr: a point spread function has no negative values"),
    ],
)
def test_rejected_files(name, message, write_exr, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    write_exr("even.exr", np.ones((5, 4, 3), np.float32))
    write_exr("dark.exr", np.ones((5, 5, 3), np.float32) * np.float32([1, 1, 0]))
    write_exr("minus.exr", np.ones((5, 5, 3), np.float32) * np.float32(-1))
    with pytest.raises(RequestError, match=message):
        make_chain(settings_from({"optical_blur": {"psf": name}}))


def test_rows_see_a_lamp_while_they_are_exposed(device):
    shutter = {
        "exposure_time": 3e-3,
        "line_time": 4e-4,
        "flicker_depth": 0.6,
        "flicker_frequency": 120.0,
        "flicker_phase": 50.0,
    }
    grey = np.full((50, 3, 3), 0.5, np.float32)
    seen = blurred(grey, device, shutter=shutter)
    for row in (0, 7, 49):
        times = row * 4e-4 + (np.arange(1000) + 0.5) * 3e-6
        light = 1 + 0.6 * np.cos(2 * np.pi * 120 * times + np.deg2rad(50))
        assert seen[row] == pytest.approx(0.5 * light.mean(), rel=1e-4)
    steady = blurred(grey, device, shutter={**shutter, "exposure_time": 1 / 60})
    assert steady == pytest.approx(grey, rel=1e-6)  # two periods
