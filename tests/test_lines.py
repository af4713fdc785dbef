"""Budgets of lines of code."""

from tools.lines import counts, lines_of

CODE = '''"""A module."""

# A comment.
NUMBERS = [
    1,

    2,  # another
]


def one() -> str:
    """A docstring
    of two lines."""
    return """a text
of two lines"""
'''


def test_only_tokens_of_code_count(tmp_path):
    for folder in ("clpipe/engine", "clpipe", "tests"):
        (tmp_path / folder).mkdir(parents=True, exist_ok=True)
        (tmp_path / folder / "a.py").write_text(CODE)
    assert lines_of(tmp_path / "tests" / "a.py") == 7
    assert counts(tmp_path, {"clpipe/engine": 1, "clpipe": 1}) == {"clpipe/engine": 7, "clpipe": 7}
