"""Denoising over time: a stage with state, on frames of a sequence."""

import numpy as np
import pyopencl as cl
import pytest

import clpipe
from clpipe.base.errors import DeviceFailedError, ImageError
from clpipe.chain.making import make_chain
from clpipe.chain.settings import settings_from
from clpipe.engine.device import Device
from clpipe.engine.ir import Launch
from clpipe.engine.ops import FrameKind
from clpipe.engine.options import RunOptions
from clpipe.engine.plan import make_plan
from clpipe.engine.runner import Runner
from clpipe.engine.state import State
from clpipe.reference.image import tap
from clpipe.stages import DEFAULT_CHAIN
from tests.conftest import fail_launches

STAGE = "temporal_denoise"
METHODS = ["recursive", "block_matching", "flow"]  # flow is 0 without a layer
LONG = [*DEFAULT_CHAIN]
LONG.insert(LONG.index("denoise"), STAGE)


def chain_of(stages=(STAGE,), **parameters):
    """Return a chain of stages, with parameters of temporal_denoise."""
    return make_chain(settings_from({"iso": 3200, "stages": [*stages], STAGE: parameters}))


def results(runner, frames, **options):
    """Return the results of the frames of a sequence."""
    state = State()
    return [
        runner.run(each, str(n), RunOptions(state=state, **options))
        for n, each in enumerate(frames)
    ]


