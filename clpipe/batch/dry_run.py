"""What a run would do, and how long it would take, from a few of its images."""

import tempfile
from dataclasses import dataclass
from pathlib import Path

from clpipe.base.digests import stamp_of
from clpipe.base.errors import OutputError
from clpipe.base.process_folder import process_folder
from clpipe.batch.outcome import DONE
from clpipe.batch.session import Run

SAMPLE = 8  # images that are developed


@dataclass(frozen=True)
class Plan:
    """What a run would do.

    Args:
        images: the number of images.
        existing: the number of images whose pictures exist already.
        megapixels: the megapixels of the images to make.
        input_bytes: the bytes of the images to make.
        output_bytes: the bytes of their pictures, as files.
        seconds: the time that this machine takes for them.
        errors: the errors of sampled images.
    """

    images: int
    existing: int
    megapixels: float
    input_bytes: int
    output_bytes: int
    seconds: float
    errors: tuple[str, ...] = ()


def plan_of(run: Run) -> Plan:
    """Return what a run would do. A few images are developed in a temporary directory.

    They are spread evenly over the run, and developed twice, because the first time compiles.

    Raises:
        RequestError, DeviceError, OutputError: the sample cannot be developed.
    """
    missing = run.missing()
    sample = missing[:: max(len(missing) // SAMPLE, 1)][:SAMPLE]
    input_bytes = sum(stamp_of(path)[0] for job in missing for path in job.paths)
    errors: tuple[str, ...] = ()
    seconds = megapixels = size = 0.0
    for _ in range(2 if sample else 0):
        with tempfile.TemporaryDirectory(prefix="plan-", dir=process_folder()) as folder:
            trial = run.trial(sample, Path(folder))
            outcomes = list(trial.outcomes(trial.jobs))
            seconds, megapixels = trial.summary.elapsed, trial.summary.megapixels
            size = sum(p.stat().st_size for p in Path(folder).rglob("*") if p.is_file())
            errors = tuple(each.error for each in outcomes if each.error)
            done = sum(each.status == DONE for each in outcomes)
    if sample and not done:
        raise OutputError(f"--dry-run: none of {len(sample)} images could be made: {errors[0]}")
    factor = len(missing) / max(len(sample) - len(errors), 1)
    return Plan(
        len(run.jobs),
        len(run.jobs) - len(missing),
        megapixels * factor,
        input_bytes,
        int(size * factor),
        seconds * factor,
        errors,
    )
