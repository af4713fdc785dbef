"""What exists in the output folder: finished pictures, files of ours to replace, others' files."""

import json
import os
import re
import stat
import time
from collections.abc import Mapping, Sequence
from enum import Enum
from pathlib import Path
from typing import Any

from clpipe.base.digests import digests, stamp_of
from clpipe.base.errors import ImageError
from clpipe.base.files import sha256_of
from clpipe.base.system import open_plain
from clpipe.base.urls import url_of
from clpipe.images.whole import is_whole
from clpipe.inputs.find import Job
from clpipe.outputs.plan import OutputPlan, RenditionFiles
from clpipe.outputs.program import program_digest
from clpipe.outputs.sidecar import (
    SIDECAR,
    SidecarError,
    inputs_in,
    outputs_in,
    read_sidecar,
    sidecar_files,
    values_at,
)

MARKED = 1 << 16  # bytes at either end of a file, in which a format of clpipe names clpipe

OVERWRITTEN = "would be overwritten; move it, choose another output folder, or say --redo all"

# The tag Software of clpipe, or an attribute of its own. The camera of a DNG is called clpipe, too,
# and converters repeat it in what they make.
MARK = re.compile(rb"clpipe \d+\.\d|clpipe:\w")


class Found(Enum):
    """What exists of a rendition."""

    NOTHING = "nothing that fits, or is whole"
    OLD = "all, but made by another program"
    DONE = "all"


class Redo(Enum):
    """Which existing pictures are made again. Each choice includes those before it.

    Pictures that are missing, or were made by another request, are always made.
    """

    MISSING = "missing"  # none
    OLD = "old"  # those that another program made
    DAMAGED = "damaged"  # damaged ones, which are found by reading all files
    ALL = "all"  # all, even if clpipe did not write the files

    @property
    def verifies(self) -> bool:
        """Whether the SHA-256 of every file decides."""
        return self is Redo.DAMAGED

    def keeps(self, found: Found) -> bool:
        """Return whether a rendition is kept."""
        return found is Found.DONE or (found is Found.OLD and self is Redo.MISSING)


def find(
    files: RenditionFiles,
    job: Job,
    request: Mapping[str, Any],
    verify: bool = False,
    is_ours: bool = False,
) -> Found:
    """Return what exists of a rendition: unchanged, made of the same input by the same request.

    A file counts as unchanged if it has its size and was last touched before its sidecar was
    written. Otherwise its SHA-256 decides.

    Args:
        files: of the rendition.
        job: the image.
        request: the record of the request for the image.
        verify: let the SHA-256 of each file, and of the input, decide.
        is_ours: whether the files are in a folder where nobody else has files.

    Raises:
        ImageError: a file that would be written is somebody else's.
    """
    try:
        values = read_sidecar(files.sidecar)
    except (FileNotFoundError, SidecarError):
        values = {}
    listed = outputs_in(values)
    written = _written(files.sidecar)
    intact = {
        name
        for name, was in listed.items()
        if _is_intact(files.sidecar.with_name(name), was, written, verify)
    }
    if {path.name for path in files.pictures} <= intact == listed.keys():
        found = found_in(values, job, request, verify)
        if found is not Found.NOTHING:
            return found
    if not is_ours:
        for path in (*files.pictures, *files.others):
            if path.name not in intact and os.path.lexists(path):
                _check_own(path, files.sidecar if path.name in listed else None, written)
    return Found.NOTHING


def _is_intact(path: Path, was: Mapping[str, Any], written: int, verify: bool) -> bool:
    """Return whether a file is what a sidecar says of it.

    Args:
        path: the file.
        was: its size and SHA-256.
        written: when the sidecar was written, in ns since 1970.
        verify: compare the SHA-256 in any case.
    """
    try:
        status = os.lstat(path)
        if not stat.S_ISREG(status.st_mode) or status.st_size != was["size"]:
            return False
        is_untouched = not verify and status.st_ctime_ns <= written
        return is_untouched or sha256_of(path)[0] == was["sha256"]
    except OSError:
        return False


