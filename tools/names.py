"""Find names in docstrings, comments and Markdown that the code no longer has.

- Each entry of ``Args`` is a parameter, or a field of the class.
- The target of a role, such as ``:func:``, exists.
- Names in double backquotes, and names followed by ``()``, occur in the code.
- A module that a package's docstring names is in this package, or is another package.
- In Markdown, names below ``clpipe.`` exist.

:mod:`tools.prose` calls it. The opposite of the first rule is ruff's D417.
"""

import ast
import builtins
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path

from tools import ROOT

CODE_FOLDERS = ("clpipe", "tools", "tests", "kernels")
ROLE = re.compile(r":(?:func|class|meth|mod|data|attr):`~?([\w.]+)`")
NAME = re.compile(r"``([A-Za-z_][\w.]*)``")
CALL = re.compile(r"(?<![\w.`])([a-z]\w*_\w+)\(\)")
ENTRY = re.compile(r"^    ?\s{0,4}(\*{0,2}\w+(?:, \*{0,2}\w+)*):(?:\s|$)")
ARGUMENTS = re.compile(r"^Args:\n((?:[ \t]+.*\n?|\n)+)", re.MULTILINE)
IN_MARKDOWN = re.compile(r"`(clpipe(?:\.\w+)+)`")
COMMENT = re.compile(r"(?:^ *|  )# .*")
WORD = re.compile(r"[A-Za-z_]\w*")

# Examples, and names of other libraries that the code does not use.
ELSEWHERE = frozenset(
    {
        *("v0.1.0", "stage_2", "step0_gain", "view00_depth.exr", "stage.", "oiio.BASETYPE"),
        *("DataLoader", "torch.utils.data.DataLoader"),
    }
)

Documented = ast.Module | ast.ClassDef | ast.FunctionDef
Fault = tuple[int, str]


def docstrings_of(source: str) -> dict[ast.Constant, Documented]:
    """Return the docstrings of a module and of all that it contains, with their owners."""
    found: dict[ast.Constant, Documented] = {}
    left: list[ast.AST] = [ast.parse(source)]
    while left:
        node = left.pop()
        body = getattr(node, "body", [])
        left += [*body, *getattr(node, "orelse", [])]
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef) and body:
            first = body[0]
            if isinstance(first, ast.Expr) and isinstance(first.value, ast.Constant):
                found[first.value] = node
    return found


@cache
def words_of_code() -> frozenset[str]:
    """Return all words of the code: names and texts, without docstrings and comments."""
    words = {*dir(builtins)}
    for folder in CODE_FOLDERS:
        for path in (ROOT / folder).rglob("*"):
            words.add(path.stem)
            if path.suffix in (".cl", ".h", ".toml", ".js"):
                words.update(WORD.findall(path.read_text("utf-8")))
            elif path.suffix == ".py":
                words.update(_words_of(path))
    words.update(WORD.findall((ROOT / "pyproject.toml").read_text("utf-8")))
    return frozenset(words)


@cache
def _words_of(path: Path) -> frozenset[str]:
    lines = _without_docstrings(path.read_text("utf-8"))
    return frozenset(word for line in lines for word in WORD.findall(COMMENT.sub("", line)))


def _without_docstrings(source: str) -> list[str]:
    """Return the lines of a module, with empty ones in place of docstrings."""
    lines = source.split("\n")
    for node in docstrings_of(source):
        last = node.end_lineno or node.lineno
        lines[node.lineno - 1 : last] = [""] * (last - node.lineno + 1)
    return lines


@cache
def _has_module(name: str) -> bool:
    path = ROOT.joinpath(*name.split("."))
    return path.with_suffix(".py").is_file() or path.is_dir()


def exists(name: str) -> bool:
    """Return whether a dotted name exists: its module, and its other parts in the code.

    >>> exists("clpipe.batch.sinks.Folder"), exists("clpipe.batch.sinks.Directory")
    (True, False)
    """
    parts = name.split(".")
    if name in ELSEWHERE:
        return True
    if parts[0] not in ("clpipe", "tools"):
        return all(part in words_of_code() for part in parts)
    count = max(n for n in range(1, len(parts) + 1) if _has_module(".".join(parts[:n])))
    path = ROOT.joinpath(*parts[:count])
    file = path / "__init__.py" if path.is_dir() else path.with_suffix(".py")
    return {*parts[count:]} <= _words_of(file)


