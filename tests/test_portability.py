"""tools/stress/portability.py, without an emulator."""

import os
import subprocess
from types import SimpleNamespace

import pytest

from clpipe.engine.cpu_target import TARGETS, equivalent_target
from tools.stress.portability import EMULATED, UnavailableError, measure, script

pytestmark = pytest.mark.slow

X86 = [cpu for cpu in EMULATED if cpu.machine == "x86_64"]


@pytest.mark.parametrize("cpu", X86, ids=lambda cpu: cpu.name)
def test_the_target_that_must_crash_needs_more_than_the_one_that_is_expected(cpu):
    assert TARGETS[cpu.wider] - TARGETS[equivalent_target(cpu.target)]


def test_a_program_that_stands_for_another_passes_its_name_and_all_arguments_on(tmp_path):
    program = tmp_path / "a python"
    script(program, "printf", "%s|", "$0", "an $argument")
    done = subprocess.run([program, "more 'of' them", ""], capture_output=True, text=True)
    assert done.stdout == f"{program}|an $argument|more 'of' them||"


def test_x86_cpus_are_not_tried_with_the_packages_of_another_machine(monkeypatch, tmp_path):
    monkeypatch.setattr(os, "uname", lambda: SimpleNamespace(machine="aarch64"))
    with pytest.raises(UnavailableError, match=r"packages of x86_64, and this machine is aarch64"):
        measure(X86[0], tmp_path, [""] * 4)
    assert not any(tmp_path.iterdir())
