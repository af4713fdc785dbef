"""Denoising over time along an optical flow: from arrays, and from the layers of renders."""

import json

import numpy as np
import OpenEXR
import pytest

import clpipe
from clpipe.base.errors import ImageError
from clpipe.chain.layers import layer_of, layer_of_array, with_layers
from clpipe.chain.making import make_chain
from clpipe.chain.settings import settings_from
from clpipe.engine.options import RunOptions
from clpipe.engine.runner import Runner
from clpipe.engine.state import State
from clpipe.images.read import read_image
from tests.test_temporal import LONG, STAGE, chain_of, moving, noisy

MOVE = np.array([1.3, -0.6])  # px of a texture in each frame, to the right and down


def flow_of(size, vector):
    """Return a flow of one vector, (height, width, 2)."""
    return np.broadcast_to(np.float32(vector), (*size, 2))


def along(chain, frames, flows, device, **options):
    """Return the results of frames with their flows."""
    state, found = State(), []
    for frame, flow in zip(frames, flows, strict=True):
        layers = {STAGE: layer_of_array(chain, STAGE, flow, *frame.shape[1::-1])}
        own = Runner(with_layers(chain, layers), device, encode=False, final=True, **options)
        found.append(own.run(frame, "key", RunOptions(state=state)).final)
    return found


def fractional(size, seed):
    """Return a flow of random fractions; some places are outside the image or not known."""
    rng = np.random.default_rng(seed)
    flow = rng.normal(0, 4, (*size, 2)).astype(np.float32)
    flow[rng.random(size) < 0.1] = np.nan
    flow[rng.random(size) < 0.1] = 3e38
    flow[rng.random(size) < 0.1] = 0, -0.5  # up to the edge of the first row's pixels
    return flow


def test_the_kernel_is_the_reference(device, scalar_device):
    chain = chain_of(method="flow", threshold=100.0)
    for size in ((1, 1), (1, 9), (11, 1), (2, 3), (37, 53)):
        frames = moving(size)
        flows = [fractional(size, seed) for seed in range(len(frames))]
        expected = along(chain, frames, flows, None)
        for each in (device, scalar_device):
            for one, two in zip(along(chain, frames, flows, each), expected, strict=True):
                np.testing.assert_array_equal(one, two)
    assert not np.array_equal(expected[1], frames[1])
    other = along(chain, frames, [np.zeros_like(flow) for flow in flows], None)
    assert not np.array_equal(other[1], expected[1])


def test_whole_steps_move_pixels_exactly_and_others_between_them():
    """Without noise to be expected and any difference allowed, the mean has known weights."""
    chain = chain_of(method="flow", frames=3.0, threshold=100.0)
    before = np.random.default_rng(0).random((5, 7, 3)).astype(np.float32) * 0.01 + 0.2
    now = before[::-1].copy()
    flow = np.zeros((5, 7, 2), np.float32)
    flow[2, 3], flow[2, 4], flow[0, 0], flow[4, 6] = (-2, 1), (0.25, -0.5), (-0.6, 0), (0.4, 0.4)
    result = along(chain, [before, now], [flow, flow], None)[1]
    kept = 0.5  # (frames - 1) / (frames + 1)
    place = before[3, 1]
    assert result[2, 3] == pytest.approx(now[2, 3] + kept * (place - now[2, 3]), abs=1e-6)
    place = (0.75 * (before[1, 4] + before[2, 4]) + 0.25 * (before[1, 5] + before[2, 5])) / 2
    assert result[2, 4] == pytest.approx(now[2, 4] + kept * (place - now[2, 4]), abs=1e-6)
    assert (result[0, 0] == now[0, 0]).all()  # its place is outside
    assert (result[4, 6] != now[4, 6]).all()  # within the last pixel


def texture(size, shift):
    """Return a texture of waves of 12 px and more, moved by fractions of a pixel."""
    y, x = np.mgrid[0 : size[0], 0 : size[1]]
    x, y = x - shift[0], y - shift[1]
    waves = [np.sin((x * a + y * b) / 12 * 2 * np.pi) for a, b in ((1, 0), (0.3, 0.9), (0.6, -0.7))]
    return np.stack([0.25 + 0.05 * (waves[n] + waves[n - 1]) for n in range(3)], -1)


def error_after(device, shift, flow, count=14, **parameters):
    """Return the variance of a moving texture's error after some frames, over that of its noise."""
    size, chain = (90, 120), chain_of(**parameters)
    cleans = [texture(size, n * np.array(shift)) for n in range(count)]
    frames = [noisy(clean, chain, np.random.default_rng(n)) for n, clean in enumerate(cleans)]
    found = along(chain, frames, [flow_of(size, flow)] * count, device)
    inner = np.s_[20:-20, 20:-20]
    return np.var((found[-1] - cleans[-1])[inner]) / np.var((frames[-1] - cleans[-1])[inner])


