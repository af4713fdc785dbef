"""The digest of all code that affects pixels."""

import os
import shutil
import time

import pytest

from clpipe.engine.sources import kernel_folder
from clpipe.outputs import program
from clpipe.outputs.program import program_digest
from tests.conftest import ROOT


@pytest.fixture
def copy(tmp_path, monkeypatch):
    """A copy of the program; its digest."""
    shutil.copytree(ROOT / "clpipe", tmp_path / "clpipe")
    shutil.copytree(kernel_folder(), tmp_path / "kernels")
    folders = [tmp_path / "clpipe", tmp_path / "kernels"]
    monkeypatch.setattr(program, "_folders", lambda: folders)
    return program_digest.__wrapped__


def append(path, text="\n"):
    with open(path, "a") as file:
        file.write(text)


def test_it_is_of_what_decides_pixels(copy, tmp_path):
    seen = {copy()}
    assert copy() in seen
    for name in ("kernels/quantize.cl", "kernels/lib/random.h", "clpipe/reference/random.py"):
        append(tmp_path / name)
        assert copy() not in seen
        seen.add(copy())
    for name in ("clpipe/camera/profiles/sony-a7r2.toml", "clpipe/images/write.py"):
        append(tmp_path / name)
        assert copy() not in seen
        seen.add(copy())
    last = copy()
    for name in ("clpipe/commands/run.py", "clpipe/reports/page.py"):
        append(tmp_path / name)
    (tmp_path / "clpipe/base/__pycache__").mkdir(exist_ok=True)
    append(tmp_path / "clpipe/base/__pycache__/text.cpython-399.pyc")
    assert copy() == last


def test_a_copy_elsewhere_and_a_later_touch_are_the_same_program(copy, tmp_path):
    before = copy()
    assert before == program_digest()
    os.utime(tmp_path / "kernels/quantize.cl", (time.time() + 5,) * 2)
    assert copy() == before


def test_libraries_that_decode_and_encode_count(copy, monkeypatch):
    before = copy()
    monkeypatch.setattr(program, "versions", lambda: {"OpenEXR": "0.1"})
    assert copy() != before
