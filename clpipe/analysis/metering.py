"""Auto exposure of sequences: metered frame by frame, smoothed over time, written as a manifest."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from pathlib import Path

from clpipe.base.errors import ImageError, RequestError
from clpipe.base.files import write_new
from clpipe.chain.identity import noise_key
from clpipe.engine.device import Device
from clpipe.engine.runner import Runner
from clpipe.inputs.find import Job
from clpipe.inputs.loader import ImageLoader, LoadedImage
from clpipe.inputs.manifest import Row, key_of, manifest_text
from clpipe.stages.exposure.auto import Auto

EXPOSURE = "exposure"
DIGITS = 4  # decimal places of an EV


@dataclass(frozen=True)
class Exposure:
    """The exposure of a frame in EV.

    ``metered`` is the result of ``exposure.method=auto`` for this frame only. ``ev`` is smoothed
    over time, and includes the compensation. ``headroom`` comes from the frame's chain.
    """

    job: Job
    metered: float
    ev: float
    headroom: float


def to_meter(jobs: Sequence[Job]) -> list[Job]:
    """Return jobs without the exposure in their manifest."""
    return [
        replace(job, values={k: v for k, v in job.values.items() if k != EXPOSURE}) for job in jobs
    ]


def check_request(loader: ImageLoader, jobs: Sequence[Job]) -> None:
    """Check that frames can be metered.

    Raises:
        RequestError: a frame is a camera raw, a row of a manifest is wrong, or the chain does not
            use ``exposure.method=auto``.
    """
    for job in jobs:
        if loader.raw.is_raw(job.path):
            raise RequestError(
                f"{job.label}: this is a raw, and its exposure is fixed; give renders"
            )
    loader.check(jobs)
    for each in {id(one): one for one in map(loader.for_job, jobs)}.values():
        method = each.chain.step_named(EXPOSURE).method
        if not isinstance(method, Auto):
            raise RequestError(
                f"exposure.method: found {method.method}, but only auto measures the "
                "exposure; remove this setting"
            )


def exposures(
    loader: ImageLoader, jobs: Sequence[Job], device: Device | None, frames: float
) -> Iterator[Exposure]:
    """Yield the exposure of each frame, in the order of the jobs. Each folder is a sequence.

    Like in a camera, exposure follows the metered value with a delay (exponential smoothing). It
    covers all but 1/e of a change of light within ``frames`` frames. A sequence begins with the
    metered value of its first frame.

    Args:
        loader: the loader of a request that ends with ``exposure``, see :func:`check_request`.
        jobs: the frames in temporal order.
        device: the device for metering; None is NumPy.
        frames: the time constant in frames; 0 does not smooth.

    Raises:
        ImageError: a frame cannot be read or metered.
    """
    share = -math.expm1(-1 / frames) if frames else 1.0
    runner: Runner | None = None
    for _, sequence in groupby(jobs, key=lambda job: job.path.parent):
        smooth: float | None = None
        for job in sequence:
            own = loader.for_job(job)
            try:
                loaded = own.enter(job, own.read(job))
                assert loaded  # None is possible only with --start-at
                runner = runner.for_chain(loaded.chain) if runner else Runner(loaded.chain, device)
                metered = _metered(loaded, runner)
            except (ImageError, RequestError, MemoryError) as error:
                raise ImageError(own.error_text(job, error)) from None
            smooth = metered if smooth is None else smooth + share * (metered - smooth)
            method = loaded.chain.step_named(EXPOSURE).method
            assert isinstance(method, Auto)
            yield Exposure(job, metered, smooth + method.ev, method.headroom)


def _metered(loaded: LoadedImage, runner: Runner) -> float:
    """Return the metered EV of one image."""
    chain = loaded.chain
    result = runner.run(loaded.source.pixels, noise_key(chain.settings, loaded.key))
    return result.estimates[EXPOSURE]["metered_ev"]


def write_exposures(path: Path, found: Sequence[Exposure]) -> None:
    """Write exposures as a manifest that sets ``exposure.ev`` for each frame of a run.

    A frame from a manifest keeps the other values of its row.

    Raises:
        ImageError: the manifest cannot be written.
    """
    rows = [row for each in found for row in _rows(path.parent, each)]
    write_new(path, manifest_text(path.parent, rows))


def _rows(folder: Path, exposure: Exposure) -> Iterator[Row]:
    """Yield a row for each file of an exposure, with the same values."""
    job = exposure.job
    name = job.name or (job.stem if key_of(folder, job.path) != job.key else "")
    own = {"method": "gain", "ev": round(exposure.ev, DIGITS) + 0.0}
    if exposure.headroom != Auto.model_fields["headroom"].default:
        own["headroom"] = exposure.headroom
    values = {**job.values, EXPOSURE: own}
    yield Row(job.path, job.key, name, values, job.frames, job.location)
    for path in job.subframes:
        other = f"{name}.{path.stem}" if name else ""
        yield Row(path, "", other, values, job.frames, job.location)
