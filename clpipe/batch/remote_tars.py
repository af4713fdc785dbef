"""Tars behind a URL: which are there, and how finished ones get there.

Beside each tar lies an index, ``000000.index.json``: what the tar was asked for as, its size and
SHA-256, and what became of its images. It is begun before the tar is sent and completed when that
is there. So a tar without one is somebody else's; where it is not complete the tar is made again.
"""

import glob
import hashlib
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from clpipe.base.about import full_version
from clpipe.base.digests import stamp_of
from clpipe.base.errors import ImageError, RequestError
from clpipe.base.files import discard, sha256_of, write_whole
from clpipe.base.urls import fetched, listed, read_url, upload, url_of
from clpipe.batch.outcome import FAILED
from clpipe.batch.tars import NUMBERED, Tar
from clpipe.chain.request import ResolvedRequest
from clpipe.inputs.find import Job
from clpipe.outputs.existing import Redo
from clpipe.outputs.program import program_digest

INDEX = ".index.json"


class RemoteTars:
    """The tars of a run, behind a URL.

    Args:
        tars: of the run's part.
        request: what is asked for.
        redo: which of them are made again.

    Raises:
        RequestError: what lies there is of another run, or somebody else's.
    """

    def __init__(self, tars: Sequence[Tar], request: ResolvedRequest, redo: Redo) -> None:
        self._asked = request
        self._request = json.dumps(request.record(), sort_keys=True, default=str)
        self._redo = redo
        url = url_of(tars[0].folder)
        assert url
        below = [each.removeprefix(f"{url}/") for each in listed(url)]
        self._there = {name for name in below if "/" not in name}
        self._keys = {tar.name: self._key(tar) for tar in tars}  # of inputs as they are now
        for name in sorted(self._there):
            match = NUMBERED.fullmatch(name)
            if match and int(match[2]) >= tars[0].of:
                raise RequestError(
                    f"{url}/{name}: is of another run, as this one makes {tars[0].of} tars, and "
                    "would be read with them; remove it, or choose another URL"
                )
        for tar in tars if redo is not Redo.ALL else ():
            if tar.name in self._there and f"{_stem(tar)}{INDEX}" not in self._there:
                raise RequestError(
                    f"{url}/{tar.name}: has no index, so clpipe did not write it, and it would be "
                    "overwritten; move it, choose another URL, or say --redo all"
                )

    def has(self, tar: Tar) -> bool:
        """Whether a tar is there, whole, made by the same request of the same inputs.

        Raises:
            OutputError: its index cannot be read.
        """
        if self._redo is Redo.ALL or tar.name not in self._there:
            return False
        index = self._index_of(tar)
        if index.get("key") != self._keys[tar.name] or index.get("failed") != []:
            return False
        if self._redo is not Redo.MISSING and index.get("program") != program_digest():
            return False
        if stamp_of(tar.path)[0] != index.get("size"):
            return False
        return self._redo is not Redo.DAMAGED or _is_whole(tar, index)

    def send(self, tar: Tar, statuses: Mapping[str, str]) -> None:
        """Send a tar that is packed, and let go of it here.

        Args:
            tar: the tar.
            statuses: what became of its images, by their stems.

        Raises:
            OutputError: it cannot be sent.
        """
        failed = sorted(stem for stem, status in statuses.items() if status == FAILED)
        if not tar.path.exists():  # all of them failed
            return
        self._write(tar, {})  # it is ours from now on
        digest, size = sha256_of(tar.path)
        url = url_of(tar.path)
        assert url
        upload(tar.path, url)
        self._write(tar, {"size": size, "sha256": digest, "failed": failed})
        discard(tar.path)

    def _key(self, tar: Tar) -> str:
        """A digest of what decides a tar, besides the program."""
        jobs = [
            (
                job.stem,
                job.key,
                self._record_of(job),
                job.frames,
                list(map(stamp_of, files_of(job))),
            )
            for job in tar.jobs
        ]
        text = json.dumps([self._request, jobs], sort_keys=True, default=str)
        return hashlib.sha256(text.encode()).hexdigest()

    def _record_of(self, job: Job) -> Mapping[str, Any]:
        """What a job's own values ask for, with the digests of files that they name."""
        return self._asked.for_image(job.key, job.values).record() if job.values else {}

    def _index_of(self, tar: Tar) -> dict[str, Any]:
        """What a tar's index says; nothing where it is damaged."""
        data = read_url(f"{url_of(tar.folder)}/{_stem(tar)}{INDEX}")
        try:
            found = json.loads(data or b"{}")
        except ValueError:
            return {}
        return found if isinstance(found, dict) else {}

    def _write(self, tar: Tar, more: Mapping[str, Any]) -> None:
        record: dict[str, Any] = {
            "clpipe": full_version(),
            "program": program_digest(),
            "tar": tar.name,
        }
        record |= {"key": self._keys[tar.name], "samples": [job.stem for job in tar.jobs], **more}
        path = tar.path.with_name(f"{_stem(tar)}{INDEX}")
        write_whole(path, json.dumps(record).encode())
        url = url_of(path)
        assert url
        upload(path, url)
        discard(path)


def files_of(job: Job) -> list[Path]:
    """A job's files, and those on this machine that go with it by their names."""
    beside = [
        each
        for path in job.paths
        if url_of(path) is None
        for each in sorted(path.parent.glob(f"{glob.escape(path.stem)}_*"))
    ]
    return [*job.paths, *beside]


def _stem(tar: Tar) -> str:
    return tar.name.removesuffix(".tar")


def _is_whole(tar: Tar, index: Mapping[str, Any]) -> bool:
    """Whether a tar's bytes are those that its index says."""
    try:
        with fetched([tar.path]) as (path,):
            return sha256_of(path)[0] == index.get("sha256")
    except (ImageError, OSError):
        return False
