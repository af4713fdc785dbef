"""Ground truth of noisy pictures: the development, the mosaic, the noise variance."""

import json
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from clpipe.base.errors import RequestError
from clpipe.camera.profile import DEFAULT_CAMERA, load_camera
from clpipe.chain.making import make_chain
from clpipe.chain.registry import all_stages
from clpipe.chain.rendition import CLEAN, DEVELOPMENT, MOSAIC, VARIANCE
from clpipe.chain.settings import settings_from
from clpipe.chain.truth import noisy_mosaic, variance_of
from clpipe.engine.runner import Runner
from clpipe.images.read import read_image
from clpipe.outputs.recipes import chain_and_noise
from clpipe.reference.cfa import PATTERNS
from clpipe.reference.filter_array import parse_array
from clpipe.stage import Context, Kind, Method
from clpipe.stages import DEFAULT_CHAIN
from clpipe.stages.exposure import Gain
from clpipe.stages.row_noise import Gaussian as RowNoise
from tests.conftest import STILL_LIFE, stamps, written
from tests.dng import write_dng

ALL = ("--truth", "development", "--truth", "mosaic", "--truth", "variance")
CONTEXT = Context(load_camera(DEFAULT_CAMERA), 3200)
FIXED = {"prnu": {"sigma": 0.02}, "dsnu": {"sigma": 2e-3}}
# Four patches side by side, some brighter than the sensor holds in green: (1, 64, 3).
PATCHES = np.repeat(
    np.float32([[[0, 0, 0], [0.03, 0.02, 0.04], [0.3, 0.2, 0.4], [0.9, 0.6, 0.8]]]), 16, 1
)


def tall(rows=1600):
    """Return the patches as 400 frames of four rows, one below another."""
    return np.ascontiguousarray(np.broadcast_to(PATCHES, (rows, 64, 3)))


def chain_of(**settings):
    return make_chain(settings_from({"iso": 3200, **settings}))


def known(image, device=None, **settings):
    """A noisy mosaic, the clean one, and the variance between them; in NumPy, it is the same."""
    chain = chain_of(**settings)
    (clean, _), (signal, noise) = (chain_and_noise(role, chain) for role in (MOSAIC, VARIANCE))
    chains = (noisy_mosaic(chain), clean, signal)
    images = [Runner(c, device, encode=False, final=True).run(image, "k").final for c in chains]
    return images[0], images[1], variance_of(noise, images[2])


def agree(noisy, clean, variance, axis=1):
    """Check the predicted noise of each patch and colour within 4 standard errors.

    Rows (axis 1), or columns (axis 0), may share noise; among each other they do not. Means differ
    by up to half a DN, to which the clean mosaic is rounded.
    """
    for y, x, patch in np.ndindex(2, 2, 4):
        here = [np.split(image, 4, axis=1)[patch][y::2, x::2] for image in (noisy, clean, variance)]
        noise = (here[0] - here[1]).astype(np.float64)
        ratio = ((noise - noise.mean()) ** 2 / here[2]).mean(axis)
        error = ratio.std(ddof=1) / np.sqrt(ratio.size)
        assert error < 0.05
        assert abs(ratio.mean() - 1) < 4 * error, (y, x, patch, ratio.mean(), error)


@pytest.mark.parametrize("pattern", PATTERNS)
@pytest.mark.parametrize("method", ["skewed_gaussian", "gaussian", "poisson"])
def test_the_noise_of_400_frames_is_as_large_as_is_said(method, pattern):
    noise = {"method": method}
    agree(*known(tall(), **FIXED, mosaic={"pattern": pattern}, sensor_noise=noise))


START = ["exposure", "mosaic", "inverse_white_balance"]
END = ["quantize", "normalize", "demosaic"]


