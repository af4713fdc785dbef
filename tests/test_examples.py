"""tools/examples, unchanged, on a few small renders."""

import os
import re
import shlex
import subprocess
import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest
import yaml

from clpipe.base.errors import DeviceError, RequestError
from clpipe.base.transfers import STOP_SECONDS
from clpipe.commands.run import run
from tests.conftest import ROOT

pytestmark = pytest.mark.slow

EXAMPLES = ROOT / "tools" / "examples"


@pytest.fixture
def start(write_exr, tmp_path):
    """Return a function that runs an example in a folder with renders, and returns its output."""
    for i in range(5):
        pixels = np.random.default_rng(i).random((64, 64, 3)).astype(np.float32)
        write_exr(f"in/f{i}.exr", pixels)
    command = tmp_path / "bin" / "clpipe"
    command.parent.mkdir()
    command.write_text(f'#!/bin/sh\nexec "{sys.executable}" -m clpipe "$@"\n')
    command.chmod(0o755)
    path = f"{command.parent}:{os.environ['PATH']}"
    environment = {**os.environ, "PATH": path, "PYTHONPATH": str(ROOT)}

    def run(*arguments, **variables):
        done = subprocess.run(
            arguments,
            cwd=tmp_path,
            env=environment | variables,
            check=True,
            capture_output=True,
            text=True,
        )
        return done.stdout + done.stderr

    return run


def pictures(folder):
    return {p.name: p.read_bytes() for p in folder.iterdir() if p.suffix not in (".jsonl", ".run")}


def test_slurm_makes_what_one_machine_makes(start, clpipe, tmp_path):
    clpipe("run", "in", "-o", "whole")
    whole = pictures(tmp_path / "whole")
    assert len(whole) == 10
    for task in "12":
        result = start(
            "sh",
            EXAMPLES / "slurm_array.sh",
            *("in", "-o", "slurm"),
            CLPIPE_PARTS="2",
            SLURM_ARRAY_TASK_ID=task,
            SLURM_CPUS_PER_TASK="2",
        )
    assert "2 of 2 images done" in result  # of five; the recipe's test runs dask_local.py
    assert pictures(tmp_path / "slurm") == whole
    logs = {p.name for p in (tmp_path / "slurm").glob("*.jsonl")}
    assert logs == {f"run.{i}-of-2.jsonl" for i in "12"}


def test_kubernetes_shares_out_all_tars():
    job = yaml.safe_load((EXAMPLES / "kubernetes_job.yaml").read_text())["spec"]
    (container,) = job["template"]["spec"]["containers"]
    (script,) = container["args"]
    parts = re.findall(r'--shard "\$\(\(JOB_COMPLETION_INDEX \+ 1\)\)/(\d+)"', script)
    assert job["completionMode"] == "Indexed"
    assert parts == [str(job["completions"])]
    words = shlex.split(script.replace("$((JOB_COMPLETION_INDEX + 1))", "1"))
    assert Path(words[1]).name == "clpipe"
    known = {option for each in run.params for option in each.opts}
    assert {word for word in words if word.startswith("-")} <= known
    failures, disruptions = job["podFailurePolicy"]["rules"]
    assert failures["action"] == "FailIndex"
    assert failures["onExitCodes"]["values"] == [RequestError.exit_status, DeviceError.exit_status]
    assert failures["onExitCodes"]["containerName"] == container["name"]
    assert disruptions["action"] == "Ignore"
    assert job["template"]["spec"]["terminationGracePeriodSeconds"] > 20 > STOP_SECONDS


def test_the_image_installs_what_is_locked():
    text = (ROOT / "Dockerfile").read_text()
    copied = re.findall(r"locks/[\w.]+", text.partition("COPY . ")[0])
    assert set(copied) == {"locks/pip.txt", "locks/cloud.txt"}
    locked = (ROOT / "locks/cloud.txt").read_text()
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    needed = [*project["dependencies"], *project["optional-dependencies"]["cloud"], "hatchling"]
    for requirement in needed:
        name = re.match(r"[\w.-]+", requirement)[0].lower().replace("_", "-")
        assert re.search(rf"^{name}==", locked, re.MULTILINE), name
    assert 'ENTRYPOINT ["clpipe"]' in text and text.index("USER clpipe") < text.index("VOLUME")
