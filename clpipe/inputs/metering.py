"""The control loops of sequences: each frame is metered, and gets settings of its own.

The loops meter renders, so the settings of a frame depend on earlier frames, but not on how they
were developed. The frames can then be processed in any order.
"""

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from itertools import groupby
from pathlib import Path
from typing import Any

from clpipe.base.errors import ImageError, RequestError
from clpipe.base.files import write_new
from clpipe.base.types import Array
from clpipe.camera.control import AutoIso, ControlLoop
from clpipe.chain.chain import Chain, Step
from clpipe.chain.identity import noise_key
from clpipe.engine.device import Device
from clpipe.engine.extents import Box
from clpipe.engine.options import RunOptions
from clpipe.engine.runner import Runner
from clpipe.inputs.find import Job
from clpipe.inputs.loader import ImageLoader
from clpipe.inputs.manifest import Row, key_of, manifest_text
from clpipe.inputs.sequences import sequence_of
from clpipe.stage import StageRole
from clpipe.stages.exposure.auto import Auto
from clpipe.stages.white_balance.gains import EstimatedGains

CORNER = Box(0, 0, 1, 1)

DIGITS = 4  # decimal places of an EV and of a gain


@dataclass(frozen=True)
class Reading:
    """What the loops set for a frame.

    Args:
        values: the settings, nested like a configuration.
        metered: the EV or gain that was metered for this frame only, by name.
        error: why the frame could not be metered.
    """

    values: Mapping[str, Any] = field(default_factory=dict)
    metered: Mapping[str, float] = field(default_factory=dict)
    error: Exception | None = None


def loops_of(chain: Chain) -> tuple[Step | None, Step | None]:
    """Return the steps whose exposure and white balance are metered; None where none is."""
    exposure, balance = chain.step_in(StageRole.EXPOSURE), chain.step_in(StageRole.BALANCE)
    return (
        exposure if exposure and isinstance(exposure.method, Auto) else None,
        balance if balance and isinstance(balance.method, EstimatedGains) else None,
    )


class Meter:
    """Meters the frames of one sequence, in temporal order.

    Args:
        open_device: returns the device; None is NumPy. It is called for the first frame.
    """

    def __init__(self, open_device: Callable[[], Device | None]) -> None:
        self._open_device = open_device
        self._runner: Runner | None = None
        self._loops: dict[str, ControlLoop] = {}
        self._iso: AutoIso | None = None
        self._last = 0  # the place of the last frame

    def read(
        self,
        chain: Chain,
        image: Array,
        image_key: str,
        place: int,
        chain_of: Callable[[Mapping[str, Any]], Chain],
    ) -> Reading:
        """Return the settings of the next frame.

        White balance is estimated from the frame's raw, with its noise, at the exposure and ISO
        that the loops have set.

        Args:
            chain: the chain of the frame.
            image: the frame, as for :meth:`clpipe.engine.runner.Runner.run`.
            image_key: the key of its noise.
            place: its place in the sequence. For the loops, missing frames have the metered values
                of the frame before.
            chain_of: returns the chain of the frame with further settings.

        Raises:
            ImageError, DeviceError: as for :meth:`clpipe.engine.runner.Runner.run`.
        """
        exposure, balance = loops_of(chain)
        control = chain.settings.control
        for loop in self._loops.values():
            loop.hold(place - self._last - 1)
        self._last = place
        values: dict[str, Any] = {}
        metered: dict[str, float] = {}

        def follow(name: str, ev: float) -> float:
            return self._loops.setdefault(name, ControlLoop(control)).next(ev)

        if exposure:
            method = exposure.method
            assert isinstance(method, Auto)
            metered["metered_ev"] = self._measure(chain, exposure, image, image_key)["metered_ev"]
            ev = round(follow(exposure.name, metered["metered_ev"]) + method.ev, DIGITS) + 0.0
            values[exposure.name] = {"method": "gain", "ev": ev}
            if method.headroom != Auto.model_fields["headroom"].default:
                values[exposure.name]["headroom"] = method.headroom
            if control.iso_max is not None:
                self._iso = self._iso or AutoIso(chain.iso, chain.camera.iso_range, control)
                values["iso"] = round(self._iso.next(ev), DIGITS)
        if balance:
            chain = chain_of(values) if values else chain
            gains = self._measure(chain, balance, image, image_key)
            metered |= gains
            followed = {k: round(2 ** follow(k, math.log2(v)), DIGITS) for k, v in gains.items()}
            values[balance.name] = {"method": "gains", **followed}
        return Reading(values, metered)

    def _measure(
        self, chain: Chain, step: Step, image: Array, image_key: str
    ) -> Mapping[str, float]:
        """Return the numbers that a step estimates from a frame."""
        part = chain.up_to([step.name])
        known = self._runner
        self._runner = known.for_chain(part) if known else Runner(part, self._open_device())
        options = RunOptions(boxes=[CORNER])  # the picture itself is not needed
        result = self._runner.run(image, noise_key(chain.settings, image_key), options)
        return result.estimates[step.name]


