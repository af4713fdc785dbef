"""Live frames: clpipe.Stream and the command clpipe stream."""

import io
import json
import os
import subprocess
import sys
import threading
from multiprocessing import shared_memory

import numpy as np
import pyopencl as cl
import pytest
from click.testing import CliRunner

import clpipe
from clpipe.base.errors import DeviceError, DeviceFailedError, ImageError, RequestError
from clpipe.camera.control import Control, ControlLoop
from clpipe.commands import stream as command
from clpipe.commands.main import main
from clpipe.commands.stream import frames_in
from clpipe.engine.recovery import MAX_FAILURES
from tests.conftest import fail_launches, run_cli, run_python
from tests.held import GUARD

LIGHT = (1, 1, 4, 4, 4, 4, 0.5, 0.5)


@pytest.fixture(scope="module")
def frames():
    scene = np.random.default_rng(0).uniform(0.01, 0.2, (24, 32, 3))
    return [(scene * light).astype(np.float32) for light in LIGHT]


def stream(**options):
    return clpipe.Stream(device="numpy", iso=800, **options)


def test_a_picture_has_the_bits_of_a_single_one_with_its_settings(frames):
    loops = {"exposure": {"method": "auto"}, "white_balance": {"method": "gray_world"}}
    control = {"iso_max": 3200.0}
    with clpipe.Stream(device="numpy", iso=400, control=control, **loops) as camera:
        shots = [camera(frame) for frame in frames]
    single = clpipe.Pipeline(device="numpy", iso=400)
    for number, (frame, shot) in enumerate(zip(frames, shots, strict=True)):
        assert shot.settings.keys() == {"exposure", "iso", "white_balance"}
        expected = single(frame, f"stream/{number:06}", **shot.settings).image
        assert np.array_equal(shot.image, expected)
    assert len({shot.settings["iso"] for shot in shots}) > 1


def test_exposure_follows_the_loop(frames):
    control = {"delay": 1, "smoothing": 1.5, "speed": 0.7, "hysteresis": 0.2}
    with stream(exposure={"method": "auto", "ev": -1.0}, control=control) as camera:
        shots = [camera(frame) for frame in frames]
    loop = ControlLoop(Control(**control))
    assert [shot.settings["exposure"]["ev"] for shot in shots] == pytest.approx(
        [loop.next(shot.metered["metered_ev"]) - 1 for shot in shots], abs=1e-4
    )
    first, _, third, *_ = (shot.metered["metered_ev"] for shot in shots)
    assert first - third == pytest.approx(2, abs=0.01)


def test_noise_is_of_the_frame_and_of_the_stream(frames):
    with stream() as one, stream() as two, stream(name="other") as other:
        first = [one(frames[0]).image for _ in range(2)]
        assert np.array_equal(first[0], two(frames[0]).image)
        assert not np.array_equal(*first)
        assert not np.array_equal(first[0], other(frames[0]).image)


def test_put_and_get_give_the_pictures_of_calls(frames):
    with stream() as one:
        expected = [one(frame).image for frame in frames]
    got = []
    with stream() as two:
        pictures = threading.Thread(target=lambda: [got.append(two.get()) for _ in frames])
        pictures.start()
        assert all(two.put(frame) for frame in frames)
        pictures.join(120)
        assert two.dropped == 0
    assert [shot.index for shot in got] == list(range(len(frames)))
    assert all(np.array_equal(shot.image, e) for shot, e in zip(got, expected, strict=True))


def test_a_frame_may_change_after_it_was_put(frames):
    frame = frames[0].copy()
    with stream() as camera:
        camera.put(frame)
        frame[:] = 0
        (shot,) = camera.finish()
    with stream() as camera:
        assert np.array_equal(shot.image, camera(frames[0]).image)


