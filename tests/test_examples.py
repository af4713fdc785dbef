"""tools/examples, as they are, on a few small renders."""

import os
import subprocess
import sys

import numpy as np
import pytest
from PIL import Image

from tests.conftest import ROOT, STILL_LIFE

pytestmark = pytest.mark.tools

EXAMPLES = ROOT / "tools" / "examples"


@pytest.fixture
def start(write_exr, tmp_path):
    """Start an example in a folder with renders, the command clpipe on the PATH; what it told."""
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
    return {p.name: p.read_bytes() for p in folder.iterdir() if p.suffix != ".jsonl"}


def test_slurm_makes_what_one_machine_makes(start, clpipe, tmp_path):
    clpipe("run", "in", "-o", "whole")
    whole = pictures(tmp_path / "whole")
    assert len(whole) == 10
    for task in "12":
        told = start(
            "sh",
            EXAMPLES / "slurm_array.sh",
            *("in", "-o", "slurm"),
            CLPIPE_PARTS="2",
            SLURM_ARRAY_TASK_ID=task,
            SLURM_CPUS_PER_TASK="2",
        )
    assert "2 of 2 images done" in told  # of five; the recipe's test runs dask_local.py
    assert pictures(tmp_path / "slurm") == whole
    logs = {p.name for p in (tmp_path / "slurm").glob("*.jsonl")}
    assert logs == {f"run.{i}-of-2.jsonl" for i in "12"}


def figures(told):
    """PSNR and SSIM of the table that train_denoiser.py prints."""
    rows = [line.split() for line in told.splitlines()]
    names = ("noisy", "IID", "clpipe")
    return {row[0]: list(map(float, row[1:])) for row in rows if len(row) == 3 and row[0] in names}


def test_denoisers_learn(start, tmp_path):
    pytest.importorskip("torch")
    iso = ("--iso", "25600")
    start(
        *("clpipe", "run", STILL_LIFE, "-o", ".", *iso),
        *("--format", "png", "--truth", "development"),
    )
    pair = ("still_life.png", "still_life.truth.png")
    (tmp_path / "held_out.exr").write_bytes(STILL_LIFE.read_bytes())
    for held_out in (["--test", "held_out.exr"], ["--real", *pair]):
        told = start(
            *(sys.executable, EXAMPLES / "train_denoiser.py", STILL_LIFE, *held_out),
            *(*iso, "--steps", "300", "--size", "32", "-o", "crops.png"),
        )
        table = figures(told)
        for name in ("IID", "clpipe"):
            assert all(np.greater(table[name], table["noisy"])), table
        with Image.open(tmp_path / "crops.png") as crops:
            assert np.ptp(np.asarray(crops)) > 100


def test_what_is_trained_on_is_no_test(tmp_path):
    pytest.importorskip("torch")
    (tmp_path / "renders").mkdir()
    (tmp_path / "renders/a.exr").write_bytes(STILL_LIFE.read_bytes())
    (tmp_path / "link.exr").symlink_to(tmp_path / "renders/a.exr")
    for test in ("renders/a.exr", "link.exr"):
        command = [sys.executable, EXAMPLES / "train_denoiser.py", "renders", "--test", test]
        done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
        assert done.returncode == 2 and f"{test} is in renders, which is trained on" in done.stderr