@pytest.mark.parametrize(
    ("stages", "settings"),
    [
        (["mosaic", "sensor_noise", "prnu", "inverse_white_balance", *END], {}),
        (["mosaic", "dsnu", "row_noise", "sensor_noise", "inverse_white_balance", *END], {}),
        ([*START, "sensor_noise", "sensor_noise", *END], {"sensor_noise_2": {"method": "poisson"}}),
        ([*START, "prnu", "sensor_noise", "row_noise", "demosaic"], {}),
        ([*START, *END[:2], "sensor_noise", "row_noise", "demosaic"], {}),
        (DEFAULT_CHAIN, {"sensor_noise": {"tukey_lambda": -0.2}}),
        (DEFAULT_CHAIN, {"sensor_noise": {"full_well": 1e4}}),
        (DEFAULT_CHAIN, {"sensor_noise": {"a": 0.0, "b": 3e-5}, "quantize": {"bits": 8}}),
        (DEFAULT_CHAIN, {"normalize": {"black_level": 500.0, "white_level": 9000.0}}),
    ],
)
def test_other_orders_and_methods_are_as_large_as_is_said(stages, settings):
    light = tall() + np.float32(0.02)  # noise of noise is not linear in the dark
    agree(*known(light, stages=list(stages), **FIXED, **settings))


def test_columns_are_as_large_as_is_said():
    column = {"column_noise": {"sigma": 4e-3}, "row_noise": {"sigma": 0.0}}
    agree(*known(np.repeat(tall(8), 128, 1), **FIXED, **column), axis=0)


def test_400_frames_of_a_mosaic_of_one_row(device):
    settings = {"row_noise": {"sigma": 5e-3}}
    _, clean, variance = known(PATCHES, device, **settings)
    assert variance.shape == (1, 64)
    frame = Runner(noisy_mosaic(chain_of(**settings)), device, encode=False, final=True)
    noise = np.stack([frame.run(PATCHES, f"k#{i}").final - clean for i in range(400)])
    ratio = (noise**2 / variance).mean((1, 2), np.float64)
    assert abs(ratio.mean() - 1) < 4 * ratio.std(ddof=1) / 20 < 0.4


def test_the_variance_is_the_sum_of_its_parts(device):
    settings = {"row_noise": {"sigma": 2e-3}, "column_noise": {"sigma": 3e-3}, **FIXED}
    settings |= {"exposure": {"headroom": 0}, "skip": ["optical_blur"]}
    image = np.float32([-0.1, 0, 0.2, 1, 5]).repeat(3).reshape(1, 5, 3)
    both = {
        on: known(image, on, sensor_noise={"a": 1e-3, "b": 1e-5}, **settings)[2]
        for on in (None, device)
    }
    gain = np.where(np.arange(5) % 2, 1, 2.77)  # of the camera's red
    y = np.minimum(image[0, :, 0] / gain, 1)
    expected = np.maximum(1e-3 * y + 1e-5, 0) + (0.02 * y) ** 2 + 2e-3**2 + 2e-3**2 + 3e-3**2
    expected += 1 / 12 / (16383 - 512) ** 2
    for variance in both.values():
        assert variance.dtype == np.float32
        assert np.allclose(variance[0], expected, rtol=1e-5, atol=0)
    full = known(
        image, skip=["optical_blur"], sensor_noise={"a": 1e-3, "b": 1e-5, "full_well": 100.0}
    )[2]
    assert full.max() == pytest.approx(1e-3 * 0.1 + 1e-5 + 6.12e-9, rel=0.2)


def test_every_noise_on_a_mosaic_says_how_large_it_is():
    for stage in (s for s in all_stages().values() if s.writes is Kind.MOSAIC):
        for method in stage.methods:
            array = next(map(parse_array, method.only_arrays), None)
            resolved = method(**method.example).resolve(replace(CONTEXT, array=array))
            draws = any(p.random for p in resolved.passes())
            assert not draws or method.variance is not Method.variance


def exr(path):
    return read_image(Path(path), mosaic=True)


def crop(write_exr, name="a.exr", size=(24, 32)):
    return write_exr(name, read_image(STILL_LIFE).pixels[200 : 200 + size[0], 300 : 300 + size[1]])


