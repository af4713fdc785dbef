"""The log of a run: a line of JSON for its start, for each image, and for its end."""

import contextlib
import errno
import json
import logging
import os
import secrets
import stat
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from clpipe.base.about import FORMAT, FORMAT_KEY, full_version
from clpipe.base.errors import OutputError
from clpipe.base.memory import peak_memory
from clpipe.base.system import open_plain
from clpipe.base.urls import upload
from clpipe.batch.interrupt import INTERRUPTED
from clpipe.batch.outcome import DONE, FAILED, LEFT_OUT, SKIPPED, STEPS, Outcome
from clpipe.engine.clipping import WARNING_SHARE
from clpipe.inputs.find import Shard
from clpipe.outputs.sidecar import check_format

log = logging.getLogger(__name__)

SEND_SECONDS = 60.0  # s; the interval between uploads of a log
START = b'{"event": "start"'  # the beginning of the first line


def log_name(shard: Shard) -> str:
    """Return the name of the log of a run, or of a shard of one.

    >>> log_name(Shard()), log_name(Shard(2, 12))
    ('run.jsonl', 'run.02-of-12.jsonl')
    """
    if shard.of == 1:
        return "run.jsonl"
    return f"run.{shard.number:0{len(str(shard.of))}}-of-{shard.of}.jsonl"


@dataclass
class Summary:
    """Counts of the outcomes of a run so far."""

    total: int
    counts: dict[str, int] = field(
        default_factory=lambda: dict.fromkeys((DONE, SKIPPED, LEFT_OUT, FAILED), 0)
    )
    failures: list[str] = field(default_factory=list)
    without_picture: list[str] = field(default_factory=list)
    megapixels: float = 0.0
    seconds: dict[str, float] = field(default_factory=lambda: dict.fromkeys(STEPS, 0.0))
    began: float = field(default_factory=time.perf_counter)
    interrupted: bool = False
    gave_up: str = ""  # why the run stopped itself
    much_clipped: int = 0  # images with a clipped share of MUCH or more
    most_clipped: tuple[float, str] = (0.0, "")  # the largest clipped share, and its image
    old: int = 0  # existing pictures that another version of the program made
    # Images that have pictures, but no outcome yet, because their tar or clip is not complete.
    waiting: int = 0

    def add(self, outcome: Outcome) -> None:
        """Count the outcome of one image."""
        self.counts[outcome.status] += 1
        self.old += outcome.old
        if outcome.status == DONE:
            self.megapixels += outcome.megapixels
            self.much_clipped += outcome.clipped >= WARNING_SHARE
            if outcome.clipped > self.most_clipped[0]:
                self.most_clipped = outcome.clipped, outcome.job.display_name
        if outcome.error:
            self.failures.append(outcome.error)
        if outcome.reason:
            self.without_picture.append(outcome.reason)
        for step in STEPS:
            self.seconds[step] += outcome.seconds(step)

    def exceeds(self, most: int) -> bool:
        """Return whether more images have failed than are allowed, and note that the run stops."""
        failed = self.counts[FAILED]
        if failed > most and not self.gave_up:
            self.gave_up = (
                f"the run stopped, because more than {most} image{'s' * (most != 1)} failed"
            )
        return bool(self.gave_up)

    @property
    def finished(self) -> int:
        """The number of images that have an outcome."""
        return sum(self.counts.values())

    @property
    def made(self) -> int:
        """The number of images that have an outcome, or pictures that wait for it."""
        return self.finished + self.waiting

    @property
    def exit_status(self) -> int:
        """The exit status of a command: 130 after an interruption, 1 if something is missing."""
        if self.gave_up:
            return 1
        has_no_result = self.counts[LEFT_OUT] > 0 == self.counts[DONE] + self.counts[SKIPPED]
        return INTERRUPTED if self.interrupted else int(bool(self.failures or has_no_result))

    @property
    def elapsed(self) -> float:
        """The seconds since the start."""
        return time.perf_counter() - self.began

    def shares(self) -> str:
        """Return the share of each step in the time of all threads. Files of URLs are fetched.

        >>> Summary(1, seconds={"fetch": 0.0, "decode": 1.0, "device": 2.0, "encode": 1.0}).shares()
        'decode 25 %, device 50 %, encode 25 %'
        """
        total = sum(self.seconds.values()) or 1.0
        shares = {s: t for s, t in self.seconds.items() if t or s != "fetch"}
        return ", ".join(f"{s} {100 * t / total:.0f} %" for s, t in shares.items())

    def record(self) -> dict[str, Any]:
        """Return the counts as JSON values."""
        return {
            "images": self.total,
            **{status.replace(" ", "_"): n for status, n in self.counts.items()},
            "interrupted": self.interrupted,
            "gave_up": self.gave_up or None,
            "of_another_program": self.old,
            "megapixels": round(self.megapixels, 3),
            "seconds": round(self.elapsed, 3),
            "peak_memory": peak_memory(),
            **{f"{step}_seconds": round(t, 3) for step, t in self.seconds.items()},
        }


