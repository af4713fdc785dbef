"""Noise depends on the seed, the ISO and the image, and is shared only on request."""

import json
import warnings
from pathlib import Path

import numpy as np
import pytest

import clpipe as api
from clpipe.images.read import read_image
from clpipe.images.write import write_exr

RUN = ("--device", "numpy", "--until", "sensor_noise", "--format", "exr", "--iso", 3200)
SIDE = 48


def render(path, level, side=SIDE):
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    write_exr(Path(path), np.full((side, side, 3), level, np.float32), "RGB", {})


def noise(path):
    pixels = read_image(Path(path), mosaic=True).pixels
    sites = [pixels[y::2, x::2] for y in (0, 1) for x in (0, 1)]
    return np.stack([(s - s.mean()) / s.std() for s in sites])


def correlation(one, two):
    return float((noise(one) * noise(two)).mean())


def alike(value):
    """Whether a correlation of fields is some: beyond 5 standard errors of 0."""
    return abs(value) > 5 / SIDE


def test_two_views_of_one_name_do_not_share_noise(clpipe):
    render("camL/0001.exr", 0.3)
    render("camR/0001.exr", 0.31)
    for camera in ("camL", "camR"):  # one folder at a time
        clpipe("run", camera, "-o", f"o/{camera}", *RUN)
    assert not alike(correlation("o/camL/0001.exr", "o/camR/0001.exr"))
    clpipe("run", "camL", "-o", "again", *RUN)
    assert Path("again/0001.exr").read_bytes() == Path("o/camL/0001.exr").read_bytes()
    clpipe("run", "camL/0001.exr", "-o", "single", *RUN)
    assert Path("single/0001.exr").read_bytes() == Path("o/camL/0001.exr").read_bytes()


def test_one_render_at_two_isos_does_not_share_noise(clpipe):
    render("a.exr", 0.3)
    for iso in (1600, 3200):
        clpipe("run", "a.exr", "-o", f"o{iso}", *RUN[:-1], iso)
    assert not alike(correlation("o1600/a.exr", "o3200/a.exr"))
    # One that was kept without noise goes on at two ISOs.
    clean = ("--until", "inverse_white_balance", "--format", "exr", "--device", "numpy")
    clpipe("run", "a.exr", "-o", "kept", *clean)
    for iso in (1600, 3200):
        run = ("run", "kept/a.exr", "-o", f"k{iso}", "--start-at", "sensor_noise")
        clpipe(*run, *RUN[:-1], iso)
    assert not alike(correlation("k1600/a.exr", "k3200/a.exr"))
    assert np.array_equal(noise("k3200/a.exr"), noise("o3200/a.exr"))


def test_the_same_picture_under_two_names_does_not_share_noise(clpipe):
    render("in/a.exr", 0.3)
    Path("in/b.exr").write_bytes(Path("in/a.exr").read_bytes())
    clpipe("run", "in", "-o", "o", *RUN)
    assert not alike(correlation("o/a.exr", "o/b.exr"))


@pytest.mark.parametrize("way", ["option", "manifest", "config"])
def test_common_random_numbers_are_asked_for(clpipe, way):
    render("in/a.exr", 0.3)
    render("in/b.exr", 0.35)
    if way == "option":
        clpipe("run", "in", "-o", "o", *RUN, "--noise-key", "pair")
    elif way == "config":
        Path("own.toml").write_text('noise_key = "pair"\n')
        clpipe("run", "in", "-o", "o", *RUN, "-c", "own.toml")
    else:
        Path("in/list.csv").write_text("path,iso,noise_key\na.exr,1600,pair\nb.exr,3200,pair\n")
        clpipe("run", "in/list.csv", "-o", "o", *RUN)
    assert correlation("o/a.exr", "o/b.exr") > 0.99
    assert json.loads(Path("o/a.json").read_text())["noise_key"] == "pair"


def test_a_frame_that_was_kept_with_a_key_of_its_own_goes_on_as_it_would_have(clpipe):
    render("a.exr", 0.3)
    own = (*RUN[:2], "--iso", 3200, "--noise-key", "pair", "--frames", 2)
    clpipe("run", "a.exr", "-o", "o", *own, "--until", "sensor_noise", "--format", "exr")
    clpipe("run", "a.exr", "-o", "kept", *own, "--keep", "inverse_white_balance")
    clpipe(
        *("run", "kept/a.frame1.inverse_white_balance.exr", "-o", "k"),
        *("--start-at", "sensor_noise", *RUN[:-2]),
    )
    kept = "k/a.frame1.inverse_white_balance.exr"
    assert np.array_equal(noise(kept), noise("o/a.frame1.exr"))
    assert not alike(correlation("o/a.frame0.exr", "o/a.frame1.exr"))


