"""Check the English of the project: constructions that readers stumble over, and long sentences.

    python -m tools.prose [PATH...]

It reads Markdown, and in Python files docstrings, comments and messages. Code, tables and names
in backquotes are skipped. Without paths it checks :data:`CHECKED`. The exit status is 1 if it finds
anything. The rules are those of CONTRIBUTING.md, "Writing". :mod:`tools.names` finds names that no
longer exist.
"""

import ast
import io
import re
import sys
import tokenize
from collections.abc import Iterator
from pathlib import Path

from tools import ROOT
from tools.names import faults_of
from tools.shared.options import parser_of

CHECKED = (
    *("README.md", "CHANGELOG.md", "CONTRIBUTING.md", "SECURITY.md", "docs", "clpipe"),
    *("tools",),
)

MOST_WORDS = 30  # in a sentence

RULES = {
    "a clause is the subject; name the reader or the thing": re.compile(
        r"(?:^|[.;] )(?:and )?(?:Who|who|Whoever|whoever|What|what) (?!is\b)[a-z' ,-]{2,60}?"
        r"\b(?:is|are|was|were|has|goes|go|stays|stay)\b(?![^.]*\?)"
    ),
    "say who tells whom, or use 'states'": re.compile(r"\b(?:is|are|was|were|be) told\b"),
    "say 'is warped with' or 'is written with'": re.compile(r"\b(?:goes|go|went|going) along\b"),
    "write the full clause": re.compile(r"\bsuch as (?:it|they) (?:has|have|is|are)\b"),
    "repeat the noun": re.compile(r"\b(?:[Tt]hat|[Tt]he same) of (?:those|another|others|these)\b"),
    "say 'after' or 'next to'": re.compile(
        r"\b(?:behind|beside|in front of) "
        r"(?:a |an |the |it\b|its |each |them\b|every |one |those\b)"
    ),
    "write a zero before the point": re.compile(r"(?<![\w.)\]/*-])\.\d+\b(?!\.\w)"),
    "begin with the subject": re.compile(r"(?:^|\. )Of (?!course)[a-z]"),
    "no 'too' at the end": re.compile(r", too[.;]"),
    "say 'depends on' or name the difference": re.compile(r"\btold apart\b"),
}

CODE = re.compile(r"``.+?``|`[^`]+`|:\w+:`[^`]+`|\{[^}]*\}|https?://\S+")
SENTENCE = re.compile(r"(?<=[.!?])\s+(?=[A-Z\"'(]|clpipe\b|code\b)")
SENTENCE_END = re.compile(r"[.!?](?:\s|$)")
ENTRY = re.compile(r"^\s*(?:[-*]|\d+\.|\w[\w, *`|]*:)\s")  # of a list, or of Args
ABBREVIATION = re.compile(r"\b(?:e\.g|i\.e|etc|al|eq|sec|vol|Fig|Int|Rev|No|Inst|Math)\.")

Text = tuple[int, str]  # the number of its first line, and the paragraph


def paragraphs(text: str, first: int = 1) -> Iterator[Text]:
    """Yield the paragraphs of a text with their lines. Examples, code and tables are skipped."""
    lines: list[str] = []
    start, in_fence, in_commands = first, False, False
    for number, line in enumerate([*text.split("\n"), ""], first):
        bare = line.strip()
        fence = bare.startswith(("```", "~~~"))
        in_fence ^= fence
        in_commands = bool(bare) and (in_commands or bare == "\b")  # examples in click's help
        skipped = fence or in_fence or in_commands or not bare
        ends = skipped or bare.startswith((">>>", "...", "|", "#", "<", "!!!"))
        if lines and (ends or ENTRY.match(line)):
            yield start, " ".join(lines)
            lines = []
        if not ends:
            start = start if lines else number
            lines.append(ENTRY.sub("", line).strip())


def texts_of(path: Path) -> Iterator[Text]:
    """Yield the paragraphs of a file: all of Markdown, the prose of Python."""
    source = path.read_text("utf-8")
    if path.suffix != ".py":
        yield from paragraphs(source)
        return
    tree = ast.parse(source)
    documented = (ast.Module, ast.ClassDef, ast.FunctionDef)
    docstrings = set()
    for node in ast.walk(tree):
        if isinstance(node, documented) and ast.get_docstring(node) is not None:
            first = node.body[0]
            assert isinstance(first, ast.Expr)
            docstrings.add(first.value)
            yield from paragraphs(str(ast.get_docstring(node, clean=False)), first.lineno)
        elif isinstance(node, ast.Constant | ast.JoinedStr) and node not in docstrings:
            text = node.value if isinstance(node, ast.Constant) else message_of(node)
            if isinstance(text, str) and len(text.split()) > 3 and "__global " not in text:
                for line, paragraph in paragraphs(text, node.lineno):
                    if "\n" not in text or SENTENCE_END.search(paragraph):  # else code or data
                        yield line, paragraph
    comments: list[Text] = []  # lines, of which those on lines of their own belong together
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.COMMENT:
            number, text = token.start[0], token.string.lstrip("# ")
            if token.line.lstrip().startswith("#") and comments and comments[-1][0] == number - 1:
                comments[-1] = number, f"{comments[-1][1]} {text}"
            else:
                comments.append((number, text))
    yield from comments


def message_of(node: ast.JoinedStr) -> str:
    """Return the text of a formatted string, with X for each value."""
    return "".join(str(v.value) if isinstance(v, ast.Constant) else "X" for v in node.values)


def faults_in(text: str) -> Iterator[str]:
    """Yield what is wrong in a paragraph, with the place.

    >>> [fault.partition(":")[0] for fault in faults_in("Every image has noise, " + "too.")]
    ["no 'too' at the end"]
    >>> list(faults_in("The black part is void, with a weight of 0.05."))
    []
    """
    plain = ABBREVIATION.sub("abbr", CODE.sub("code", text))
    for sentence in SENTENCE.split(plain):
        for rule, pattern in RULES.items():
            if found := pattern.search(sentence):
                place = max(found.start() - 10, 0)
                yield f"{rule}: {sentence[place : place + 70].strip()}"
        if (count := len(re.findall(r"[\w'/-]*\w[\w'/-]*", sentence))) > MOST_WORDS:
            yield f"{count} words, of {MOST_WORDS} at most: {sentence[:60]}..."


def main() -> int:
    """Print all faults in files or folders, and return the exit status."""
    parser = parser_of(__doc__)
    parser.add_argument("paths", nargs="*", metavar="PATH", default=CHECKED)
    count = 0
    for name in parser.parse_args().paths:
        place = ROOT / name
        files = (
            sorted(f for s in ("*.py", "*.md") for f in place.rglob(s))
            if place.is_dir()
            else [place]
        )
        for path in files:
            faults = [(line, f) for line, text in texts_of(path) for f in faults_in(text)]
            for line, fault in (*faults, *faults_of(path)):
                print(f"{path.relative_to(ROOT)}:{line}: {fault}")
                count += 1
    return int(count > 0)


if __name__ == "__main__":
    sys.exit(main())
