"""Values that are set, but that nothing uses, are named."""

import re

import numpy as np
import pytest

import clpipe as api

DRIFT = "dark_current.temperature={drift=[30, 40]}"


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        (["--set", "control.delay=3"], "control.delay acts only on frames of sequences"),
        (["--set", DRIFT], "dark_current.temperature drifts only through the frames"),
        (["--set", "shutter.line_time=1e-5"], "shutter.line_time changes no pixel"),
        (
            ["--sequence", "--set", "control.delay=3", "--set", "control.speed=1"],
            "no loop uses control.delay, control.speed; add --set exposure.method=auto",
        ),
        (["--sequence", "--set", DRIFT], None),
        (["--sequence", "--set", "exposure.method=auto", "--set", "control.delay=3"], None),
        (["--set", "shutter.line_time=1e-5", "--set", "shutter.flicker_depth=0.1"], None),
        ([], None),
    ],
)
def test_a_run_names_what_nothing_uses(clpipe, write_exr, caplog, options, expected):
    write_exr("in/a.exr", np.full((8, 12, 3), 0.2, np.float32))
    clpipe("run", "in", "-o", "o", "--device", "numpy", "--dry-run", *options)
    named = [m for m in caplog.messages if re.search("acts? only|drifts|changes|no loop", m)]
    if expected is None:
        assert named == []
    else:
        [message] = named
        assert message.startswith(expected)


def test_an_exposure_that_is_longer_than_its_frame_is_named(clpipe, write_exr, caplog):
    pytest.importorskip("av", reason="needs PyAV: pip install av")
    for frame in range(2):
        write_exr(f"in/a{frame}.exr", np.full((8, 12, 3), 0.2, np.float32))
    given = ("--set", "shutter.exposure_time=0.1", "--set", "shutter.flicker_depth=0.5")
    clip = ("-o", "o", "--format", "mkv", "--fps", "24", "--device", "numpy")
    clpipe("run", "in", *clip, *given)
    assert "shutter.exposure_time is 0.1 s, but at 24 frames per second a frame has" in caplog.text


def test_pipelines_and_streams_name_it_in_their_own_words():
    with pytest.warns(UserWarning, match=r"control.delay acts .*; use clpipe.Stream, or remove it"):
        api.Pipeline(device="numpy", control={"delay": 3})
    with pytest.warns(UserWarning, match="shutter.subframes averages the files of an exposure"):
        api.Pipeline(device="numpy", shutter={"subframes": 3})
