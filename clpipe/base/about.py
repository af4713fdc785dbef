"""The version of this program, in one place; ``pyproject.toml`` reads it from here.

There are two, because they answer two questions. :data:`__version__` is the release that this is,
or becomes: it marks files as clpipe's. :func:`full_version` says which code it was, for people:
``--version``, sidecars, measurements. Neither decides what a run makes again: that is the digest of
:mod:`clpipe.outputs.program`.
"""

from functools import cache
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pathlib import Path

__version__ = "0.1.0"

_ARCHIVED = "$Format:%h %(describe:tags=true)$"  # git archive fills it in; see .gitattributes


@cache
def full_version() -> str:
    """The version with the commit, as PEP 440 writes it.

    ``0.1.0`` is the commit with the tag ``v0.1.0``, ``0.1.0.post5+g1234567`` the fifth one after
    it, and ``0.1.0.dev632+g1234567`` one of 632 before it; ``dev0`` where their number is not
    known, as in a shallow clone. What ends in ``dirty`` has other files in ``clpipe`` or
    ``kernels`` than the commit. A wheel or an sdist says what its checkout said when it was built,
    and a copy of a checkout that has no history says ``0.1.0.dev0+unknown``.

    It is found when it is first asked for: git takes longer than importing clpipe.
    """
    from pathlib import Path

    root = Path(__file__).resolve().parents[2]
    return _frozen(root) or _of_checkout(root) or _of_archive(_ARCHIVED) or _named("", "unknown", 0)


def _frozen(root: "Path") -> str:
    """What an sdist or an installed wheel says of itself; "" where this is neither."""
    said = "Version: "
    for path in (root / "PKG-INFO", *root.glob("clpipe-*.dist-info/METADATA")):
        if path.is_file():
            lines = path.read_text("utf-8").splitlines()
            return next((line.removeprefix(said) for line in lines if line.startswith(said)), "")
    return ""


def _of_checkout(root: "Path") -> str:
    """What git says of a checkout; "" where there is none, or no git."""
    import subprocess

    # Named, because variables may name others (within hooks), and root's git would refuse to look
    # into another user's checkout (within containers). Who owns it owns the code that runs here.
    git = ["git", f"--git-dir={root / '.git'}", f"--work-tree={root}", "--no-optional-locks"]

    def said(*arguments: str) -> str:
        done = subprocess.run(  # noqa: S603
            [*git, *arguments], check=True, capture_output=True, text=True, timeout=10, cwd=root
        )
        return done.stdout.strip()

    if not (root / ".git").exists():
        return ""
    try:
        is_shallow, commit = said("rev-parse", "--is-shallow-repository", "--short", "HEAD").split()
        count = 0 if is_shallow == "true" else int(said("rev-list", "--count", "HEAD"))
        described = said("describe", "--tags", "--match", f"v{__version__}", "--always")
        version = _named(described, f"g{commit}", count)
        is_dirty = said("status", "--porcelain", "--", "clpipe", "kernels")
    except (OSError, subprocess.SubprocessError, ValueError):
        return ""
    return version + ("." if "+" in version else "+") + "dirty" if is_dirty else version


def _of_archive(filled: str) -> str:
    """The version of what git archive has filled in; "" where it has not."""
    commit, _, described = filled.partition(" ")
    return "" if commit.startswith("$") else _named(described, f"g{commit}", 0)


def _named(described: str, commit: str, count: int) -> str:
    """The name of a version.

    Args:
        described: what ``git describe`` says, such as v0.1.0 or v0.1.0-5-g1234567.
        commit: its name.
        count: how many commits there are.
    """
    tag, _, since = described.partition("-")
    if tag != f"v{__version__}":
        return f"{__version__}.dev{count}+{commit}"
    return f"{__version__}.post{since.partition('-')[0]}+{commit}" if since else __version__
