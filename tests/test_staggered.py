"""Staggered exposures in changing light: sub-frames, rows, flicker."""

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from clpipe.base.errors import RequestError
from clpipe.chain.exposures import exposures_of
from clpipe.chain.making import make_chain
from clpipe.chain.settings import settings_from
from clpipe.dataset import Dataset
from clpipe.engine.check import difference
from clpipe.engine.options import RunOptions
from clpipe.engine.runner import Runner
from clpipe.stage import Span
from clpipe.stages.shutter import Rows

# The first exposure covers four of seven frames, the second two, and the last one.
STAGGERED = {"method": "staggered", "count": 3, "ratio": 2.0}
SPANS = (Span(0, 1), Span(1, 0.5), Span(1.5, 0.25))
BAR = 3.0


def chain_of(*stages, iso=400, **settings):
    noise = {**STAGGERED, **settings.pop("sensor_noise", {})}
    all_stages = [*stages, "shutter", "mosaic", "sensor_noise"]
    own = {"stages": all_stages, "iso": iso, "sensor_noise": noise, **settings}
    return make_chain(settings_from(own))


def merged(exposures):
    """The merging of exposures without noise, written down once more: (3, ...) to (...)."""
    *first, result = [np.minimum(e * 2.0**-i, 1) * 2.0**i for i, e in enumerate(exposures)]
    for i, own in reversed(list(enumerate(first))):
        weight = np.clip((0.95 - own * 2.0**-i) / 0.1, 0, 1)
        result = weight * own + (1 - weight) * result
    return result


def bar(number):
    """A bar of 12 columns that moves by two columns a frame."""
    row = np.full(40, 0.1)
    row[2 * number : 2 * number + 12] = BAR
    return row


def means(*frames):
    return np.mean([bar(number) for number in frames], axis=0)