def parameters_of(node: Documented) -> set[str] | None:
    """Return the names that ``Args`` may contain. None if they are not known."""
    if isinstance(node, ast.Module):
        return None
    if isinstance(node, ast.ClassDef):
        fields = {
            each.target.id
            for each in node.body
            if isinstance(each, ast.AnnAssign) and isinstance(each.target, ast.Name)
        }
        inits = [e for e in node.body if isinstance(e, ast.FunctionDef) and e.name == "__init__"]
        inherited = set[str]() if inits or fields or not node.bases else None
        return inherited if inherited is None else fields.union(*map(_arguments, inits))
    return _arguments(node)


def _arguments(node: ast.FunctionDef) -> set[str]:
    arguments = node.args
    every = [*arguments.posonlyargs, *arguments.args, *arguments.kwonlyargs]
    return {each.arg for each in (*every, arguments.vararg, arguments.kwarg) if each}


def wrong_arguments(text: str, node: Documented) -> Iterator[str]:
    """Yield the entries of ``Args`` of a docstring that are no parameters.

    >>> tree = ast.parse("def f(a): ...")
    >>> list(wrong_arguments("Args:\\n    a: one.\\n    b: two.", tree.body[0]))
    ['b']
    """
    known = parameters_of(node)
    match = ARGUMENTS.search(text)
    if known is None or not match:
        return
    depth = len(match[1]) - len(match[1].lstrip())
    for line in match[1].splitlines():
        if len(line) - len(line.lstrip()) == depth and (entry := ENTRY.match(line)):
            for name in entry[1].replace("*", "").split(", "):
                if name not in known:
                    yield name


@cache
def _module_names() -> frozenset[str]:
    return frozenset(path.stem for path in (ROOT / "clpipe").rglob("*.py"))


def misplaced_modules(text: str, package: Path) -> Iterator[str]:
    """Yield the modules that a package's docstring names, but that belong to other packages."""
    for name in NAME.findall(text):
        places = (package, ROOT / "clpipe")
        is_near = any((at / name).is_dir() or (at / f"{name}.py").is_file() for at in places)
        if name in _module_names() and not is_near:
            yield name


def faults_of(path: Path) -> Iterator[Fault]:
    """Yield lines of a Python or Markdown file, each with a name that no longer exists."""
    source = path.read_text("utf-8")
    patterns: tuple[re.Pattern[str], ...] = (ROLE, NAME, CALL)
    if path.suffix == ".md":
        prose, patterns = [*enumerate(source.splitlines(), 1)], (IN_MARKDOWN,)
    else:
        prose = [*_prose_of(source)]
        yield from _faults_of_docstrings(path, source)
    for line, text in prose:
        for name in dict.fromkeys(n for p in patterns for n in p.findall(text)):
            if not exists(name):
                yield line, f"{name} does not exist"


def _prose_of(source: str) -> Iterator[tuple[int, str]]:
    """Yield the docstrings and comments of a module, with their lines."""
    for constant, node in docstrings_of(source).items():
        yield constant.lineno, str(ast.get_docstring(node))
    for number, line in enumerate(_without_docstrings(source), 1):
        for comment in COMMENT.findall(line):
            yield number, comment


def _faults_of_docstrings(path: Path, source: str) -> Iterator[Fault]:
    """Yield docstrings that name parameters or modules which do not exist where they say."""
    for constant, node in docstrings_of(source).items():
        text = str(ast.get_docstring(node))
        for name in wrong_arguments(text, node):
            yield constant.lineno, f"Args names {name}, which is no parameter"
        if path.name == "__init__.py":
            for name in misplaced_modules(text, path.parent):
                yield constant.lineno, f"{name} is a module of another package"