def test_frames_are_dropped_and_counted(frames):
    with stream(drop=True) as camera:
        taken = [camera.put(frame) for frame in frames]
        shots = list(camera.finish())
        # Nobody got pictures: one waits for that, one is developed or done, and one waits.
        assert taken[0] and len(shots) == sum(taken) <= 4
        assert camera.dropped == len(frames) - len(shots)
        assert [shot.index for shot in shots] == [n for n, each in enumerate(taken) if each]
        with pytest.raises(RequestError, match="was ended and accepts no more frames"):
            camera.put(frames[0])
        assert camera.get() is None


def test_a_wrong_frame_fails_alone(frames):
    with stream() as camera:
        with pytest.raises(ImageError, match="NaN"):
            camera(frames[0] * np.nan)
        assert camera(frames[1]).index == 1
    with stream() as camera:
        camera.put(frames[0][..., :2])
        with pytest.raises(ImageError, match=r"stream/000000: .*shape"):
            camera.get()
        camera.put(frames[1])
        assert [shot.index for shot in camera.finish()] == [1]
    with stream(transfer="srgb") as camera, pytest.raises(ImageError, match="expects uint8"):
        camera(frames[0])
    with pytest.raises(TimeoutError), stream() as camera:
        camera.get(timeout=0.01)


FEW = {"stages": ["distortion", "exposure", "gamma"]}
# Shows a share of black that differs from frame to frame.
BENT = {"method": "brown_conrady", "fx": 30.0, "k1": {"drift": [-0.3, -0.2], "frames": 2}}


@pytest.mark.parametrize("way", ["call", "get", "finish"])
def test_a_kind_of_warning_is_issued_once_at_the_line_of_the_user(frames, way):
    flow = np.zeros((24, 32, 2), np.float32)

    def use():
        for number, frame in enumerate(frames[:6]):
            layers = {"flow": flow} if number > 2 else {}
            if way == "call":
                camera(frame, **layers)
            else:
                camera.put(frame, **layers)
            if way == "get" or (way == "finish" and number < 5):
                camera.get()
        assert len(list(camera.finish())) == (way == "finish")

    camera = clpipe.Stream(device="numpy", distortion=BENT, **FEW)
    with camera, pytest.warns(UserWarning, match=".") as caught:
        use()
    black, unread = (str(each.message) for each in caught)
    assert black.startswith("stream/000000: ") and "% of the picture is black" in black
    assert unread.startswith("stream/000003: no step reads the flow")
    assert {each.filename for each in caught} == {__file__}


def test_a_closed_stream_does_nothing(frames):
    camera = stream()
    camera.put(frames[0])
    camera.close()
    camera.close()
    for use in (
        lambda: camera(frames[0]),
        lambda: camera.put(frames[0]),
        camera.get,
        camera.end,
        camera.finish,
        lambda: camera.warm_up((24, 32, 3)),
        camera.__enter__,
    ):
        with pytest.raises(RequestError, match="this stream is closed; make another one"):
            use()
    with stream() as camera:
        pictures = camera.finish()
        for use in (camera, camera.put, lambda frame: camera.warm_up(frame.shape)):
            with pytest.raises(RequestError, match="was ended and accepts no more frames"):
                use(frames[0])
    with pytest.raises(RequestError, match="this stream is closed"):
        next(pictures)


def test_all_that_wait_in_put_learn_of_the_end(frames):
    errors = []

    def put():
        try:
            while True:
                camera.put(frames[0])
        except RequestError as error:
            errors.append(error)

    with stream() as camera:
        threads = [threading.Thread(target=put, daemon=True) for _ in range(2)]
        for thread in threads:
            thread.start()
        assert camera.get(GUARD) and camera.get(GUARD)  # so both have put frames
        camera.end()
        for thread in threads:
            thread.join(120)
    assert len(errors) == 2


