"""Compiled programs: shared in a process, cached between processes, announced if slow."""

import io
import logging
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import platformdirs
import pyopencl as cl
import pytest
from rich.console import Console

from clpipe.base.errors import DeviceError
from clpipe.batch.execution import ExecutionOptions
from clpipe.batch.run_log import Summary
from clpipe.chain.making import make_chain
from clpipe.chain.settings import settings_from
from clpipe.commands import progress
from clpipe.commands.notices import NOTICES
from clpipe.engine import cache_folder, programs
from clpipe.engine.device import Device
from clpipe.engine.discovery import choose, find_devices
from clpipe.engine.runner import Runner
from tests.conftest import STILL_LIFE, run_python

SMALL = {"stages": ["exposure", "gamma"]}
FOLDER = (
    "from clpipe.engine.cache_folder import cache_folder, cache_problem;"
    "print(cache_folder()); print(cache_problem())"
)
DEVELOP = (
    "import numpy, clpipe; clpipe.Pipeline(stages=['exposure', 'gamma'], device='cpu')"
    ".process(numpy.zeros((4, 4, 3), numpy.float32), 'a')"
)


def python(code, **environment):
    """What a fresh process prints, in an environment without a cache folder of its own."""
    with pytest.MonkeyPatch.context() as patch:
        for name in ("CLPIPE_CACHE_DIR", "XDG_CACHE_HOME", "POCL_CACHE_DIR", "HOME"):
            patch.delenv(name, raising=False)
        return run_python("-c", code, **environment).stdout.strip()


def test_the_cache_folder_is_the_users_or_a_named_one(tmp_path):
    (tmp_path / "file").touch()
    home, named, none = tmp_path / ".cache" / "clpipe", tmp_path / "x", tmp_path / "file"
    assert python(FOLDER, HOME=tmp_path) == str(home)
    assert python(FOLDER, HOME=tmp_path, CLPIPE_CACHE_DIR=named) == str(named)
    lines = python(FOLDER, CLPIPE_CACHE_DIR=none).split("\n")
    assert lines == ["None", f"they cannot be cached in {none}"]


@pytest.mark.slow
def test_in_a_home_that_cannot_be_written_to_pocl_compiles_in_a_folder_of_the_process(tmp_path):
    (tmp_path / "file").touch()
    code = f"{DEVELOP}; import os; print(os.environ['POCL_CACHE_DIR']); {FOLDER}"
    used, kept, _ = python(code, HOME=tmp_path / "file", POCL_CACHE_DIR=tmp_path / "x").split("\n")
    assert kept == "None" and not (tmp_path / "x").exists()
    assert not Path(used).exists()  # it went with the process


def test_a_user_without_a_home(monkeypatch):
    def fail(_):
        raise RuntimeError("could not determine the home directory")  # platformdirs from 4.5 on

    with monkeypatch.context() as patch:
        patch.setattr(platformdirs, "user_cache_path", fail)
        assert cache_folder.user_folder() is None
    monkeypatch.setattr(platformdirs, "user_cache_path", lambda _: Path("~/.cache"))
    assert cache_folder.user_folder() is None
    assert not cache_folder.is_usable(None)


SIGNALS_AROUND = """
import ctypes, signal

handler_of = ctypes.CDLL(None).signal
handler_of.restype, handler_of.argtypes = ctypes.c_void_p, [ctypes.c_int, ctypes.c_void_p]

def handlers():
    found = [handler_of(number, None) for number in (signal.SIGINT, signal.SIGTERM)]
    handler_of(signal.SIGINT, found[0]), handler_of(signal.SIGTERM, found[1])
    return found

signal.signal(signal.SIGTERM, lambda *of: None)
before = handlers()
from clpipe.engine.device import open_devices
open_devices(["cpu"])
print(before == handlers())
"""


@pytest.mark.slow
def test_signals_go_where_they_went_before_there_was_a_compiler_in_the_process(tmp_path):
    assert python(SIGNALS_AROUND, CLPIPE_CACHE_DIR=tmp_path) == "True"


