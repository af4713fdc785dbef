"""What lies in the output folder already: pictures that are done, ours to replace, or others'."""

import json
import os
import re
import stat
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import Any

from clpipe.base.digests import digests, joint_digest, stamp_of
from clpipe.base.errors import ImageError
from clpipe.base.files import sha256_of
from clpipe.base.system import open_plain
from clpipe.base.urls import url_of
from clpipe.images.whole import is_whole
from clpipe.inputs.find import Job
from clpipe.outputs.program import program_digest
from clpipe.outputs.sealed import Parts, SidecarError, outputs_in, read_sidecar

MARKED = 1 << 16  # bytes at either end of a file, in which a format of clpipe names clpipe

OVERWRITTEN = "would be overwritten; move it, choose another output folder, or say --redo all"

# The tag Software of clpipe, or an attribute of its own. The camera of a DNG is called clpipe, too,
# and converters repeat it in what they make.
MARK = re.compile(rb"clpipe \d+\.\d|clpipe:\w")


class Found(Enum):
    """What lies there of a rendition."""

    NOTHING = "nothing that fits, or is whole"
    OLD = "all, but made by another program"
    DONE = "all"


class Redo(Enum):
    """Which of the pictures that are there already are made again: each has those before it, too.

    What is missing, or was asked for in another way, is always made.
    """

    MISSING = "missing"  # no others
    OLD = "old"  # those that another program made
    DAMAGED = "damaged"  # those that are damaged, which is found by reading everything
    ALL = "all"  # all, also files that clpipe did not write

    @property
    def verifies(self) -> bool:
        """Whether the SHA-256 of every file decides."""
        return self is Redo.DAMAGED

    def keeps(self, found: Found) -> bool:
        """Whether what was found stays."""
        return found is Found.DONE or (found is Found.OLD and self is Redo.MISSING)


@dataclass(frozen=True)
class Existing:
    """The files of one rendition that may be there.

    Args:
        sidecar: the path of its sidecar.
        pictures: those that every such rendition has.
        others: further files that may be written.
        is_ours: whether they lie in a folder of clpipe's own, where nobody else has files.
    """

    sidecar: Path
    pictures: Sequence[Path]
    others: Sequence[Path] = ()
    is_ours: bool = False

    def found(self, job: Job, request: Mapping[str, Any], verify: bool = False) -> Found:
        """Whether all is there, unchanged, made of the same input by the same request.

        A file counts as unchanged where it has its size and was last touched before its sidecar was
        written; else its SHA-256 decides.

        Args:
            job: the image.
            request: the record of the request for the image.
            verify: let the SHA-256 of each file, and of the input, decide.

        Raises:
            ImageError: a file that would be written is somebody else's.
        """
        try:
            values = read_sidecar(self.sidecar, Parts)
        except (FileNotFoundError, SidecarError):
            values = {}
        listed = outputs_in(values)
        written = _written(self.sidecar)
        intact = {
            name for name, was in listed.items() if self._is_intact(name, was, written, verify)
        }
        pictures = {path.name for path in self.pictures}
        if pictures <= intact == listed.keys():
            found = found_in(values, job, request, verify)
            if found is not Found.NOTHING:
                return found
        if not self.is_ours:
            for path in (*self.pictures, *self.others):
                if path.name not in intact and os.path.lexists(path):
                    self._check_own(path, path.name in listed, written)
        return Found.NOTHING

    def _is_intact(self, name: str, was: Mapping[str, Any], written: int, verify: bool) -> bool:
        """Whether a file is what a sidecar says of it.

        Args:
            name: of the file.
            was: its size and SHA-256.
            written: when the sidecar was written, in ns since 1970.
            verify: compare the SHA-256 in any case.
        """
        path = self.sidecar.with_name(name)
        try:
            status = os.lstat(path)
            if not stat.S_ISREG(status.st_mode) or status.st_size != was["size"]:
                return False
            is_untouched = not verify and status.st_ctime_ns <= written
            return is_untouched or sha256_of(path)[0] == was["sha256"]
        except OSError:
            return False

    def _check_own(self, path: Path, is_listed: bool, written: int) -> None:
        """See that a file that would be overwritten is clpipe's.

        Args:
            path: the file, which is not as a sidecar says.
            is_listed: whether the sidecar lists it.
            written: when the sidecar was written, in ns since 1970.

        Raises:
            ImageError: it is somebody else's, or somebody changed it.
        """
        if not is_marked(path):
            raise ImageError(
                f"{path}: clpipe did not write this file, or it was changed since, and "
                f"{OVERWRITTEN}"
            )
        # What nobody has touched since was changed by the disk, which has no title to it.
        if is_listed and os.lstat(path).st_ctime_ns > written and is_whole(path):
            raise ImageError(
                f"{path}: was changed since clpipe wrote it (its SHA-256 is not that in "
                f"{self.sidecar.name}), and {OVERWRITTEN}"
            )


