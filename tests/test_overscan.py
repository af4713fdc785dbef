"""Overscan: pixels outside the display window, used where a lens shows them."""

import json
import re
from pathlib import Path

import numpy as np
import OpenEXR
import pytest

import clpipe as clpipe_api
from clpipe.base.errors import ImageError
from clpipe.chain.layers import layer_of_array, with_layers
from clpipe.chain.making import make_chain
from clpipe.chain.overscan import overscan_step_count, with_overscan
from clpipe.chain.settings import settings_from
from clpipe.engine.check import example
from clpipe.engine.runner import Runner
from clpipe.images.read import read_image
from clpipe.inputs.subframes import weights_of
from clpipe.reference.geometry import NO_MARGINS, Margins
from clpipe.stage import Kind
from clpipe.stages.shutter import Rows
from tests.test_cuts import in_less_memory

K1, FX = -0.12, 50.3
BARREL = {"method": "brown_conrady", "fx": FX, "k1": K1}
SETS = [x for k, v in BARREL.items() for x in ("--set", f"distortion.{k}={v}")]
RUN = ("run", "in", "-o", "o", "--device", "numpy", "--format", "exr")
BEND = (*RUN, *SETS, "--stages", "distortion")
WIDTH, HEIGHT, AROUND = 72, 48, Margins(15, 11, 9, 12)


def places(width, height, margins=NO_MARGINS):
    """Columns and rows of pixels' centres in the picture, of an image with margins around it."""
    left, top, right, bottom = margins
    return np.meshgrid(
        np.arange(-left, width + right) + 0.5, np.arange(-top, height + bottom) + 0.5
    )


def light(x, y):
    """A smooth scene without end, never black."""
    waves = np.sin(x / 9 + y / 17), np.cos(x / 12 - y / 8), np.sin((x + y) / 10)
    return np.stack([2 + wave for wave in waves], -1).astype(np.float32)


def seen(width, height, k1=K1, fx=FX):
    """Where pixels of the picture come from, found by iteration, in the picture's pixels."""
    x, y = places(width, height)
    x, y = x - width / 2, y - height / 2
    u, v = x, y
    for _ in range(200):
        grown = 1 + k1 * (u * u + v * v) / fx**2
        u, v = x / grown, y / grown
    return u + width / 2, v + height / 2


def chain_of(margins=NO_MARGINS, **settings):
    chain = make_chain(settings_from({"stages": ["distortion"], "distortion": BARREL, **settings}))
    return with_overscan(chain, margins) if margins else chain


def bent(image, margins, device=None, **settings):
    return Runner(chain_of(margins, **settings), device, encode=False, final=True).run(image, "k")


def write_render(write_exr, name, margins=AROUND, pixels=None):
    left, top, _, _ = margins
    x, y = places(WIDTH, HEIGHT, margins)
    pixels = np.dstack([light(x, y), x + 100 * y]) if pixels is None else pixels
    window = {"x": -left, "y": -top, "full_width": WIDTH, "full_height": HEIGHT}
    return write_exr(name, pixels, "R,G,B,Z", half=False, **window)


@pytest.mark.parametrize("size", [(HEIGHT, WIDTH), (1, 71), (63, 1)])
def test_the_lens_shows_what_is_beyond_the_picture(device, size):
    height, width = size
    image = light(*places(width, height, AROUND))
    result = bent(image, AROUND, device).final
    assert np.array_equal(result, bent(image, AROUND).final)
    assert np.abs(result - light(*seen(width, height))).max() < 0.005
    without = bent(np.ascontiguousarray(AROUND.cropped(image)), NO_MARGINS, device).final
    u, v = seen(width, height)
    inside = (u > 3) & (u < width - 3) & (v > 3) & (v < height - 3)  # away from what is mirrored
    assert (without == 0).any()
    assert np.abs(without - result)[inside].max(initial=0) < 1e-3


