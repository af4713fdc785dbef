"""The progress of a run that other processes or machines do, from its logs and the list of tars."""

import os
import re
import statistics
import time
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from clpipe.base.reading import check_exists
from clpipe.base.text import format_duration
from clpipe.base.url_text import is_url, local
from clpipe.base.urls import list_urls, read_url
from clpipe.batch.outcome import DONE, FAILED, LEFT_OUT, SKIPPED, STEPS
from clpipe.batch.run_log import parse_log
from clpipe.batch.tars import NUMBERED
from clpipe.reports.figures import Session, moment, number, sessions

LOG = re.compile(r"run(\.\d+-of-\d+)?(\.\d{8}T\d{6}-\w+)?\.jsonl")
SLOW = 2.0  # a tar is slow if it takes more than this factor of the median


@dataclass
class Status:
    """The progress of a run.

    Args:
        parts: the last start of each shard, by text such as "2/8".
        lines: the last line of each image, by the path of its outputs.
        tars: the names of the tars that exist.
    """

    parts: dict[str, Session] = field(default_factory=dict)
    lines: dict[str, Mapping[str, Any]] = field(default_factory=dict)
    tars: set[str] = field(default_factory=set)

    def counts(self) -> dict[str, int]:
        """Return the number of images by status: done, failed, and those that have none."""
        found = Counter(str(line.get("status")) for line in self.lines.values())
        done = sum(found[status] for status in (DONE, SKIPPED, LEFT_OUT))
        total = self._total("images")
        missing = max(total - done - found[FAILED], 0)
        return {"images": total, "done": done, "failed": found[FAILED], "missing": missing}

    def tar_counts(self) -> dict[str, int]:
        """Return the number of tars: done, with failed images, and missing."""
        failed = {name for name, line in self._in_tars() if line.get("status") == FAILED}
        done = {name for name, _ in self._in_tars()} & self.tars - failed
        total = self._total("tars")
        missing = max(total - len(done | failed), 0)
        return {"tars": total, "done": len(done), "failed": len(failed), "missing": missing}

    def errors(self) -> Counter[str]:
        """Return the number of failed images by the class of their error."""
        failed = (line for line in self.lines.values() if line.get("status") == FAILED)
        return Counter(str(line.get("error_class")) for line in failed)

    def slow_tars(self) -> tuple[float, dict[str, float]]:
        """Return the median seconds of work on a tar, and the seconds of tars that took longer."""
        seconds: Counter[str] = Counter()
        for name, line in self._in_tars():
            seconds[name] += sum(number(line.get(f"{step}_seconds")) for step in STEPS)  # type: ignore[assignment]
        median = statistics.median(seconds.values()) if seconds else 0.0
        return median, {n: s for n, s in sorted(seconds.items()) if s > SLOW * median > 0}

    def missing_shards(self) -> int:
        """Return the number of shards that have no log."""
        of = max((int(part.rpartition("/")[2]) for part in self.parts), default=0)
        return of - len(self.parts)

    @property
    def is_complete(self) -> bool:
        """Whether all images are done."""
        counts = self.counts()
        return bool(self.parts) and not (
            counts["failed"] or counts["missing"] or self.missing_shards()
        )

    def _total(self, name: str) -> int:
        return sum(int(number(part.start.get(name))) for part in self.parts.values())

    def _in_tars(self) -> Iterator[tuple[str, Mapping[str, Any]]]:
        """Yield the lines of images in tars, with the names of the tars."""
        for stem, line in self.lines.items():
            name = stem.partition("/")[0]
            if NUMBERED.fullmatch(name):
                yield name, line


def read_status(place: str) -> Status:
    """Return the progress of a run.

    Args:
        place: its output directory, or the URL of one.

    Raises:
        MissingError: there is no such directory.
        RequestError: the URL cannot be listed.
    """
    status = Status()
    found: list[Session] = []
    url = place.rstrip("/") if is_url(place) else ""
    if not url:
        check_exists(Path(local(place)))
    listed = list_urls(url) if url else os.listdir(local(place))
    for name in (each.removeprefix(f"{url}/") for each in listed):
        if NUMBERED.fullmatch(name) and name[0] != ".":
            status.tars.add(name)
        if LOG.fullmatch(name):
            data = read_url(f"{url}/{name}") if url else Path(local(place), name).read_bytes()
            found += sessions(parse_log(data or b""))
    for session in sorted(found, key=lambda each: moment(each.start)):
        part = str(session.start.get("shard", "1/1"))
        of = part.rpartition("/")[2]  # an earlier run may have had another number of shards
        status.parts = {p: s for p, s in status.parts.items() if p.rpartition("/")[2] == of}
        status.parts[part] = session
        status.lines |= {str(line.get("stem")): line for line in session.images}
    return status


def part_text(part: str, session: Session) -> str:
    """Return the state of a shard's last start, as a line of text."""
    last = moment((session.images or [session.start])[-1])
    start = session.start
    where = f"on {start.get('host')}, process {start.get('pid')}"
    ago = f"; last image {format_duration(max(time.time() - last, 0))} ago" * (not session.end)
    return f"shard {part}: {session.state}, attempt {start.get('attempt', 1)} {where}{ago}"
