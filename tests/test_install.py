"""The installed package: used from another folder, with its kernels."""

import itertools
import re
import subprocess
import tomllib

import pytest
import yaml
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from clpipe import __version__
from clpipe.base import extras, transfers
from tests.conftest import ROOT, STILL_LIFE, run_python

pytestmark = pytest.mark.slow


def test_the_installed_package_works_from_anywhere(tmp_path):
    target = tmp_path / "site"
    options = ["--no-deps", "--no-build-isolation", "--quiet", "--disable-pip-version-check"]
    run_python("-m", "pip", "install", *options, "--target", target, ROOT, cwd=tmp_path)
    assert (target / "clpipe" / "kernels" / "lib" / "lanes.h").is_file()
    assert (target / "clpipe" / "camera" / "profiles" / "sony-a7r2.toml").is_file()
    code = (
        "import clpipe.engine.sources as c; print(c.kernel_folder()); "
        "from clpipe.commands.main import main; main()"
    )
    run = ("run", STILL_LIFE, "-o", "out")
    done = run_python("-c", code, *run, cwd=tmp_path, PYTHONPATH=target)
    assert done.stdout.startswith(str(target))
    assert (tmp_path / "out" / "still_life.jpg").is_file()


def test_the_sdist_has_all_that_lies_beside_the_package():
    table = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))
    included = table["tool"]["hatch"]["build"]["targets"]["sdist"]["include"]
    others = {"pyproject.toml", ".gitignore", ".ci"}  # hatch's own, and of no use elsewhere
    listed = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True)
    if listed.returncode:
        pytest.skip("needs a git checkout of clpipe")
    assert {name.partition("/")[0] for name in listed.stdout.split()} <= {*included, *others}


@pytest.mark.parametrize(
    ("command", "message"),
    [
        (
            ("calibrate", "a.dng", "-o", "c.toml"),
            "clpipe calibrate needs matplotlib and scipy, which are in the extra 'calibrate'",
        ),
        (
            ("measure", STILL_LIFE, "--plot", "a.png"),
            "--plot needs matplotlib and scipy, which are in the extra 'calibrate'",
        ),
        (
            ("explore", STILL_LIFE),
            "clpipe explore needs matplotlib, scipy, starlette and uvicorn, which are in the extra "
            "'explore'",
        ),
        (
            ("run", STILL_LIFE, "-o", "out", "--dask", "tcp://x:1"),
            "--dask needs distributed, which is in the extra 'dask'",
        ),
        (
            ("run", "s3://bucket/a.exr", "-o", "out"),
            "s3://bucket/a.exr needs fsspec and s3fs, which are in the extra 'cloud'",
        ),
    ],
)
def test_packages_that_are_missing_are_named(clpipe, monkeypatch, command, message):
    found = extras.find_spec
    absent = {*itertools.chain(*extras.EXTRAS.values()), "s3fs"}
    monkeypatch.setattr(extras, "find_spec", lambda name: None if name in absent else found(name))
    error = clpipe(*command, status=2).stderr
    packages = message.partition(" needs ")[2].partition(", which")[0]
    packages = packages.replace(" and ", " ").replace(",", "")
    assert f"{message}. Run: pip install {packages}\n" in error


def test_extras_have_these_packages():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    packages = {
        extra: {(found := Requirement(text)).name: str(found.specifier) for text in listed}
        for extra, listed in project["optional-dependencies"].items()
    }
    for extra, modules in extras.EXTRAS.items():
        if extra != "cloud":
            assert sorted(packages[extra]) == sorted(modules)
    assert {*transfers.PACKAGES.values(), "fsspec"} == {*packages["cloud"]}
    for extra in ("annotations", "calibrate", "dask", "docs", "explore", "lens", "report", "video"):
        assert packages[extra].items() <= packages["dev"].items(), extra


def test_the_name_of_the_distribution_is_one_line():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    for extra, listed in project["optional-dependencies"].items():
        assert project["name"] not in [Requirement(text).name for text in listed], extra