def test_beyond_the_data_window_it_is_black():
    margins = Margins(top=AROUND.top, right=2)
    result = bent(light(*places(WIDTH, HEIGHT, margins)), margins).final[..., 1]
    u, v = seen(WIDTH, HEIGHT)
    beyond = np.maximum.reduce([-u, u - WIDTH - 2, v - HEIGHT])
    assert (result[beyond > 0.01] == 0).all() and (result[beyond < -0.01] > 0).all()
    assert (result[0, WIDTH // 2] > 0).all() and (result[-1, 0] == 0).all()


@pytest.mark.parametrize("k1", [-0.12, 0.6])
def test_tiles_have_the_same_bits(device, k1):
    margins, size = Margins(40, 131, 97, 6), (301, 540)
    own = {**BARREL, "k1": k1, "fx": 430.0}
    runner = Runner(chain_of(margins, distortion=own), device, encode=False, final=True)
    image = example(Kind.RGB, margins.image_size(*size)[::-1])
    whole = runner.run(image, "k")
    assert whole.final.shape == (540, 301, 3)
    assert np.array_equal(whole.final, bent(image, margins, distortion=own).final)
    in_less_memory(runner, image)


def test_fit_makes_no_use_of_more_than_fills_the_picture():
    def factor(margins, k1=K1):
        chain = chain_of(margins, distortion={**BARREL, "k1": k1, "fit": True})
        return chain.steps[0].method.lens().scale(*margins.image_size(WIDTH, HEIGHT))

    alone, few, many = (factor(Margins(n, n, n, n)) for n in (0, 3, 20))
    assert alone > few > many == 1
    assert factor(Margins(20, 20, 20, 20), 0.2) == factor(NO_MARGINS, 0.2) < 1
    few = {"fit": True, **BARREL}
    image = light(*places(WIDTH, HEIGHT, Margins(3, 3, 3, 3)))
    assert (bent(image, Margins(3, 3, 3, 3), distortion=few).final > 0.5).all()


def test_stages_before_the_lens_see_the_overscan():
    own = {
        "stages": ["shutter", "defocus", "motion_blur", "distortion"],
        "shutter": {"flicker_depth": 0.5, "line_time": 1e-3, "exposure_time": 1e-3},
        "defocus": {"method": "thin_lens", "focal_length": 200.0, "f_number": 0.5},
        "focus_distance": 1.0,
        "motion_blur": {"length": 5.0},
    }
    x, y = places(WIDTH, HEIGHT, AROUND)
    image, depth = light(x, y), np.float32(3 + x / 100 + y / 100)

    def made(margins, image, depth):
        chain = chain_of(margins, **own)
        held = {"defocus": layer_of_array(chain, "defocus", depth, *image.shape[1::-1])}
        runner = Runner(with_layers(chain, held), None, ("shutter", "defocus", "motion_blur"))
        return runner.run(image, "k").kept

    wide = made(AROUND, image, depth)
    narrow = made(NO_MARGINS, AROUND.cropped(image), AROUND.cropped(depth))
    apart = [np.abs(AROUND.cropped(wide[name]) - narrow[name]) for name in narrow]
    assert apart[0].max() < 1e-5  # the first row of the picture is exposed first
    inside = np.s_[20:-20, 20:-20]
    assert all(each[inside].max() < 1e-5 for each in apart)
    assert apart[1].max() > 0.01 and apart[2].max() > 0.01  # mirrored at the picture's edge


def test_a_camera_turns_about_the_middle_of_the_picture():
    turn = {"method": "perspective", "rotation": 3.0, "angle": 20.0, "fx": FX}
    image = light(*places(WIDTH, HEIGHT, AROUND))

    def kept(image, margins):
        chain = chain_of(margins, stages=["motion_blur", "distortion"], motion_blur=turn)
        runner = Runner(chain, None, ("motion_blur",), encode=False)
        return runner.run(image, "k").kept["motion_blur"]

    wide, narrow = kept(image, AROUND), kept(AROUND.cropped(image), NO_MARGINS)
    inside = np.s_[5:-5, 5:-5]
    assert AROUND.cropped(wide)[inside] == pytest.approx(narrow[inside], abs=1e-4)


def test_where_it_is_of_use():
    def count(**settings):
        return overscan_step_count(make_chain(settings_from(settings)))

    assert count() == 0 and count(distortion={**BARREL, "k1": 0.0}) == 0
    assert count(distortion=BARREL) == 5
    stages = ["vignetting", "distortion", "resize"]
    bent_last = {"stages": stages, "distortion": BARREL, "vignetting": {"method": "pa", "k1": -0.1}}
    assert count(**bent_last) == 0  # it counts from the middle of its image
    assert count(**{**bent_last, "skip": ["vignetting"]}) == 1
    smaller = {"stages": ["resize", "distortion"], "resize": {"scale": 0.5}}
    assert count(**smaller, distortion={"method": "poly3", "k1": -0.1}) == 0


def test_a_render_with_overscan(clpipe, write_exr):
    write_render(write_exr, "in/a.exr")
    carry = ("--carry", "Z:label", "--set", f"render.fx={FX}")
    clpipe(*BEND, *carry)
    u, v = seen(WIDTH, HEIGHT)
    assert np.abs(read_image(Path("o/a.exr")).pixels - light(u, v)).max() < 0.005
    part = OpenEXR.File("o/a.carried.exr", separate_channels=True).parts[0]
    depth, valid = (part.channels[name].pixels for name in ("Z", "valid"))
    assert (valid == 1).all()
    assert np.array_equal(depth, np.floor(u) + 0.5 + 100 * (np.floor(v) + 0.5))
    record = json.loads(Path("o/a.json").read_text())
    assert record["overscan"] == AROUND._asdict()
    assert (record["width"], record["height"]) == (WIDTH, HEIGHT)
    assert {k: record["intrinsics"][k] for k in ("width", "fx", "cx", "cy")} == {
        **{"width": WIDTH, "fx": FX, "cx": WIDTH / 2, "cy": HEIGHT / 2}
    }
    # A picture of another size, or without a lens, is that of the display window.
    write_render(write_exr, "in/b.exr", NO_MARGINS)
    clpipe(*RUN, "--stages", "motion_blur", "--set", "motion_blur.length=5", "--redo", "all")
    one, two = (read_image(Path(f"o/{name}.exr")).pixels for name in "ab")
    assert np.array_equal(one, two)
    assert "overscan" not in json.loads(Path("o/a.json").read_text())


def test_layers_with_other_windows(clpipe, write_exr):
    x, y = places(WIDTH, HEIGHT)
    write_exr("in/a.exr", light(x, y), half=False)
    write_exr("in/b.exr", light(*places(WIDTH, HEIGHT, AROUND)), half=False, **{
        "x": -AROUND.left, "y": -AROUND.top, "full_width": WIDTH, "full_height": HEIGHT
    })  # fmt: skip
    write_render(write_exr, "in/a_depth.exr")
    write_exr("in/b_depth.exr", np.ones((HEIGHT, WIDTH, 1)), "Z")
    clpipe(*BEND, "--carry", "depth:depth")
    u, v = seen(WIDTH, HEIGHT)
    inside = (u >= 0) & (u <= WIDTH) & (v >= 0) & (v <= HEIGHT)
    for name in "ab":
        part = OpenEXR.File(f"o/{name}.carried.exr", separate_channels=True).parts[0]
        assert np.array_equal(part.channels["valid"].pixels, inside)


def test_a_kept_image_has_its_overscan(clpipe, write_exr):
    write_render(write_exr, "in/a.exr")
    chain = ("--stages", "motion_blur,distortion", "--set", "motion_blur.length=3", *SETS)
    clpipe(*RUN, *chain, "--keep", "motion_blur", "--keep", "distortion")
    header = OpenEXR.File("o/a.motion_blur.exr").parts[0].header
    assert header["dataWindow"][0].tolist() == [-AROUND.left, -AROUND.top]
    assert header["displayWindow"][1].tolist() == [WIDTH - 1, HEIGHT - 1]
    assert read_image(Path("o/a.distortion.exr")).pixels.shape == (HEIGHT, WIDTH, 3)
    again = ("run", "o/a.motion_blur.exr", "-o", "again", "--device", "numpy", "--format", "exr")
    clpipe(*again, "--start-at", "distortion")
    one, two = (read_image(Path(f)) for f in ("o/a.exr", "again/a.motion_blur.exr"))
    assert np.array_equal(one.pixels, two.pixels)


def test_sub_frames_have_the_same_windows(clpipe, write_exr):
    rolling = Rows(subframes=8, exposure_time=0.02, line_time=1e-3)
    of_image = weights_of(rolling, 8, HEIGHT + AROUND.top + AROUND.bottom, AROUND)
    of_picture = rolling.weights(8, HEIGHT)
    assert np.array_equal(of_image[:, AROUND.top : AROUND.top + HEIGHT], of_picture)
    assert of_image.sum(0) == pytest.approx(1)
    write_render(write_exr, "in/a.exr")
    write_render(write_exr, "in/b.exr")
    mean = ("--set", "shutter.subframes=2", "--stages", "shutter,distortion")
    clpipe(*RUN, *SETS, *mean)
    assert np.abs(read_image(Path("o/a.exr")).pixels - light(*seen(WIDTH, HEIGHT))).max() < 0.005
    write_render(write_exr, "in/b.exr", Margins(1))
    stderr = clpipe(*RUN, *SETS, *mean, "--redo", "all", status=1).stderr
    assert "72x48 with (1, 0, 0, 0) px of overscan" in stderr and "(15, 11, 9, 12)" in stderr


def test_truths_and_brackets_have_it_too(clpipe, write_exr):
    write_render(write_exr, "in/a.exr")
    stages = ("--stages", "motion_blur,distortion,exposure,mosaic,sensor_noise")
    clpipe(*RUN, *SETS, *stages, "--truth", "clean", "--bracket", "0,1")
    for name in ("a.ev+0.truth_clean", "a.ev+1.truth_clean", "a.ev+1"):
        mosaic = read_image(Path(f"o/{name}.exr"), mosaic=True).pixels
        assert mosaic.shape == (HEIGHT, WIDTH) and mosaic.min() > 0.3


@pytest.mark.parametrize("around", [NO_MARGINS, AROUND], ids=["without", "with"])
def test_black_corners_are_told(clpipe, write_exr, around):
    write_render(write_exr, "in/a.exr", around)
    stderr = clpipe(*BEND, "--set", f"render.fx={FX}").stderr
    (black,) = re.findall(r"([\d.]+) % of the picture is black", stderr) or ["0"]
    seen = read_image(Path("o/a.exr")).pixels.max(-1) < 0.5
    assert float(black) == pytest.approx(100 * seen.mean(), abs=1.5)
    assert ("set distortion.fit=true" in stderr) == (around == NO_MARGINS)
    if around == NO_MARGINS:
        assert float(black) > 1
        (more,) = re.findall(r"render (\d+) px more on each side", stderr)
        assert int(more) <= max(AROUND)
        assert "black" not in clpipe(*BEND, "--set", "distortion.fit=true").stderr


def test_datasets_and_pipelines(write_exr, tmp_path):
    path = write_render(write_exr, "a.exr")
    own = {"stages": ["distortion"], "distortion": BARREL}
    with pytest.warns(UserWarning, match="values of its layer Z are not whole"):
        sample = clpipe_api.Dataset(path, device="numpy", carry="Z:label", epochs=1, **own)[0]
    pipe = clpipe_api.Pipeline(device="numpy", **own)
    image = read_image(path, overscan=True).pixels
    made = pipe.process(image, "a", overscan=AROUND).image
    assert np.array_equal(sample["image"], made) and made.shape == (HEIGHT, WIDTH, 3)
    x, y = places(WIDTH, HEIGHT, AROUND)
    depth, valid = pipe.carry(x + 100 * y, "label", overscan=AROUND)
    assert np.array_equal(depth, sample["carried.Z"][..., 0]) and valid.all()
    plain = clpipe_api.Pipeline(device="numpy", stages=["motion_blur"], motion_blur={"length": 5.0})
    one = plain.process(image, "a", overscan=AROUND).image
    assert np.array_equal(one, plain.process(read_image(path).pixels, "a").image)
    assert plain.carry(x, "depth", overscan=AROUND)[0].shape == (HEIGHT, WIDTH)
    for wrong in ((1, 2, 3), (50, 0, 46, 0), (0, 0, 0, -1)):
        with pytest.raises(ImageError, match=r"found overscan \(.* of shape \(71, 96"):
            pipe.process(image, "a", overscan=wrong)


def test_windows_that_do_not_meet_or_are_too_far_apart(clpipe, write_exr):
    pixels = np.ones((4, 5, 3))
    window = {"full_width": 6, "full_height": 4}
    write_exr("in/a.exr", pixels, x=6, **window)
    assert "no pixel of its data window, 5x4 at 6, 0, lies in" in clpipe(*BEND, status=1).stderr
    assert not Path("o/a.exr").exists()
    write_exr("in/a.exr", np.ones((1, 300, 3)), x=-100, **{"full_width": 2, "full_height": 200})
    stderr = clpipe(*BEND, "--max-pixels", 1000, "--redo", "all", status=1).stderr
    assert "300x200 pixels; at most 1000 are read" in stderr


def test_a_lens_that_folds_the_overscan_is_refused():
    strong = {**BARREL, "k1": -0.4}
    bent(light(*places(WIDTH, HEIGHT, AROUND)), NO_MARGINS, distortion={**strong, "fx": 90.0})
    wide = Margins(60, 60, 60, 60)
    with pytest.raises(ImageError, match=r"the corner of 192x168 pixels .* or less overscan"):
        bent(light(*places(WIDTH, HEIGHT, wide)), wide, distortion=strong)