@pytest.mark.slow
def test_what_lies_beside_a_picture(clpipe, write_exr):
    clpipe("run", crop(write_exr), "-o", "o", "--iso", 3200, *ALL, "--keep", "normalize")
    names = ["a", "a.truth", "a.truth_mosaic", "a.truth_variance"]
    assert set(written(Path("o"))) == {
        *(f"{name}.json" for name in names),
        *("a.jpg", "a.normalize.exr", "a.truth.jpg"),  # the truth of normalize is truth_mosaic
        *("a.truth_mosaic.exr", "a.truth_variance.exr"),
    }
    again = ("run", "a.exr", "-o", "o", "--iso", 3200, *ALL, "--keep", "normalize")
    assert "there already" in clpipe(*again).stderr
    clpipe("replay", "o/a.truth.json", "-o", "r")
    assert set(written(Path("r"))) == {"a.truth.jpg", "a.truth.json"}
    noisy, truth, variance = (
        exr(f"o/a.{x}.exr") for x in ("normalize", "truth_mosaic", "truth_variance")
    )
    assert 0.9 < ((noisy.pixels - truth.pixels) ** 2 / variance.pixels).mean() < 1.1
    clpipe("run", "a.exr", "-o", "q", "--iso", 3200, "--skip", "noise", "--until", "normalize")
    assert np.array_equal(truth.pixels, exr("q/a.exr").pixels)
    assert (truth.attributes["stage"], truth.attributes["kind"]) == ("normalize", "mosaic")
    assert variance.attributes["kind"] == "variance"
    # Without the truth of the mosaic, that of the kept stage is missing, and is made.
    clpipe("run", "a.exr", "-o", "o", "--iso", 3200, *ALL[:2], "--keep", "normalize")
    assert np.array_equal(exr("o/a.truth.normalize.exr").pixels, truth.pixels)
    records = {name: json.loads(Path(f"o/{name}.json").read_text()) for name in names}
    for name, record in records.items():
        assert all(Path("o", output["name"]).is_file() for output in record["outputs"])
        assert record["picture"] == name.removeprefix("a") and record["image_key"].startswith(
            "a.exr@"
        )
    (variance,) = records["a.truth_variance"]["outputs"]
    assert variance["name"] == "a.truth_variance.exr"
    assert records["a.truth_variance"]["noise"] == records["a"]["noise"]
    assert (
        records["a.truth_variance"]["stages"]
        == records["a"]["stages"][: DEFAULT_CHAIN.index("normalize") + 1]
    )
    assert records["a.truth"]["noise"] is records["a.truth_mosaic"]["noise"] is None


@pytest.mark.slow
def test_a_truth_that_enters_again_claims_no_noise(clpipe, write_exr):
    clpipe("run", crop(write_exr), "-o", "o", "--iso", 3200, "--set", "sensor_noise.a=1e-3", *ALL)
    clpipe("run", "o/a.truth_mosaic.exr", "-o", "b", "--start-at", "white_balance")
    assert Path("b/a.truth_mosaic.jpg").read_bytes() == Path("o/a.truth.jpg").read_bytes()
    assert json.loads(Path("b/a.truth_mosaic.json").read_text())["noise"] is None
    found = clpipe("run", "o", "-o", "c", "--start-at", "white_balance", "--format", "exr")
    assert written(Path("c")) == ["a.truth_mosaic.exr", "a.truth_mosaic.json"]
    assert "1 image in a directory was kept after other stages" in found.stderr
    refused = ("run", "o/a.truth_variance.exr", "-o", "d", "--start-at", "white_balance")
    assert "holds variance" in clpipe(*refused, status=1).stderr
    # It does claim the noise that it is then given.
    keep = ("--truth", "development", "--keep", "inverse_white_balance")
    clpipe("run", "a.exr", "-o", "e", "--iso", 3200, *keep)
    again = "e/a.truth.inverse_white_balance.exr"
    clpipe("run", again, "-o", "e", "--start-at", "prnu")
    assert json.loads(Path(again).with_suffix(".json").read_text())["noise"]