def moving(size, count=3):
    """Return noisy float32 frames of a texture whose left half moves by a pixel each."""
    rng = np.random.default_rng(0)
    still = rng.random((*size, 3)) ** 2 * 1.4 - 0.05
    frames = [still + 0.01 * rng.normal(size=still.shape) for _ in range(count)]
    for number, frame in enumerate(frames):
        frame[:, : size[1] // 2] = np.roll(frame[:, : size[1] // 2], number, axis=1)
    return [frame.astype(np.float32) for frame in frames]


def test_single_images_and_first_frames_do_not_change(device):
    image = moving((16, 24), 1)[0]
    for runner in (Runner(chain_of(), each, encode=False, final=True) for each in (device, None)):
        np.testing.assert_array_equal(runner.run(image, "").final, image)
        np.testing.assert_array_equal(results(runner, [image])[0].final, image)


def test_a_frame_of_another_size_starts_again(device):
    small, large = moving((16, 24), 1)[0], moving((20, 24), 1)[0]
    for each in (device, None):
        runner = Runner(chain_of(), each, encode=False, final=True)
        found = results(runner, [small, large, large * np.float32(0.999), small])
        np.testing.assert_array_equal(found[1].final, large)
        assert not np.array_equal(found[2].final, large * np.float32(0.999))
        np.testing.assert_array_equal(found[3].final, small)


def test_two_sequences_do_not_mix(device):
    frames = moving((16, 24))
    runner = Runner(chain_of(), device, encode=False, final=True)
    expected = results(runner, frames)
    one, two = State(), State()
    for number, frame in enumerate(frames):
        runner.run(frame[::-1].copy(), "", RunOptions(state=two))
        found = runner.run(frame, "", RunOptions(state=one))
        np.testing.assert_array_equal(found.final, expected[number].final)


def test_a_stream_averages_its_frames(device):
    image = np.full((40, 60, 3), 0.2, np.float32)
    options = {"device": device.info.index, "iso": 6400, "stages": LONG}
    with clpipe.Stream(**options) as stream:
        shots = [stream(image) for _ in range(6)]
    assert shots[-1].image.std() < 0.8 * shots[0].image.std()


def test_plans_of_single_images_have_no_trace_of_the_stage():
    plans = {frame: make_plan(chain_of(LONG), frame=frame) for frame in FrameKind}
    launches = {
        frame: [op.step for x in plan.launches if isinstance(x, Launch) for op in x.ops]
        for frame, plan in plans.items()
    }
    assert STAGE not in launches[FrameKind.SINGLE]
    assert STAGE not in launches[FrameKind.FIRST]
    assert launches[FrameKind.LATER].count(STAGE) == 1
    assert plans[FrameKind.SINGLE].states == ()
    (_, no_image, first), (_, before, after) = (
        plans[each].states[0] for each in (FrameKind.FIRST, FrameKind.LATER)
    )
    assert no_image is None
    assert plans[FrameKind.FIRST].border == plans[FrameKind.LATER].border
    slots = [plans[FrameKind.LATER].slots[image.number] for image in (before, after)]
    assert not set(slots[0]) & set(slots[1])
    assert plans[FrameKind.FIRST].slots[first.number]


def test_a_failure_ends_its_sequence_and_no_other(device, monkeypatch):
    own = Device(device.info)
    frames = moving((16, 24))
    runner = Runner(chain_of(), own, encode=False, final=True)
    runner.run(frames[0], "")
    state = State()
    runner.run(frames[0], "", RunOptions(state=state))
    with monkeypatch.context() as patch:
        fail_launches(patch, cl.RuntimeError("clEnqueue failed"), 0)
        with pytest.raises(DeviceFailedError, match="failed: clEnqueue failed"):
            runner.run(frames[1], "", RunOptions(state=state))
    with pytest.raises(DeviceFailedError, match=r"earlier frame of this sequence.* again"):
        runner.run(frames[2], "", RunOptions(state=state))
    expected = results(Runner(chain_of(), device, encode=False, final=True), frames)
    for one, two in zip(results(runner, frames), expected, strict=True):
        np.testing.assert_array_equal(one.final, two.final)


def test_a_device_that_was_opened_again_has_lost_the_state(device):
    own = Device(device.info)
    frames = moving((16, 24))
    runner, state = Runner(chain_of(), own, encode=False, final=True), State()
    runner.run(frames[0], "", RunOptions(state=state))
    own.reopen()
    with pytest.raises(DeviceFailedError, match="earlier frame of this sequence"):
        runner.run(frames[1], "", RunOptions(state=state))


def test_a_frame_that_needs_tiles_is_rejected(device):
    image = np.full((300, 400, 3), 0.2, np.float32)
    small = Device(device.info, memory=2**20)
    runner = Runner(chain_of(), small, encode=False, final=True)
    assert runner.run(image, "").final.shape == image.shape  # a single image is cut into tiles
    with pytest.raises(ImageError, match=r"400x300 pixels: temporal_denoise cannot .* --memory"):
        runner.run(image, "", RunOptions(state=State()))


def test_the_clean_truth_has_no_temporal_denoising():
    clean = chain_of(LONG).without_noise_or_denoising()
    assert clean.step_named(STAGE).passes == ()
    assert chain_of(frames=1.0).step_named(STAGE).passes == ()


def variance_at(chain, level):
    """Return the variance of red, green and blue that the stage expects at a level."""
    a, b = chain.steps[0].context.noise_parameters()
    red, blue = chain.steps[0].context.applied_gains
    gains = np.array([red, 1.0, blue])
    return a * gains * level + b * gains**2


def noisy(clean, chain, rng):
    """Return an image with the white noise that the stage expects."""
    return (clean + np.sqrt(variance_at(chain, clean)) * rng.normal(size=clean.shape)).astype(
        np.float32
    )


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("frames", [4.0, 8.0])
@pytest.mark.parametrize("level", [0.02, 0.5])
def test_noise_of_static_fields_follows_the_formulas(device, method, frames, level):
    chain, rng = chain_of(method=method, frames=frames), np.random.default_rng(1)
    clean = np.full((120, 160, 3), level)
    found = results(
        Runner(chain, device, encode=False, final=True),
        [noisy(clean, chain, rng) for _ in range(int(5 * frames))],
    )
    *_, before, last = [result.final - clean for result in found]
    np.testing.assert_allclose(last.var((0, 1)) * frames, variance_at(chain, level), rtol=0.07)
    correlation = (before * last).mean() / (before.std() * last.std())
    assert correlation == pytest.approx((frames - 1) / (frames + 1), abs=0.02)


def ghost_of_edge(device, step, noises=6, **parameters):
    """Return the share of an edge's contrast that remains where it was.

    The contrast is a multiple of the noise.

    The bright side moves by ``step`` pixels to the right in each frame.
    """
    chain, rng = chain_of(**parameters), np.random.default_rng(2)
    contrast = noises * np.sqrt(variance_at(chain, 0.3))
    edges = [20 + step * n for n in range(30)]
    cleans = [np.full((160, 120, 3), 0.2) for _ in edges]
    for edge, clean in zip(edges, cleans, strict=True):
        clean[:, :edge] += contrast
    frames = [noisy(clean, chain, rng) for clean in cleans]
    found = results(Runner(chain, device, encode=False, final=True), frames)
    ghosts = [
        (found[n].final - cleans[n])[:, edges[n - 1] : edges[n]].mean((0, 1)) / contrast
        for n in range(10, 30)
    ]
    return np.abs(np.mean(ghosts, axis=0)).max()


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("step", [1, 3])
def test_a_moving_edge_leaves_no_ghost(device, method, step):
    assert ghost_of_edge(device, step, method=method) < 0.02


def test_faint_edges_leave_a_faint_ghost(device):
    assert ghost_of_edge(device, 3, noises=1.5) < 0.25
    assert ghost_of_edge(device, 3, noises=1.5, threshold=2.5) > 0.4
    assert ghost_of_edge(device, 3, noises=1.5, method="block_matching") < 0.25


@pytest.mark.parametrize("period", [3, 4, 8])
@pytest.mark.parametrize("noises", [1, 2, 6])
def test_a_moving_grating_is_not_smeared(device, period, noises):
    chain, rng = chain_of(), np.random.default_rng(4)
    wave = noises * np.sqrt(variance_at(chain, 0.3))
    x = np.arange(120)[None, :, None] * np.ones((80, 1, 1))
    cleans = [0.3 + wave * np.sin(2 * np.pi * (x - 2 * n) / period) for n in range(12)]
    frames = [noisy(clean, chain, rng) for clean in cleans]
    last = results(Runner(chain, device, encode=False, final=True), frames)[-1].final
    assert (last - cleans[-1]).var() < 1.1 * (frames[-1] - cleans[-1]).var()


def test_without_the_threshold_a_ghost_remains(device):
    assert ghost_of_edge(device, 1, threshold=100.0) > 0.5


def test_block_matching_keeps_averaging_what_moves(device):
    """Only the texture's own motion is compensated, so its noise falls as in static areas."""
    rng = np.random.default_rng(3)
    texture = rng.random((90, 120, 3)) * 0.4 + 0.1
    noise = {}
    for method in METHODS:
        chain = chain_of(method=method)
        cleans = [tap(texture, 2 * n, -n) for n in range(12)]
        frames = [noisy(clean, chain, np.random.default_rng(n)) for n, clean in enumerate(cleans)]
        last = results(Runner(chain, device, encode=False, final=True), frames)[-1].final
        inner = np.s_[20:-20, 30:-30]
        noise[method] = (last - cleans[-1])[inner].var() / (frames[-1] - cleans[-1])[inner].var()
    assert noise["recursive"] > 0.9 and noise["flow"] > 0.9
    assert noise["block_matching"] < 0.3
