"""The version matches the commit, for every origin of the code."""

import json
import os
import re
import shutil
import subprocess
import tarfile
from importlib.util import module_from_spec, spec_from_file_location

import pytest

from clpipe import __version__
from clpipe.base.about import full_version
from tests.conftest import ROOT, STILL_LIFE, run_python, values_of

ABOUT = "clpipe/base/about.py"


def version_at(root):
    """What the copy of about.py in a folder says."""
    spec = spec_from_file_location("about", root / ABOUT)
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.full_version()


@pytest.fixture
def copy(tmp_path):
    """A checkout's files without its history."""
    root = tmp_path / "copy"
    for name in (ABOUT, "kernels/one.cl", "README.md", ".gitattributes", ".gitignore"):
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_bytes((ROOT / name).read_bytes() if (ROOT / name).exists() else b"\n")
    return root


@pytest.fixture
def git(copy, monkeypatch):
    """Git in that folder, where two commits were made."""
    if not shutil.which("git"):
        pytest.skip("needs the program git")
    for name in [name for name in os.environ if name.startswith("GIT_")]:
        monkeypatch.delenv(name)
    monkeypatch.setenv("GIT_CONFIG_GLOBAL", os.devnull)

    def run(*arguments):
        user = ("-c", "user.name=a", "-c", "user.email=a@b")
        command = ["git", "-C", copy, *user, *arguments]
        return subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip()

    run("init", "--quiet")
    run("add", ".")
    for number in range(2):
        run("commit", "--quiet", "--allow-empty", "-m", str(number))
    return run


def test_a_version_names_its_commit(copy, git):
    commit = git("rev-parse", "--short", "HEAD")
    assert version_at(copy) == f"{__version__}+g{commit}"
    git("tag", "other")
    assert version_at(copy) == f"{__version__}+g{commit}"


def test_a_tag_is_the_release(copy, git):
    git("tag", f"v{__version__}")
    assert version_at(copy) == __version__
    (copy / "kernels" / "one.cl").write_text("// other\n")
    assert version_at(copy) == f"{__version__}+dirty"
    git("commit", "-am", "after it")
    assert version_at(copy) == f"{__version__}+g{git('rev-parse', '--short', 'HEAD')}"


@pytest.mark.parametrize(
    ("name", "is_dirty"),
    [("kernels/one.cl", True), ("clpipe/stages/mine.py", True), ("README.md", False), ("a", False)],
)
def test_dirty_is_what_an_install_would_hold(copy, git, name, is_dirty):
    (copy / name).parent.mkdir(exist_ok=True)
    (copy / name).write_text("# other\n")
    assert version_at(copy).endswith(".dirty") == is_dirty


def test_in_a_linked_worktree_and_within_a_hook(copy, git, tmp_path, monkeypatch):
    git("worktree", "add", "--quiet", "-b", "linked", str(tmp_path / "linked"), "HEAD~1")
    monkeypatch.setenv("GIT_DIR", str(copy / ".git"))
    assert version_at(tmp_path / "linked").startswith(f"{__version__}+g")


def test_a_shallow_clone(copy, git, tmp_path):
    git("clone", "--quiet", "--depth=1", f"file://{copy}", str(tmp_path / "shallow"))
    assert version_at(tmp_path / "shallow") == version_at(copy)


@pytest.mark.parametrize("tagged", [None, "HEAD", "HEAD~1"])
def test_git_archive(copy, git, tmp_path, tagged):
    if tagged:
        git("tag", f"v{__version__}", tagged)
    expected = version_at(copy)
    git("archive", "--output", str(tmp_path / "a.tar"), "HEAD")
    with tarfile.open(tmp_path / "a.tar") as archive:
        archive.extractall(tmp_path / "unpacked", filter="data")
    if "%(describe" in (tmp_path / "unpacked" / ABOUT).read_text().partition("_ARCHIVED")[2]:
        pytest.skip("needs git 2.35 or newer")
    assert version_at(tmp_path / "unpacked") == expected


def test_a_copy_without_history_says_so(copy, monkeypatch):
    assert version_at(copy) == f"{__version__}+unknown"
    (copy / ".git").mkdir()  # damaged
    assert version_at(copy) == f"{__version__}+unknown"
    monkeypatch.setenv("PATH", "")  # no git
    assert version_at(copy) == f"{__version__}+unknown"


@pytest.mark.parametrize(
    "name", ["PKG-INFO", "clpipe-1.2.3.dist-info/METADATA", "my_clpipe-1.2.3.dist-info/METADATA"]
)
def test_an_sdist_and_an_installed_wheel_have_the_version_of_their_checkout(copy, git, name):
    (copy / name).parent.mkdir(exist_ok=True)
    (copy / name).write_text("Metadata-Version: 2.4\nName: clpipe\nVersion: 1.2.3+g1\n\nVersion: 4")
    assert version_at(copy) == "1.2.3+g1"


@pytest.mark.slow
def test_both_versions_are_where_they_belong(clpipe, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    full = full_version()
    assert re.fullmatch(rf"{re.escape(__version__)}(\+[a-z0-9.]+)?", full)
    assert clpipe("--version").stdout == f"clpipe, version {full}\n"
    clpipe("run", STILL_LIFE, "-o", "out", "--device", "numpy", "--until", "quantize")
    sidecar = values_of(tmp_path / "out" / "still_life.json")
    assert (sidecar["clpipe"], sidecar["versions"]["clpipe"]) == (__version__, full)
    start, *_ = (tmp_path / "out" / "run.jsonl").read_text().splitlines()
    assert json.loads(start)["clpipe"] == full


def test_importing_runs_no_git():
    code = "import sys, clpipe; print('subprocess' in sys.modules, 'pathlib' in sys.modules)"
    assert run_python("-S", "-c", code).stdout == "False False\n"
