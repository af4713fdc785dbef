"""The sink that uploads finished tars to a URL.

Next to each tar is an index, ``000000.index.json``, with a digest of its request, its size and
SHA-256, and the images that failed. The index is written before the tar is uploaded, and completed
afterwards. So clpipe did not write a tar without an index, and a tar whose index is incomplete is
made again.
"""

import glob
import hashlib
import json
from collections import Counter
from collections.abc import Generator, Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from clpipe.base.about import full_version
from clpipe.base.digests import stamp_of
from clpipe.base.errors import ImageError, RequestError
from clpipe.base.files import discard, sha256_of, write_atomic
from clpipe.base.urls import fetched_files, list_urls, read_url, upload, url_of
from clpipe.batch.outcome import FAILED, SKIPPED, Outcome
from clpipe.batch.sinks import Executor
from clpipe.batch.tar_sink import Packer, Tars
from clpipe.batch.tars import NUMBERED, Tar
from clpipe.inputs.find import Job
from clpipe.outputs.existing import Redo
from clpipe.outputs.program import program_digest
from clpipe.outputs.shared import SHARED
from clpipe.outputs.writer import OutputWriter

INDEX = ".index.json"


class RemoteTars(Tars):
    """Tars at a URL as a sink. Each is packed here, sent, and removed here.

    Args:
        writer: writes the files of a rendition.
        redo: which of the tars are made again.
        tars: the tars of the run's part.

    Attributes:
        names: the files at the URL.

    Raises:
        RequestError: a tar there belongs to another run, or is not ours.
    """

    def __init__(self, writer: OutputWriter, redo: Redo, tars: Sequence[Tar]) -> None:
        super().__init__(writer, redo, tars)
        self._request = json.dumps(writer.request.record(), sort_keys=True, default=str)
        url = url_of(tars[0].folder)
        assert url
        below = [each.removeprefix(f"{url}/") for each in list_urls(url)]
        self.names = {name for name in below if "/" not in name}
        self._keys = {tar.name: self._key(tar) for tar in tars}  # digests of the current inputs
        for name in sorted(self.names):
            match = NUMBERED.fullmatch(name)
            if match and int(match[2]) >= tars[0].of:
                raise RequestError(
                    f"{url}/{name}: is of another run, as this one makes {tars[0].of} tars, and "
                    "would be read with them; remove it, or choose another URL"
                )
        for tar in tars if redo is not Redo.ALL else ():
            if tar.name in self.names and f"{_stem(tar)}{INDEX}" not in self.names:
                raise RequestError(
                    f"{url}/{tar.name}: has no index, so clpipe did not write it, and it would be "
                    "overwritten; move it, choose another URL, or say --redo all"
                )

    def receive(self, executor: Executor, jobs: Iterable[Job]) -> Generator[Outcome, None, None]:
        """Let an executor do the jobs of tars that are missing; the others are skipped.

        Raises:
            RequestError, DeviceError, OutputError: as :meth:`Tars.receive`.
        """
        there = [tar for tar in self.tars if not executor.is_stopping and self.has(tar)]
        if executor.is_stopping:
            return
        self.tars = [tar for tar in self.tars if tar not in there]
        for tar in there:
            for job in tar.jobs:
                yield Outcome(replace(job, name=f"{tar.name}/{job.stem}"), SKIPPED)
        if self.tars:
            yield from super().receive(executor, [job for tar in self.tars for job in tar.jobs])

    def pack(self, packer: Packer) -> None:
        """Write a tar and send it.

        Raises:
            OutputError: it cannot be written, or sent.
        """
        super().pack(packer)
        self._send(packer.tar, packer.statuses)

    def has(self, tar: Tar) -> bool:
        """Return whether a tar is there, whole, made by the same request of the same inputs.

        Raises:
            OutputError: its index cannot be read.
        """
        if self.redo is Redo.ALL or tar.name not in self.names:
            return False
        index = self._index_of(tar)
        if index.get("key") != self._keys[tar.name] or index.get("failed") != []:
            return False
        if self.redo is not Redo.MISSING and index.get("program") != program_digest():
            return False
        if stamp_of(tar.path)[0] != index.get("size"):
            return False
        return self.redo is not Redo.DAMAGED or _is_whole(tar, index)

    def _send(self, tar: Tar, statuses: Mapping[str, str]) -> None:
        """Send a packed tar, and remove it here.

        Args:
            tar: the tar.
            statuses: what became of its images, by their stems.

        Raises:
            OutputError: it cannot be sent.
        """
        failed = sorted(stem for stem, status in statuses.items() if status == FAILED)
        if not tar.path.exists():  # all images failed
            return
        self._write(tar, {})  # marks the tar as written by this program
        digest, size = sha256_of(tar.path)
        url = url_of(tar.path)
        assert url
        upload(tar.path, url)
        for path in sorted(tar.folder.glob(f"*.{SHARED}")):
            if path.name not in self.names:
                upload(path, f"{url_of(tar.folder)}/{path.name}")
                self.names.add(path.name)
        counts = Counter(statuses.values())
        self._write(tar, {"size": size, "sha256": digest, "failed": failed, "counts": counts})
        discard(tar.path)

    def _key(self, tar: Tar) -> str:
        """Return a digest of everything that a tar depends on, except the program."""
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
        """Return the request of a job's own values, with the digests of files that they name."""
        return self.writer.request.for_image(job.key, job.values).record() if job.values else {}

    def _index_of(self, tar: Tar) -> dict[str, Any]:
        """Return the values of a tar's index. They are empty if it is damaged."""
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
        write_atomic(path, json.dumps(record).encode())
        url = url_of(path)
        assert url
        upload(path, url)
        discard(path)


def files_of(job: Job) -> list[Path]:
    """Return a job's files, and local files next to it with its name as prefix."""
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
    """Return whether a tar's bytes have the SHA-256 of its index."""
    try:
        with fetched_files([tar.path]) as (path,):
            return sha256_of(path)[0] == index.get("sha256")
    except (ImageError, OSError):
        return False