def test_a_moving_texture_is_averaged_like_a_static_one(device):
    static = error_after(device, (0, 0), (0, 0), method="flow")
    assert static == pytest.approx(1 / 6, rel=0.2)
    assert error_after(device, MOVE, -MOVE, method="flow") < 1.2 * static
    assert error_after(device, MOVE, MOVE, method="flow") > 0.6  # it must be the other direction


@pytest.mark.parametrize(("period", "contrast"), [(12, 0.92), (4, 0.58)])
def test_the_contrast_of_moving_waves_is_that_of_the_page(period, contrast):
    """Interpolation softens them in each frame. They are so weak that noise could explain this."""
    x, size = np.arange(160.0), (9, 160)
    waves = [np.cos(2 * np.pi * (x - n / 2) / period) for n in range(30)]
    frames = [np.float32(np.broadcast_to(0.3 + 0.02 * row[:, None], (*size, 3))) for row in waves]
    last = along(chain_of(method="flow"), frames, [flow_of(size, (-0.5, 0))] * 30, None)[-1]
    inner = np.s_[4, 40:136]  # whole periods
    assert last[inner].std() / frames[-1][inner].std() == pytest.approx(contrast, abs=0.01)


def test_what_a_moving_object_uncovers_has_no_ghost(device):
    """The object moves by 2.5 px in each frame over a static background."""
    chain = chain_of(method="flow")
    cleans, flows = [], []
    for n in range(12):
        edge, clean = 10 + 2.5 * n, np.full((60, 80, 3), 0.1)
        share = np.clip(np.arange(80) + 1 - edge, 0, 1) * np.clip(edge + 30 - np.arange(80), 0, 1)
        clean += 0.3 * share[:, None]
        flow = np.zeros((60, 80, 2), np.float32)
        flow[:, share > 0.5, 0] = -2.5
        cleans.append(clean)
        flows.append(flow)
    frames = [noisy(clean, chain, np.random.default_rng(n)) for n, clean in enumerate(cleans)]
    last = along(chain, frames, flows, device)[-1]
    behind = np.s_[:, 34:37]  # the background that the object has uncovered
    assert np.abs((last - cleans[-1])[behind].mean((0, 1))).max() < 0.02 * 0.3
    inside = np.s_[5:-5, 45:60]
    assert np.var((last - cleans[-1])[inside]) < 0.3 * np.var((frames[-1] - cleans[-1])[inside])


STREAM = {"iso": 6400, "stages": LONG, STAGE: {"method": "flow"}}


def test_a_stream_takes_flow(device):
    """Its first frame has none that is known."""
    size, options = (60, 80), {"device": device.info.index, **STREAM}
    frames = [texture(size, n * MOVE).astype(np.float32) for n in range(6)]
    flows = [flow_of(size, np.nan), *[flow_of(size, -MOVE)] * 5]
    unknown = [flow_of(size, np.nan)] * 6

    def last(flows):
        with clpipe.Stream(**options) as stream:
            for frame, flow in zip(frames, flows, strict=True):
                assert stream.put(frame, flow=flow)
                shot = stream.get()
        return shot.image.astype(float)

    stages = [stage for stage in LONG if stage != STAGE]
    clean = clpipe.Pipeline(
        device="numpy", iso=6400, stages=stages, sensor_noise={"method": "none"}
    ).process(frames[-1])
    errors = [(last(each) - clean.image)[10:-10, 10:-10].std() for each in (flows, unknown)]
    assert errors[0] < 0.8 * errors[1]


def test_arrays_that_are_no_flow():
    frame = np.full((8, 9, 3), 0.2, np.float32)
    with clpipe.Stream(device="numpy", **STREAM) as stream:
        with pytest.raises(ImageError, match=r"needs flow, \(height, width, 2\), .*flow=flow"):
            stream(frame)
        with pytest.raises(ImageError, match=r"found flow of shape \(8, 9, 3\)"):
            stream(frame, flow=frame)
        stream(frame, flow=flow_of((8, 9), 0))
    plain = {"device": "numpy", "stages": ["exposure"]}
    with (
        clpipe.Stream(**plain) as stream,
        pytest.warns(UserWarning, match=r"no step reads the flow. Set temporal_denoise.method"),
    ):
        stream(frame, flow=flow_of((8, 9), 0))


