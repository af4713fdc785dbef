"""What a run says while it goes on: a bar on a terminal, lines in a log. All of it on stderr."""

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

from clpipe.batch.outcome import DONE, FAILED, LEFT_OUT, SKIPPED, Outcome
from clpipe.batch.run_log import Summary
from clpipe.outputs.formats import ending_of
from clpipe.outputs.writer import OutputWriter

NAMED = 20  # failures that are named again at the end


class Reporter:
    """Tells of outcomes as they come, and of all of them when it is told to end.

    Args:
        summary: what became of the images so far; kept up by who calls.
        target: where the pictures go.
        console: where to tell; a terminal gets a bar where there are several images.
        quiet: tell of failures alone.
    """

    def __init__(
        self, summary: Summary, target: OutputWriter, console: Console, quiet: bool = False
    ) -> None:
        self._summary = summary
        self._target = target
        self._console = console
        self._quiet = quiet
        self._several = summary.total > 1
        self._bar: Progress | None = None
        if self._several and console.is_terminal and not quiet:
            self._bar = Progress(
                BarColumn(bar_width=None),
                TextColumn("{task.completed}/{task.total} images"),
                TextColumn("{task.description}"),
                TimeRemainingColumn(compact=True),
                console=console,
                transient=True,
            )
            self._task = self._bar.add_task("", total=summary.total)
            self._bar.start()

    def say(self, text: str) -> None:
        """A line of its own."""
        self._console.print(text, markup=False, highlight=False, soft_wrap=True)

    def tell(self, outcome: Outcome) -> None:
        """Tell what became of one image, which the summary has counted."""
        if outcome.error:
            self.say(f"clpipe: {outcome.error}")
        if self._quiet:
            return
        for warning in outcome.warnings:
            if outcome.status == DONE:
                self.say(f"clpipe: {outcome.job.path}: warning: {warning}")
        if self._bar:
            self._bar.update(
                self._task, completed=self._summary.finished, description=self._state()
            )
        elif outcome.status == DONE:
            self.say(f"{outcome.job.path} -> {self._made(outcome)}")

    def _made(self, outcome: Outcome) -> str:
        first, *others = self._target.pictures_of(outcome.job)
        made = str(self._target.path(outcome.job, ending_of(self._target.formats[0]), first))
        if others:
            made += f" and {len(others)} more"
        seconds = sum(outcome.seconds(step) for step in self._summary.seconds)
        return f"{made}  {outcome.megapixels:.2g} MP  {seconds:.2f} s"

    def _state(self) -> str:
        summary = self._summary
        failed = summary.counts[FAILED]
        speed = summary.megapixels / max(summary.elapsed, 1e-9)
        return f"{speed:.0f} MP/s  {summary.shares()}" + f"  {failed} failed" * bool(failed)

    def end(self) -> None:
        """Tell of the whole; the bar is over."""
        if self._bar:
            self._bar.stop()
        summary, counts = self._summary, self._summary.counts
        if counts[LEFT_OUT] and not self._quiet:
            self.say(f"{counts[LEFT_OUT]} images in folders were kept elsewhere and left out")
        failed = summary.failures
        if self._several and failed and (self._bar or not self._quiet):
            self.say("failed:")
            for error in failed[:NAMED]:
                self.say(f"  {error.splitlines()[0]}")
            if len(failed) > NAMED:
                self.say(f"  and {len(failed) - NAMED} more, which the run log names")
        if self._quiet or not (self._several or failed or counts[SKIPPED]):
            return
        there = f" ({counts[SKIPPED]} of them were there already)" if counts[SKIPPED] else ""
        done = counts[DONE] + counts[SKIPPED]
        text = f"{done} of {summary.total} images done{there}, {counts[FAILED]} failed"
        if left := summary.total - summary.finished:
            text += f", {left} not begun"
        if counts[DONE]:
            speed = summary.megapixels / summary.elapsed
            text += f"; {summary.elapsed:.1f} s, {speed:.3g} MP/s; {summary.shares()}"
        self.say(text)
