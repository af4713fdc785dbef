"""The linter for names in prose: it finds those that no longer exist, and no others."""

import pytest

from tests.conftest import ROOT
from tools.names import faults_of, misplaced_modules

GONE = "removed" + "_thing"  # no word of the code

MODULE = '''"""Uses :func:`{0}`, or ``{1}``."""

from pathlib import Path


def area(width: int, height: int) -> int:
    """Return an area.

    Args:
        {2}: the width in px.
        height: the height in px: a number.
    """
    return width * height  # see {3}()


class Box:
    """A box.

    Args:
        {4}: the path.
    """

    path: Path
'''
TRUE = ("clpipe.run", "batch.sinks", "width", "make_chain", "path")


@pytest.mark.parametrize("wrong", [None, *range(5)])
def test_names_that_no_longer_exist(tmp_path, wrong):
    names = [GONE if number == wrong else name for number, name in enumerate(TRUE)]
    (tmp_path / "module.py").write_text(MODULE.format(*names))
    found = [fault for _, fault in faults_of(tmp_path / "module.py")]
    kind = "Args names {}, which is no parameter" if wrong in (2, 4) else "{} does not exist"
    assert found == ([] if wrong is None else [kind.format(GONE)])


def test_names_below_clpipe_in_pages(tmp_path):
    (tmp_path / "a.md").write_text(f"`clpipe.run` and\n`clpipe.batch.{GONE}` are `{GONE}`.\n")
    assert [*faults_of(tmp_path / "a.md")] == [(2, f"clpipe.batch.{GONE} does not exist")]


def test_a_module_of_another_package():
    text = "``metering`` follows sequences, ``emva`` simulates, and ``outputs`` writes."
    assert [*misplaced_modules(text, ROOT / "clpipe/analysis")] == ["metering"]