def test_a_stream_goes_on_after_its_device_failed(device, frames, monkeypatch):
    """The frame after a failure starts again, also if that was one too many."""
    options = {"device": device.info.index, "iso": 800, "stages": ["exposure", "temporal_denoise"]}
    with clpipe.Stream(**options) as camera:
        first = camera(frames[0]).image
        for failure in range(MAX_FAILURES):
            with monkeypatch.context() as patch:
                fail_launches(patch, cl.RuntimeError("lost"), *range(9))
                expected = DeviceFailedError if failure < MAX_FAILURES - 1 else DeviceError
                with pytest.raises(expected, match="failed"):
                    camera(frames[0])
        assert np.array_equal(camera(frames[0]).image, first)


LOOPS = {"exposure": {"method": "auto"}, "white_balance": {"method": "gray_world"}}
NAMES = "exposure mosaic sensor_noise white_balance demosaic temporal_denoise gamma"
AVERAGED = {"iso": 800, "stages": NAMES.split(), "control": {"iso_max": 3200.0}, **LOOPS}


def test_after_warming_up_no_frame_compiles_or_differs(device, frames, monkeypatch):
    options = {"device": device.info.index, **AVERAGED}
    built, build = [], cl.Program.build
    monkeypatch.setattr(cl.Program, "build", lambda *of, **by: built.append(of) or build(*of, **by))
    with clpipe.Stream(**options) as camera:
        camera.warm_up(frames[0].shape)
        built.clear()
        warmed = [camera(frame) for frame in frames[:4]]
        camera.warm_up(frames[0].shape, np.float32)
        warmed += [camera(frame) for frame in frames[4:]]
        assert not built
    with clpipe.Stream(**options) as camera:
        cold = [camera(frame) for frame in frames]
    for one, other in zip(warmed, cold, strict=True):
        assert np.array_equal(one.image, other.image)
        assert (one.index, one.settings) == (other.index, other.settings)
        assert (one.metered, one.result.estimates) == (other.metered, other.result.estimates)


def test_what_cannot_be_warmed_up_is_told(frames):
    with stream() as camera:
        for shape, dtype in (((24, 32, 2), "float32"), ((24, 32), "float32"), ((4, 4, 3), "uint8")):
            with pytest.raises(ImageError, match="the image has"):
                camera.warm_up(shape, dtype)
        for shape, dtype in (((-1, 4, 3), "float32"), ("large", "float32"), ((4, 4, 3), "float7")):
            with pytest.raises(RequestError, match=r"found shape .* such as \(720, 1280, 3\)"):
                camera.warm_up(shape, dtype)
        assert camera(frames[0]).index == 0


WARMED = """
import sys
from pathlib import Path
import numpy as np
import clpipe
from clpipe.engine.cache_folder import pocl_folder
from clpipe.engine.programs import watching_compilation

compiled = []
options, dtype = eval(sys.argv[1]), sys.argv[2]
depth = np.ones((48, 64), np.float32) * np.linspace(1, 9, 64, dtype=np.float32)
layers = {"depth": depth} if "defocus" in options else {}
layers |= {"flow": np.zeros((48, 64, 2))} if "temporal_denoise" in options else {}
watch = watching_compilation(lambda *count: compiled.append(count))
with watch, clpipe.Stream(device=int(sys.argv[3]), **options) as camera:
    def count():
        libraries = len([*pocl_folder().rglob("*.so")]) if pocl_folder() else 0
        return len(compiled), libraries
    before = count()
    camera.warm_up((48, 64, 3), dtype)
    warm = count()
    for number in range(7):
        light = np.random.default_rng(number).uniform(0, 1 / (1 + number % 3), (48, 64, 3))
        camera.put((light * (255 if dtype == "uint8" else 1)).astype(dtype), **layers)
        camera.get()
    assert before < warm == count(), (before, warm, count())
"""
LENS = {"method": "thin_lens", "focal_length": 50.0, "sensor_width": 36.0, "max_radius": 4}
LAYERS = {"defocus": LENS, "temporal_denoise": {"method": "flow"}}
WITH_LAYERS = ["defocus", "exposure", "temporal_denoise", "gamma"]
TWO_GAINS = {"sensor_noise": {"method": "split_dual_gain"}}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("options", "dtype"),
    [
        ({"config": "video", **LOOPS, "transfer": "srgb"}, "uint8"),
        ({"stages": WITH_LAYERS, **LAYERS, "keep": "all"}, "float16"),
        ({"camera": "sony-imx490", **TWO_GAINS, "until": "quantize"}, "float64"),
    ],
)
def test_a_new_process_compiles_only_while_it_warms_up(device, tmp_path, options, dtype):
    words = repr(options), dtype, device.info.index
    run_python("-c", WARMED, *words, CLPIPE_CACHE_DIR=tmp_path)