def test_bursts_of_a_kept_burst_do_not_share_noise(clpipe):
    render("a.exr", 0.3)
    burst = (*RUN, "--frames", 2)
    step = "inverse_white_balance"
    clpipe("run", "a.exr", "-o", "first", *burst, "--keep", step)
    for i in (0, 1):
        run = ("run", f"first/a.frame{i}.{step}.exr", "-o", "again", "--start-at", "sensor_noise")
        clpipe(*run, *burst)
    names = [f"again/a.frame{i}.{step}.frame{k}.exr" for i in (0, 1) for k in (0, 1)]
    made = [noise(name) for name in names]
    for i, one in enumerate(made):
        assert not any(alike(float((one * other).mean())) for other in made[:i])
    for i in (0, 1):  # each goes on as it would have
        assert np.array_equal(made[2 * i], noise(f"first/a.frame{i}.exr"))


def test_pipeline(tmp_path, clpipe):
    image = np.full((SIDE, SIDE, 3), 0.3, np.float32)
    pipeline = api.Pipeline(iso=3200, device="numpy", until="sensor_noise")
    first = list(pipeline.process_many([image, image]))
    second = list(pipeline.process_many([image, image]))
    made = [*first, *second]
    for i, one in enumerate(made):
        assert not any(np.array_equal(one.image, other.image) for other in made[:i])
    # Another image under the same key, and the same at another ISO.
    left, right = pipeline.process(image, "0001"), pipeline.process(image + 0.01, "0001")
    low = pipeline.process(image, "0001", iso=1600)
    same = pipeline.process(image, "0001")
    assert np.array_equal(left.image, same.image)

    def of_reds(one, two):
        return float(np.corrcoef(*(r.image[::2, ::2].ravel() for r in (one, two)))[0, 1])

    assert abs(of_reds(left, right)) < 0.2 and abs(of_reds(left, low)) < 0.2
    shared = [pipeline.process(image + i / 100, "k", noise_key="pair") for i in (0, 1)]
    assert of_reds(*shared) > 0.99
    # The sidecar's key repeats the noise of a run.
    render("a.exr", 0.3)
    clpipe("run", "a.exr", "-o", "o", *RUN)
    key = json.loads(Path("o/a.json").read_text())["noise_key"]
    exact = np.asarray(read_image(Path("a.exr")).pixels)
    assert np.array_equal(
        pipeline.process(exact, "any", noise_key=key).image,
        read_image(Path("o/a.exr"), mosaic=True).pixels,
    )


def test_a_dataset_has_the_noise_of_a_run(clpipe):
    render("in/a.exr", 0.3)
    clpipe("run", "in", "-o", "o", *RUN, "--frames", 2)
    samples = api.Dataset("in", device="numpy", iso=3200, until="sensor_noise", epochs=2)
    for sample, name in zip(samples, ("o/a.frame0.exr", "o/a.frame1.exr"), strict=True):
        assert np.array_equal(sample["image"], read_image(Path(name), mosaic=True).pixels)


def test_what_clips_is_said(clpipe):
    render("in/a.exr", 0.3, side=16)
    render("in/b.exr", 0.2, side=16)
    run = ("run", "in", "-o", "o", "--device", "numpy")
    assert "clipped" not in clpipe(*run).stderr
    assert json.loads(Path("o/a.json").read_text())["clipped"] == 0
    stderr = clpipe(*run, "--set", "exposure.ev=6").stderr
    assert "2 images have many clipped pixels. The worst is in/" in stderr
    assert "100 % of its pixels are" in stderr
    assert json.loads(Path("o/a.json").read_text())["clipped"] == 1
    run_again = (*run, "--set", "exposure.ev=6", "--quiet", "--redo", "all")
    assert "clipped" not in clpipe(*run_again).stderr
    single = clpipe("run", "in/a.exr", "-o", "s", *run[4:], "--set", "exposure.ev=6").stderr
    assert "in/a.exr: warning: 100 % of its pixels are clipped. Check exposure.ev" in single


def test_python_says_that_an_image_clips():
    pipeline = api.Pipeline(device="numpy")
    image = np.full((8, 8, 3), 0.3, np.float32)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        pipeline.process(image, "a")
    with pytest.warns(UserWarning, match="b: 100 % of its pixels are clipped. Check exposure"):
        pipeline.process(image * 255, "b")
