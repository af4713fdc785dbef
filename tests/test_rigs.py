"""Streams of several views, and of sub-frames."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import clpipe
from clpipe.base.errors import ImageError, RequestError
from clpipe.images.read import read_image

RIG = {"left": {"camera": "sony-a7r2"}, "right": {"camera": "nikon-d850", "iso": 400}}
FRAMES = np.random.default_rng(0).random((6, 2, 24, 32, 3)).astype(np.float32) / 8
AUTO = {"exposure": {"method": "auto"}, "keep": "quantize"}


def same(one, two):
    assert np.array_equal(one.image, two.image)
    assert np.array_equal(one.result.kept["quantize"], two.result.kept["quantize"])
    assert (one.index, one.view, one.settings, one.camera) == (
        *(two.index, two.view, two.settings, two.camera),
    )


@pytest.mark.parametrize("device", [None, "numpy"])
@pytest.mark.parametrize("temporal", [False, True])
def test_a_view_is_a_stream_of_its_own(device, temporal):
    options = {**AUTO, "device": device}
    if temporal:
        options["config"] = "video"
    with clpipe.Stream(views=RIG, **options) as stream:
        called = [
            stream(frame, view=view, time=float(step))
            for step, pair in enumerate(FRAMES)
            for frame, view in zip(pair, RIG, strict=True)
        ]
    put = []
    with clpipe.Stream(views=RIG, **options) as stream:
        for step, pair in enumerate(FRAMES):
            assert stream.put_many(pair * np.float32(1), times=[float(step)] * 2)
            put += [stream.get(60), stream.get(60)]
    for one, two in zip(called, put, strict=True):
        same(one, two)
    for name, own in RIG.items():
        with clpipe.Stream(name=f"stream/{name}", **{**options, **own}) as single:
            for step, shot in enumerate(each for each in called if each.view == name):
                alone = single(FRAMES[step, list(RIG).index(name)])
                assert np.array_equal(alone.image, shot.image)
                assert replace(alone.camera, time=float(step)) == shot.camera
                assert shot.time == step


def test_views_that_fail_do_not_stop_others():
    bad = FRAMES[0].copy()
    bad[0] = np.nan
    with clpipe.Stream(device="numpy", views=RIG, **AUTO) as stream:
        stream.put_many(FRAMES[0])
        first = [stream.get(60), stream.get(60)]
        stream.put_many(bad)
        with pytest.raises(ImageError, match=r"stream/left/000001: .* NaN"):
            stream.get(60)
        assert stream.get(60).view == "right"
        stream.put_many(FRAMES[1][1:], ["right"])
        assert stream.get(60).index == 2
    assert [shot.index for shot in first] == [0, 0]


def test_drop_drops_all_views_of_a_put():
    with clpipe.Stream(device="numpy", views=RIG, drop=True) as stream:
        sent = sum(stream.put_many(FRAMES[0]) for _ in range(20))
        shots = list(stream.finish())
    assert len(shots) == 2 * sent == 40 - stream.dropped


def test_rejected_views():
    with clpipe.Stream(device="numpy", views=RIG) as stream:
        for arguments, message in (
            ({}, "this stream has the views left, right; name one"),
            ({"view": "top"}, "unknown view 'top'"),
        ):
            with pytest.raises(RequestError, match=message):
                stream(FRAMES[0, 0], **arguments)
        with pytest.raises(RequestError, match="found 2 views, but the stack has 1 views"):
            stream.put_many(FRAMES[0, :1])
        with pytest.raises(RequestError, match="found 1 times, but the stack has 2 views"):
            stream.put_many(FRAMES[0], times=[0.0])


def test_what_is_rejected_or_empty_takes_no_place():
    with clpipe.Stream(device="numpy", views=RIG) as stream:
        with pytest.raises(RequestError, match="unknown view 'top'"):
            stream.put_many(FRAMES[0], views=["left", "top"])
        with pytest.raises(ImageError, match="a stack of images is expected"):
            stream.put_many(np.float32(3))
        for _ in range(3):  # more than there are places
            assert stream.put_many(FRAMES[0, :0], views=[])
        assert stream.put_many(FRAMES[0], times=np.array([0.0, 0.5]))
        shots = list(stream.finish())
    assert [(shot.view, shot.index, shot.time) for shot in shots] == [
        ("left", 0, 0.0),
        ("right", 0, 0.5),
    ]


def test_subframes_are_those_of_files(write_exr, clpipe):
    """A list of sub-frames makes the exposure that clpipe run makes of files."""
    shutter = {"subframes": 3, "exposure_time": 0.004, "line_time": 1e-4}
    frames = [frame.astype(np.float16).astype(np.float32) for frame in FRAMES[:3, 0]]
    for number, frame in enumerate(frames):
        write_exr(f"in/f.{number:04}.exr", frame)
    words = [word for k, v in shutter.items() for word in ("--set", f"shutter.{k}={v}")]
    clpipe("run", "in/f.%04d.exr", "-o", "out", "--until", "shutter", *words)
    expected = read_image(Path("out/f.0000.exr")).pixels
    with _stream(until="shutter", shutter=shutter) as stream:
        assert np.array_equal(stream(frames).image, expected)
        stream.put(frames)
        assert np.array_equal(stream.get(60).image, expected)
    one = _stream(until="shutter")
    with one, pytest.raises(RequestError, match=r"3 sub-frames, but shutter\.subframes is 1"):
        one(frames)
    three = _stream(until="shutter", shutter=shutter)
    with three, pytest.raises(ImageError, match="different shapes"):
        three([*frames[:2], frames[2][:-1]])


def _stream(**options):
    return clpipe.Stream(device="numpy", **options)
