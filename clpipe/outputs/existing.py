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
from clpipe.inputs.jobs import Job
from clpipe.outputs.plan import OutputPlan, RenditionFiles
from clpipe.outputs.program import program_digest
from clpipe.outputs.sidecar import (
    SIDECAR,
    NewerFormatError,
    SidecarError,
    input_entries,
    output_entries,
    read_sidecar,
    sidecar_files,
    values_at,
)

MARK_SEARCH_BYTES = 1 << 16  # clpipe's mark is searched in this many bytes at both ends of a file

OVERWRITTEN = "would be overwritten; move it, choose another output directory, or use --redo all"

# clpipe's Software tag, or one of clpipe's attributes. The name clpipe is not enough: DNGs have a
# camera of this name, which converters copy to their output.
MARK = re.compile(rb"clpipe \d+\.\d|clpipe:\w")


class ExistingFiles(Enum):
    """Which files of a rendition exist."""

    NOTHING = "nothing that matches and is complete"
    OLD = "all files, but made by another program"
    DONE = "all files"


class Redo(Enum):
    """Which existing pictures are recomputed. Each choice includes those before it.

    Pictures that are missing, or were made by another request, are always computed.
    """

    MISSING = "missing"  # only pictures that do not exist
    OLD = "old"  # pictures that another version of the program made
    DAMAGED = "damaged"  # damaged pictures, which are found by reading all files
    ALL = "all"  # all pictures, even if clpipe did not write the files

    @property
    def verifies(self) -> bool:
        """Whether the SHA-256 of every file decides."""
        return self is Redo.DAMAGED

    def keeps(self, found: ExistingFiles) -> bool:
        """Return whether a rendition is kept."""
        return found is ExistingFiles.DONE or (found is ExistingFiles.OLD and self is Redo.MISSING)


def find_existing(
    files: RenditionFiles,
    job: Job,
    request: Mapping[str, Any],
    verify: bool = False,
    is_exclusive: bool = False,
) -> ExistingFiles:
    """Return which files of a rendition exist, unchanged and from the same input and request.

    A file counts as unchanged if its size matches and its sidecar was written after its last
    change. Otherwise its SHA-256 decides.

    Args:
        files: the files of the rendition.
        job: the image.
        request: the record of the request for the image.
        verify: whether to check the SHA-256 of each file and of the input.
        is_exclusive: whether only clpipe writes to this folder.

    Raises:
        ImageError: a file of the same name exists that clpipe did not write, or a newer one did.
    """
    try:
        values = read_sidecar(files.sidecar)
    except NewerFormatError:
        raise
    except (FileNotFoundError, SidecarError):
        values = {}
    listed = output_entries(values)
    written_at = _written_at(files.sidecar)
    intact = {
        name
        for name, entry in listed.items()
        if _is_intact(files.sidecar.with_name(name), entry, written_at, verify)
    }
    if {path.name for path in files.pictures} <= intact == listed.keys():
        found = match_sidecar(values, job, request, verify)
        if found is not ExistingFiles.NOTHING:
            return found
    if not is_exclusive:
        for path in (*files.pictures, *files.others):
            if path.name not in intact and os.path.lexists(path):
                _check_written_by_clpipe(
                    path, files.sidecar if path.name in listed else None, written_at
                )
    return ExistingFiles.NOTHING


def _is_intact(path: Path, entry: Mapping[str, Any], written_at: int, verify: bool) -> bool:
    """Return whether a file matches its entry in a sidecar.

    Args:
        path: the file.
        entry: its entry in a sidecar, with size and SHA-256.
        written_at: when the sidecar was written, in ns since 1970.
        verify: whether to compare the SHA-256 in any case.
    """
    try:
        status = os.lstat(path)
        if not stat.S_ISREG(status.st_mode) or status.st_size != entry["size"]:
            return False
        is_untouched = not verify and status.st_ctime_ns <= written_at
        return is_untouched or sha256_of(path)[0] == entry["sha256"]
    except OSError:
        return False


