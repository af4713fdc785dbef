"""OpenCL runtimes are tested in a separate process before use, because they may crash."""

import json
import sys
from types import SimpleNamespace

import pyopencl as cl
import pytest

from clpipe.base.errors import DeviceError
from clpipe.commands.devices import device_rows
from clpipe.engine import discovery, trial, verdicts
from clpipe.engine.cpu_target import Target, compile_for
from clpipe.engine.discovery import choose, find_devices
from clpipe.engine.runtimes import attempt, platform_id
from clpipe.engine.store import Store
from clpipe.engine.verdicts import Verdicts, run_tests


@pytest.fixture
def program(tmp_path, monkeypatch):
    """Replace the test of runtimes by a shell script, which reads known results from stdin."""

    def be(script):
        path = tmp_path / "python"
        path.write_text(f"#!/bin/sh\nknown=$(cat)\n{script}\n")
        path.chmod(0o755)
        monkeypatch.setattr(sys, "executable", str(path))
        monkeypatch.setattr(verdicts, "_store", lambda: Store(tmp_path / "known"))

    return be


def say(**values):
    return f"echo '{json.dumps(values)}'"


def test_what_ends_the_process_is_passed_over_and_the_rest_tried(program):
    program(f"""case "$known" in
        *SIGILL*) {say(at="attempt", name="b")}; {say(attempt="b", problem="", passing=False)};;
        *) {say(at="attempt", name="a")}; echo noise; echo no such instruction >&2; kill -ILL $$;;
        esac""")
    found = run_tests(Verdicts())
    assert found.attempts == {
        "a": "it crashes the process (SIGILL): no such instruction",
        "b": "",
    }
    assert found.lasting and found.problems


def test_a_platform_that_ends_the_process_is_named(program):
    program(f"""case "$known" in
        *SIGABRT*) ;;
        *) {say(at="platform", name="A")}; kill -ABRT $$;;
        esac""")
    assert run_tests(Verdicts()).platforms == {"A": "it crashes the process (SIGABRT)"}


def test_the_driver_that_ends_the_listing_is_hidden(program, monkeypatch):
    monkeypatch.setattr(verdicts, "installed_drivers", lambda: ["good", "bad"])
    # It ends it wherever "bad" is not hidden.
    program(f"""case "$known" in
        *'"bad":'*) {say(at="list")};;
        *) {say(at="list")}; kill -SEGV $$;;
        esac""")
    assert run_tests(Verdicts()).hidden == {"bad": "it crashes the process (SIGSEGV)"}
    monkeypatch.setattr(verdicts, "installed_drivers", list)
    assert run_tests(Verdicts()).listing == "it crashes the process (SIGSEGV)"


@pytest.mark.parametrize("script", ["exit 1", "kill -KILL $$", f"{say(at='list')}; kill -KILL $$"])
def test_what_says_nothing_of_runtimes_is_not_kept(program, tmp_path, script):
    program(script)
    assert not run_tests(Verdicts()).lasting
    assert not verdicts.verdicts().problems
    assert not (tmp_path / "known").exists()


def test_a_program_that_cannot_be_started_says_nothing_either(monkeypatch):
    monkeypatch.setattr(sys, "executable", "/nowhere/python")
    assert run_tests(Verdicts()) == Verdicts(lasting=False)


def test_a_runtime_that_hangs_is_passed_over(program, monkeypatch):
    monkeypatch.setattr(verdicts, "LIMIT", 0.3)
    program(f"""case "$known" in
        *longer*) ;;
        *) {say(at="attempt", name="a")}; exec sleep 9;;
        esac""")
    assert run_tests(Verdicts()).attempts["a"].startswith("it takes longer than 0.3 s")


def test_what_is_known_is_not_tried_again_unless_it_failed(program, tmp_path):
    passed = say(attempt="a", problem="", passing=False)
    program(f"echo once >> {tmp_path}/runs; {passed}")
    assert verdicts.verdicts() == verdicts.verdicts(again=True) == Verdicts(attempts={"a": ""})
    assert (tmp_path / "runs").read_text() == "once\n"
    store, state = verdicts._store(), verdicts._state()
    store.keep(b'{"attempts": {"a": "it is wrong"}}', "runtimes", state)
    assert verdicts.verdicts().problems
    assert not verdicts.verdicts(again=True).problems
    store.path("runtimes", state).write_bytes(b"damaged")
    assert verdicts.verdicts() == Verdicts(attempts={"a": ""})


def test_what_is_known_is_bound_to_cpu_drivers_and_environment(monkeypatch):
    before = verdicts._state()
    assert before == verdicts._state()
    changes = {
        "cpu_text": lambda: "another CPU",
        "icd_files": lambda: [("new.icd", "libnew.so")],
        "version": lambda _: "9",
    }
    for name, value in changes.items():
        with monkeypatch.context() as patch:
            patch.setattr(verdicts, name, value)
            assert verdicts._state() != before
    monkeypatch.setenv("CLPIPE_CPU_TARGET", "haswell")
    assert verdicts._state() != before