def test_a_table_that_is_none_is_told_as_python_writes_it():
    for name, value, said in (
        ("exposure", "auto", r"exposure: found 'auto'.* use exposure=\{'method': 'auto'\}"),
        ("control", 4, r"control: found 4.* use control=\{\.\.\.\}"),
    ):
        with pytest.raises(RequestError, match=said):
            stream(**{name: value})


def test_finished_frames_are_converted_to_light(frames):
    codes = np.random.default_rng(1).integers(0, 256, (24, 32, 3), dtype=np.uint8)
    x = codes / 255
    light = np.where(x <= 0.04045, x / 12.92, ((x + 0.055) / 1.055) ** 2.4).astype(np.float32)
    with stream(transfer="srgb", keep="exposure") as one, stream(keep="exposure") as two:
        found, expected = one(codes).result.kept["exposure"], two(light).result.kept["exposure"]
    assert found == pytest.approx(expected, rel=1e-4, abs=1e-6)


def test_raws_and_frames_in_shared_memory(frames):
    memory = shared_memory.SharedMemory(create=True, size=frames[0].nbytes)
    try:
        shared = np.ndarray(frames[0].shape, np.float32, memory.buf)
        with stream(until="quantize") as camera, stream(until="quantize") as other:
            for frame in frames[:3]:
                shared[:] = frame
                shot = camera(shared)
                assert (shot.image.shape, shot.image.dtype) == ((24, 32), np.uint16)
                assert np.array_equal(shot.image, other(frame).image)
            del shared
    finally:
        memory.close()
        memory.unlink()


def test_a_drawn_value_is_of_the_stream_and_a_drift_of_the_frame(frames):
    temperature = {"drift": [20, 60], "frames": 3}
    with clpipe.Stream(
        device="numpy",
        iso={"log_uniform": [100, 6400]},
        dark_current={"temperature": temperature},
    ) as camera:
        settings = [camera(frames[0]).settings for _ in range(6)]
    assert len({each["iso"] for each in settings}) == 1
    assert len({each["dark_current"]["temperature"] for each in settings}) == 6


def piped(data, *options):
    command = [sys.executable, "-m", "clpipe", "stream", "--device", "numpy", *options]
    return subprocess.run(command, input=data, capture_output=True, timeout=300)


def arrays(data):
    file = io.BytesIO(data)
    found = []
    while file.tell() < len(data):
        found.append(np.load(file))
    return found


def npy(*frames):
    file = io.BytesIO()
    for frame in frames:
        np.save(file, frame)
    return file.getvalue()


def test_frames_are_read_as_the_simulator_writes_them(frames):
    """Also a header and samples in pieces, and planes in Fortran order."""
    data = npy(frames[0], np.asfortranarray(frames[1]))
    ends, begun = os.pipe(), []

    def write():
        with open(ends[1], "wb", buffering=0) as pipe:
            for start in range(0, len(data), 1000):
                pipe.write(data[start : start + 1000])

    writer = threading.Thread(target=write)
    writer.start()
    with open(ends[0], "rb") as pipe:
        found = list(frames_in(pipe, lambda *kind: begun.append(kind)))
    writer.join()
    assert begun == [((24, 32, 3), np.float32)]
    assert np.array_equal(found, frames[:2])