def picture(chain, image):
    return Runner(chain, None, encode=False, final=True).run(image, "k").final


def test_the_clean_picture_is_the_same_at_every_iso_but_for_sharpening():
    image = np.random.default_rng(0).random((12, 16, 3)).astype(np.float32)
    cleans, developments = [], []
    for iso in (100, 25600):
        denoise = {"luma_noise": 0.1 if iso > 100 else None}
        chain = chain_of(iso=iso, denoise=denoise, sharpen={"amount": 0.5})
        cleans.append(picture(chain_and_noise(CLEAN, chain)[0], image))
        developments.append(picture(chain_and_noise(DEVELOPMENT, chain)[0], image))
    assert np.array_equal(*cleans)
    assert np.abs(developments[0] - developments[1]).max() > 0.05


def test_without_noise_to_take_away_development_and_clean_picture_are_one():
    image = np.random.default_rng(0).random((12, 16, 3)).astype(np.float32)
    quiet = {"skip": ["denoise", "sharpen"], "demosaic": {"method": "bilinear"}}
    chain = chain_of(**quiet, sensor_noise={"full_well": 3e3})
    clean, development = (
        picture(chain_and_noise(t, chain)[0], image) for t in (CLEAN, DEVELOPMENT)
    )
    assert np.array_equal(clean, development)


def test_what_follows_from_the_noise_follows_from_none_in_the_clean_picture(monkeypatch):
    def resolve(method, context):
        return method.model_copy(update={"ev": 1e3 * context.noise_parameters()[0]})

    monkeypatch.setattr(Gain, "resolve", resolve)
    chain = chain_of(stages=["mosaic", "sensor_noise", "demosaic", "exposure"])
    strengths = {t: chain_and_noise(t, chain)[0].steps[-1] for t in (CLEAN, DEVELOPMENT)}
    assert strengths[CLEAN].method.ev == 0 < strengths[DEVELOPMENT].method.ev
    assert strengths[CLEAN].context.noise_parameters() == (0, 0)


def test_the_clean_picture_is_written_kept_and_entered_again(clpipe, write_exr):
    write_exr("a.exr", np.random.default_rng(0).random((12, 16, 3)))
    run = ("--device", "numpy", "--format", "exr")
    truths = ("--truth", "clean", "--truth", "development")
    clpipe("run", "a.exr", "-o", "o", "--iso", 3200, *run, *truths, "--keep", "demosaic")
    clpipe("run", "o/a.truth_clean.demosaic.exr", "-o", "b", "--start-at", "denoise", *run)
    clpipe("run", "o/a.truth.demosaic.exr", "-o", "b", "--start-at", "denoise", *run)
    clpipe("replay", "o/a.truth_clean.json", "-o", "c", *run[:2])
    (clean, *cleans), (other, again) = (
        [read_image(Path(name), False).pixels for name in names]
        for names in (
            ["o/a.truth_clean.exr", "b/a.truth_clean.demosaic.exr", "c/a.truth_clean.exr"],
            ["o/a.truth.exr", "b/a.truth.demosaic.exr"],
        )
    )
    assert all(np.array_equal(clean, each) for each in cleans)
    assert np.array_equal(other, again)
    assert not np.array_equal(clean, other)
    record = json.loads(Path("o/a.truth_clean.json").read_text())
    assert record["noise"] is None
    assert {s["name"]: s["method"] for s in record["stages"]}["denoise"] == "biweight"


