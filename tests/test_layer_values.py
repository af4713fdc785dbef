"""Values of layers that cannot mean what their kind says."""

import json
from pathlib import Path

import numpy as np
import OpenEXR
import pytest

from clpipe.base.errors import ImageError
from clpipe.inputs.layer_values import value_warnings

NORMALS = np.random.default_rng(0).normal(size=(8, 9, 3)).astype(np.float32)
NORMALS /= np.sqrt((NORMALS**2).sum(-1, keepdims=True))


def test_labels_are_whole():
    labels = np.ones((4, 5, 1), np.float32)
    assert not value_warnings("Index", "label", labels)
    labels[2, 3], labels[3, 0], labels[0, 0] = 1.5, 2.25, np.inf
    [warning] = value_warnings("Index", "label", labels)
    assert warning.startswith(
        "2 of 20 values of its layer Index are not whole, the first at column 3, row 2: 1.5"
    )
    assert not value_warnings("Index", "label", np.ones((4, 5, 1), np.uint32))
    assert not value_warnings("CryptoObject00", "label", labels + np.float32(0.3))


def test_hashes_are_exact():
    with pytest.raises(ImageError, match="CryptoObject00 has half floats, which round the hashes"):
        value_warnings("CryptoObject00", "label", np.ones((4, 5, 4), np.float16))


@pytest.mark.parametrize("dtype", [np.float16, np.float32])
def test_normals_have_length_1(dtype):
    assert not value_warnings("Normal", "normal", NORMALS.astype(dtype))
    [warning] = value_warnings("Normal", "normal", (NORMALS / 2 + 0.5).astype(dtype))
    assert warning == "normals of its layer Normal are stored as 0 to 1; write them as -1 to 1"
    [warning] = value_warnings("Normal", "normal", (2 * NORMALS).astype(dtype))
    assert warning == "normals of its layer Normal have a length of 2 instead of 1"
    assert not value_warnings("Normal", "normal", np.zeros((4, 5, 3), dtype))  # only background


def test_depth_is_in_front():
    assert value_warnings("Z", "depth", np.full((4, 5, 1), -2, np.float32))
    assert not value_warnings("Z", "depth", np.float32([[[-1.0], [2.0]]]))


def test_a_run_warns_and_records(clpipe, write_exr):
    pixels = {"RGB": np.full((6, 8, 3), 0.3, np.float32), "Id.X": np.full((6, 8), 1.5, np.float32)}
    Path("in").mkdir()
    OpenEXR.File({}, pixels).write("in/a.exr")
    run = ("run", "in", "-o", "out", "--carry", "Id:label", "--device", "numpy")
    stderr = clpipe(*run).stderr
    text = "48 of 48 values of its layer Id are not whole, the first at column 0, row 0: 1.5"
    assert f"in/a.exr: warning: {text}" in stderr
    assert any(text in each for each in json.loads(Path("out/a.json").read_text())["warnings"])
