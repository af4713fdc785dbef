"""Prints the progress of a run on stderr: a bar on a terminal, otherwise lines.

Each image has a line if there are not many. Another line is printed every 10 s.
"""

import contextlib
import shlex
import time
from collections import Counter
from collections.abc import Callable, Generator, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Self

import click
from rich.console import Console
from rich.text import Text

from clpipe.base.errors import ImageError
from clpipe.base.text import format_duration, one_line
from clpipe.base.ticker import ticking
from clpipe.base.urls import url_of
from clpipe.batch.interrupt import interruptible
from clpipe.batch.outcome import DONE, FAILED, LEFT_OUT, SKIPPED, Outcome
from clpipe.batch.session import Run
from clpipe.commands.metrics import write_metrics
from clpipe.commands.notices import NOTICES
from clpipe.engine.clipping import clipping_text
from clpipe.engine.programs import watching_compilation
from clpipe.outputs.existing import Redo

if TYPE_CHECKING:
    from rich.progress import Progress

MAX_LINES = 50  # without a terminal, each image has a line if there are at most this many images
COMPILE_DELAY = 0.5  # s; compiling is shown if it takes longer
LINE_INTERVAL = 10.0  # s; the interval between lines of progress


def bar_on(console: Console) -> "Progress":
    """Return a progress bar for images, with a description and the remaining time.

    The bar disappears when it stops.
    """
    from rich import progress  # slow to import, and a single image needs no bar

    return progress.Progress(
        progress.BarColumn(bar_width=None),
        progress.TextColumn("{task.completed}/{task.total} images"),
        progress.TextColumn("{task.description}"),
        progress.TimeRemainingColumn(compact=True),
        console=console,
        transient=True,
    )


@contextlib.contextmanager
def status_line() -> Generator[Callable[[str], None]]:
    """Yield a function that shows progress on stderr.

    A terminal shows one line that changes. Otherwise a line is printed every 10 s.
    """
    console = Console(stderr=True)
    last = time.perf_counter()

    def line(text: str) -> None:
        nonlocal last
        if time.perf_counter() - last >= LINE_INTERVAL:
            last = time.perf_counter()
            console.print(text, markup=False, highlight=False, soft_wrap=True)

    if not console.is_terminal:
        yield line
        return
    with console.status("") as status:
        yield lambda text: status.update(Text(text))


