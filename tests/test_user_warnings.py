"""Warnings of the Python interface: each names the user's line, and a kind of them appears once."""

import numpy as np
import pytest

import clpipe

# Each render shows another share of black, because its lens is another one.
LENS = {"method": "brown_conrady", "fx": 30.0, "k1": {"uniform": [-0.3, -0.2]}}
OPTIONS = {"device": "numpy", "stages": ["distortion", "exposure", "gamma"], "distortion": LENS}
RENDER = np.random.default_rng(0).uniform(0.1, 0.3, (24, 32, 3)).astype(np.float32)


def texts_of(use):
    """Return the texts of the warnings of a call, by the files that they name."""
    with pytest.warns(UserWarning, match=".") as caught:
        use()
    return [(each.filename, str(each.message)) for each in caught]


def test_a_pipeline_warns_about_each_image_at_the_line_that_passed_it():
    camera = clpipe.Pipeline(**OPTIONS)
    for use in (
        lambda: camera(RENDER, "a"),
        lambda: camera(RENDER, "a"),
        lambda: list(camera.process_many([(RENDER, "a")])),
    ):
        ((file, text),) = texts_of(use)
        assert file == __file__ and text.startswith("a: ") and "picture is black" in text
    raw = clpipe.Pipeline(device="numpy", until="quantize")
    ((file, text),) = texts_of(lambda: list(raw.process_many([RENDER * 1000])))
    assert file == __file__ and "100 % of its pixels are clipped" in text


@pytest.fixture
def folder(write_exr, tmp_path):
    """Three renders, and a damaged one."""
    for number in range(4):
        path = write_exr(f"in/{number}.exr", RENDER)
    path.write_bytes(path.read_bytes()[:-1000])
    return tmp_path / "in"


def test_a_dataset_issues_a_kind_of_warning_once(folder):
    dataset = clpipe.Dataset(folder, **OPTIONS, on_error="skip")
    black, skipped = texts_of(lambda: [dataset[number] for number in range(4)])
    assert black[0] == skipped[0] == __file__
    assert "picture is black" in black[1] and "skipped: " in skipped[1]


def test_a_warning_of_a_thread_names_no_line_of_clpipe(folder):
    dataset = clpipe.Dataset(folder, **OPTIONS, on_error="skip")
    black, skipped = texts_of(lambda: list(dataset))
    assert black[0] in ("sys", "<sys>") and "picture is black" in black[1]
    assert skipped[0] == __file__ and "skipped: " in skipped[1]