def _line(event: str, at: float, values: Mapping[str, Any]) -> bytes:
    time_text = datetime.fromtimestamp(at, UTC).isoformat(timespec="milliseconds")
    return (json.dumps({"event": event, "at": time_text, **values}) + "\n").encode()


class RunLog:
    """Writes the log of a run after the logs of earlier runs.

    It begins with the first image, or with :meth:`begin`.

    Args:
        path: the file.
        start: the values of the first line.
        echo: also called with each line.
        url: the directory in a bucket to which the log is uploaded, under a unique name, when it
            begins, at intervals, and when it is closed. None is none.
    """

    def __init__(
        self,
        path: Path,
        start: Mapping[str, Any],
        echo: Callable[[bytes], None] | None = None,
        url: str | None = None,
    ) -> None:
        self._path = path
        self._echo = echo
        self._file: int | None = None
        self._start = {FORMAT_KEY: FORMAT, "clpipe": full_version(), "attempt": 1, **start}
        self._began = time.time()
        began = time.strftime("%Y%m%dT%H%M%S", time.gmtime(self._began))
        self._url = url and f"{url}/{path.stem}.{began}-{secrets.token_hex(2)}.jsonl"
        self._sent = 0.0  # when it was uploaded last, in s of time.monotonic()

    def begin(self) -> None:
        """Write the first line, and upload it.

        Raises:
            OutputError: it cannot be written.
        """
        self._write(b"")
        try:
            self._send()
        except OutputError:
            self._url = None  # one message is enough
            raise

    def _send(self) -> None:
        """Upload the log, if it has a URL.

        Raises:
            OutputError: it cannot be written.
        """
        if self._url and self._file is not None:
            self._sent = time.monotonic()
            upload(self._path, self._url)

    def _write(self, line: bytes) -> None:
        try:
            if self._file is None:
                self._file = self._open()
                line = _line("start", self._began, self._start) + line
            _append(self._file, line)
        except OSError as error:
            raise OutputError(f"{self._path}: cannot be written: {error.strerror}") from None
        if self._echo:
            self._echo(line)

    def _open(self) -> int:
        """Open the file after its last whole line.

        Raises:
            OSError: it cannot be opened, or is no regular file.
        """
        file = open_plain(self._path, os.O_RDWR | os.O_CREAT)
        status = os.fstat(file)
        if not stat.S_ISREG(status.st_mode):
            os.close(file)
            raise OSError(errno.EINVAL, "not a regular file")
        if status.st_size:
            self._start["attempt"] = 1 + self._path.read_bytes().count(START)
            os.lseek(file, -1, os.SEEK_END)
            if os.read(file, 1) != b"\n":
                _append(file, b"\n")  # the last line is incomplete
        return file

    def add(self, outcome: Outcome) -> None:
        """Write the line of one image.

        Raises:
            OutputError: it cannot be written.
        """
        job = outcome.job
        line = _line(
            "image",
            outcome.began,
            {
                "input": job.display_name,
                "name": job.key,
                "stem": job.stem,
                "status": outcome.status,
                "host": outcome.host,
                "pid": outcome.pid,
                "device": outcome.device or None,
                "layer": outcome.layer,
                "part": outcome.part,
                "megapixels": round(outcome.megapixels, 6),
                **{f"{step}_seconds": round(outcome.seconds(step), 6) for step in STEPS},
                "outputs": list(outcome.outputs),
                "warnings": list(outcome.warnings),
                "clipped": round(outcome.clipped, 4),
                "error": outcome.error or None,
                "error_class": outcome.error_class or None,
                **({"reason": outcome.reason} if outcome.reason else {}),
            },
        )
        self._write(line)
        if time.monotonic() - self._sent > SEND_SECONDS:
            self._send()

    def end(self, summary: Summary) -> None:
        """Write the last line, if there is a first one.

        Raises:
            OutputError: it cannot be written.
        """
        if self._file is not None:
            self._write(_line("end", time.time(), summary.record()))

    def close(self) -> None:
        """Close the file. This writes no error, because it might hide one of the run."""
        if self._file is not None:
            try:
                self._send()
            except OutputError as error:
                log.warning("%s; the end of this run's log is lost", error)
            with contextlib.suppress(OSError):
                os.fsync(self._file)
            os.close(self._file)
            self._file = None


def _append(file: int, data: bytes) -> None:
    """Append data to a file, all of it or nothing.

    Raises:
        OSError: it cannot be written.
    """
    end = os.lseek(file, 0, os.SEEK_END)
    written = 0
    try:
        while written < len(data):
            written += os.write(file, data[written:])
    except OSError:
        os.ftruncate(file, end)
        raise


def read_log(path: Path) -> Sequence[dict[str, Any]]:
    """Return the lines of a log, without one that is cut off.

    Raises:
        OSError: it cannot be read.
    """
    return parse_log(path.read_bytes())


def parse_log(data: bytes) -> Sequence[dict[str, Any]]:
    """Return the lines of a log's bytes, without one that is cut off.

    Raises:
        NewerFormatError: a newer version wrote it.
    """
    lines = []
    for line in data.splitlines():
        try:
            lines.append(json.loads(line))
        except ValueError:
            continue
        check_format(lines[-1], "run.jsonl")
    return lines