def test_flow_is_warped_like_the_pixels_of_earlier_stages():
    """A resized image has shorter vectors, and a distorted one those between new places."""
    flow = flow_of((24, 32), (4, -2))
    half = {"stages": ["resize", STAGE], "resize": {"scale": 0.5}, STAGE: {"method": "flow"}}
    chain = make_chain(settings_from(half))
    table = layer_of(chain, STAGE, flow).pixels
    assert table.shape[:2] == (2, 12)
    assert table[:, 3, 5].tolist() == pytest.approx([2, -1])
    lens = {"method": "brown_conrady", "fx": 30.0, "k1": 0.2}
    bent = {"stages": ["distortion", STAGE], "distortion": lens, STAGE: {"method": "flow"}}
    table = layer_of(make_chain(settings_from(bent)), STAGE, flow).pixels
    carried, _ = clpipe.Pipeline(device="numpy", distortion=lens).carry(flow, "flow")
    np.testing.assert_allclose(table[:, 6:18, 8:24], np.moveaxis(carried, 2, 0)[:, 6:18, 8:24])
    assert abs(table[0, 12, 16] - 4) > 1e-3


def write(path, image, **channels):
    """Write a render of a frame, with further channels."""
    planes = dict(zip("RGB", np.moveaxis(image, 2, 0), strict=True)) | channels
    kind = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    path.parent.mkdir(exist_ok=True)
    OpenEXR.File(kind, {k: np.ascontiguousarray(v, np.float32) for k, v in planes.items()}).write(
        str(path)
    )


def vector(size, across, down):
    """Return Blender's Vector pass of a flow to the frame before."""
    numbers = {"X": across, "Y": -down, "Z": 9.0, "W": 9.0}
    return {f"View.Vector.{name}": np.full(size, value) for name, value in numbers.items()}


RUN = {"sequence": True, "iso": 3200, "stages": ["exposure", STAGE], "format": "exr"}
RUN |= {"device": "numpy", STAGE: {"method": "flow"}}


def test_blenders_vector_pass_is_read_and_recorded(tmp_path):
    size, chain = (40, 56), chain_of(("exposure", STAGE), method="flow")
    frames = [texture(size, n * MOVE).astype(np.float32) for n in range(4)]
    for n, frame in enumerate(frames):
        write(tmp_path / f"in/{n}.exr", frame, **vector(size, *-MOVE))
    outcomes = list(clpipe.run(tmp_path / "in", tmp_path / "out", **RUN))
    assert [outcome.status for outcome in outcomes] == ["done"] * 4
    expected = along(chain, frames, [flow_of(size, -MOVE)] * 4, None)[-1]
    assert np.abs(expected - frames[-1]).max() > 3e-3
    assert read_image(tmp_path / "out/3.exr").pixels == pytest.approx(expected, abs=1e-3)
    record = json.loads((tmp_path / "out/3.json").read_text())
    assert record["flow"][0].items() >= {"layer": "Vector", "file": "3.exr"}.items()


def test_flow_of_another_directory_is_an_input_of_its_picture(tmp_path):
    size = (8, 9)
    frames = [texture(size, n * MOVE).astype(np.float32) for n in range(3)]
    for n, frame in enumerate(frames):
        write(tmp_path / f"in/{n}.exr", frame)
        write(tmp_path / f"flow/{n}.exr", frame, **vector(size, 0, 0))
    named = {STAGE: {"method": "flow", "layer": "Vector=../flow/{name}.exr"}}

    def run():
        return [o.status for o in clpipe.run(tmp_path / "in", tmp_path / "out", **RUN | named)]

    assert run() == ["done"] * 3
    assert run() == ["skipped"] * 3
    before = read_image(tmp_path / "out/2.exr").pixels
    write(tmp_path / "flow/2.exr", frames[2], **vector(size, *-MOVE))
    assert run() == ["done"] * 3
    assert not np.array_equal(read_image(tmp_path / "out/2.exr").pixels, before)


@pytest.mark.parametrize(
    ("layer", "message"),
    [
        (
            None,
            "0.exr: temporal_denoise needs flow: there is no layer 'Vector'; the file has Depth, "
            "and there is no 0_Vector.exr next to it; render the layer into one of these files "
            "(clpipe also looked for Flow); to use another layer, set temporal_denoise.layer; to "
            "use none, set temporal_denoise.method=recursive",
        ),
        (
            "Depth",
            "0.exr: its layer Depth has 1 channel, but a layer of flow needs 2 or more; to use "
            "another layer, set temporal_denoise.layer; to use none, set "
            "temporal_denoise.method=recursive",
        ),
        (
            "Flow=../flow/{name}.exr",
            "0.exr: its companion in/../flow/0.exr does not exist; correct the pattern in "
            "temporal_denoise.layer=...=../flow/{name}.exr, or render the file; to",
        ),
    ],
)
def test_layers_that_are_no_flow(tmp_path, monkeypatch, layer, message):
    monkeypatch.chdir(tmp_path)
    write(tmp_path / "in/0.exr", texture((8, 9), (0, 0)), **{"Depth.Z": np.ones((8, 9))})
    named = {STAGE: {"method": "flow", **({"layer": layer} if layer else {})}}
    (outcome,) = clpipe.run("in", "out", **RUN | named)
    assert outcome.status == "failed"
    assert message in outcome.error
