"""The Python API, as a user imports it."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

import clpipe
from clpipe.engine.programs import watching_compilation


@pytest.fixture(scope="module")
def render():
    return np.random.default_rng(0).random((40, 60, 3), np.float32) * np.float32(0.6)


@pytest.fixture(scope="module")
def camera():
    return clpipe.Pipeline(iso=3200, denoise={"luma_strength": 0.5}, keep=["quantize"])


def test_one_image(camera, render):
    shot = camera.process(render, "a")
    assert shot.image.shape == render.shape
    assert shot.image.dtype == np.uint8
    raw = shot.kept["quantize"]
    assert raw.shape == render.shape[:2]
    assert np.array_equal(raw, np.rint(raw))
    assert np.array_equal(camera.process(render, "a").image, shot.image)
    assert not np.array_equal(camera.process(render, "b").kept["quantize"], raw)


@pytest.mark.slow
def test_overrides_hold_for_one_image_and_compile_nothing(camera, render):
    plain = camera.process(render, "a")
    values = {
        "iso": 12800,
        "sensor_noise": {"a": 5e-3, "b": 1e-5},
        "inverse_white_balance": {"red_gain": 1.9, "blue_gain": 1.2},
    }
    with watching_compilation(lambda *_: pytest.fail("it compiles")):
        noisy = camera.process(render, "a", **values)
    steps = [np.diff(shot.kept["quantize"][:, ::2], axis=1).std() for shot in (plain, noisy)]
    assert steps[1] > steps[0]
    fresh = clpipe.Pipeline(denoise={"luma_strength": 0.5}, **values)
    assert np.array_equal(fresh.process(render, "a").image, noisy.image)
    assert np.array_equal(camera.process(render, "a").image, plain.image)


def test_many_images(camera, render):
    items = [render, (render, {"key": "a", "iso": 800}), render.astype(np.float16)]
    shots = list(camera.process_many(iter(items)))
    assert np.array_equal(shots[0].image, camera.process(render, "0").image)
    assert np.array_equal(shots[1].image, camera.process(render, "a", iso=800).image)
    assert len(shots) == 3


@pytest.mark.slow
def test_from_a_file_and_in_part(tmp_path, render):
    path = tmp_path / "pipeline.toml"
    path.write_text('iso = 400\n[demosaic]\nmethod = "bilinear"\n')
    camera = clpipe.Pipeline(path, until="demosaic", seed=3)
    assert camera.chain.iso == 400
    shot = camera.process(render.astype(np.float64), "a")
    assert shot.image.dtype == np.float32
    rest = clpipe.Pipeline(path, start_at="denoise", seed=3)
    assert np.array_equal(
        rest.process(shot.image, "a").image,
        clpipe.Pipeline(path, seed=3).process(render, "a").image,
    )


def test_a_raw_in_whole_numbers(render):
    camera = clpipe.Pipeline(keep="quantize", iso=800)
    shot = camera.process(render, "a")
    raw = shot.kept["quantize"].astype(np.uint16)
    developed = clpipe.Pipeline(start_at="normalize", iso=800).process(raw, "a")
    assert np.array_equal(developed.image, shot.image)
    with pytest.raises(clpipe.ImageError, match=r"type int8, .* pass image.astype\(np.uint16\)"):
        clpipe.Pipeline(start_at="normalize").process(raw.astype(np.int8), "a")


@pytest.mark.slow
def test_what_a_user_may_write(render):
    matrix = np.eye(3)
    camera = clpipe.Pipeline(
        iso=np.float32(800),
        stages=("exposure", "color_matrix", "gamma"),
        keep="all",
        color_matrix={"method": "given", "matrix": matrix},
    )
    shot = camera.process(render, "a")
    assert list(shot.kept) == [step.name for step in camera.chain.steps]
    assert [s.image.mean() for s in camera.process_many([(render, "a")])] == [shot.image.mean()]
    with pytest.raises(clpipe.DeviceError, match="unknown device '77'"):
        clpipe.Pipeline(device=77)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"denoise": {"strong": 1}}, "unknown parameter of denoise"),
        ({"config": "papers"}, "unknown configuration 'papers' .*'paper'"),
        ({"keep": ["denoize"]}, "unknown stage in this chain 'denoize'"),
    ],
)
def test_a_request_that_is_wrong(settings, message):
    with pytest.raises(clpipe.RequestError, match=message):
        clpipe.Pipeline(**settings)


def test_several_threads_may_use_one_pipeline():
    camera = clpipe.Pipeline(iso=3200)
    random = np.random.default_rng(0)
    images = [random.random((40 + 8 * (i % 3), 64, 3), np.float32) for i in range(12)]
    alone = [camera.process(image, str(i), noise_key="k").image for i, image in enumerate(images)]
    with ThreadPoolExecutor(4) as pool:
        both = pool.map(lambda i: camera.process(images[i], str(i), noise_key="k").image, range(12))
        assert all(map(np.array_equal, alone, both))