def test_a_device_is_tried_for_each_target_it_may_compile_for(device, monkeypatch):
    handle, platform = device.info.handle, device.info.handle.platform
    wide, narrow = Target("skx", "by features"), Target("x86-64", "since skx does not work")
    monkeypatch.setattr(verdicts, "candidates", lambda *_: [wide, narrow])
    first, second = (attempt(platform, handle, t) for t in (wide, narrow))
    assert Verdicts().of(platform, handle) is None
    assert Verdicts(attempts={first: ""}).of(platform, handle) == (wide, "")
    assert Verdicts(attempts={first: "no", second: ""}).of(platform, handle) == (narrow, "")
    assert Verdicts(attempts={first: "no", second: "nor"}).of(platform, handle) == (wide, "no")


@pytest.mark.slow
def test_this_machines_device_computes_as_numpy_does(device, monkeypatch):
    info = device.info
    assert trial.find_problem(info.handle, info.lanes) == ""
    with monkeypatch.context() as patch:
        patch.setattr(trial, "SOURCE", trial.SOURCE.replace("a / divisor", "a * divisor"))
        assert (
            trial.find_problem(info.handle, info.lanes)
            == "1024 of 2048 numbers that it computes are wrong"
        )
        patch.setattr(trial, "SOURCE", "this is no C")
        assert trial.find_problem(info.handle, info.lanes).startswith("it cannot compile kernels: ")


def test_the_cpu_that_llvm_does_not_know_is_found(device):
    info = device.info
    if "PoCL 3.0" not in info.handle.platform.version:
        pytest.skip("needs version 3.0 of the package pocl-binary-distribution")
    compile_for(info.handle, Target("generic", "as on an AMD Zen 5"))
    try:
        problem = trial.find_problem(info.handle, 8)
    finally:
        compile_for(info.handle, info.target)
    assert problem == "it cannot compile kernels: unknown target CPU 'generic'"


@pytest.mark.slow
def test_the_trial_as_a_program(device):
    found = run_tests(Verdicts())
    info = device.info
    assert found.of(info.handle.platform, info.handle) == (info.target, "")
    assert found.lasting and not found.listing


def test_what_fails_is_passed_over_and_what_helps_is_said(device, monkeypatch):
    platform, handle = device.info.handle.platform, device.info.handle
    failed = dict.fromkeys(
        [attempt(platform, handle, t) for t in discovery.candidates(platform, handle)],
        "it crashes the process (SIGILL)",
    )
    known = Verdicts(attempts=failed, hidden={"/etc/bad.icd": "it crashes the process (SIGABRT)"})
    monkeypatch.setattr(discovery, "verdicts", lambda *_, **__: known)
    monkeypatch.setattr(discovery, "platforms", lambda _: [platform])
    devices = find_devices()
    rows = device_rows(devices)
    assert rows[0]["status"] == "not used: it crashes the process (SIGILL)"
    assert rows[1]["platform"] == "/etc/bad.icd" and "SIGABRT" in rows[1]["status"]
    monkeypatch.setattr(discovery.this_system, "system", lambda: "Linux")
    monkeypatch.setattr(discovery.this_system, "machine", lambda: "x86_64")
    with pytest.raises(DeviceError, match=r"SIGILL.*intel-opencl-rt.*pocl-opencl-icd.*numpy"):
        choose(None, devices)
    monkeypatch.setattr(discovery.this_system, "machine", lambda: "aarch64")
    with pytest.raises(DeviceError, match=r"try: your GPU's driver, or apt-get install pocl"):
        choose(None, devices)
    gone = Verdicts(platforms={platform_id(platform): "it crashes the process (SIGABRT)"})
    monkeypatch.setattr(discovery, "verdicts", lambda *_, **__: gone)
    monkeypatch.setattr(cl.Platform, "get_devices", lambda _: pytest.fail("it would end here"))
    assert "when asked for its devices, it crashes" in find_devices()[0].problem
    monkeypatch.setattr(discovery, "verdicts", lambda *_, **__: Verdicts(listing="it ends"))
    with pytest.raises(DeviceError, match=r"listed: it ends. On this machine, try"):
        find_devices()


def test_a_device_that_was_not_there_is_tried(device, monkeypatch):
    queried = []

    def answer(again=False, missing=()):
        queried.extend(missing)
        return Verdicts(attempts=dict.fromkeys(missing, ""))

    monkeypatch.setattr(discovery, "verdicts", answer)
    found = next(d for d in find_devices() if d.handle == device.info.handle)
    assert not found.problem and any(found.name in name for name in queried)


def test_what_another_process_does_not_see_is_trusted(program):
    program(say(attempt="a", problem="", passing=False))
    assert verdicts.verdicts(missing=["b"]).attempts == {"a": "", "b": ""}
    assert verdicts.verdicts().attempts == {"a": "", "b": ""}


def test_a_runtime_that_is_busy_is_not_blamed(monkeypatch, capfd):
    def busy(*_):
        raise cl.MemoryError("CL_OUT_OF_RESOURCES")

    monkeypatch.setattr(trial, "find_problem", busy)
    monkeypatch.setattr(trial.os, "dup2", lambda *_: None)
    monkeypatch.setattr(trial, "sys", SimpleNamespace(stdout=sys.__stdout__, stderr=sys.stderr))
    trial.test_all({"hidden": {}, "platforms": {}, "attempts": {}, "only_listing": False})
    lines = [json.loads(line) for line in capfd.readouterr().out.splitlines()]
    results = [line for line in lines if "attempt" in line]
    assert results and all(r["problem"] == "" and r["passing"] for r in results)