def metered_jobs(
    loader: ImageLoader, jobs: Iterable[Job], open_device: Callable[[], Device | None]
) -> Iterator[tuple[Job, Reading]]:
    """Yield the frames of sequences with the settings of their sequence, and what was metered.

    Draws get one value for each sequence, unless they drift, and exposure and white balance follow
    their control loops. A frame that cannot be metered keeps its settings. For the loops, it and
    missing frames have the metered values of the frame before.

    Args:
        loader: the loader of the run.
        jobs: the frames, each with its place, in the order of
            :func:`~clpipe.inputs.sequences.in_sequences`.
        open_device: opens the device that meters. It is called only if a frame is metered.
    """
    opened = cache(open_device)
    for _, frames in groupby(jobs, key=sequence_of):
        meter = Meter(opened)
        for job in frames:
            drawn, reading = job, Reading()
            try:
                drawn = with_drawn(loader, job)
                own = loader.for_job(drawn)
                is_fixed = own.kept or own.raw.is_raw(job.path)
                if not is_fixed and any(loops_of(own.chain)):
                    reading = read_job(own, drawn, meter)
            except (ImageError, RequestError, MemoryError) as error:
                reading = Reading(error=error)
            yield with_values(drawn, reading.values), reading


def read_job(loader: ImageLoader, job: Job, meter: Meter) -> Reading:
    """Meter a frame.

    Args:
        loader: the loader of the frame.
        job: the frame.
        meter: the meter of its sequence.

    Raises:
        ImageError, RequestError: the frame cannot be read or metered.
    """
    loaded = loader.enter(job, loader.read(job))
    assert loaded and job.place  # None is possible only with --start-at

    def chain_of(values: Mapping[str, Any]) -> Chain:
        request = loader.request.for_image(job.key, merged(job.values, values))
        entered = replace(loader, request=request).enter(job, loaded.source)  # it has the layers
        assert entered
        return entered.chain

    return meter.read(loaded.chain, loaded.source.pixels, loaded.key, job.place.index, chain_of)


def with_drawn(loader: ImageLoader, job: Job) -> Job:
    """Return a frame with the values that its sequence draws.

    Raises:
        RequestError: a value is not allowed.
    """
    place = job.place
    assert place
    settings = loader.request.for_image("", job.values).settings()
    return with_values(job, settings.drawn_values(place.key, place.index))


def with_values(job: Job, values: Mapping[str, Any]) -> Job:
    """Return a job with further settings."""
    return replace(job, values=merged(job.values, values)) if values else job


def merged(values: Mapping[str, Any], others: Mapping[str, Any]) -> dict[str, Any]:
    """Return settings that others override. A table with a method replaces a table."""
    result = dict(values)
    for key, value in others.items():
        old = result.get(key)
        both = isinstance(value, Mapping) and isinstance(old, Mapping) and "method" not in value
        result[key] = {**(old or {}), **value} if both else value
    return result


def write_exposures(path: Path, jobs: Sequence[Job]) -> None:
    """Write frames as a manifest with their settings. All files of an exposure have the same.

    Raises:
        ImageError: the manifest cannot be written.
    """
    rows = []
    for job in jobs:
        name = job.name or (job.stem if key_of(path.parent, job.path) != job.key else "")
        own = job.values, job.frames, job.location
        rows.append(Row(job.path, job.key, name, *own))
        for file in job.subframes:
            rows.append(Row(file, "", f"{name}.{file.stem}" if name else "", *own))
    write_new(path, manifest_text(path.parent, rows))
