"""Compiled programs: shared by a process, kept between processes, and announced when slow."""

import logging
import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from clpipe.chain.chain import make_chain
from clpipe.chain.settings import settings_from
from clpipe.engine import programs
from clpipe.engine.device import Device
from clpipe.engine.runner import Runner
from tests.conftest import STILL_LIFE

SMALL = {"stages": ["exposure", "gamma"]}
FOLDER = "from clpipe.engine.cache_folder import cache_folder; print(cache_folder())"
DEVELOP = (
    "import numpy, clpipe; clpipe.Pipeline(stages=['exposure', 'gamma'], device='cpu')"
    ".process(numpy.zeros((4, 4, 3), numpy.float32), 'a')"
)


def python(code, **environment):
    """What a fresh process prints, in an environment without a cache folder of its own."""
    names = ("CLPIPE_CACHE_DIR", "XDG_CACHE_HOME", "POCL_CACHE_DIR", "HOME")
    plain = {k: v for k, v in os.environ.items() if k not in names}
    given = {k: str(v) for k, v in environment.items()}
    done = subprocess.run(
        [sys.executable, "-c", code], env=plain | given, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


def test_the_cache_folder_is_the_users_or_a_named_one(tmp_path):
    assert python(FOLDER, HOME=tmp_path) == str(tmp_path / ".cache" / "clpipe")
    assert python(FOLDER, HOME=tmp_path, CLPIPE_CACHE_DIR=tmp_path / "x") == str(tmp_path / "x")


def test_a_home_that_cannot_be_written_to_gets_a_temporary_cache(tmp_path):
    (tmp_path / "file").touch()
    folder = python(FOLDER, HOME=tmp_path / "file")
    assert Path(folder).name.startswith("clpipe-")
    assert not Path(folder).exists()  # it went with the process
    python(DEVELOP, HOME=tmp_path / "file")


def test_a_second_process_compiles_nothing(device, tmp_path):
    if "Portable Computing" not in device.info.platform:
        pytest.skip("looks into PoCL's cache")

    def compiled():
        return {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*.so")}

    python(DEVELOP, CLPIPE_CACHE_DIR=tmp_path)
    first = compiled()
    assert first
    python(DEVELOP, CLPIPE_CACHE_DIR=tmp_path)
    assert compiled() == first


def test_devices_and_chains_share_programs(device):
    image = np.zeros((8, 8, 3), np.float32)
    Runner(make_chain(settings_from(SMALL)), device).run(image, "a")
    before = len(programs.programs_of(device.info))
    for own in (device, Device(device.info)):
        for values in ({}, {"iso": 1600}, {"exposure": {"ev": 2}}):
            Runner(make_chain(settings_from({**SMALL, **values})), own).run(image, "a")
    assert len(programs.programs_of(device.info)) == before


def test_slow_compiling_is_announced_once(device, monkeypatch, caplog):
    monkeypatch.setattr(programs, "LONG", 0.01)
    monkeypatch.setattr(programs, "_announced", programs.threading.Event())
    with caplog.at_level(logging.INFO, "clpipe"):
        for _ in range(2):
            with programs.announced(device.info):
                time.sleep(0.1)
        with programs.announced(device.info):
            pass
    (record,) = caplog.records
    assert "compiling kernels for" in record.getMessage()
    assert device.info.label in record.getMessage()


@pytest.mark.parametrize(("options", "count"), [((), 1), (("--quiet",), 0)])
def test_the_command_line_prints_it(clpipe, monkeypatch, options, count):
    monkeypatch.setattr(programs, "LONG", 0.0)
    monkeypatch.setattr(programs, "_announced", programs.threading.Event())
    done = clpipe("run", STILL_LIFE, "-o", "out", "--stages", "exposure,gamma", *options)
    assert done.stderr.count("clpipe: compiling kernels for") == count
