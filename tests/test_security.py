"""The promises of SECURITY.md, by number, or the names of their tests."""

import json
import re
from pathlib import Path

import numpy as np
import pytest

from clpipe.images.write import write_exr
from tests.conftest import ROOT, reseal, run_python, written

OWN_TEXT = Path(__file__).read_text("utf-8")
NUMPY = ("--device", "numpy")

# Where each promise is held besides here.
ELSEWHERE = {
    1: ("test_request", "test_no_code_comes_from_a_sidecar"),
    3: ("test_existing", "test_what_is_no_file_is_not_ours"),
    4: ("test_hostile_files", "test_what_is_no_file_is_refused_without_waiting"),
    5: ("test_hostile_files", "test_images_that_claim_too_much_are_refused_in_little_memory"),
    6: ("test_hostile_files", "test_names_from_a_file_are_escaped_in_messages"),
    7: ("test_existing", "test_what_is_missing_or_damaged_is_made_again"),
    8: ("test_kernel_cache", "test_a_folder_that_others_may_write_to_is_not_used"),
}


def test_each_promise_is_held():
    text = (ROOT / "SECURITY.md").read_text("utf-8")
    promises = {int(number) for number in re.findall(r"^(\d+)\. \*\*", text, re.MULTILINE)}
    held = set(ELSEWHERE) | {int(n) for n in re.findall(r"def test_(\d)_", OWN_TEXT)}
    assert promises == held
    for module, name in ELSEWHERE.values():
        assert f"def {name}" in (ROOT / f"tests/{module}.py").read_text("utf-8")


@pytest.fixture
def render(tmp_path):
    write_exr(Path("in.exr"), np.full((8, 8, 3), 0.25, np.float32), "RGB", {})
    return "in.exr"


@pytest.fixture(autouse=True)
def _here(clpipe):
    """Run every test in its own folder."""


def test_1_no_data_runs_code(clpipe, render):
    Path("evil.py").write_text("open('ran', 'w')\n")
    Path("evil.toml").write_text('stage_files = ["evil.py"]\n')
    clpipe("run", render, "-o", "out", *NUMPY, "--keep", "normalize")
    values = json.loads(Path("out/in.json").read_text())
    request = {**values["request"], "options": {"camera": "evil.toml"}}
    reseal(Path("edited.json"), {**values, "request": request})
    clpipe("replay", "edited.json", "-o", "r", *NUMPY, status=2)
    named = {"stage_files": ["evil.py"]}
    Path("in.jsonl").write_text(json.dumps({"path": "in.exr", **named}))
    clpipe("run", "in.jsonl", "-o", "m", *NUMPY, status=2)
    Path("in.jsonl").write_text(json.dumps({"path": "in.exr", "camera": "evil.toml"}))
    clpipe("run", "in.jsonl", "-o", "m", *NUMPY, status=2)
    write_exr(
        *(Path("kept.exr"), np.full((8, 8), 0.25, np.float32), ("Y",)),
        {"stage": "normalize", "kind": "mosaic", "settings": json.dumps(named)},
    )
    clpipe("run", "kept.exr", "-o", "k", "--start-at", "white_balance", *NUMPY, status=1)
    assert not Path("ran").exists()


def test_2_pictures_stay_below_out(clpipe, render):
    Path("deep").mkdir()
    clpipe("run", render, "-o", "deep/out", *NUMPY)
    before = written(Path())
    values = json.loads(Path("deep/out/in.json").read_text())
    for name in ("../x", "/tmp/x", "a/../../x", "..", "x\0y"):
        Path("in.jsonl").write_text(json.dumps({"path": "in.exr", "name": name}))
        clpipe("run", "in.jsonl", "-o", "deep/out", *NUMPY, status=2)
        reseal(Path("deep/e.json"), {**values, "name": name})
        clpipe("replay", "deep/e.json", "-o", "deep/out", *NUMPY, status=2)
        edited = {**values, "picture": name}
        reseal(Path("deep/e.json"), edited)
        clpipe("replay", "deep/e.json", "-o", "deep/out", *NUMPY, status=2)
    for outputs in (["../../in.exr"], [{"name": "../../in.exr", "size": 1, "sha256": ""}]):
        reseal(Path("deep/out/in.json"), {**values, "outputs": outputs})
        clpipe("run", render, "-o", "deep/out", *NUMPY)
    assert written(Path()) == sorted([*before, "deep/e.json", "in.jsonl"])


def test_3_no_link_is_written_through(clpipe, render):
    Path("victim").write_text("keep")
    for name in ("in.jpg", "in.json", "run.jsonl", ".clpipe.lock", "in.normalize.exr"):
        out = Path(f"out of {name}")
        out.mkdir()
        (out / name).symlink_to("../victim")
        clpipe("run", render, "-o", out, "--keep", "normalize", *NUMPY, status=(1, 2))
        assert Path("victim").read_text() == "keep" and (out / name).is_symlink()
    Path("out").mkdir()
    Path("out/in.jpg").symlink_to("../victim")
    clpipe("run", render, "-o", "out", "--redo", "all", *NUMPY)
    assert Path("victim").read_text() == "keep" and not Path("out/in.jpg").is_symlink()
    Path("trace.json").symlink_to("victim")
    clpipe("run", render, "-o", "t", "--trace", "trace.json", *NUMPY, status=2)
    assert Path("victim").read_text() == "keep"


@pytest.mark.slow
def test_faults_of_all_kinds_in_small():
    """Each fault of tools/stress/faults.py hits pictures and tars; by default, 50 times."""
    options = ("--images", 8, "--repeats", 2, "--device", "numpy")
    done = run_python("-m", "tools.stress.faults", *options)
    assert done.stdout.count("2 trials") == 4
