"""The version of this program, in one place; ``pyproject.toml`` reads it from here.

:data:`__version__` is the present or next release. It marks files as written by clpipe.
:func:`full_version` also identifies the commit, for ``--version``, sidecars and measurements.
Neither decides which images a run recomputes; the digest of :mod:`clpipe.outputs.program` does.
"""

from functools import cache
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pathlib import Path

__version__ = "0.1.0"

FORMAT = 1  # number of the formats of sidecars, logs, cameras.json and --json
FORMAT_KEY = "format"  # the key of this number

_ARCHIVED = "$Format:%h %(describe:tags=true)$"  # git archive fills it in; see .gitattributes


@cache
def full_version() -> str:
    """Return the version with the commit, in the form of PEP 440.

    ``0.1.0`` is the commit with the tag ``v0.1.0``. ``0.1.0+g1234567`` is another commit. A copy of
    a checkout without its history has the version ``0.1.0+unknown``.

    The version ends in ``dirty`` if files in ``clpipe`` or ``kernels`` differ from the commit. A
    wheel or an sdist has the version of the checkout from which it was built.

    The version is computed at the first call, because git takes longer than importing clpipe.
    """
    from pathlib import Path

    root = Path(__file__).resolve().parents[2]
    return (
        _version_from_metadata(root)
        or _version_from_git(root)
        or _version_from_archive(_ARCHIVED)
        or _format_version("", "unknown")
    )


def _version_from_metadata(root: "Path") -> str:
    """Return the version in the metadata of an sdist or an installed wheel; "" if there is none."""
    prefix = "Version: "
    for path in (root / "PKG-INFO", *root.glob("*clpipe*.dist-info/METADATA")):
        if path.is_file():
            lines = path.read_text("utf-8").splitlines()
            return next(
                (line.removeprefix(prefix) for line in lines if line.startswith(prefix)), ""
            )
    return ""


def _version_from_git(root: "Path") -> str:
    """Return the version of a git checkout; "" if this is no checkout or git is missing."""
    import subprocess

    # The folders are explicit for two reasons. In hooks, variables may name other folders. In
    # containers, root's git rejects another user's checkout, although its code runs here anyway.
    git = ["git", f"--git-dir={root / '.git'}", f"--work-tree={root}", "--no-optional-locks"]

    def git_output(*arguments: str) -> str:
        process = subprocess.run(  # noqa: S603
            [*git, *arguments], check=True, capture_output=True, text=True, timeout=10, cwd=root
        )
        return process.stdout.strip()

    if not (root / ".git").exists():
        return ""
    try:
        commit = git_output("rev-parse", "--short", "HEAD")
        tags = git_output("tag", "--points-at", "HEAD").split()
        version = _format_version(
            f"v{__version__}" if f"v{__version__}" in tags else "", f"g{commit}"
        )
        is_dirty = git_output("status", "--porcelain", "--", "clpipe", "kernels")
    except (OSError, subprocess.SubprocessError, ValueError):
        return ""
    return version + ("." if "+" in version else "+") + "dirty" if is_dirty else version


def _version_from_archive(text: str) -> str:
    """Return the version that ``git archive`` has filled in; "" if it has not."""
    commit, _, described = text.partition(" ")
    return "" if commit.startswith("$") else _format_version(described, f"g{commit}")


def _format_version(tag: str, commit: str) -> str:
    """Return the version of a commit.

    Args:
        tag: its tag, such as v0.1.0; other texts are no release.
        commit: its name, such as g1234567.
    """
    return __version__ if tag == f"v{__version__}" else f"{__version__}+{commit}"