def _check_written_by_clpipe(path: Path, sidecar: Path | None, written_at: int) -> None:
    """Check that clpipe wrote a file that would be overwritten.

    Args:
        path: the file, which does not match a sidecar.
        sidecar: the sidecar that lists the file, or None.
        written_at: when the sidecar was written, in ns since 1970.

    Raises:
        ImageError: clpipe did not write the file, or somebody changed it.
    """
    if not is_marked(path):
        raise ImageError(
            f"{path}: clpipe did not write this file, or it was changed later, and {OVERWRITTEN}"
        )
    # A file that differs without having been modified was damaged by the disk.
    if sidecar and os.lstat(path).st_ctime_ns > written_at and is_complete(path):
        raise ImageError(
            f"{path}: this file was changed after clpipe wrote it (its SHA-256 differs from that "
            f"in {sidecar.name}), and {OVERWRITTEN}"
        )


def _written_at(path: Path) -> int:
    """Return when a sidecar was written, in ns since 1970; 0 if that is in the future."""
    try:
        modified = path.stat().st_mtime_ns
    except OSError:
        return 0
    return modified if modified <= time.time_ns() else 0


def match_sidecar(
    values: Mapping[str, Any], job: Job, request: Mapping[str, Any], verify: bool = False
) -> ExistingFiles:
    """Compare the input, request and program of a sidecar with the current ones.

    For the arguments, see :func:`find_existing`.
    """
    if not _same_request(values.get("request"), request) or not _same_input(values, job, verify):
        return ExistingFiles.NOTHING
    return ExistingFiles.DONE if values.get("program") == program_digest() else ExistingFiles.OLD


def _same_input(values: Mapping[str, Any], job: Job, verify: bool) -> bool:
    """Return whether a sidecar lists a job's files unchanged, see :func:`_is_same`."""
    try:
        return all(
            _is_same(path, entry, verify) for path, entry in input_entries(values, job.paths)
        )
    except (KeyError, TypeError, ValueError):  # a damaged sidecar, or another number of files
        return False


def _is_same(path: Path, entry: Mapping[str, Any], verify: bool) -> bool:
    """Return whether an input file matches its entry in a sidecar.

    A file with the same size and modification time counts as unchanged. For URLs, nothing else is
    compared. Otherwise, and with ``verify``, the SHA-256 decides.

    Raises:
        KeyError, TypeError: the sidecar is damaged.
    """
    size, modified = stamp_of(path)
    if size != entry["size"]:
        return False
    if modified == entry["modified"] and not (verify and url_of(path) is None):
        return True
    return entry["sha256"] in digests([str(path)]).values()


def _same_request(first: Any, second: Mapping[str, Any]) -> bool:
    """Return whether records of requests are equal. Files are compared by content, not by name."""
    if first == second:
        return True
    if not isinstance(first, dict) or not (second["files"] and first.get("files")):
        return False
    texts = []
    for values in (first, second):
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
            ends = file.read(MARK_SEARCH_BYTES)
            file.seek(max(status.st_size - MARK_SEARCH_BYTES, 0))
            ends += file.read(MARK_SEARCH_BYTES)
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
    planned = {plan.path(job, SIDECAR, each) for job in jobs for each in plan.renditions_of(job)}
    input_folders = {Path(text) for text in {os.path.dirname(job.input) for job in jobs}}
    searched_folders = [Path(text) for text in inputs if os.path.isdir(text)]
    count = 0
    for path in sidecar_files(plan.folder):
        if path in planned:
            continue
        try:
            render = (values_at(path) or {}).get("input")
        except SidecarError:
            continue
        if isinstance(render, str) and not os.path.lexists(render):
            entry = Path(render)
            count += entry.parent in input_folders or any(
                entry.is_relative_to(each) for each in searched_folders
            )
    return count
