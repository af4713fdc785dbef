"""What a search found: the columns of both, on what it saw and on what it did not, and a file."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from clpipe.analysis.matching.ambiguity import Ambiguity, ambiguities
from clpipe.analysis.matching.columns import COLUMNS, SKEWS, TAILS, Noise
from clpipe.analysis.matching.scenes import Scenes
from clpipe.analysis.matching.search import Candidate, Search, Target, target_at, target_of
from clpipe.analysis.matching.space import DEVELOPMENT, TONE
from clpipe.analysis.report import json_number
from clpipe.base.files import write_new
from clpipe.base.types import Mask
from clpipe.chain.settings import Settings, overlay
from clpipe.chain.toml import value_text

AT_END = 0.01  # of an ISO: what is as near to an end of the range is at it
CHECKED = 4  # frames of each pair that are developed when the result is measured


@dataclass(frozen=True)
class Row:
    """One column: theirs and ours, the mean of all scenes; ours less theirs; and their errors.

    A relative column's residual is a share of theirs. NaN where nothing can be compared.
    """

    name: str
    theirs: float
    ours: float
    residual: float
    error: float

    @property
    def relative(self) -> bool:
        """Whether the residual is a share of theirs."""
        return COLUMNS[self.name].relative


class Compared(NamedTuple):
    """The noise of a scene, theirs and ours, and the pixels that count, searched or not."""

    theirs: Noise
    ours: Noise
    mask: Mask


@dataclass(frozen=True)
class Match:
    """A development, and how like the camera's its noise is.

    ``seen`` are the columns of the places that the search saw, ``unseen`` of those that it did not.
    """

    settings: Settings
    numbers: Mapping[str, float]
    scenes: Scenes
    seen: tuple[Row, ...]
    unseen: tuple[Row, ...]
    evaluations: int
    noises: tuple[Compared, ...]
    ambiguities: tuple[Ambiguity, ...]

    @property
    def remarks(self) -> tuple[str, ...]:
        """What a reader of the configuration must know: the verdict and the warnings."""
        return (self.verdict, *self.warnings)

    @property
    def warnings(self) -> tuple[str, ...]:
        """What is ambiguous, and where the camera's ISOs ended the search."""
        ended = ended_by(self.settings, self.numbers)
        return (*map(str, self.ambiguities), *([ended] if ended else []))

    @property
    def verdict(self) -> str:
        """The correlation with the largest residual in places that the search did not see."""
        rows = [
            row
            for row in self.unseen
            if abs(row.theirs) <= 1 and not (row.relative or row.name in (*TAILS, *SKEWS))
        ]
        if not rows:
            return "the places that were not searched are too few to tell"
        worst = max(rows, key=lambda row: abs(row.residual))
        return (
            "largest residual of a correlation in places not searched: "
            f"{worst.residual:+.3f} ({COLUMNS[worst.name].text})"
        )

    def record(self) -> dict[str, Any]:
        """The match as JSON values; what could not be compared is null."""
        return {
            "settings": self.settings.record(),
            "searched": dict(self.numbers),
            "evaluations": self.evaluations,
            "scenes": [scene.name for scene in self.scenes.each],
            "notes": list(self.scenes.notes),
            "ambiguities": [each.record() for each in self.ambiguities],
            "ended_by_range": ended_by(self.settings, self.numbers) or None,
            "columns": {
                seen.name: {
                    "relative": seen.relative,
                    "searched": row_record(seen),
                    "not_searched": row_record(unseen),
                }
                for seen, unseen in zip(self.seen, self.unseen, strict=True)
            },
        }


def ended_by(settings: Settings, numbers: Mapping[str, float]) -> str:
    """What is to be said of an ISO that was searched up to an end of the camera's range, else "".

    >>> ended_by(Settings(camera="nikon-d800"), {"iso": 6400})  # doctest: +ELLIPSIS
    'iso stopped at 6400, where those of nikon-d800 end: the pictures may have more noise than...'
    """
    limits = settings.isos()
    for end, which in ((limits.low, "less"), (limits.high, "more")):
        if abs(numbers.get("iso", 0.0) / end - 1) < AT_END:
            return (
                f"iso stopped at {end:g}, where those of {settings.camera} end: the pictures may "
                f"have {which} noise than its profile has at any ISO"
            )
    return ""


