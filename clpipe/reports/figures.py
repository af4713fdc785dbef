"""The figures of a run: what became of its images, how long it took, and what was drawn."""

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from functools import cached_property
from typing import Any

from clpipe.base.memory import in_words
from clpipe.base.text import duration, one_line
from clpipe.batch.outcome import DONE, FAILED, LEFT_OUT, SKIPPED, STEPS
from clpipe.engine.clipping import MUCH
from clpipe.reports.run import Made, Run

TIMES = 60  # pieces of a run's time, at most
DISTINCT = 12  # values of a parameter that are listed


@dataclass(frozen=True)
class Session:
    """One start of the program, by its log: the lines of its images and its end."""

    start: Mapping[str, Any]
    images: Sequence[Mapping[str, Any]]
    end: Mapping[str, Any]  # empty where it was cut off

    @property
    def command(self) -> Sequence[str]:
        """The words of the command."""
        words = self.start.get("arguments")
        return [str(word) for word in words] if isinstance(words, list) else []

    @property
    def state(self) -> str:
        """How it ended, in a word."""
        if not self.end:
            return "killed, or still running"
        return "interrupted" if self.end.get("interrupted") else "finished"

    def count(self, status: str) -> int:
        """How many images have a status."""
        return sum(line.get("status") == status for line in self.images)

    @cached_property
    def megapixels(self) -> float:
        """Of what was done."""
        return sum(number(line.get("megapixels")) for line in self.images)

    @cached_property
    def seconds(self) -> float:
        """From the start to the end, or to the last image that was begun."""
        if self.end:
            return number(self.end.get("seconds"))
        moments = [moment(line) for line in self.images]
        return max(moments, default=0.0) - moment(self.start) if moments else 0.0

    @property
    def speed(self) -> float:
        """In MP/s; 0 where nothing was done."""
        return self.megapixels / self.seconds if self.seconds > 0 else 0.0

    def pace(self) -> list[dict[str, float]]:
        """How fast it was over its time: seconds since the start, MP/s, and shares of the steps.

        An image counts where the last of its steps ends, as near as the log tells: when it was
        begun, and the time of its steps. Where none ends, there are no shares.
        """
        done = [line for line in self.images if line.get("status") == DONE]
        begun, length = moment(self.start), self.seconds
        if not done or length <= 0:
            return []
        width = length / min(TIMES, max(len(done) // 4, 1))
        pieces: dict[int, list[Mapping[str, Any]]] = {}
        for line in done:
            ends = moment(line) - begun + sum(number(line.get(f"{step}_seconds")) for step in STEPS)
            piece = int(min(max(ends, 0), length * 0.9999) / width)
            pieces.setdefault(piece, []).append(line)
        rows = []
        for i in range(max(pieces) + 1):
            lines = pieces.get(i, [])
            spent = {s: sum(number(x.get(f"{s}_seconds")) for x in lines) for s in STEPS}
            whole = sum(spent.values())
            speed = sum(number(line.get("megapixels")) for line in lines) / width
            shares = {step: spent[step] / whole for step in STEPS} if whole else {}
            rows.append({"seconds": (i + 0.5) * width, "speed": speed, **shares})
        return rows


def sessions(logs: Iterable[Mapping[str, Any]]) -> list[Session]:
    """The starts of the program that logs tell of, in the order of the lines."""
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
    """A value as a number; what is none, or not finite, counts as 0."""
    try:
        found = float(value) if isinstance(value, int | float) else 0.0
    except OverflowError:
        return 0.0
    return found if math.isfinite(found) else 0.0


def moment(line: Mapping[str, Any]) -> float:
    """When a line of a log was, in seconds since 1970; 0 where it does not say."""
    try:
        return datetime.fromisoformat(str(line.get("at"))).timestamp()
    except ValueError:
        return 0.0


def last_failures(found: Sequence[Session]) -> list[str]:
    """The errors of images that failed and were not done since.

    An image is told by where its pictures are: a series makes several of one input.
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
    """The figures that stand on top, by their names; the last run is one that made pictures."""
    pictures = run.pictures
    others = len(run.made) - len(pictures)
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
            rows.append(("Time of the last run", duration(last.seconds)))
        if last.speed:
            rows.append(("Speed of the last run", f"{last.speed:.3g} MP/s"))
        if peak := number(last.end.get("peak_memory")):
            rows.append(("Peak memory", in_words(peak)))
    return rows


@dataclass(frozen=True)
class Parameter:
    """The values of a parameter over the pictures of a run."""

    name: str
    values: Counter[Any]  # JSON values, lists as their text
    is_asked: bool = True  # whether it was drawn, or set for images alone; else it follows

    @property
    def varies(self) -> bool:
        """Whether pictures differ in it."""
        return len(self.values) > 1

    @property
    def numbers(self) -> list[float]:
        """All values that are numbers, each as often as it occurs."""
        return [
            float(value)
            for value, count in self.values.items()
            if isinstance(value, int | float) and not isinstance(value, bool)
            for _ in range(count)
        ]

    @property
    def text(self) -> str:
        """The value, or what values there are."""
        numbers = self.numbers
        if len(self.values) > DISTINCT and len(numbers) == self.values.total():
            return f"{min(numbers):.6g} to {max(numbers):.6g}"
        if len(numbers) == self.values.total():
            return ", ".join(text_of(value) for value in sorted(self.values))
        listed = [text_of(value) for value, _ in self.values.most_common(DISTINCT)]
        more = len(self.values) - len(listed)
        return ", ".join(listed) + (f" and {more} more" if more > 0 else "")


def plain(value: Any) -> int | float | str | None:
    """A value of a sidecar that can be counted and ordered; what is none is its text."""
    is_plain = isinstance(value, str | None) or value == number(value)
    return value if is_plain else str(value)


def text_of(value: Any) -> str:
    """A value of a sidecar for people."""
    if isinstance(value, bool) or value is None:
        return {True: "yes", False: "no", None: "-"}[value]
    return f"{value:.6g}" if isinstance(value, float) else one_line(str(value))


@dataclass(frozen=True)
class Step:
    """A step of the chains of a run: its methods, and the values of their parameters."""

    name: str
    methods: Counter[str]
    parameters: Sequence[Parameter]
    pictures: int  # that have it

    @property
    def is_idle(self) -> bool:
        """Whether it does nothing to any picture."""
        return set(self.methods) == {"none"}


def steps_of(pictures: Sequence[Made]) -> list[Step]:
    """The steps of the chains of pictures, in the order of the longest chain."""
    order: list[str] = []
    records: dict[int, Mapping[str, Any]] = {}  # steps that are alike are the same object
    counts: Counter[int] = Counter()
    for made in pictures:
        ids = [id(step) for step in made.steps]
        counts.update(ids)
        records.update(zip(ids, made.steps, strict=True))
        if len(ids) > len(order):
            names = [str(step.get("name")) for step in made.steps]
            order = names + [name for name in order if name not in names]
    by_name: dict[str, list[tuple[Mapping[str, Any], int]]] = {name: [] for name in order}
    for key, record in records.items():
        by_name.setdefault(str(record.get("name")), []).append((record, counts[key]))
    return [_step(name, counted) for name, counted in by_name.items()]


def _step(name: str, counted: Sequence[tuple[Mapping[str, Any], int]]) -> Step:
    """A step, from how often each record of it occurs."""
    methods: Counter[str] = Counter()
    values: dict[str, Counter[Any]] = {}
    for record, count in counted:
        methods[str(record.get("method"))] += count
        parameters = record.get("parameters")
        for key, value in parameters.items() if isinstance(parameters, Mapping) else ():
            values.setdefault(str(key), Counter())[plain(value)] += count
    parameters = [Parameter(key, each) for key, each in values.items()]
    return Step(name, methods, parameters, methods.total())


def drawn(pictures: Sequence[Made], steps: Sequence[Step]) -> list[Parameter]:
    """What differs from picture to picture: camera, ISO, noise and parameters."""
    asked: set[str] = set().union(*(made.value("asked") or () for made in pictures))
    cameras = Counter(text_of(made.value("camera")) for made in pictures)
    isos = Counter(round(number(made.value("iso"))) for made in pictures)
    lenses = Counter(text_of(made.value("lens") or "none") for made in pictures)
    facts = [Parameter(*each) for each in (("camera", cameras), ("lens", lenses), ("ISO", isos))]
    facts += [
        Parameter(name, Counter(plain(made.value(*keys)) for made in pictures), False)
        for name, keys in (
            ("noise a", ("noise", "signal", "a")),
            ("noise b", ("noise", "signal", "b")),
            ("clipped share", ("clipped",)),
        )
    ]
    repeated = {("sensor_noise", "a"), ("sensor_noise", "b")}
    facts += [
        Parameter(f"{step.name}.{each.name}", each.values, f"{step.name}.{each.name}" in asked)
        for step in steps
        for each in step.parameters
        if (step.name, each.name) not in repeated
    ]
    return [fact for fact in facts if fact.varies]


def warnings_of(made: Made) -> list[str]:
    """The warnings of a picture."""
    found = made.value("warnings")
    return [str(each) for each in found] if isinstance(found, list) else []


def oddities(made: Made) -> list[str]:
    """What is unusual with a picture: files that are gone or changed, clipping, warnings."""
    found = [blob.problem for blob in made.files.values() if blob.problem]
    clipped = number(made.value("clipped"))
    if clipped >= MUCH:
        found.append(f"{clipped * 100:.0f} % of its pixels are clipped")
    return found + warnings_of(made)