def test_a_stream_is_warm_before_it_reads_the_first_frame(frames, monkeypatch):
    done = []
    monkeypatch.setattr(command.Camera, "warm_up", lambda _, *kind: done.append(kind))
    monkeypatch.setattr(command.Camera, "put", lambda _, frame: done.append(frame.shape))
    data = io.BufferedReader(io.BytesIO(npy(frames[0], frames[1])))
    CliRunner().invoke(main, ["stream", "--device", "numpy"], input=data)
    assert done == [((24, 32, 3), np.float32), (24, 32, 3), (24, 32, 3)]


@pytest.mark.parametrize("name", ["__stdin__", "__stdout__"])
def test_the_command_needs_both_ends_of_a_pipe(monkeypatch, name):
    monkeypatch.setattr(sys, name, None)
    assert (
        f"standard {name.strip('_')[3:]}put is closed; use pipes"
        in run_cli("stream", status=2).output
    )


@pytest.mark.slow
@pytest.mark.parametrize("redirection", [">&-", "<&-", "2>&-", ">&- 2>&- <&-"])
@pytest.mark.parametrize(("words", "status"), [("stream --device numpy", 2), ("stages", 0)])
def test_a_closed_stream_of_the_process_is_no_traceback(words, status, redirection):
    shell = f'exec "$0" -m clpipe {words} {redirection}'
    done = subprocess.run(
        ["sh", "-c", shell, sys.executable], stdin=subprocess.DEVNULL, capture_output=True
    )
    if redirection == "2>&-":
        status = {"stream --device numpy": 0}.get(words, status)
    assert done.returncode == status, done.stderr
    assert b"Traceback" not in done.stderr
    assert done.stderr or status == 0 or "2>&-" in redirection


@pytest.mark.slow
def test_the_command_prints_a_kind_of_warning_once(frames, tmp_path):
    (tmp_path / "bent.toml").write_text(
        'stages = ["distortion", "exposure", "gamma"]\n[distortion]\n'
        'method = "brown_conrady"\nfx = 30.0\nk1 = {drift = [-0.3, -0.2], frames = 2}\n'
    )
    found = piped(npy(*frames), "-c", tmp_path / "bent.toml")
    warning, summary = found.stderr.decode().splitlines()
    assert warning.startswith("clpipe: stream/000000: ") and "% of the picture is black" in warning
    assert summary.startswith("8 pictures in ")


@pytest.mark.slow
def test_the_command_develops_standard_input(frames, tmp_path):
    options = ["--iso", "800", "--set", "exposure.method=auto", "--log", tmp_path / "log.jsonl"]
    data = npy(frames[0], frames[1] * np.nan, *frames[2:])
    found = piped(data, *options)
    assert found.returncode == 1
    assert b"stream/000001: the image has 2304 samples that are NaN" in found.stderr
    assert b"7 pictures in " in found.stderr and b"0 frames dropped, 1 failed" in found.stderr
    with stream(exposure={"method": "auto"}) as camera:
        expected = []
        for number, frame in enumerate(frames):
            if number == 1:
                with pytest.raises(ImageError):
                    camera(frame * np.nan)
            else:
                expected.append(camera(frame))
    assert np.array_equal(arrays(found.stdout), [shot.image for shot in expected])
    log = [json.loads(line) for line in (tmp_path / "log.jsonl").read_text().splitlines()]
    assert [(line["frame"], line["settings"]) for line in log] == [
        (shot.index, shot.settings) for shot in expected
    ]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"hello", "frame 0 of standard input: this is no .npy"),
        (npy(np.zeros((2, 2, 3), np.float32))[:-5], "this is no .npy of numbers: EOF"),
        (npy(np.array(["text"])).replace(b"'<U4'", b"'|O' "), "no .npy of numbers: Object arrays"),
    ],
)
def test_the_command_says_what_is_wrong_with_its_input(data, message):
    found = piped(data)
    assert found.returncode != 0 and message in found.stderr.decode()
    assert "Traceback" not in found.stderr.decode()
