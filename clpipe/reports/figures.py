"""Figures of a run: outcomes of images, times, and drawn values."""

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from functools import cached_property
from typing import Any

from clpipe.base.memory import format_bytes
from clpipe.base.text import format_duration, one_line
from clpipe.batch.outcome import DONE, FAILED, LEFT_OUT, SKIPPED, STEPS
from clpipe.chain.registry import stage_in
from clpipe.engine.clipping import WARNING_SHARE
from clpipe.reports.run import Run, RunPicture
from clpipe.stage import StageRole

TIMES = 60  # the most intervals into which a run is divided
DISTINCT = 12  # the most values of a parameter that are listed


@dataclass(frozen=True)
class Session:
    """One start of the program, from its log: the lines of images and of the end."""

    start: Mapping[str, Any]
    images: Sequence[Mapping[str, Any]]
    end: Mapping[str, Any]  # empty if the log has no end

    @property
    def command(self) -> Sequence[str]:
        """The arguments of the command."""
        words = self.start.get("arguments")
        return [str(word) for word in words] if isinstance(words, list) else []

    @property
    def state(self) -> str:
        """How the session ended."""
        if not self.end:
            return "killed, or still running"
        return "interrupted" if self.end.get("interrupted") else "finished"

    def count(self, status: str) -> int:
        """Return the number of images with a status."""
        return sum(line.get("status") == status for line in self.images)

    @cached_property
    def megapixels(self) -> float:
        """The megapixels of finished images."""
        return sum(number(line.get("megapixels")) for line in self.images)

    @cached_property
    def seconds(self) -> float:
        """The time from the start to the end, or to the start of the last image."""
        if self.end:
            return number(self.end.get("seconds"))
        moments = [moment(line) for line in self.images]
        return max(moments, default=0.0) - moment(self.start) if moments else 0.0

    @property
    def speed(self) -> float:
        """The speed in MP/s. 0 without finished images."""
        return self.megapixels / self.seconds if self.seconds > 0 else 0.0

    def pace(self) -> list[dict[str, float]]:
        """Return the progress: seconds since the start, MP/s, and time shares of the steps.

        An image counts in the interval in which its last step ends. This is its start plus the time
        of its steps. Intervals in which no image ends have no shares.
        """
        done = [line for line in self.images if line.get("status") == DONE]
        start_time, length = moment(self.start), self.seconds
        if not done or length <= 0:
            return []
        width = length / min(TIMES, max(len(done) // 4, 1))
        intervals: dict[int, list[Mapping[str, Any]]] = {}
        for line in done:
            end_time = (
                moment(line)
                - start_time
                + sum(number(line.get(f"{step}_seconds")) for step in STEPS)
            )
            interval = int(min(max(end_time, 0), length * 0.9999) / width)
            intervals.setdefault(interval, []).append(line)
        rows = []
        for i in range(max(intervals) + 1):
            lines = intervals.get(i, [])
            step_seconds = {s: sum(number(x.get(f"{s}_seconds")) for x in lines) for s in STEPS}
            total = sum(step_seconds.values())
            speed = sum(number(line.get("megapixels")) for line in lines) / width
            shares = {step: step_seconds[step] / total for step in STEPS} if total else {}
            rows.append({"seconds": (i + 0.5) * width, "speed": speed, **shares})
        return rows


def sessions(logs: Iterable[Mapping[str, Any]]) -> list[Session]:
    """Return the sessions in logs, in the order of the lines."""
    found: list[Session] = []
    images: list[Mapping[str, Any]] = []
    for line in logs:
        match line.get("event"):
            case "start":
                images = []
                found.append(Session(line, images, {}))
            case "image":
                images.append(line)
            case "end" if found:
                found[-1] = Session(found[-1].start, images, line)
    return found


def number(value: Any) -> float:
    """Return a value as a float. It is 0 for other types and values that are not finite."""
    try:
        found = float(value) if isinstance(value, int | float) else 0.0
    except OverflowError:
        return 0.0
    return found if math.isfinite(found) else 0.0


def moment(line: Mapping[str, Any]) -> float:
    """Return the time of a log line in seconds since 1970. It is 0 if absent."""
    try:
        return datetime.fromisoformat(str(line.get("at"))).timestamp()
    except ValueError:
        return 0.0


def last_failures(found: Sequence[Session]) -> list[str]:
    """Return the errors of images that failed and were not finished later.

    Images are identified by their output path, because a series makes several of one input.
    """
    errors: dict[str, str] = {}
    for session in found:
        for line in session.images:
            key = str(line.get("stem", line.get("name")))
            if line.get("status") == FAILED:
                errors[key] = str(line.get("error"))
            elif line.get("status") in (DONE, SKIPPED):
                errors.pop(key, None)
    return list(errors.values())


def totals(run: Run, found: Sequence[Session]) -> list[tuple[str, str]]:
    """Return the figures of the summary by name. The last run is the last that made images."""
    pictures = run.pictures
    others = len(run.all_pictures) - len(pictures)
    megapixels = sum(number(p.value("width")) * number(p.value("height")) for p in pictures) / 1e6
    last = next((session for session in reversed(found) if session.count(DONE)), None)
    rows = [
        ("Images", f"{len(pictures):,}"),
        ("Truths, frames, baselines", f"{others:,}"),
        ("Megapixels", f"{megapixels:,.1f}"),
        ("Failed", f"{len(last_failures(found)):,}"),
    ]
    if last:
        left_out = last.count(LEFT_OUT)
        rows += [("Left out", f"{left_out:,}")] if left_out else []
        if last.seconds > 0:
            rows.append(("Time of the last run", format_duration(last.seconds)))
        if last.speed:
            rows.append(("Speed of the last run", f"{last.speed:.3g} MP/s"))
        if peak := number(last.end.get("peak_memory")):
            rows.append(("Peak memory", format_bytes(peak)))
    return rows


@dataclass(frozen=True)
class Parameter:
    """The values of a parameter over the pictures of a run."""

    name: str
    values: Counter[Any]  # JSON values; lists are counted as their text
    # Whether values were drawn, or set for single images; otherwise they were derived.
    is_requested: bool = True

    @property
    def varies(self) -> bool:
        """Whether the value differs between pictures."""
        return len(self.values) > 1

    @property
    def numbers(self) -> list[float]:
        """All numeric values, each as often as it occurs."""
        return [
            float(value)
            for value, count in self.values.items()
            if isinstance(value, int | float) and not isinstance(value, bool)
            for _ in range(count)
        ]

    @property
    def text(self) -> str:
        """The value, or the list or range of values."""
        numbers = self.numbers
        if len(self.values) > DISTINCT and len(numbers) == self.values.total():
            return f"{min(numbers):.6g} to {max(numbers):.6g}"
        if len(numbers) == self.values.total():
            return ", ".join(text_of(value) for value in sorted(self.values))
        listed = [text_of(value) for value, _ in self.values.most_common(DISTINCT)]
        more = len(self.values) - len(listed)
        return ", ".join(listed) + (f" and {more} more" if more > 0 else "")


def plain(value: Any) -> int | float | str | None:
    """Return a value of a sidecar that can be counted and sorted. Other types become text."""
    is_plain = isinstance(value, str | None) or value == number(value)
    return value if is_plain else str(value)


def text_of(value: Any) -> str:
    """Return a value of a sidecar as readable text."""
    if isinstance(value, bool) or value is None:
        return {True: "yes", False: "no", None: "-"}[value]
    return f"{value:.6g}" if isinstance(value, float) else one_line(str(value))


@dataclass(frozen=True)
class Step:
    """A step of the chains of a run, with its methods and parameter values."""

    name: str
    methods: Counter[str]
    parameters: Sequence[Parameter]
    pictures: int  # number of pictures with this step

    @property
    def is_idle(self) -> bool:
        """Whether the step changes no picture."""
        return set(self.methods) == {"none"}


def steps_of(pictures: Sequence[RunPicture]) -> list[Step]:
    """Return the steps of the chains of pictures, in the order of the longest chain."""
    order: list[str] = []
    records: dict[int, Mapping[str, Any]] = {}  # by id; equal steps are the same object
    counts: Counter[int] = Counter()
    for picture in pictures:
        ids = [id(step) for step in picture.steps]
        counts.update(ids)
        records.update(zip(ids, picture.steps, strict=True))
        if len(ids) > len(order):
            names = [str(step.get("name")) for step in picture.steps]
            order = names + [name for name in order if name not in names]
    by_name: dict[str, list[tuple[Mapping[str, Any], int]]] = {name: [] for name in order}
    for key, record in records.items():
        by_name.setdefault(str(record.get("name")), []).append((record, counts[key]))
    return [_step(name, counted) for name, counted in by_name.items()]


def _step(name: str, counted: Sequence[tuple[Mapping[str, Any], int]]) -> Step:
    """Return a step, from its records and their counts."""
    methods: Counter[str] = Counter()
    values: dict[str, Counter[Any]] = {}
    for record, count in counted:
        methods[str(record.get("method"))] += count
        parameters = record.get("parameters")
        for key, value in parameters.items() if isinstance(parameters, Mapping) else ():
            values.setdefault(str(key), Counter())[plain(value)] += count
    parameters = [Parameter(key, each) for key, each in values.items()]
    return Step(name, methods, parameters, methods.total())


def drawn(pictures: Sequence[RunPicture], steps: Sequence[Step]) -> list[Parameter]:
    """Return what varies between pictures: camera, ISO, noise and parameters."""
    requested: set[str] = set().union(*(picture.value("asked") or () for picture in pictures))
    cameras = Counter(text_of(picture.value("camera")) for picture in pictures)
    isos = Counter(round(number(picture.value("iso"))) for picture in pictures)
    lenses = Counter(text_of(picture.value("lens") or "none") for picture in pictures)
    facts = [Parameter(*each) for each in (("camera", cameras), ("lens", lenses), ("ISO", isos))]
    facts += [
        Parameter(name, Counter(plain(picture.value(*keys)) for picture in pictures), False)
        for name, keys in (
            ("noise a", ("noise", "signal", "a")),
            ("noise b", ("noise", "signal", "b")),
            ("clipped share", ("clipped",)),
        )
    ]
    noise = stage_in(StageRole.SENSOR_NOISE).name
    repeated = {(noise, "a"), (noise, "b")}
    facts += [
        Parameter(f"{step.name}.{each.name}", each.values, f"{step.name}.{each.name}" in requested)
        for step in steps
        for each in step.parameters
        if (step.name, each.name) not in repeated
    ]
    return [fact for fact in facts if fact.varies]


def warnings_of(picture: RunPicture) -> list[str]:
    """Return the warnings of a picture."""
    found = picture.value("warnings")
    return [str(each) for each in found] if isinstance(found, list) else []


def anomalies(picture: RunPicture) -> list[str]:
    """Return what is unusual in a picture: missing or changed files, clipping, warnings."""
    found = [blob.problem for blob in picture.files.values() if blob.problem]
    clipped = number(picture.value("clipped"))
    if clipped >= WARNING_SHARE:
        found.append(f"{clipped * 100:.0f} % of its pixels are clipped")
    return found + warnings_of(picture)
