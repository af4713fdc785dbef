"""Smaller pictures: their sizes, pixels, and everything that scales with them."""

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from clpipe.chain.making import make_chain
from clpipe.chain.settings import settings_from
from clpipe.engine.check import example
from clpipe.engine.codegen import write_kernel
from clpipe.engine.runner import Runner
from clpipe.images.read import read_image
from clpipe.reference.resample import Resampling, lanczos3, overlap, resample
from clpipe.stage import Kind

FILTERS = {"area": (overlap, 0.5), "lanczos3": (lanczos3, 3.0)}
# Each size has noise by row and a stencil, so places on each of them count.
TWICE = {
    "stages": ["resize", "mosaic", "row_noise", "demosaic", "resize"],
    "iso": 3200,
    "row_noise": {"sigma": 0.01},
    "demosaic": {"method": "bilinear"},
}


def resized(image, scale, name):
    for axis in ("rows", "columns"):
        image = resample(image, Resampling(axis, scale, *FILTERS[name]))
    return image


def size_of(path):
    with Image.open(path) as picture:
        return picture.size


@pytest.mark.parametrize(("name", "most"), [("area", 0.09), ("lanczos3", 0.02)])
def test_slopes_stay_in_their_place(name, most):
    for scale in (0.75, 0.7, 0.5, 0.4):
        ramp = np.arange(1000)[None] + 0.5
        smaller = resample(ramp, Resampling("columns", scale, *FILTERS[name]))[0]
        places = (np.arange(smaller.size) + 0.5) * 1000 / smaller.size
        apart = (smaller - places)[10:-10]
        assert np.abs(apart).max() < (most if scale != 0.5 else 1e-3)
        assert abs(apart.mean()) < 1e-3


@pytest.mark.parametrize("scale", [1 / 8, 0.3, 0.5, 0.77, 1])
@pytest.mark.parametrize("name", FILTERS)
def test_every_tap_lies_in_the_image_and_weights_sum_to_one(name, scale):
    for size in (*range(1, 40), 1001):
        resampling = Resampling("columns", scale, *FILTERS[name])
        taps = resampling.taps(size)
        assert taps.first.min() >= 0 and taps.first.max() + taps.count <= size
        assert np.abs(taps.weights.sum(1, dtype=np.float64) - 1).max() < 1e-6
        lowest, beyond = resampling.needed("columns", (size, 1), 0, resampling.size(size))
        assert 0 <= lowest <= beyond <= size


def test_the_area_average_keeps_all_light_in_its_place():
    image = np.random.default_rng(0).random((30, 21, 3)).astype(np.float32)
    thirds = resized(image, 1 / 3, "area")
    assert np.allclose(thirds, image.reshape(10, 3, 7, 3, 3).mean((1, 3)), atol=1e-6)
    uneven = resized(image, 0.4, "area")  # 12 x 8, of pixels that are cut
    assert np.allclose(uneven.mean((0, 1)), image.mean((0, 1)), atol=1e-6)
    ramp = np.arange(21, dtype=np.float32)[None].repeat(30, 0)
    assert np.allclose(resized(ramp, 0.4, "area")[0], (np.arange(8) + 0.5) * 21 / 8 - 0.5, atol=0.1)


@pytest.mark.parametrize("scale", [0.13, 0.5, 0.77])
def test_lanczos3_is_that_of_pillow(scale):
    image = np.random.default_rng(0).random((37, 53)).astype(np.float32)
    ours = resized(image, scale, "lanczos3")
    other = Image.fromarray(image).resize(ours.shape[::-1], Image.Resampling.LANCZOS)
    assert np.abs(ours - np.asarray(other)).max() < 2e-6


def test_kernels_do_not_depend_on_the_scale():
    chains = [
        make_chain(settings_from({**TWICE, "resize": {"scale": scale, "method": method}}))
        for scale, method in ((0.5, "area"), (0.7, "lanczos3"))
    ]
    one, two = (Runner(chain, None).plan() for chain in chains)
    assert one != two
    assert one.unscaled == two.unscaled
    for mine, other in zip(one.launches, two.launches, strict=True):
        assert write_kernel(one, mine, 8).source == write_kernel(two, other, 8).source


@pytest.mark.slow
def test_an_image_of_which_one_pixel_is_left(device):
    settings = {**TWICE, "stages": TWICE["stages"][:-1], "resize": {"scale": 0.125}}
    chain = make_chain(settings_from(settings))
    image = example(Kind.RGB, (4, 9))
    one, two = (Runner(chain, d, final=True).run(image, "k").final for d in (device, None))
    assert one.shape == (1, 1, 3)
    assert np.array_equal(one, two)


