"""Code blocks of Markdown pages: found, and run in order, as a reader would.

A block of ``sh`` is a script, with ``clpipe`` and ``python`` on the PATH. A block of ``python``
goes on where the one before it on the page ended. A block with a title (``toml title="a.toml"``) is
that file. Blocks of ``toml`` are configurations or camera profiles, and must be valid.

A comment before a block changes that: ``<!-- not run: why -->``, or ``<!-- needs: torch -->``, for
a block that is run only where these modules are installed.
"""

import os
import re
import shlex
import subprocess
import sys
import tomllib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from glob import glob
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parent.parent
BLOCK = re.compile(
    r"(?:^<!-- (?P<rule>not run|needs): (?P<what>.*?) -->\n\s*)?"
    r"^```(?P<language>\w+)(?: title=\"(?P<title>[^\"]+)\")?\n(?P<text>.*?)^```$",
    re.DOTALL | re.MULTILINE,
)
RUN = ("sh", "python", "toml")
WRITTEN = (*RUN, "csv", "json", "c")
QUOTED = re.compile(r"'[^'\n]*'|\"[^\"\n]*\"")
SHELL = re.compile(r"[$|;&<`(){}\n]")  # outside of quotes: what only a shell understands


@dataclass(frozen=True)
class Block:
    """A code block with its position and the comment before it."""

    page: Path
    line: int
    language: str
    title: str
    text: str
    not_run: str
    needs: tuple[str, ...]

    @property
    def place(self) -> str:
        """The position for messages."""
        return f"{self.page.relative_to(ROOT)}, line {self.line}"

    @property
    def missing(self) -> list[str]:
        """The required modules that are not installed."""
        return [name for name in self.needs if find_spec(name) is None]


def blocks(page: Path) -> list[Block]:
    """Return the code blocks of a page in order."""
    text = page.read_text()
    found = []
    for match in BLOCK.finditer(text):
        rule, what = match["rule"], match["what"] or ""
        found.append(
            Block(
                page,
                text.count("\n", 0, match.start("language")) + 1,
                match["language"],
                match["title"] or "",
                match["text"],
                what if rule == "not run" else "",
                tuple(what.split()) if rule == "needs" else (),
            )
        )
    return found


def commands(script: str) -> Iterator[str]:
    """Return the lines of a script without comments, with continued lines joined."""
    for line in script.replace("\\\n", " ").splitlines():
        if text := re.sub(r"(^|\s)#.*", "", line).strip():
            yield text


class PageRunner:
    """Runs the blocks of a page in a folder.

    Args:
        folder: the working directory; it holds what the page takes for granted.
        clpipe: runs the command line in this process, and checks its exit status.
        numpy: have ``clpipe run`` and ``replay`` develop in NumPy if a line names no device, which
            saves compiling the kernels of chains that occur only here.
    """

    def __init__(self, folder: Path, clpipe: Callable[..., Any], numpy: bool = False) -> None:
        self._folder = folder
        self._clpipe = clpipe
        self._numpy = numpy
        self._names: dict[str, Any] = {"__name__": "page"}
        self._tools = folder / ".bin"
        self._tools.mkdir()
        for name, start in (("clpipe", "-m clpipe"), ("python", "")):
            tool = self._tools / name
            tool.write_text(f'#!/bin/sh\nexec "{sys.executable}" {start} "$@"\n')
            tool.chmod(0o755)

    def run(self, block: Block) -> None:
        """Run a block, or write its file."""
        if block.not_run or block.missing:
            return
        if block.title:
            assert block.language in WRITTEN, block.place
            (self._folder / block.title).write_text(block.text)
        if block.language == "toml":
            self._validate(block)
        elif block.title:
            return
        elif block.language == "python":
            exec(compile(block.text, block.place, "exec"), self._names)
        elif block.language == "sh":
            self._script(block)

    def _validate(self, block: Block) -> None:
        """Check that a TOML block is a configuration or a profile, or at least valid TOML."""
        values = tomllib.loads(block.text)
        if "project" in values:
            return
        path = self._folder / (block.title or "block.toml")
        path.write_text(block.text)
        self._clpipe(*(("cameras", path) if "gain_stages" in values else ("plan", "-c", path)))

    def _script(self, block: Block) -> None:
        lines = list(commands(block.text))
        if any(SHELL.search(QUOTED.sub("", line)) for line in lines):
            self._shell(block, block.text)
            return
        for line in lines:
            if line.startswith("clpipe "):  # in this process, which saves the start of another one
                self._command(line)
            else:
                self._shell(block, line)

    def _command(self, line: str) -> None:
        """Run a line that uses no shell features except globs and ``> FILE``."""
        words: list[str] = []
        for word in shlex.split(line, posix=False)[1:]:
            found = [] if word[0] in "'\"" else sorted(glob(word, root_dir=self._folder))
            words += found or [word.strip("'\"")]
        target = ""
        if ">" in words:
            words, (target,) = words[: words.index(">")], words[words.index(">") + 1 :]
        if self._numpy and words[0] in ("run", "replay") and not {"--device", "--dask"} & {*words}:
            words += ["--device", "numpy"]
        result = self._clpipe(*words)
        if target:
            (self._folder / target).write_text(result.stdout)

    def _shell(self, block: Block, script: str) -> None:
        environment = {
            **os.environ,
            "PATH": f"{self._tools}:{os.environ['PATH']}",
            "PYTHONPATH": str(ROOT),
            "CLPIPE_CHECKOUT": str(ROOT),
        }
        done = subprocess.run(
            ["sh", "-eu", "-c", script],
            cwd=self._folder,
            env=environment,
            capture_output=True,
            text=True,
        )
        if done.returncode:
            pytest.fail(f"{block.place}: status {done.returncode}\n{done.stdout}{done.stderr}")
