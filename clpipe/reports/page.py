"""The HTML file of one or two runs. It is self-contained and needs no network."""

import json
import shlex
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined

from clpipe.analysis.svg import PAGE_FILES, bars_svg, histogram_svg, lines_svg, shares_svg
from clpipe.base.about import __version__
from clpipe.base.text import format_duration, one_line
from clpipe.batch.outcome import DONE, FAILED, SKIPPED, STEPS
from clpipe.reports import figures
from clpipe.reports.figures import Parameter, Session, Step, text_of
from clpipe.reports.images import (
    BUDGET,
    Budget,
    ComparedImage,
    add_stages,
    compared_image,
    contact_sheet,
    select_images,
)
from clpipe.reports.noise import LIMIT, laws, noises
from clpipe.reports.run import Run, RunPicture

TEMPLATES = Path(__file__).parent / "page"
LISTED = 40  # the most failures, warnings and problems that are listed
HISTOGRAMS = 12
BARS = 8  # bars of a chart, one for each distinct value
SHEET_SHARE = 0.45  # share of the budget for contact sheets
MAX_STAGED = 2  # images whose kept stages can be compared
MAX_PLOTS = 3  # pictures whose noise is plotted
SESSIONS = 12  # the latest starts of the program

# The share of luma variance that 2x2 averaging leaves, and the luma correlation of horizontal
# neighbours. The source is JPEGs of a 5D Mark III and a D800 at native size, ISO 1600 and 3200 (Nam
# et al., CVPR 2016), measured by clpipe.analysis.signature. See docs/validation.md.
REAL_LEFT = (0.57, 0.63)
REAL_RIGHT = (0.51, 0.59)
# Ratio of luma noise in the steepest areas to the noise in the flattest areas.
REAL_EDGES = (1.1, 2.4)


@dataclass(frozen=True)
class Listed:
    """A list of texts. Only the first ones are shown."""

    shown: Sequence[str]
    more: int  # distinct texts that are not shown
    total: int


def listed(texts: Sequence[str]) -> Listed:
    """Return texts for display. Equal texts are merged, and the list is limited."""
    counted = Counter(texts)
    lines = [text + (f" ({n:,} times)" if n > 1 else "") for text, n in counted.items()]
    return Listed(lines[:LISTED], max(len(lines) - LISTED, 0), len(texts))


