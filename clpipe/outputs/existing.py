"""Finds what the output directory contains: finished pictures, and files of clpipe or others."""

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
from clpipe.images.whole import is_complete
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

MARKED = 1 << 16  # bytes at either end of a file in which clpipe's mark is searched

OVERWRITTEN = "would be overwritten; move it, choose another output directory, or use --redo all"

# clpipe's Software tag, or an attribute of its own. The name clpipe alone is not enough: a DNG's
# camera has it as well, and converters copy it to their output.
MARK = re.compile(rb"clpipe \d+\.\d|clpipe:\w")


class Found(Enum):
    """What exists of a rendition."""

    NOTHING = "nothing that matches and is complete"
    OLD = "all files, but made by another program"
    DONE = "all files"


class Redo(Enum):
    """Which existing pictures are recomputed. Each choice includes those before it.

    Pictures that are missing, or were made by another request, are always computed.
    """

    MISSING = "missing"  # none
    OLD = "old"  # pictures that another program made
    DAMAGED = "damaged"  # damaged pictures, which are found by reading all files
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
        files: the files of the rendition.
        job: the image.
        request: the record of the request for the image.
        verify: whether to check the SHA-256 of each file and of the input.
        is_ours: whether only clpipe writes to this folder.

    Raises:
        ImageError: a file of the same name exists that clpipe did not write.
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
    """Return whether a file matches its entry in a sidecar.

    Args:
        path: the file.
        was: its entry, with size and SHA-256.
        written: when the sidecar was written, in ns since 1970.
        verify: whether to compare the SHA-256 in any case.
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
    """Check that clpipe wrote a file that would be overwritten.

    Args:
        path: the file, which does not match a sidecar.
        sidecar: the sidecar that lists it; None if there is none.
        written: when the sidecar was written, in ns since 1970.

    Raises:
        ImageError: clpipe did not write the file, or somebody changed it.
    """
    if not is_marked(path):
        raise ImageError(
            f"{path}: clpipe did not write this file, or it was changed later, and {OVERWRITTEN}"
        )
    # A file that differs but was not touched was damaged by the disk.
    if sidecar and os.lstat(path).st_ctime_ns > written and is_complete(path):
        raise ImageError(
            f"{path}: this file was changed after clpipe wrote it (its SHA-256 differs from that "
            f"in {sidecar.name}), and {OVERWRITTEN}"
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
    """Return whether a sidecar has the same input and request, and names this program.

    The arguments are those of :func:`find`.
    """
    if not _same_request(values.get("request"), request) or not _same_input(values, job, verify):
        return Found.NOTHING
    return Found.DONE if values.get("program") == program_digest() else Found.OLD


def _same_input(values: Mapping[str, Any], job: Job, verify: bool) -> bool:
    """Return whether a sidecar lists a job's files unchanged, see :func:`_is_same`."""
    try:
        return all(_is_same(path, was, verify) for path, was in inputs_in(values, job.paths))
    except (KeyError, TypeError, ValueError):  # damaged, or for another number of files
        return False


def _is_same(path: Path, was: Mapping[str, Any], verify: bool) -> bool:
    """Return whether an input file matches its entry in a sidecar.

    A file with the same size and modification time counts as unchanged. For URLs, nothing else is
    compared. Otherwise, and with ``verify``, the SHA-256 decides.

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
    """Return whether a file has clpipe's mark, or only zeros, which a power loss may leave."""
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
    """Return the number of pictures in the output directory whose input was removed or renamed.

    An input counts only if it was in a current input folder, or next to a current input. Names in
    sidecars are relative to the working directory of their run, which may be another.

    Args:
        plan: the plan of the run.
        jobs: all jobs of the run.
        inputs: the inputs as the user wrote them.
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