@pytest.fixture
def frames(tmp_path, write_exr, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for number in range(7):
        image = np.broadcast_to(bar(number)[None, :, None], (24, 40, 3))
        write_exr(f"in/f{number}.exr", image, half=False)


RUN = ("run", "in", "--stages", "shutter,mosaic,sensor_noise", "--format", "npy", "--iso", "400")
SET = {"shutter.subframes": 7, **{f"sensor_noise.{k}": v for k, v in STAGGERED.items()}}
RUN += ("--device", "numpy")  # which the kernel is held against below
RUN += tuple(x for key, value in SET.items() for x in ("--set", f"{key}={value}"))
CLEAN = ("--set", "sensor_noise.a=0", "--set", "sensor_noise.b=0")


def test_each_exposure_sees_its_own_frames(frames, clpipe):
    expected = [means(0, 1, 2, 3), means(4, 5), means(6)]
    for part, own in enumerate(expected):
        clpipe(*RUN, *CLEAN, "-o", f"p{part}", "--set", f"sensor_noise.part={part}")
        found = np.load(f"p{part}/f0.npy")
        clipped = np.minimum(own, 2**part)
        assert found == pytest.approx(np.tile(clipped, (24, 1)), abs=2**part * 1e-4)
    clpipe(*RUN, *CLEAN, "-o", "o")
    row = np.load("o/f0.npy")[11]
    assert row == pytest.approx(merged(expected), abs=3e-4)
    # Where the first exposure is white, the bar has the edges of the shorter exposures. It begins
    # at column 12, like in the last exposure.
    assert row[6:8] == pytest.approx(0.1, abs=1e-3)
    assert row[12:16] == pytest.approx(BAR, abs=1e-3)
    assert row[18:] == pytest.approx(0.1, abs=1e-3)  # no light from after the first exposure
    (record,) = [json.loads(path.read_text()) for path in Path("o").glob("*.json")]
    assert len(record["subframes"]) == 7


def test_truth_and_samples_have_the_same_motion(frames, clpipe):
    clpipe(*RUN, "-o", "o", "--truth", "clean")
    expected = np.tile(merged([means(0, 1, 2, 3), means(4, 5), means(6)]), (24, 1))
    noisy, clean = (np.load(f"o/{name}.npy") for name in ("f0", "f0.truth_clean"))
    assert clean == pytest.approx(expected, abs=1e-5)
    assert 0.001 < np.abs(noisy - clean)[:, 20:].std() < 0.02
    options = {"shutter": {"subframes": 7}, "sensor_noise": STAGGERED, "iso": 400}
    (sample,) = Dataset("in", device="numpy", truth="clean", **options)
    clpipe("run", "in", "-o", "d", *RUN[6:], "--format", "png")
    assert np.array_equal(sample["image"], np.asarray(Image.open("d/f0.png")))


def test_rows_roll_in_each_exposure(frames, clpipe):
    # The shutter rolls over the rows during the last 4 of 11 parts of the time. So frames are
    # 11/7 s long, and the last row is exposed 4 s later.
    times = ("--set", "shutter.exposure_time=4", "--set", f"shutter.line_time={4 / 23}")
    clpipe(*RUN, *CLEAN, "-o", "o", *times, "--set", "sensor_noise.part=2")
    found = np.load("o/f0.npy")
    for row in (0, 10, 23):
        start = 6 + row * 4 / 23  # s; the last exposure is 1 s long, and a frame 11/7 s
        shares = np.diff(np.clip(np.arange(8) * 11 / 7, start, start + 1))
        expected = np.minimum(sum(w * bar(k) for k, w in enumerate(shares)), 4)
        assert found[row] == pytest.approx(expected, abs=1e-3)


def test_shares_of_frames_are_those_of_time():
    shutter = Rows(subframes=5, exposure_time=0.01, line_time=1e-3)
    time = (np.arange(400_000) + 0.5) / 400_000 * (0.01 * 1.75 + 8e-3)
    frame = (time / time[-1] * 4.9999).astype(int)
    for number, span in enumerate(SPANS):
        weights = shutter.for_exposure(SPANS, number).weights(5, 9)
        for row in (0, 5, 8):
            begins = row * 1e-3 + 0.01 * span.start
            seen = (time >= begins) & (time < begins + 0.01 * span.length)
            expected = [(frame[seen] == k).mean() for k in range(5)]
            assert weights[:, row] == pytest.approx(expected, abs=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("is_clean", [False, True])
def test_the_kernel_merges_as_numpy(device, scalar_device, is_clean):
    chain = chain_of(shutter={"subframes": 3}, sensor_noise={"later_noise": 1.5})
    chain = chain.without_noise() if is_clean else chain
    random = np.random.default_rng(0)
    for size in ((1, 1), (1, 9), (11, 1), (2, 3), (37, 53)):
        image, *later = (random.random((3, *size, 3)) ** 3 * 6).astype(np.float32)
        options = RunOptions(later_exposures=later)
        on = {d: Runner(chain, d, encode=False, final=True) for d in (device, scalar_device, None)}
        results = {d: runner.run(image, "k", options).final for d, runner in on.items()}
        assert difference(results[device], results[None]).largest == 0
        assert difference(results[scalar_device], results[None]).largest == 0


@pytest.mark.slow
def test_without_change_it_is_as_without_time():
    image = (np.random.default_rng(1).random((20, 30, 3)) * 6).astype(np.float32)
    still, timed = (chain_of(shutter={"subframes": n}) for n in (1, 2))
    assert exposures_of(still) is None
    assert exposures_of(timed).spans == SPANS
    one, two = (Runner(c, None, encode=False, final=True).run(image, "k") for c in (still, timed))
    assert np.array_equal(one.final, two.final)


@pytest.mark.slow
def test_a_lamp_flickers_in_each_exposure(develop):
    lamp = {"exposure_time": 4e-3, "flicker_depth": 0.5, "flicker_frequency": 100.0}
    given = {"stages": ["shutter", "mosaic", "sensor_noise"], "iso": 400, "shutter": lamp}
    time = (np.arange(7000) + 0.5) * 1e-6
    light = 1 + 0.5 * np.cos(2 * np.pi * 100 * time)
    for part, span in enumerate(SPANS):
        noise = {**STAGGERED, "part": part, "a": 0.0, "b": 0.0}
        grey = np.full((2, 2, 3), 0.4, np.float32)
        found = develop(grey, numpy=True, sensor_noise=noise, **given).final
        seen = (time >= span.start * 4e-3) & (time < span.end * 4e-3)
        assert found == pytest.approx(np.full((2, 2), 0.4 * light[seen].mean()), abs=4e-4)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"exposure": {"method": "auto"}}, "this method would measure each exposure"),
        ({"start_at": "mosaic"}, "an image that starts at mosaic shows only one"),
    ],
)
def test_what_is_refused(settings, message):
    start = settings.pop("start_at", None)
    stages = ["shutter", "exposure", "mosaic", "sensor_noise"]
    own = {"stages": stages, "sensor_noise": STAGGERED, "shutter": {"subframes": 7}, **settings}
    with pytest.raises(RequestError, match=message):
        make_chain(settings_from(own), start_at=start)


def test_a_variance_is_not_known(frames, clpipe):
    stderr = clpipe(*RUN, "-o", "o", "--truth", "variance", status=2).stderr
    assert "sensor_noise (staggered) cannot compute the variance" in stderr
