"""CONTRIBUTING.md, the glossary, and the example on the page about own stages."""

import itertools
import pkgutil
import re
import subprocess
from dataclasses import replace
from typing import Any
from zipfile import ZipFile

import numpy as np
import pytest
from click.testing import CliRunner

import clpipe
from clpipe.batch.session import Run
from clpipe.chain.making import make_chain
from clpipe.chain.registry import load_stage_file
from clpipe.chain.settings import settings_from
from clpipe.commands.main import main
from clpipe.engine.check import check_method, example
from clpipe.engine.device import Device
from clpipe.engine.runner import Runner
from clpipe.stage import Kind
from tests.conftest import ROOT, STILL_LIFE, written
from tests.markdown import blocks
from tests.test_cuts import in_tiles

PAGE = ROOT / "CONTRIBUTING.md"
TEXT = PAGE.read_text()
STAGES = ROOT / "docs" / "own_stages.md"
GLOSSARY = ROOT / "docs" / "glossary.md"


def block(language: str) -> str:
    return next(block.text for block in blocks(STAGES) if block.language == language)


@pytest.fixture
def vignette(tmp_path, forget_stage_files):
    """The files of the example, next to each other; this is the path of the stage file."""
    (tmp_path / "vignette.cl").write_text(block("c"))
    (tmp_path / "vignette.py").write_text(block("python"))
    return tmp_path / "vignette.py"


@pytest.mark.slow
def test_the_example_stage_works(device, vignette):
    stage = load_stage_file(vignette)
    for any_device in (device, Device(replace(device.info, lanes=1))):
        result = check_method(any_device, stage, stage.methods[0])
        assert result.difference.samples > 1000
        assert result.passed, result


def test_its_numbers_are_recorded_whatever_numpy_computes(tmp_path, monkeypatch):
    """Chains of drawn values share one structure, and have the values of chains without draws."""
    monkeypatch.setattr("clpipe.chain.registry._from_files", {})
    (tmp_path / "vignette.cl").write_text(block("c"))
    text = block("python").replace("self.focal_length**-2", "1 / np.sqrt(self.focal_length**4)")
    assert "np.sqrt" in text
    (tmp_path / "vignette.py").write_text(text)
    load_stage_file(tmp_path / "vignette.py")
    values = {
        "stages": ["exposure", "vignette"],
        "vignette": {"focal_length": {"uniform": [9, 99]}},
    }
    drawn = [make_chain(settings_from(values).drawn(key)) for key in "abcdef"]
    assert len({id(chain.structure) for chain in drawn[2:]}) == 1
    assert drawn[-1].structure is not None
    for chain in drawn:
        focal_length = chain.step_named("vignette").method.focal_length
        scale = chain.arguments["vignette"]["scale"]
        assert scale == np.float32(1 / np.sqrt(focal_length**4))
        assert type(scale) is np.float32


@pytest.mark.slow
def test_it_reads_places_in_the_image_also_in_tiles(device, vignette):
    chain = make_chain(settings_from({"stages": [load_stage_file(vignette).name]}))
    image = example(Kind.RGB, (150, 203))
    result, count = in_tiles(Runner(chain, device, final=True), image, 64, 48)
    assert count >= 6
    assert np.abs(result.final - Runner(chain, None, final=True).run(image, "k").final).max() < 1e-6


@pytest.mark.slow
def test_the_commands_it_shows_work(tmp_path, vignette, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "render.exr").write_bytes(STILL_LIFE.read_bytes())
    commands = [line.split()[1:] for line in block("sh").splitlines()]
    assert [command[0] for command in commands] == ["check", "stages", "run"]
    for command in commands:
        result = CliRunner().invoke(main, command, catch_exceptions=False)
        assert result.exit_code == 0, result.output
    assert (tmp_path / "out" / "render.jpg").is_file()