def test_no_text_installs_another_project_of_that_name():
    """On the public index, clpipe is a package of somebody else."""
    places = ("clpipe/**/*.py", "docs/**/*.md", "docs/*.ipynb", "tools/**/*.py", "*.md")
    for path in (found for place in places for found in ROOT.glob(place)):
        assert not re.search(r"pip install[^`\n]*\bclpipe\b(?!/|\.txt)", path.read_text("utf-8")), (
            path
        )


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
    requirements = [Requirement(text) for text in project["dependencies"]]
    requirements = [
        each for each in requirements if each.marker is None or each.marker.evaluate(here)
    ]
    assert {
        each.name for each in requirements if "cl" in each.name and each.name != "click"
    } == expected
    assert not any(each.extras for each in requirements)


def needed(project, extra):
    """What pyproject.toml asks for with an extra."""
    yield from map(
        Requirement,
        project["optional-dependencies"][extra] if extra else project["dependencies"],
    )
    if extra:
        yield from needed(project, "")


@pytest.mark.parametrize("extra", ["", "dev", "docs"])
def test_a_lock_has_all_that_is_asked_for(extra):
    lock = (ROOT / "locks" / f"{extra or 'clpipe'}.txt").read_text()
    versions = {}
    for text in lock.replace("\\\n", "").splitlines():
        if text and text.lstrip()[0] != "#":
            requirement, *hashes = text.split("--hash=sha256:")
            assert hashes, text
            locked = Requirement(requirement)
            (pinned,) = locked.specifier
            versions.setdefault(canonicalize_name(locked.name), []).append(pinned.version)
    pyproject = tomllib.loads((ROOT / "pyproject.toml").read_text())
    build = map(Requirement, pyproject["build-system"]["requires"])
    for requirement in (*needed(pyproject["project"], extra), *build):
        found = versions.get(canonicalize_name(requirement.name), [])
        assert found, f"{requirement} is not locked; run tools/versions lock {requirement.name}"
        assert all(version in requirement.specifier for version in found), (requirement, found)


def test_a_lock_names_no_index_and_no_folder():
    locks = sorted((ROOT / "locks").iterdir())
    assert {lock.stem for lock in locks} == {"clpipe", "cloud", "dev", "docs", "pip"}
    for lock in locks:
        assert not re.search(r"://|--(extra-)?index|--find-links|@ |\s/", lock.read_text())


def test_what_a_tool_installs_is_locked():
    found = [
        (path, line.partition("=")[2])
        for path in (ROOT / "tools").iterdir()
        if path.is_file()
        for line in path.read_text().splitlines()
        if line.startswith("extra=") and path.name != "setup"
    ]
    assert len(found) == 6
    for path, extra in found:
        assert (ROOT / "locks" / f"{extra or 'clpipe'}.txt").is_file(), path


def test_what_checks_a_commit_is_what_the_tests_run_first():
    checks = (ROOT / "tools" / "lint").read_text()
    for name in ("ruff format --check", "ruff check", "mypy", "lint-imports"):
        assert f".venv/bin/{name}" in checks
    assert "\nsh tools/lint\n" in (ROOT / "tools" / "test").read_text()
    (repository,) = yaml.safe_load((ROOT / ".pre-commit-config.yaml").read_text())["repos"]
    (hook,) = repository["hooks"]
    assert (repository["repo"], hook["language"]) == ("local", "system")
    assert (hook["entry"], hook["pass_filenames"]) == ("sh tools/lint", False)


def test_the_citation_is_of_this_version_and_of_the_paper():
    cited = yaml.safe_load((ROOT / "CITATION.cff").read_text("utf-8"))
    assert (cited["cff-version"], cited["type"], cited["title"]) == ("1.2.0", "software", "clpipe")
    assert cited["message"] and cited["authors"] == [{"name": "The clpipe developers"}]
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert (cited["version"], cited["license"]) == (__version__, project["license"])
    assert f"\n## {__version__} (" in (ROOT / "CHANGELOG.md").read_text("utf-8")
    paper = cited["preferred-citation"]
    assert paper["title"] in " ".join((ROOT / "docs" / "paper.md").read_text("utf-8").split())
    assert [author["family-names"] for author in paper["authors"]] == [
        *("Bielova", "Hänsch", "Ley", "Hellwich"),
    ]
    assert (paper["type"], paper["year"]) == ("conference-paper", 2019)