def html(runs: Sequence[Run], report_progress: Callable[[str], None] = lambda _: None) -> str:
    """Return the report of a run, or a comparison of two runs.

    Args:
        runs: one or two runs.
        report_progress: called with a description of the next step.
    """
    first, *others = runs
    labels = labels_of(runs)
    sessions_by_run = [figures.sessions(run.logs) for run in runs]
    steps = [figures.steps_of(run.pictures) for run in runs]
    drawn = figures.drawn(first.pictures, steps[0]) if not others else []
    problems = [text for run in runs for text in run.problems]
    report_progress("noise of raw mosaics")
    all_laws = [law for run in runs for law in laws(run, problems)]
    selected = select_images(first, {law.name for law in all_laws if law.deviates})
    typical = sorted(selected, key=lambda picture: bool(figures.anomalies(picture)))
    budget = Budget(BUDGET)
    report_progress("noise of images")
    noise = [
        (label, each)
        for label, run in zip(labels, runs, strict=True)
        for each in noises(run, matching_pictures(run, typical), problems, MAX_PLOTS // len(runs))
    ]
    furthest = sorted(all_laws, key=lambda law: law.errors, reverse=True)[:MAX_PLOTS]
    law_drawings = [(law.name, law.svg) for law in furthest]
    for svg in [each.svg for _, each in noise] + [svg for _, svg in law_drawings]:
        budget.take(svg)
    share = int(budget.left * SHEET_SHARE) // len(runs)
    shares = [Budget(share) for _ in runs]
    sheets = [
        contact_sheet(*each, report_progress) for each in zip(runs, shares, labels, strict=True)
    ]
    budget.left -= sum(share - each.left for each in shares)
    problems += [text for sheet in sheets for text in sheet.problems]
    entries = [entry for sheet in sheets for entry in sheet.entries]
    compared = []
    for i, picture in enumerate(selected, 1):
        report_progress(f"comparison {i} of {len(selected)}")
        compared.append((picture, compared_image(runs, labels, picture, budget, problems)))
    report_progress("figures")
    shown = [each for _, each in compared if each]
    for picture, each in compared[:MAX_STAGED]:
        if each:
            add_stages(each, picture, budget)
    totals = [figures.totals(run, found) for run, found in zip(runs, sessions_by_run, strict=True)]
    names = list(dict.fromkeys(name for rows in totals for name, _ in rows))
    found = [session for each in sessions_by_run for session in each]
    return (
        page_environment()
        .get_template("report.html")
        .render(
            title=" and ".join(dict.fromkeys(run.folder.resolve().name for run in runs)),
            version=__version__,
            labels=labels,
            totals=[(name, [dict(rows).get(name, "-") for rows in totals]) for name in names],
            sessions=[session_row(session) for session in found[-SESSIONS:]],
            failures=listed(
                [text for each in sessions_by_run for text in figures.last_failures(each)]
            ),
            warnings=listed([text for run in runs for text in warnings(run)]),
            problems=listed(list(dict.fromkeys(problems))),
            pace=pace_drawings(found),
            facts=machine_facts([picture for run in runs for picture in run.pictures]),
            steps=steps[0],
            differences=differences(*steps) if others else [],
            drawn=drawings_of(drawn),
            pictures=sum(sheet.pictures for sheet in sheets),
            shown_pictures=len(entries),
            entries=script_json(entries),
            large=shown,
            views=script_json([view_record(each) for each in shown]),
            noise=noise,
            real_left=REAL_LEFT,
            real_right=REAL_RIGHT,
            real_edges=REAL_EDGES,
            laws=all_laws,
            law_drawings=law_drawings,
            limit=f"{LIMIT:g}",
            style=page_text("css"),
            script=page_text("js"),
        )
    )


def page_environment() -> Environment:
    """Return the environment of the templates of pages."""
    return Environment(
        loader=FileSystemLoader(TEMPLATES),
        autoescape=True,
        finalize=escaped,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )


def page_text(kind: str) -> str:
    """Return the styles ("css") or scripts ("js") of all pages, followed by those of reports."""
    own = (TEMPLATES / f"report.{kind}").read_text("utf-8")
    return (PAGE_FILES / f"page.{kind}").read_text("utf-8") + own


def escaped(value: Any) -> Any:
    r"""Return a value with the unprintable characters of its texts escaped.

    Markup stays as it is.

    >>> escaped({"name": "a" + chr(27), "unusual": [chr(10)]})
    {'name': 'a\\x1b', 'unusual': ['\\n']}
    """
    if type(value) is str:
        return one_line(value)
    if isinstance(value, Mapping):
        return {key: escaped(each) for key, each in value.items()}
    return list(map(escaped, value)) if isinstance(value, list | tuple) else value


def labels_of(runs: Sequence[Run]) -> list[str]:
    """Return unique labels of runs: directory names or paths. The label of a single run is ""."""
    if len(runs) == 1:
        return [""]
    names = [run.folder.resolve().name for run in runs]
    return names if len(set(names)) == len(names) else [str(run.folder) for run in runs]


def matching_pictures(run: Run, pictures: Sequence[RunPicture]) -> list[RunPicture]:
    """Return the pictures of a run that match pictures of another run."""
    return [own for picture in pictures if (own := run.matching_picture(picture))]


def warnings(run: Run) -> list[str]:
    """Return the warnings of all pictures, with their names."""
    return [
        f"{picture.name}: {text}"
        for picture in run.pictures
        for text in figures.warnings_of(picture)
    ]


def differences(first: Sequence[Step], second: Sequence[Step]) -> list[tuple[str, str, str]]:
    """Return the differences between the chains of two runs: methods and values by name."""
    tables = []
    for steps in (first, second):
        rows = {f"{step.name}.method": ", ".join(step.methods) for step in steps}
        rows |= {f"{s.name}.{each.name}": each.text for s in steps for each in s.parameters}
        tables.append(rows)
    one, two = tables
    return [
        (name, one.get(name, "-"), two.get(name, "-"))
        for name in dict.fromkeys([*one, *two])
        if one.get(name) != two.get(name)
    ]


def script_json(value: Any) -> str:
    """Return JSON that is safe inside a ``<script>`` element."""
    text = json.dumps(escaped(value), separators=(",", ":"))
    for character in "<>&\u2028\u2029":
        text = text.replace(character, f"\\u{ord(character):04x}")
    return text


def view_record(each: ComparedImage) -> Mapping[str, Any]:
    """Return the data of an image for the comparison script."""
    return {
        "name": each.name,
        "width": each.width,
        "height": each.height,
        "by": each.reduction,
        "places": [asdict(place) for place in each.places],
        "views": each.views,
    }


def session_row(session: Session) -> Mapping[str, str]:
    """Return a session as a row of the table."""
    return {
        "command": shlex.join(["clpipe", *session.command]),
        "at": str(session.start.get("at", ""))[:19].replace("T", " "),
        "state": session.state,
        "done": f"{session.count(DONE):,}",
        "skipped": f"{session.count(SKIPPED):,}",
        "failed": f"{session.count(FAILED):,}",
        "time": format_duration(session.seconds),
        "speed": f"{session.speed:.3g} MP/s" if session.speed else "-",
    }


def pace_drawings(found: Sequence[Session]) -> list[str]:
    """Return plots of the speed and the time shares of the last run with images."""
    for session in reversed(found):
        rows = session.pace()
        if len(rows) < 3:
            continue
        x = [row["seconds"] for row in rows]
        speed = {"MP/s": [row["speed"] for row in rows]}
        with_shares = [row for row in rows if STEPS[0] in row]
        share_times = [row["seconds"] for row in with_shares]
        shares = {step: [row[step] for row in with_shares] for step in STEPS}
        label = "time since the start, s"
        return [
            lines_svg(x, speed, (label, "MP/s"), "Speed during the run"),
            shares_svg(share_times, shares, label, "Time shares of the steps during the run"),
        ]
    return []


def machine_facts(pictures: Sequence[RunPicture]) -> list[tuple[str, str]]:
    """Return the devices and versions that made the pictures."""
    rows: dict[str, dict[str, None]] = {}
    for picture in pictures:
        device = picture.value("device")
        if isinstance(device, Mapping):
            text = f"{device.get('name')}, {device.get('version')}"
            rows.setdefault("Device", {})[text] = None
        versions = picture.value("versions")
        sidecar_entry = versions if isinstance(versions, Mapping) else {}
        for name, version in {"clpipe": picture.value("clpipe"), **sidecar_entry}.items():
            rows.setdefault(str(name), {})[str(version)] = None
    return [(name, "; ".join(texts)) for name, texts in rows.items()]


def drawings_of(drawn: Sequence[Parameter]) -> list[tuple[Parameter, str]]:
    """Return varying parameters with plots: a histogram, or bars for few distinct values.

    Derived parameters have no plot.
    """
    found: list[tuple[Parameter, str]] = []
    for fact in drawn:
        numbers = fact.numbers
        svg = ""
        if fact.is_requested and sum(bool(each) for _, each in found) < HISTOGRAMS:
            if len(numbers) == fact.values.total() and len(fact.values) > 2:
                svg = histogram_svg(numbers, fact.name)
            elif len(fact.values) <= BARS:
                svg = bars_svg({text_of(value): n for value, n in fact.values.items()}, fact.name)
        found.append((fact, svg))
    return found