def test_the_example_sink_works(tmp_path, monkeypatch, write_exr):
    """Pictures are in the archive when they are done, also those of subdirectories."""
    example: dict[str, Any] = {}
    exec(next(block.text for block in blocks(PAGE) if block.language == "python"), example)
    monkeypatch.setattr(Run, "sink", lambda run: example["Zip"](run.writer, run.execution.redo))
    renders, out = tmp_path / "in", tmp_path / "out"

    def statuses() -> dict[str, str]:
        found = {}
        for outcome in clpipe.run(renders, out, device="numpy", processes=2):
            with ZipFile(out / "pictures.zip") as archive:
                assert {*outcome.outputs} <= {*archive.namelist()}
            found[outcome.job.key] = outcome.status
        return found

    for name in ("a", "sub/b"):
        write_exr(renders / f"{name}.exr", np.full((8, 8, 3), 0.2, np.float32))
    assert statuses() == {"a.exr": "done", "sub/b.exr": "done"}
    write_exr(renders / "sub/a.exr", np.full((8, 8, 3), 0.2, np.float32))
    assert statuses() == {"a.exr": "skipped", "sub/b.exr": "skipped", "sub/a.exr": "done"}
    with ZipFile(out / "pictures.zip") as archive:
        names = sorted(archive.namelist())
    assert names == [f"{n}.{e}" for n in ("a", "sub/a", "sub/b") for e in ("jpg", "json")]
    assert written(out) == ["pictures.zip"]


def test_every_lock_says_what_it_guards():
    lock = re.compile(r"= threading\.\w*(Lock|Semaphore|Condition)\(")
    for path in (ROOT / "clpipe").rglob("*.py"):
        lines = path.read_text().splitlines()
        for before, line in itertools.pairwise(["", *lines]):
            if lock.search(line):
                assert "  # " in line or before.lstrip().startswith("# "), f"{path}: {line}"


def test_authors_of_stages_need_not_know_how_numbers_are_repeated():
    folders = (ROOT / "clpipe" / name for name in ("stages", "reference", "camera"))
    files = [path for folder in folders for path in folder.rglob("*.py")]
    assert len(files) > 100
    for path in (*files, STAGES):
        assert not re.search(r"\btrac(e|es|ed|ing|eable)\b", path.read_text()), path


def test_every_file_it_names_is_there():
    text = TEXT + STAGES.read_text()
    for name in re.findall(r"`((?:clpipe|kernels|tests|tools|docs)/[\w./]+)`", text):
        if "vignette" not in name and "<" not in name:
            assert (ROOT / name).exists(), name


def test_the_walks_are_true_to_the_code():
    walks = TEXT[TEXT.index("## Two walks") : TEXT.index("## Stages and words")]
    names = re.findall(r"`([a-z_]+(?:\.[A-Za-z_]+)+)`", walks)
    assert len(names) > 20
    for name in names:
        if name != "denoise.luma_strength":
            assert pkgutil.resolve_name(f"clpipe.{name}") is not None


def test_the_words_are_those_of_the_code():
    words = GLOSSARY.read_text()
    code = "\n".join(path.read_text() for path in (ROOT / "clpipe").rglob("*.py"))
    named = re.findall(r"^\| ([a-zA-Z, ]+) \|", words, re.MULTILINE)[1:]
    assert len(named) > 25
    for word in (word for row in named for word in row.split(", ")):
        assert re.search(rf"\b{word}s?\b", code, re.IGNORECASE), word


def test_the_tools_that_are_named_are_those_that_are_there():
    table = TEXT[TEXT.index("| `tools/run` |") : TEXT.index("## Dependencies")]
    rows = set(re.findall(r"^\| `(\w+ \w+)` \|", table, re.MULTILINE))
    listed = subprocess.run([ROOT / "tools" / "run"], capture_output=True, text=True)
    assert set(re.findall(r"^ +tools/run (\w+ \w+)$", listed.stderr, re.MULTILINE)) == rows
    for path in (*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")):
        assert set(re.findall(r"tools/run ([a-z]\w+ \w+)", path.read_text())) <= rows, path


def test_the_map_names_every_package():
    package = ROOT / "clpipe"
    packages = {p.name for p in package.iterdir() if p.is_dir() and p.name != "__pycache__"}
    modules = {p.name for p in package.glob("[a-z]*.py")}
    for name in (*(f"  {name}/" for name in packages), *modules):
        assert name in TEXT, name