class Reporter:
    """Prints the outcome of each image, and a summary at the end of its context.

    Args:
        run: the run.
        console: the console to print on; a terminal shows a bar if there are several images.
        quiet: print failures only.
        metrics: the file for the counts of the run, if any.
    """

    def __init__(
        self, run: Run, console: Console, quiet: bool = False, metrics: Path | None = None
    ) -> None:
        self._summary = summary = run.summary
        self._writer = run.writer
        self._console = console
        self._quiet = quiet
        self._metrics = metrics
        self._keeps_old = run.execution.redo is Redo.MISSING
        self._several = summary.total > 1
        run.watch = self._show_progress
        self._start = time.perf_counter()
        self._bar: Progress | None = None
        self._is_live = console.is_terminal and not quiet
        self._live = contextlib.ExitStack()
        self._warnings: Counter[str] = Counter()  # each warning is printed once, and counted

    def __enter__(self) -> Self:
        self._live.enter_context(NOTICES.printed_by(self.print))
        self._live.enter_context(watching_compilation(self._compiling))
        if self._is_live and self._several:
            self._show("")
        self._write_metrics()
        self._live.enter_context(ticking(LINE_INTERVAL, self._tick))
        return self

    def __exit__(self, *error: object) -> None:
        self._live.close()
        self.end()
        self._write_metrics()

    def _show(self, description: str) -> None:
        """Show the bar with a description."""
        if self._bar is None:
            self._bar = bar_on(self._console)
            self._task = self._bar.add_task("", total=self._summary.total)
            self._bar.start()
        self._bar.update(self._task, completed=self._summary.made, description=description)

    def _compiling(self, compiled: int, total: int) -> None:
        """Show how many kernels are compiled, if compiling takes long."""
        if self._is_live and time.perf_counter() - self._start > COMPILE_DELAY:
            left = f"compiling {compiled + 1} of {total}" if compiled < total else "first launches"
            self._show(left)

    def print(self, text: str) -> None:
        """Print a line. A failure to print, such as on a full disk, does not stop the run."""
        with contextlib.suppress(OSError):
            self._console.print(one_line(text), markup=False, highlight=False, soft_wrap=True)

    def report(self, outcome: Outcome) -> None:
        """Print the outcome of one image, which is already in the summary."""
        if outcome.error:
            self.print(f"clpipe: {outcome.error}")
        if self._quiet:
            return
        for warning in outcome.warnings if outcome.status == DONE else ():
            if not self._warnings[warning]:
                self.print(f"clpipe: {outcome.job.display_name}: warning: {warning}")
            self._warnings[warning] += 1
        self._show_progress()
        has_line = not (self._bar and self._several) and self._summary.total <= MAX_LINES
        if has_line and outcome.status == DONE:
            self.print(f"{outcome.job.display_name} -> {self._files(outcome)}")

    def _show_progress(self) -> None:
        """Update the bar."""
        if self._bar and self._several:
            self._show(self._progress_text())

    def _tick(self) -> None:
        """Print a line if there is no bar, and write the metrics."""
        if not self._is_live and not self._quiet:
            self.print(self._progress_text(with_count=True))
        self._write_metrics()

    def _write_metrics(self) -> None:
        if self._metrics:
            try:
                write_metrics(self._metrics, self._summary)
            except ImageError as error:  # a run goes on without metrics
                self.print(f"clpipe: --metrics: {error}")
                self._metrics = None

    def _files(self, outcome: Outcome) -> str:
        first, *others = self._writer.renditions_of(outcome.job)
        path = self._writer.files(outcome.job, first).pictures[0]
        text = url_of(path) or str(path)
        if others:
            text += f" and {len(others)} more"
        seconds = sum(outcome.seconds(step) for step in self._summary.seconds)
        return f"{text}  {outcome.megapixels:.2g} MP  {seconds:.2f} s"

    def _progress_text(self, with_count: bool = False) -> str:
        """Return the progress as text: for the bar, or with the count of images for a line."""
        summary = self._summary
        failed = summary.counts[FAILED]
        speed = summary.megapixels / max(summary.elapsed, 1e-9)
        text = f"{speed:.0f}" if speed >= 10 else f"{speed:.2g}"
        parts = [f"{text} MP/s", summary.shares()] + [f"{failed} failed"] * bool(failed)
        if not with_count:
            return "  ".join(parts)
        if summary.made:
            left = summary.elapsed * (summary.total - summary.made) / summary.made
            parts.append(f"about {format_duration(left)} left")
        images = "images" if self._several else "image"
        return "; ".join([f"{summary.made} of {summary.total} {images}", *parts])

    def _notes(self) -> Iterator[str]:
        """Yield notes about clipped, old and omitted pictures."""
        summary, without = self._summary, self._summary.without_picture
        if count := summary.much_clipped:
            share, path = summary.most_clipped
            have = "images have" if count > 1 else "image has"
            worst = f"{count} {have} many clipped pixels. The worst is {path}: "
            start = worst if self._several else f"clpipe: {path}: warning: "
            yield start + clipping_text(share)
        if count := summary.old:
            were, stay, are = ("s were", "stay", "are") if count > 1 else (" was", "stays", "is")
            old = f"{count} picture{were} made by another version of clpipe or of image libraries"
            redone = f"{are} recomputed; --redo missing keeps them"
            yield f"{old}, and {f'{stay} (--redo missing)' if self._keeps_old else redone}"
        if without:
            hold = "images in directories have" if len(without) > 1 else "image in a directory has"
            yield f"left out: {len(without)} {hold} no picture, such as {without[0]}"
        if (kept := summary.counts[LEFT_OUT] - len(without)) > 0:
            were = "image in a directory was" if kept == 1 else "images in directories were"
            yield f"left out: {kept} {were} kept after other stages"

    def end(self) -> None:
        """Remove the bar and print the summary."""
        if self._bar:
            self._bar.stop()
        summary, counts = self._summary, self._summary.counts
        for text, count in self._warnings.items():
            if count > 1:
                self.print(f"{count} images have this warning: {text}")
        for note in () if self._quiet else self._notes():
            self.print(note)
        failed = summary.failures
        is_done = summary.made == summary.total and not failed and not counts[SKIPPED]
        if self._quiet or (is_done and not self._several):
            return
        were = "was" if counts[SKIPPED] == 1 else "were"
        which = "it" if summary.total == 1 else f"{counts[SKIPPED]} of them"
        existing = f" ({which} {were} there already)" * bool(counts[SKIPPED])
        done = counts[DONE] + counts[SKIPPED]
        images = "image" if summary.total == 1 else "images"
        text = f"{done} of {summary.total} {images} done{existing}, {counts[FAILED]} failed"
        if counts[LEFT_OUT]:
            text += f", {counts[LEFT_OUT]} left out"
        if summary.waiting:
            text += f", {summary.waiting} kept for the next run"
        if left := summary.total - summary.made:
            text += f", {left} not begun"
        text += f"; {summary.gave_up}" * bool(summary.gave_up)
        if counts[DONE]:
            speed = summary.megapixels / summary.elapsed
            text += f"; {summary.elapsed:.1f} s, {speed:.3g} MP/s; {summary.shares()}"
        self.print(text)
        if self._bar and self._several and counts[DONE] and not url_of(self._writer.folder):
            self.print(f"for a report: clpipe report {shlex.quote(str(self._writer.folder))}")


def follow(
    run: Run,
    outcomes: Generator[Outcome, None, None],
    quiet: bool = False,
    reporter: Reporter | None = None,
    stop: Callable[[], None] | None = None,
    metrics: Path | None = None,
) -> None:
    """Print the outcomes of a run's images, and its notes at the end.

    Args:
        run: the run.
        outcomes: the outcomes of its images.
        quiet: print failures only.
        reporter: the reporter to use. None creates one that prints on stderr.
        stop: the function to call on Ctrl-C. None stops the run.
        metrics: as for :class:`Reporter`.

    Raises:
        ClpipeError: the run cannot continue.
    """
    output = reporter or Reporter(run, Console(stderr=True), quiet, metrics)
    with contextlib.closing(outcomes), interruptible(stop or run.stop), output:
        for outcome in outcomes:
            output.report(outcome)
    for note in () if quiet else run.notes:
        click.echo(note, err=True)


def print_line(line: bytes) -> None:
    """Print a line on stdout. A failure to print does not stop the run."""
    with contextlib.suppress(OSError):
        click.echo(line, nl=False)