def test_only_what_is_missing_is_made(clpipe, write_exr):
    run = ("run", crop(write_exr), "-o", "o", "--iso", 3200)

    def made(*options):
        for name in written(Path("o")):
            os.utime(Path("o", name), (1, 1))
        clpipe(*run, *options)
        return {name for name, at in stamps("o").items() if at != 10**9}

    clpipe(*run)
    assert made("--truth", "mosaic") == {"a.truth_mosaic.exr", "a.truth_mosaic.json"}
    assert not made("--truth", "mosaic")
    rest = {"a.truth.jpg", "a.truth.json", "a.truth_variance.exr", "a.truth_variance.json"}
    assert made(*ALL) == rest
    bytes_of = Path("o/a.truth_variance.exr").read_bytes()
    Path("o/a.truth_variance.exr").unlink()
    assert made(*ALL) == {"a.truth_variance.exr", "a.truth_variance.json"}
    assert Path("o/a.truth_variance.exr").read_bytes() == bytes_of
    assert len(made(*ALL, "--seed", 3)) == len(written(Path("o"))) == 8


@pytest.mark.slow
def test_a_burst_has_each_truth_once(clpipe, write_exr):
    clpipe("run", crop(write_exr), "-o", "o", "--iso", 3200, "--frames", 2, *ALL)
    names = ("frame0.jpg", "frame1.jpg", "truth.jpg", "truth_mosaic.exr", "truth_variance.exr")
    pictures = {f"a.{name}" for name in names}
    assert set(written(Path("o"))) == pictures | {f"{p.rpartition('.')[0]}.json" for p in pictures}
    clpipe("run", "a.exr", "-o", "one", "--iso", 3200, *ALL)
    for name in pictures & set(written(Path("one"))):
        assert Path("o", name).read_bytes() == Path("one", name).read_bytes()


@pytest.mark.slow
def test_noise_behind_the_mosaic_alone_has_no_clean_mosaic(clpipe, write_exr):
    noise = ("--set", "picture_noise.method=iid_gaussian", "--set", "picture_noise.sigma=0.1")
    quiet = (*noise, "--skip", "sensor_noise", "--skip", "row_noise")
    run = ("run", crop(write_exr), "-o", "o", *quiet)
    assert "picture_noise, comes after the mosaic" in clpipe(*run, *ALL, status=2).stderr
    clpipe(*run, "--truth", "development", "--format", "exr")
    assert "a.truth.exr" in written(Path("o"))


def test_a_stage_that_does_not_say_its_variance_is_named(monkeypatch):
    monkeypatch.setattr(RowNoise, "variance", Method.variance)
    with pytest.raises(RequestError, match=r"row_noise \(gaussian\) cannot compute"):
        chain_and_noise(VARIANCE, chain_of())
    chain_and_noise(MOSAIC, chain_of())


def test_a_raw_among_renders_has_no_truth(clpipe, write_exr, tmp_path):
    crop(write_exr, "in/a.exr")
    write_dng(tmp_path / "in" / "b.dng", np.arange(24 * 32).reshape(24, 32) + 2048)
    result = clpipe("run", "in", "-o", "o", "--iso", 3200, *ALL[2:4], status=1)
    assert "b.dng: no stage of this chain adds noise" in result.stderr
    assert written(Path("o")) == ["a.jpg", "a.json", "a.truth_mosaic.exr", "a.truth_mosaic.json"]


def test_two_images_whose_files_would_be_the_same(clpipe, write_exr):
    inputs = (crop(write_exr), crop(write_exr, "a.truth_mosaic.exr"))
    result = clpipe("run", *inputs, "-o", "o", "--format", "exr", *ALL, status=2)
    assert "would both write o/a.truth_mosaic" in result.stderr


def test_a_chain_that_only_adds_noise_has_a_truth_too(clpipe, write_exr):
    write_exr("m.exr", np.full((6, 8, 1), 0.25, np.float32), "Y", half=False)
    options = ("--start-at", "sensor_noise", "--until", "sensor_noise", *ALL)
    clpipe("run", "m.exr", "-o", "o", "--iso", 3200, *options)
    for name in ("truth", "truth_mosaic"):
        assert np.all(exr(f"o/m.{name}.exr").pixels == 0.25)
        assert exr(f"o/m.{name}.exr").attributes["stage"] == "sensor_noise"
    assert len(np.unique(exr("o/m.truth_variance.exr").pixels)) == 1
    assert len(np.unique(exr("o/m.exr").pixels)) > 9
