"""A wheel and an sdist, built and used in an environment of their own outside of the checkout."""

import json
import os
import subprocess
import sys
import tarfile
import venv
from pathlib import Path
from zipfile import ZipFile

import pytest

from clpipe import __version__
from clpipe.base import extras
from tests.conftest import ROOT, run_python

pytestmark = pytest.mark.slow

# A command that needs an extra, and the packages that its message names.
NEED = {
    "annotations": ("run", "a.exr", "-o", "o", "--annotations", "coco.json"),
    "calibrate": ("calibrate", "a.dng", "-o", "c.toml"),
    "cloud": ("run", "s3://bucket/a.exr", "-o", "o"),
    "dask": ("run", "a.exr", "-o", "o", "--dask", "tcp://x:1"),
    "explore": ("explore", "a.exr"),
    "lens": ("run", "a.exr", "-o", "o", "--lens", "Canon EF 50mm f/1.8"),
    "report": ("report", "demo"),
    "video": ("run", "a.exr", "-o", "o.mp4"),
}


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    """The folder of a wheel and an sdist under another name of the distribution."""
    folder = tmp_path_factory.mktemp("built")
    source = folder / "source"
    listed = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True)
    if listed.returncode:
        pytest.skip("needs a git checkout of clpipe")
    for name in listed.stdout.split("\n"):
        if (ROOT / name).is_file():
            (source / name).parent.mkdir(parents=True, exist_ok=True)
            (source / name).write_bytes((ROOT / name).read_bytes())
    project = source / "pyproject.toml"
    text = project.read_text()
    assert text.count('\nname = "clpipe"') == 1
    project.write_text(text.replace('\nname = "clpipe"', '\nname = "another-clpipe"'))
    for target in ("sdist", "wheel"):
        run_python("-m", "hatchling", "build", "-t", target, "-d", folder, cwd=source)
    return folder


@pytest.fixture(scope="module")
def installed(built):
    """Run a program of an environment with only the wheel and what it needs, in an empty folder."""
    place = built / "environment"
    venv.create(place, with_pip=True)
    python, work = place / "bin/python", built / "work"
    work.mkdir()
    [wheel] = built.glob("*.whl")
    pip = (python, "-m", "pip", "install", "--quiet", "--disable-pip-version-check")
    lock = ROOT / "locks" / "clpipe.txt"
    needed = [*pip, "--no-deps", "--require-hashes", "-r", lock]
    for command in (needed, [*pip, "--no-deps", wheel], [python, "-m", "pip", "check"]):
        done = subprocess.run(command, capture_output=True, text=True)
        assert not done.returncode, done.stderr

    def run(*words, status=0):
        clean = {name: v for name, v in os.environ.items() if name != "PYTHONPATH"}
        program = [place / "bin/clpipe"] if words[0] != "-c" else [python]
        command = [*map(str, [*program, *words])]
        done = subprocess.run(command, cwd=work, env=clean, capture_output=True, text=True)
        assert done.returncode == status, done.stdout + done.stderr
        return done.stdout + done.stderr

    run.folder = work
    return run


def test_the_wheel_has_all_that_is_used(built):
    [wheel] = built.glob("*.whl")
    assert wheel.name.startswith("another_clpipe-0.1.0")
    with ZipFile(wheel) as file:
        names, sizes = file.namelist(), [each.compress_size for each in file.infolist()]
    listed = subprocess.run(["git", "ls-files", "clpipe", "kernels"], cwd=ROOT, capture_output=True)
    expected = {
        name if name.startswith("clpipe/") else f"clpipe/{name}"
        for name in listed.stdout.decode().split()
        if (ROOT / name).is_file()
    }
    assert expected == {name for name in names if name.startswith("clpipe/")}
    assert {"clpipe/schemas/sidecar.json", "clpipe/scenes/still_life.exr"} < expected
    assert sum(sizes) < 2_500_000


def test_the_sdist_builds_the_same_wheel(built, tmp_path):
    [sdist], [wheel] = built.glob("*.tar.gz"), built.glob("*.whl")
    with tarfile.open(sdist) as file:
        file.extractall(tmp_path, filter="data")
    [source] = tmp_path.iterdir()
    assert (source / "tests/test_release.py").is_file() and (source / "docs/index.md").is_file()
    run_python("-m", "hatchling", "build", "-t", "wheel", "-d", tmp_path / "dist", cwd=source)
    [again] = (tmp_path / "dist").iterdir()
    with ZipFile(again) as one, ZipFile(wheel) as other:
        same = {n: one.read(n) for n in one.namelist() if "RECORD" not in n}
        assert same == {n: other.read(n) for n in other.namelist() if "RECORD" not in n}


def test_the_installed_program_works(installed):
    assert f"clpipe, version {__version__}" in installed("--version")
    assert "3 of 3 images done, 0 failed" in installed("demo")
    isos = installed.folder / "demo"
    assert sorted(each.name for each in isos.glob("iso*")) == ["iso100", "iso12800", "iso3200"]
    shared = json.loads(next(isos.glob("iso100/*.run")).read_text())
    assert shared["versions"]["clpipe"].startswith(__version__)
    assert "the same bytes" in installed("replay", "demo/iso100/still_life.json", "-o", "again")
    assert "0 failed" in installed("check", "--small", "exposure", "sensor_noise", "demosaic")
    names = installed("cameras").count("\n")
    assert names > 35 and "default" in installed("run", "--help")
    code = "import clpipe; print(clpipe.Pipeline('training', camera='canon-6d').chain.names[0])"
    assert "projection" in installed("-c", code)


@pytest.mark.parametrize("extra", NEED)
def test_a_missing_extra_is_named_with_all_its_packages(installed, extra):
    (installed.folder / "coco.json").write_text("{}")
    source = Path(extras.__file__).parents[1] / "scenes/still_life.exr"
    (installed.folder / "a.exr").write_bytes(source.read_bytes())
    installed("demo")
    output = installed(*NEED[extra], status=2)
    listed = {**extras.EXTRAS, "cloud": ("fsspec", "s3fs"), "lens": ("lensfunpy",)}[extra]
    message = output.partition(" needs ")[2]
    assert f"the extra '{extra}'" in message and "Traceback" not in output, output
    assert all(name in message for name in listed), output


def test_this_python_is_that_of_the_environment(installed):
    code = "import sys; print(sys.version_info[:2])"
    assert installed("-c", code).strip() == str(sys.version_info[:2])
