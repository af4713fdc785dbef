"""The result of a search: columns inside and outside the searched areas, and a configuration."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from clpipe.analysis.matching.ambiguity import Ambiguity, ambiguities
from clpipe.analysis.matching.charts import Tone
from clpipe.analysis.matching.columns import COLUMNS, SKEWS, TAILS, Noise
from clpipe.analysis.matching.edges import Sharpness, as_sharp, edge_in
from clpipe.analysis.matching.scenes import Scenes
from clpipe.analysis.matching.search import Candidate, Search, Target, target_at, target_of
from clpipe.analysis.matching.space import DEVELOPMENT, TONE
from clpipe.analysis.report import json_object
from clpipe.analysis.sharpness import Edge
from clpipe.base.files import write_new
from clpipe.base.types import Mask
from clpipe.chain.settings import Settings, overlay
from clpipe.chain.toml import value_text

AT_END = 0.01  # share of the range; an ISO this close to an end counts as at the end
NO_EDGES = (
    "the pictures have too few straight, isolated edges to measure their sharpness, so "
    "optical_blur and sharpen.limit are the defaults; add a picture of a slanted edge (--chart)"
)
CHECKED = 4  # frames of each pair that are developed to measure the result


@dataclass(frozen=True)
class Row:
    """A column: theirs and ours as means over scenes, the residual (ours minus theirs), and errors.

    A relative column's residual is a share of theirs. NaN means that nothing can be compared.
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

    def record(self) -> dict[str, Any]:
        """Return the figures as JSON values."""
        return json_object(
            theirs=self.theirs, ours=self.ours, residual=self.residual, error=self.error
        )


class Compared(NamedTuple):
    """The noise of a scene, theirs and ours, and its valid pixels, searched or not."""

    theirs: Noise
    ours: Noise
    mask: Mask


@dataclass(frozen=True)
class Match:
    """A development, and the similarity of its noise to the camera's.

    ``seen`` has the columns in areas that were used in the search, ``unseen`` those in held-out
    areas.
    """

    settings: Settings
    numbers: Mapping[str, float]
    scenes: Scenes
    seen: tuple[Row, ...]
    unseen: tuple[Row, ...]
    evaluations: int
    noises: tuple[Compared, ...]
    ambiguities: tuple[Ambiguity, ...]
    sharpness: Sharpness | None
    tone: Tone | None = None

    @property
    def remarks(self) -> tuple[str, ...]:
        """Sentences for a reader of the configuration: the verdict and the warnings."""
        charts = [str(each) for each in (self.sharpness, self.tone) if each]
        return (self.verdict, *charts, *self.warnings)

    @property
    def warnings(self) -> tuple[str, ...]:
        """Sentences about poorly constrained numbers, an ISO at the end of the range, and edges."""
        ended = ended_by(self.settings, self.numbers)
        blunt = [] if self.sharpness else [NO_EDGES]
        return (*map(str, self.ambiguities), *([ended] if ended else []), *blunt)

    @property
    def verdict(self) -> str:
        """A sentence with the correlation of the largest residual in held-out areas."""
        rows = [
            row
            for row in self.unseen
            if abs(row.theirs) <= 1 and not (row.relative or row.name in (*TAILS, *SKEWS))
        ]
        if not rows:
            return "the held-out areas are too small for a verdict"
        worst = max(rows, key=lambda row: abs(row.residual))
        return (
            "largest residual of a correlation in held-out areas: "
            f"{worst.residual:+.3f} ({COLUMNS[worst.name].text})"
        )

    def record(self) -> dict[str, Any]:
        """Return the match as JSON values, with null for columns that cannot be compared."""
        return json_object(
            settings=self.settings.record(),
            searched=self.numbers,
            evaluations=self.evaluations,
            scenes=[scene.name for scene in self.scenes.each],
            notes=self.scenes.notes,
            ambiguities=self.ambiguities,
            sharpness=self.sharpness,
            tone=self.tone,
            ended_by_range=ended_by(self.settings, self.numbers) or None,
            columns={
                seen.name: {
                    "relative": seen.relative,
                    "searched": seen.record(),
                    "not_searched": unseen.record(),
                }
                for seen, unseen in zip(self.seen, self.unseen, strict=True)
            },
        )


def ended_by(settings: Settings, numbers: Mapping[str, float]) -> str:
    """Return a sentence about an ISO at an end of the camera's range; "" if it is not there.

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


def measured(
    search: Search, found: Candidate, edge: Edge | None = None, tone: Tone | None = None
) -> Match:
    """Return the match of a candidate, developed with new noise and measured on all crops.

    Args:
        search: the search.
        found: its result.
        edge: of a chart; None takes those of the scenes.
        tone: of a chart.

    Raises:
        StoppedError: the search's watch stopped it.
    """
    scenes = search.scenes
    sharp, sharpness = as_sharp(
        found.settings, edge or edge_in(scenes.each), search.simulator.device
    )
    settings = with_output(sharp, scenes)
    pairs: dict[bool, list[tuple[Target, Target]]] = {True: [], False: []}
    noises = []
    for scene in scenes.each:
        count = len(scene.frames) if scene.own_mean else CHECKED
        noise = search.simulator.noise(settings, scene, "result", count)
        for part, is_seen in ((~scene.holdout, True), (scene.holdout, False)):
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
        sharpness,
        tone,
    )


def rows_of(pairs: Sequence[tuple[Target, Target]]) -> tuple[Row, ...]:
    """Return a row for each column, over scenes.

    The error of a residual is the larger of two: that of the jackknife, and that of the mean of the
    scenes' residuals.
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
    """Return the settings with the JPEG of the camera's pictures.

    If the pictures have another format, subsampling is turned off, because it would change noise.
    """
    if scenes.jpeg is None:
        return overlay(settings, {"output": {"jpeg_subsampling": "4:4:4"}})
    encoding = {
        "jpeg_quality": scenes.jpeg.quality,
        "jpeg_subsampling": scenes.jpeg.subsampling,
    }
    return overlay(settings, {"output": encoding})


def configuration(settings: Settings, scenes: Scenes, remarks: Sequence[str]) -> str:
    """Return a development as a configuration file, with remarks at its beginning.

    It contains the stages, and every parameter of the searched ones. The result therefore does not
    depend on defaults, and can be combined with another configuration up to the raw.
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
        ImageError: the file cannot be written.
    """
    write_new(path, configuration(settings, scenes, remarks).encode())