def _check_own(path: Path, sidecar: Path | None, written: int) -> None:
    """Check that a file that would be overwritten is clpipe's.

    Args:
        path: the file, which is not as a sidecar says.
        sidecar: the one that lists it; None if there is none.
        written: when the sidecar was written, in ns since 1970.

    Raises:
        ImageError: it is somebody else's, or somebody changed it.
    """
    if not is_marked(path):
        raise ImageError(
            f"{path}: clpipe did not write this file, or it was changed since, and {OVERWRITTEN}"
        )
    # If nobody has touched the file since, the disk has damaged it.
    if sidecar and os.lstat(path).st_ctime_ns > written and is_whole(path):
        raise ImageError(
            f"{path}: was changed since clpipe wrote it (its SHA-256 is not that in "
            f"{sidecar.name}), and {OVERWRITTEN}"
        )


def _written(path: Path) -> int:
    """Return when a sidecar was written, in ns since 1970; 0 if that is in the future."""
    try:
        modified = path.stat().st_mtime_ns
    except OSError:
        return 0
    return modified if modified <= time.time_ns() else 0


def found_in(
    values: Mapping[str, Any], job: Job, request: Mapping[str, Any], verify: bool = False
) -> Found:
    """Return whether a sidecar's values are of the same input, the same request and this program.

    Arguments as for :func:`find`.
    """
    if not _same_request(values.get("request"), request) or not _same_input(values, job, verify):
        return Found.NOTHING
    return Found.DONE if values.get("program") == program_digest() else Found.OLD


def _same_input(values: Mapping[str, Any], job: Job, verify: bool) -> bool:
    """Return whether a sidecar is of a job's files, see :func:`_is_same`."""
    try:
        return all(_is_same(path, was, verify) for path, was in inputs_in(values, job.paths))
    except (KeyError, TypeError, ValueError):  # the sidecar is damaged, or of more files
        return False


def _is_same(path: Path, was: Mapping[str, Any], verify: bool) -> bool:
    """Return whether an input file is what a sidecar says of it.

    A file with the same size and time of change counts as the same, and a URL always by these.
    Otherwise, and with ``verify``, the SHA-256 decides.

    Raises:
        KeyError, TypeError: the sidecar is damaged.
    """
    size, modified = stamp_of(path)
    if size != was["size"]:
        return False
    if modified == was["modified"] and not (verify and url_of(path) is None):
        return True
    return was["sha256"] in digests([str(path)]).values()


def _same_request(one: Any, other: Mapping[str, Any]) -> bool:
    """Return whether records of requests are equal. Files are compared by content, not by name."""
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
    """Return whether a file has clpipe's tags, or only zeros, which a loss of power may leave."""
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


def pictures_without_input(plan: OutputPlan, jobs: Sequence[Job], inputs: Sequence[str]) -> int:
    """Return how many pictures of the output folder are of inputs that were removed or renamed.

    An input counts only if it was in a folder that is an input now, or next to an input: names in
    sidecars are relative to the folder in which that run was started.

    Args:
        plan: of the run.
        jobs: all of it.
        inputs: as the user gave them.
    """
    own = {plan.path(job, SIDECAR, each) for job in jobs for each in plan.renditions_of(job)}
    beside = {Path(text) for text in {os.path.dirname(job.input) for job in jobs}}
    below = [Path(text) for text in inputs if os.path.isdir(text)]
    count = 0
    for path in sidecar_files(plan.folder):
        if path in own:
            continue
        try:
            render = (values_at(path) or {}).get("input")
        except SidecarError:
            continue
        if isinstance(render, str) and not os.path.lexists(render):
            was = Path(render)
            count += was.parent in beside or any(was.is_relative_to(each) for each in below)
    return count
