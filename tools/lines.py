"""Count lines of code by package, and fail if one has more than its budget in pyproject.toml.

    .venv/bin/python -m tools.lines

Comments, docstrings and blank lines do not count. Lowering a budget is a normal commit. A commit
that raises one says why the lines are worth more than what could go.
"""

import ast
import sys
import tokenize
import tomllib
from collections import Counter
from pathlib import Path

from tools import ROOT
from tools.shared.options import parser_of

IGNORED = {tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT}
IGNORED |= {tokenize.ENCODING, tokenize.ENDMARKER}
DOCUMENTED = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)


def lines_of(path: Path) -> int:
    """Return the number of lines of code in a Python file."""
    documentation: set[int] = set()
    for node in ast.walk(ast.parse(path.read_text("utf-8"))):
        if isinstance(node, DOCUMENTED) and ast.get_docstring(node, clean=False) is not None:
            first = node.body[0]
            documentation |= {*range(first.lineno, (first.end_lineno or first.lineno) + 1)}
    with path.open("rb") as file:
        tokens = [each for each in tokenize.tokenize(file.readline) if each.type not in IGNORED]
    lines = {line for each in tokens for line in range(each.start[0], each.end[0] + 1)}
    return len(lines - documentation)


def counts(root: Path, budgets: dict[str, int]) -> Counter[str]:
    """Return the lines of code of each folder with a budget, such as tests or clpipe/engine.

    Modules directly in clpipe belong to "clpipe".
    """
    found: Counter[str] = Counter()
    folders = {name.partition("/")[0] for name in budgets}
    for path in (each for folder in folders for each in (root / folder).rglob("*.py")):
        parts = path.relative_to(root).parts
        names = "/".join(parts[:2]), parts[0]
        if name := next((each for each in names if each in budgets), ""):
            found[name] += lines_of(path)
    return found


def main() -> None:
    """Print each folder's lines and budget."""
    parser_of(__doc__).parse_args()
    budgets = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["tool"]["lines"]
    found = counts(ROOT, budgets)
    for name, budget in budgets.items():
        over = " too many" if found[name] > budget else ""
        print(f"{name:18} {found[name]:6,} of {budget:6,} lines of code{over}")
    total = sum(count for name, count in found.items() if name.startswith("clpipe"))
    print(f"{'clpipe in all':18} {total:6,}")
    over_budget = [name for name, budget in budgets.items() if found[name] > budget]
    if over_budget:
        sys.exit(f"{', '.join(over_budget)}: more lines than [tool.lines] in pyproject.toml allows")


if __name__ == "__main__":
    main()
