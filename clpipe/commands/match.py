"""``clpipe match``: find a development whose noise matches a camera's pictures."""

import contextlib
import time
from pathlib import Path
from typing import TYPE_CHECKING, Self

import click
from rich.console import Console

from clpipe.analysis.matching.columns import COLUMNS
from clpipe.analysis.matching.match import check_names, match_files
from clpipe.analysis.matching.result import Match, Row, write_configuration
from clpipe.analysis.matching.scenes import Scenes
from clpipe.analysis.matching.search import Candidate, StoppedError, Watch
from clpipe.base.extras import require
from clpipe.base.text import format_duration
from clpipe.batch.interrupt import INTERRUPTED, interruptible
from clpipe.chain.keys import KEYS
from clpipe.chain.settings import Settings
from clpipe.chain.toml import value_text
from clpipe.commands.chain_options import device_option, option
from clpipe.commands.notices import NOTICES
from clpipe.commands.options import EXISTING, Command, OutputPath, json_option, output_option
from clpipe.commands.printing import Rows, number, show, show_json
from clpipe.commands.progress import LINE_INTERVAL

if TYPE_CHECKING:
    from rich.progress import Progress


class SearchProgress(Watch):
    """Shows the progress of a search, and writes the best configuration whenever it improves.

    Args:
        output: the path of the configuration.
        console: the console to print on. A terminal shows a bar inside the context.
    """

    def __init__(self, output: Path, console: Console) -> None:
        self._output = output
        self._console = console
        self._start = self._last_line = time.perf_counter()
        self._written: Settings | None = None
        self._bar: Progress | None = None
        self._live = contextlib.ExitStack()
        self.state = "the search has no result yet, so nothing was written"

    def __enter__(self) -> Self:
        if self._console.is_terminal:
            from rich import progress

            columns = progress.BarColumn(), progress.TextColumn("{task.description}")
            self._bar = progress.Progress(*columns, console=self._console, transient=True)
            self._task = self._bar.add_task("the first fit", total=1.0)
            self._live.enter_context(self._bar)
        self._live.enter_context(NOTICES.printed_by(self._print))
        return self

    def __exit__(self, *error: object) -> None:
        self._live.close()

    def _print(self, text: str) -> None:
        self._console.print(text, markup=False, highlight=False, soft_wrap=True)

    def stop(self) -> None:
        """Stop the search."""
        self.is_stopping = True

    def advanced(self, share: float, best: Candidate, scenes: Scenes) -> None:
        """Write the best settings if they are new, and show the progress.

        Without a terminal, a line is printed every 10 s.
        """
        residuals = f"residuals of {best.residual:.2g}"
        if best.settings is not self._written:
            self._written = best.settings
            remark = f"the best result after {share:.0%} of the search, with {residuals}"
            write_configuration(self._output, best.settings, scenes, [remark])
            self.state = f"wrote {self._output}, {remark}"
        now = time.perf_counter()
        text = f"{share:.0%}; {residuals}"
        if share:
            text += f"; about {format_duration((now - self._start) * (1 / share - 1))} left"
        if self._bar:
            self._bar.update(self._task, completed=share, description=text)
        elif now - self._last_line >= LINE_INTERVAL:
            self._last_line = now
            self._print(text)


@click.command("match", cls=Command)
@click.argument("frames", nargs=-1, required=True, metavar="FRAME...")
@output_option("CONFIG.toml", "The configuration to write.")
@click.option(
    "--mean",
    "means",
    multiple=True,
    metavar="FILES",
    help="The mean of many pictures of each FRAME's scene, in the same order: a file or a quoted "
    "glob. May be repeated. [default: the FRAMEs are a burst of one scene]",
)
@click.option(
    "--chart",
    "charts",
    multiple=True,
    type=EXISTING,
    metavar="PICTURE",
    help="A picture of a slanted edge or a ColorChecker by the same camera. Edges set the blur and "
    "the limit of sharpening, and greys set the tone curve. May be repeated. [default: edges of "
    "the FRAMEs; the search chooses the tone curve]",
)
@option(KEYS["camera"])
@option(
    KEYS["iso"]._replace(
        text="The ISO, which sets the noise of the raw.",
        default_text="the search finds the strength",
    )
)
@click.option(
    "--plot",
    type=OutputPath(path_type=Path),
    metavar="FILE.png",
    help="Draw autocorrelation, power spectrum, noise by intensity and residuals.",
)
@device_option
@json_option
def match(
    frames: tuple[str, ...],
    output: Path,
    means: tuple[str, ...],
    charts: tuple[Path, ...],
    camera: str | None,
    iso: float | None,
    plot: Path | None,
    selector: str | None,
    as_json: bool,
) -> None:
    """Find a development whose noise matches a camera's finished pictures.

    FRAMEs are JPEGs, PNGs or TIFFs from the camera, or unscaled crops of them. They are a burst of
    a static scene, or single pictures, each with the mean of many pictures of its scene (--mean).
    The search varies the methods and parameters of demosaicing, denoising and later stages, until
    the noise of the developed means has the same statistics.

    \b
    clpipe match burst/*.jpg -o camera-jpeg.toml
    clpipe match a_frame.png b_frame.png --mean a_mean.png --mean b_mean.png -o camera-jpeg.toml
    clpipe run render.exr -o out -c camera-jpeg.toml
    """
    require("clpipe match", "calibrate", "scipy", *(["matplotlib"] if plot else []))
    check_names(output, plot)
    search = SearchProgress(output, Console(stderr=True))
    try:
        with interruptible(search.stop), search:
            result = match_files(frames, means, camera, iso, selector, charts, search)
    except StoppedError:
        click.echo(f"stopped: {search.state}", err=True)
        raise click.exceptions.Exit(INTERRUPTED) from None
    write_configuration(output, result.settings, result.scenes, result.remarks)
    if plot is not None:
        from clpipe.analysis.matching.plot import draw

        draw(result, plot)
    if as_json:
        show_json({"configuration": str(output), **result.record()})
        return
    for note in result.scenes.notes:
        click.echo(f"note: {note}")
    headings, *rows = columns_table(result)
    show(headings, rows, left=1)
    click.echo(f"\n{summary(result)}")
    for warning in result.warnings:
        click.echo(f"warning: {warning}")
    click.echo(f"wrote {' and '.join(map(str, [output, *([plot] if plot else [])]))}")


def columns_table(result: Match) -> Rows:
    """Return a row for each column, with residuals and their standard errors."""
    rows: Rows = [("column", "theirs", "ours", "residual", "in places not searched")]
    for seen, unseen in zip(result.seen, result.unseen, strict=True):
        text = COLUMNS[seen.name].text
        figures = number(seen.theirs, ".3f"), number(seen.ours, ".3f")
        rows.append((text, *figures, residual_text(seen), residual_text(unseen)))
    return rows


def residual_text(row: Row) -> str:
    """Return a residual with its standard error, in percent if it is relative."""
    if row.residual != row.residual:
        return "-"
    factor, form, unit = (100, ".1f", " %") if row.relative else (1, ".3f", "")
    return f"{row.residual * factor:+{form}} ± {row.error * factor:{form}}{unit}"


def summary(result: Match) -> str:
    """Return the result of the search in two lines."""
    tables = result.settings.parameters.items()
    methods = [f"{name} {table['method']}" for name, table in tables if "method" in table]
    numbers = [f"{name} = {value_text(value)}" for name, value in result.numbers.items()]
    developments = f"after {result.evaluations} developments"
    return f"{', '.join([*methods, *numbers])}; {developments}\n{result.verdict}"