def test_a_result_as_large_as_another_image(clpipe, write_exr):
    random = np.random.default_rng(0)
    for i, size in enumerate([(16, 24), (8, 12), (16, 24), (8, 12)]):
        write_exr(f"in/{i}.exr", random.random((*size, 3)))
    clpipe("run", "in", "-o", "o", "--stages", "resize", "--set", "resize.scale=0.5")
    sizes = [size_of(f"o/{i}.jpg") for i in range(4)]
    assert sizes == [(12, 8), (6, 4)] * 2


RUN = ("--device", "numpy", "--iso", 1600, "--set", "resize.scale=0.4")
DEVELOP = "exposure,mosaic,sensor_noise,quantize,normalize,white_balance,demosaic"
LINEAR, FINISHED = f"{DEVELOP},resize,tone_curve,gamma", f"{DEVELOP},tone_curve,gamma,resize"


def test_all_that_is_written_of_a_smaller_picture(clpipe, write_exr):
    write_exr("a.exr", np.random.default_rng(0).random((20, 30, 3)))
    lens = ("--set", "render.focal_length=24", "--set", "render.sensor_width=36")
    clpipe("run", "a.exr", "-o", "o", "--stages", LINEAR, *RUN, *lens, "--keep", "normalize",
           "--keep", "resize", "--format", "jpg", "--format", "tif16", "--truth", "development",
           "--truth", "mosaic", "--truth", "variance")  # fmt: skip
    for name in ("a.jpg", "a.tif", "a.truth.jpg"):
        assert size_of(f"o/{name}") == (12, 8)
    for name, size in {
        "a.resize": (8, 12), "a.truth.resize": (8, 12), "a.normalize": (20, 30),
        "a.truth_mosaic": (20, 30), "a.truth_variance": (20, 30),
    }.items():  # fmt: skip
        assert read_image(Path(f"o/{name}.exr"), size == (20, 30)).pixels.shape[:2] == size
    with Image.open("o/a.jpg") as picture:
        tags = picture.getexif().get_ifd(0x8769)
    assert tags[0xA405] == 24  # FocalLengthIn35mmFilm: the same field of view
    assert abs(float(tags[0xA20E]) - 120 / 36) < 1e-3  # pixels/cm of the sensor
    record = json.loads(Path("o/a.json").read_text())
    assert (record["width"], record["height"]) == (12, 8)
    clpipe("run", "o/a.normalize.exr", "-o", "again", "--start-at", "white_balance", *RUN[:2])
    assert Path("again/a.normalize.jpg").read_bytes() == Path("o/a.jpg").read_bytes()


def test_finished_pictures_are_resized_too(clpipe, write_exr):
    write_exr("a.exr", np.random.default_rng(0).random((20, 30, 3)))
    png = ("--format", "png16")
    clpipe("run", "a.exr", "-o", "o", "--stages", FINISHED, *RUN, *png, "--keep", "gamma")
    assert size_of("o/a.png") == (12, 8)
    clpipe("run", "o/a.gamma.exr", "-o", "again", "--start-at", "resize", *png, *RUN[:2])
    assert Path("again/a.gamma.png").read_bytes() == Path("o/a.png").read_bytes()
    clpipe("run", "a.exr", "-o", "whole", "--stages", FINISHED, *RUN, *png, "--until", "gamma")
    clpipe("run", "whole/a.png", "-o", "last", "--stages", FINISHED, *RUN, *png,
           "--start-at", "resize")  # fmt: skip
    assert size_of("last/a.png") == (12, 8)
    refused = clpipe("run", "a.exr", "-o", "w", "--stages", "exposure,mosaic,resize", status=2)
    assert "stage resize reads rgb, but mosaic gives mosaic" in refused.stderr


def test_what_a_jpeg_cannot_hold_may_become_what_it_can(clpipe, write_exr):
    write_exr("a.exr", np.full((1, 70_000, 3), 0.5))
    run = ("run", "a.exr", "-o", "o", "--device", "numpy", "--stages", "resize")
    assert "at most 65500 per side" in clpipe(*run, status=1).stderr
    clpipe(*run, "--set", "resize.scale=0.5")
    assert size_of("o/a.jpg") == (35_000, 1)