def test_why_pocl_cannot_work_is_said(device, monkeypatch):
    if "Portable Computing" not in device.info.platform:
        pytest.skip("needs PoCL")
    monkeypatch.setattr(cache_folder, "process_folder", lambda: None)
    reason = r"PoCL needs a writable folder .* 32 MiB of free space, .*TMPDIR"
    with pytest.raises(DeviceError, match=reason):
        choose(None, find_devices())
    monkeypatch.setattr(cl.Platform, "get_devices", lambda _: [])  # as PoCL has it at first
    with pytest.raises(DeviceError, match=reason):
        choose(None, find_devices())
    monkeypatch.setattr(cache_folder, "process_folder", lambda: Path("somewhere"))
    with pytest.raises(DeviceError, match=r"Computing Language.: it offers no device"):
        choose(None, find_devices())


def test_a_pocl_with_other_headers_declares_the_functions_itself(device, monkeypatch):
    if "Portable Computing" not in device.info.platform:
        pytest.skip("needs PoCL")
    image = np.full((8, 8, 3), 0.5, np.float32)
    chain = make_chain(settings_from(SMALL))
    expected = Runner(chain, device).run(image, "a").image
    monkeypatch.setattr(programs, "BUILTIN_OPTIONS", ("-D_OPENCL_H_", "-DOTHER_HEADERS"))
    monkeypatch.setattr(programs, "_by_device", {})
    given = Runner(chain, Device(device.info)).run(image, "a").image
    np.testing.assert_array_equal(given, expected)
    assert not programs.programs_of(device.info).declares


def test_devices_and_chains_share_programs(device):
    first = Device(device.info)  # a test may have opened the session's device again
    Runner(make_chain(settings_from(SMALL)), first).run(np.zeros((8, 8, 3), np.float32), "a")
    before = len(programs.programs_of(device.info))
    for own, size in ((first, (8, 8, 3)), (Device(device.info), (50, 10, 3))):
        for values in ({}, {"iso": 1600}, {"exposure": {"ev": 2}}, {"seed": 4}):
            runner = Runner(make_chain(settings_from({**SMALL, **values})), own)
            runner.run(np.zeros(size, np.float32), "a")
    assert len(programs.programs_of(device.info)) == before


@pytest.mark.parametrize(("options", "count"), [((), 1), (("--quiet",), 0)])
def test_the_command_line_prints_it(clpipe, monkeypatch, options, count):
    monkeypatch.setattr(programs, "NOTICE_DELAY", 0.0)
    monkeypatch.setattr(programs, "_notice_logged", programs.threading.Event())
    done = clpipe("run", STILL_LIFE, "-o", "out", "--stages", "exposure,gamma", *options)
    assert done.stderr.count("clpipe: compiling kernels for") == count


def test_who_watches_is_told_how_far_compiling_is(device):
    lines = []
    chain = make_chain(settings_from({"white_balance": {"method": "gray_world"}}))
    with programs.watching_compilation(lambda *counts: lines.append(counts)):
        Runner(chain, Device(device.info)).compile()
    count = lines[-1][1]
    assert count > 1 and lines == [(i, count) for i in range(count + 1)]
    Runner(chain, Device(device.info)).compile()
    assert len(lines) == count + 1


@pytest.mark.parametrize(("done", "said"), [(2, "compiling 3 of 7"), (7, "first launches")])
def test_compiling_is_a_step_of_the_live_display(monkeypatch, done, said):
    monkeypatch.setattr(progress, "COMPILE_DELAY", -1.0)
    console = Console(file=io.StringIO(), force_terminal=True, width=80, color_system=None)
    run = SimpleNamespace(summary=Summary(6), writer=None, execution=ExecutionOptions(Path("out")))
    with progress.Reporter(run, console):
        programs.notify_watchers(done, 7)
        record = logging.LogRecord("clpipe", logging.INFO, "", 0, "compiling kernels", (), None)
        NOTICES.handle(record)
    shown = console.file.getvalue()
    assert said in shown
    assert "clpipe: compiling kernels\n" in shown.replace("\r", "")
    assert shown.rstrip().endswith("6 not begun") and "0/6" not in shown.splitlines()[-1]