def row_record(row: Row) -> dict[str, float | None]:
    """The figures of a row as JSON values."""
    return {key: json_number(getattr(row, key)) for key in ("theirs", "ours", "residual", "error")}


def measured(search: Search, found: Candidate) -> Match:
    """What was found, developed with new noise, and measured on all crops.

    Raises:
        StoppedError: the search's watch asked for it.
    """
    scenes = search.scenes
    settings = with_output(found.settings, scenes)
    pairs: dict[bool, list[tuple[Target, Target]]] = {True: [], False: []}
    noises = []
    for scene in scenes.each:
        count = len(scene.frames) if scene.own_mean else CHECKED
        noise = search.simulator.noise(settings, scene, "result", count)
        for part, is_seen in ((~scene.kept_out, True), (scene.kept_out, False)):
            if (scene.flat & part).any():
                theirs = target_of(scene, part)
                pairs[is_seen].append((theirs, target_at(scene, noise, theirs.places)))
        noises.append(Compared(scene.noise, noise, scene.flat))
    return Match(
        settings,
        found.numbers,
        scenes,
        rows_of(pairs[True]),
        rows_of(pairs[False]),
        search.evaluations,
        tuple(noises),
        ambiguities(search, found),
    )


def rows_of(pairs: Sequence[tuple[Target, Target]]) -> tuple[Row, ...]:
    """A row for each column, over scenes.

    The error of a residual is the larger of that which the jackknives give, and that of the mean of
    the scenes' residuals.
    """
    rows = []
    for name, column in COLUMNS.items():
        figures = []
        for theirs, ours in pairs:
            a, b = theirs.figures[name], ours.figures[name]
            if name in theirs.scene.left_out or np.isnan([a, b]).any():
                continue
            error = float(np.hypot(theirs.errors[name], ours.errors[name]))
            scale = abs(a) if column.relative else 1.0
            figures.append((a, b, column.residual(b, a), error / scale if scale else np.nan))
        if not figures:
            rows.append(Row(name, np.nan, np.nan, np.nan, np.nan))
            continue
        table, count = np.array(figures), len(figures)
        error = float(np.sqrt((table[:, 3] ** 2).sum()) / count)
        if count > 1:
            error = max(error, float(table[:, 2].std(ddof=1) / count**0.5))
        theirs_mean, ours_mean, residual = map(float, table[:, :3].mean(0))
        rows.append(Row(name, theirs_mean, ours_mean, residual, error))
    return tuple(rows)


def with_output(settings: Settings, scenes: Scenes) -> Settings:
    """The settings with the JPEG of the camera's pictures.

    What was matched in another format is written without subsampling, which would change it.
    """
    if scenes.jpeg is None:
        return overlay(settings, {"output": {"jpeg_subsampling": "4:4:4"}})
    encoding = {
        "jpeg_quality": scenes.jpeg.quality,
        "jpeg_subsampling": scenes.jpeg.subsampling,
    }
    return overlay(settings, {"output": encoding})


def configuration(settings: Settings, scenes: Scenes, remarks: Sequence[str]) -> str:
    """A development as a configuration file, with remarks at its beginning.

    The stages and every parameter of those that were searched are written, so that it stays the
    same where a default changes, and lies over another way to a raw with all of its steps.
    """
    names = [scene.name for scene in scenes.each]
    more = f" and {len(names) - 1} more" if len(names) > 1 else ""
    lines = [
        f"# Noise like that of {names[0]}{more}; found by clpipe match:",
        *(f"# {remark}." for remark in remarks),
        f"camera = {value_text(settings.camera)}",
        f"iso = {value_text(settings.iso)}",
        "stages = [",
        *(f"    {value_text(name)}," for name in settings.stages),
        "]",
    ]
    record = with_output(settings, scenes).record()
    for name, table in record.items():
        if not isinstance(table, dict):
            continue
        if name in (*DEVELOPMENT, TONE):
            method = settings.method(name)
            table = {"method": method.method, **method.model_dump(exclude_none=True)}  # noqa: PLW2901
        lines += ["", f"[{name}]", *(f"{key} = {value_text(v)}" for key, v in table.items())]
    return "\n".join(lines) + "\n"


def write_configuration(
    path: Path, settings: Settings, scenes: Scenes, remarks: Sequence[str]
) -> None:
    """Write a development as a :func:`configuration`.

    Raises:
        ImageError: it cannot be written.
    """
    write_new(path, configuration(settings, scenes, remarks).encode())