def _written(path: Path) -> int:
    """When a sidecar was written, in ns since 1970; 0 where that lies in the future."""
    try:
        modified = path.stat().st_mtime_ns
    except OSError:
        return 0
    return modified if modified <= time.time_ns() else 0


def found_in(
    values: Mapping[str, Any], job: Job, request: Mapping[str, Any], verify: bool = False
) -> Found:
    """Whether a sidecar's values are of the same input, the same request and this program.

    Arguments as for :meth:`Existing.found`.
    """
    if not _same_request(values.get("request"), request) or not _same_input(values, job, verify):
        return Found.NOTHING
    return Found.DONE if values.get("program") == program_digest() else Found.OLD


def _same_input(values: Mapping[str, Any], job: Job, verify: bool) -> bool:
    """Whether a sidecar's values are of a job's files.

    An input each of whose files has the same size and time of change is taken for the same; else,
    and with ``verify``, its SHA-256 decides.
    """
    try:
        was, now = stamps_in(values), [stamp_of(path) for path in job.paths]
        if [size for size, _ in was] != [size for size, _ in now]:
            return False
        reads = verify and url_of(job.path) is None  # what is behind a URL is told by its stamp
        if (was != now or reads) and values["sha256"] != _digest_of(job):
            return False
        layers = (*values.get("carried", ()), *values.get("depth", ()))
        return all(_is_same(job, each, verify) for each in layers)
    except (KeyError, TypeError):  # the sidecar is damaged
        return False


def stamps_in(values: Mapping[str, Any]) -> list[tuple[int, int]]:
    """The size and the time of change of each file of the input, as a sidecar's values say them.

    Raises:
        KeyError, TypeError: the values are damaged.
    """
    if "subframes" in values:
        return [(each["size"], each["modified"]) for each in values["subframes"]]
    return [(values["input_size"], values["input_modified"])]


def _digest_of(job: Job) -> str | None:
    """The SHA-256 of a job's input; None where it cannot be read."""
    found = digests(map(str, job.paths))
    return joint_digest(list(found.values())) if len(found) == len(set(job.paths)) else None


def _is_same(job: Job, carried: Mapping[str, Any], verify: bool) -> bool:
    """Whether the file of a carried layer is what a sidecar says of it.

    Raises:
        KeyError, TypeError: the sidecar is damaged.
    """
    file = job.path.parent / carried["file"]
    if (carried["size"], carried["modified"]) == stamp_of(file) and not verify:
        return True
    return carried["sha256"] in digests([str(file)]).values()


def _same_request(one: Any, other: Mapping[str, Any]) -> bool:
    """Whether records of requests are equal, with files compared by content and not by name."""
    if one == other:
        return True
    if not isinstance(one, dict) or not (other["files"] and one.get("files")):
        return False
    texts = []
    for values in (one, other):
        text = json.dumps({k: v for k, v in values.items() if k != "files"}, sort_keys=True)
        for file, digest in values["files"].items():
            text = text.replace(json.dumps(file), json.dumps(digest))
        texts.append(text)
    return texts[0] == texts[1]


def is_marked(path: Path) -> bool:
    """Whether a file is clpipe's work by its tags, or is what a loss of power may leave of one."""
    try:
        with open(open_plain(path, os.O_RDONLY), "rb") as file:
            status = os.fstat(file.fileno())
            if not stat.S_ISREG(status.st_mode):
                return False
            ends = file.read(MARKED)
            file.seek(max(status.st_size - MARKED, 0))
            ends += file.read(MARKED)
    except OSError:
        return False
    return MARK.search(ends) is not None or not ends.strip(b"\0")
