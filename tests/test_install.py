"""The package as a user gets it: installed from another folder, kernels inside."""

import os
import subprocess
import sys
import tomllib

import pytest
from packaging.requirements import Requirement

from clpipe.base import extras
from tests.conftest import ROOT, STILL_LIFE


def test_the_installed_package_works_from_anywhere(tmp_path):
    target = tmp_path / "site"
    options = ["--no-deps", "--no-build-isolation", "--quiet", "--disable-pip-version-check"]
    subprocess.run(
        [sys.executable, "-m", "pip", "install", *options, "--target", target, ROOT],
        check=True,
        cwd=tmp_path,
    )
    assert (target / "clpipe" / "kernels" / "lib" / "lanes.h").is_file()
    assert (target / "clpipe" / "camera" / "profiles" / "sony-a7r2.toml").is_file()
    code = (
        "import clpipe.engine.sources as c; print(c.kernel_folder()); "
        "from clpipe.commands.main import main; main()"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, "run", STILL_LIFE, "-o", "out"],
        check=True,
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(target)},
        capture_output=True,
        text=True,
    )
    assert done.stdout.startswith(str(target))
    assert (tmp_path / "out" / "still_life.jpg").is_file()


def test_the_sdist_has_all_that_lies_beside_the_package():
    table = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))
    included = table["tool"]["hatch"]["build"]["targets"]["sdist"]["include"]
    others = {"pyproject.toml", ".gitignore", ".ci"}  # hatch's own, and of no use elsewhere
    listed = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True)
    if listed.returncode:
        pytest.skip("there is no git repository")
    assert {name.partition("/")[0] for name in listed.stdout.split()} <= {*included, *others}


@pytest.mark.parametrize(
    ("command", "message"),
    [
        (("calibrate", "a.dng", "-o", "c.toml"), "clpipe calibrate needs scipy and matplotlib"),
        (("measure", "a.exr", "--plot", "a.png"), "--plot needs matplotlib"),
        (("run", STILL_LIFE, "-o", "out", "--dask", "tcp://x:1"), "--dask needs distributed"),
    ],
)
def test_what_an_extra_installs_is_named_where_it_is_missing(clpipe, monkeypatch, command, message):
    found = extras.find_spec
    absent = ("scipy", "matplotlib", "distributed")
    monkeypatch.setattr(extras, "find_spec", lambda name: None if name in absent else found(name))
    error = clpipe(*command, status=2).stderr
    extra = "dask" if "--dask" in command else "calibrate"
    assert f"{message}; pip install 'clpipe[{extra}]'" in error


@pytest.mark.parametrize(
    ("system", "machine", "expected"),
    [
        ("linux", "x86_64", {"pocl-binary-distribution", "pyopencl"}),
        ("linux", "aarch64", {"pyopencl"}),
        ("darwin", "arm64", {"pyopencl"}),
        ("win32", "AMD64", {"pyopencl"}),
    ],
)
def test_pocl_is_asked_for_only_where_it_has_a_wheel(system, machine, expected):
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    here = {"sys_platform": system, "platform_machine": machine}
    asked = [Requirement(text) for text in project["dependencies"]]
    asked = [each for each in asked if each.marker is None or each.marker.evaluate(here)]
    assert {each.name for each in asked if "cl" in each.name and each.name != "click"} == expected
    assert not any(each.extras for each in asked)
