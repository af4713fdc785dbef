"""Every program in tools answers --help, and does nothing else then."""

import re
import subprocess

import pytest

from tests.conftest import ROOT, run_python

pytestmark = pytest.mark.slow

TOOLS = ROOT / "tools"
PROGRAMS = sorted(path for path in TOOLS.rglob("*.py") if "__main__" in path.read_text("utf-8"))
# Help needs none of these packages, which are missing in many environments.
ABSENT = ("bpy", "cv2", "distributed", "halide", "mathutils", "mitsuba", "playwright", "torch")
FOLDERS = ("clpipe", "docs", "kernels", "tests", "tools")


def module_of(path):
    return ".".join(path.relative_to(ROOT).with_suffix("").parts)


def files():
    """The times and sizes of all files of the checkout, except caches and folders of results."""
    found = [path for folder in FOLDERS for path in (ROOT / folder).rglob("*")]
    found += [path for path in ROOT.iterdir() if path.is_file()]
    kept = (path for path in found if path.is_file() and path.suffix != ".pyc")
    return {path: (path.stat().st_mtime_ns, path.stat().st_size) for path in kept}


@pytest.mark.parametrize("path", PROGRAMS, ids=module_of)
def test_help_explains_a_tool_and_changes_nothing(tmp_path, path):
    for name in ABSENT:
        (tmp_path / f"{name}.py").write_text(f"raise ImportError('{name} is absent')")
    before = files()
    module = module_of(path)
    done = run_python("-m", module, "--help", cwd=tmp_path, PYTHONDONTWRITEBYTECODE="1")
    usage, description, *_ = done.stdout.split("\n\n")
    assert usage.startswith("usage: ")
    assert re.match(r"[A-Z].*\w", description) and "arguments:" not in description
    assert files() == before
    assert {each.stem for each in tmp_path.iterdir()} == {*ABSENT}


def test_the_tools_of_groups_are_those_that_run_lists():
    listed = subprocess.run([TOOLS / "run"], capture_output=True, text=True).stderr
    names = {
        f"tools.{group}.{name}" for group, name in re.findall(r"\n +tools/run (\w+) (\w+)", listed)
    }
    programs = {module_of(path) for path in PROGRAMS}
    blender = {module_of(path) for path in PROGRAMS if "import bpy" in path.read_text("utf-8")}
    users = {name for name in programs if name.startswith("tools.examples.")}
    alone = {name for name in programs if name.count(".") == 1}
    assert names == programs - blender - users - alone
