"""The control loops of sequences: each frame is metered, and gets settings of its own.

The loops meter renders, so the settings of a frame depend on earlier frames, but not on how they
were developed. The frames can then be processed in any order.
"""

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import groupby
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from clpipe.base.errors import ImageError, RequestError
from clpipe.base.files import write_new
from clpipe.base.types import Array
from clpipe.camera.control import AutoExposure, ControlLoop
from clpipe.camera.optics import DEFAULT_EXPOSURE_TIME
from clpipe.chain.chain import Chain, Step
from clpipe.chain.identity import noise_key
from clpipe.chain.keys import RENDER
from clpipe.chain.photometry import METERED
from clpipe.engine.extents import Box
from clpipe.engine.options import RunOptions
from clpipe.engine.runner import Result
from clpipe.engine.service import Frame
from clpipe.inputs.jobs import Job
from clpipe.inputs.loader import ImageLoader, LoadedImage
from clpipe.inputs.manifest import manifest_text
from clpipe.inputs.sequences import sequence_of
from clpipe.stage import StageRole
from clpipe.stages.exposure.auto import Auto
from clpipe.stages.white_balance.gains import EstimatedGains

CORNER = Box(0, 0, 1, 1)

GAINS = ("red_gain", "blue_gain")  # what estimated white balance estimates

DIGITS = 4  # decimal places of an EV and of a gain

TIME = "exposure_time"


@dataclass(frozen=True)
class Reading:
    """What the loops set for a frame.

    Args:
        values: the settings, nested like a configuration.
        metered: the EV or gain that was metered for this frame only, by name. Nothing is metered in
            a frame without light.
    """

    values: Mapping[str, Any]
    metered: Mapping[str, float]


def loops_of(chain: Chain) -> tuple[Step | None, Step | None]:
    """Return the steps whose exposure and white balance are metered; None where none is."""
    exposure, balance = chain.step_in(StageRole.EXPOSURE), chain.step_in(StageRole.BALANCE)
    return (
        exposure if exposure and isinstance(exposure.method, Auto) else None,
        balance if balance and isinstance(balance.method, EstimatedGains) else None,
    )


class Meter:
    """Meters the frames of one sequence, in temporal order.

    A frame that is black or cannot be metered holds the loops, like a missing one: for them, it has
    the metered values of the frame before. Until a frame is metered, the loops are at 0 EV.

    Args:
        develop: develops a frame, and returns its result.
    """

    def __init__(self, develop: Callable[[Frame], Result]) -> None:
        self._develop = develop
        # Each loop, and the place of the last frame that it followed.
        self._loops: dict[str, tuple[ControlLoop, float]] = {}
        self._exposure: AutoExposure | None = None

    def read(
        self,
        chain: Chain,
        image: Array,
        image_key: str,
        place: float,
        chain_of: Callable[[Mapping[str, Any]], Chain],
    ) -> Reading:
        """Return the settings of the next frame.

        White balance is estimated from the frame's raw, with its noise, at the exposure and ISO
        that the loops have set.

        Args:
            chain: the chain of the frame.
            image: the frame, as for :class:`~clpipe.engine.service.Frame`.
            image_key: the key of its noise.
            place: its place in the sequence, in frames.
            chain_of: returns the chain of the frame with further settings.

        Raises:
            RequestError: a setting of the loops is not allowed.
            DeviceError: no device is usable any more.
        """
        exposure, balance = loops_of(chain)
        control = chain.settings.control
        values: dict[str, Any] = {}
        metered: dict[str, float] = {}

        def measure(step: Step, chain: Chain) -> Mapping[str, float]:
            try:
                return self._measure(chain, step, image, image_key)
            except (ImageError, MemoryError):  # the frame may fail for the same reason
                return {}

        def follow(name: str, ev: float | None) -> float:
            loop, last = self._loops.get(name) or (ControlLoop(control), place - 1)
            self._loops[name] = loop, place
            missing = max(round(place - last) - 1, 0)
            loop.hold(missing)
            return loop.next(ev, place - last - missing)

        if exposure:
            method = exposure.method
            assert isinstance(method, Auto)
            metered |= measure(exposure, chain)
            metered.pop("gain", None)
            # Without light, the result is 0 EV, even if the limits do not allow it.
            limits = {exposure.name: {"min_ev": 1.0, "max_ev": 20.0}}
            if metered == {METERED: 0} and not measure(exposure, chain_of(limits)).get(METERED):
                metered.clear()
            is_lit = bool(metered)
            ev = round(follow(exposure.name, metered.get(METERED)) + method.ev, DIGITS) + 0.0
            if is_lit:
                self._exposure = self._exposure or AutoExposure(chain.camera.iso_range, control)
            program = None
            time = chain.optics.exposure_time
            if self._exposure:
                program = self._exposure.next(ev, chain.iso, time or DEFAULT_EXPOSURE_TIME)
                ev = round(program.ev, DIGITS) + 0.0
            values[exposure.name] = {"method": "gain", "ev": ev}
            if method.headroom != Auto.model_fields["headroom"].default:
                values[exposure.name]["headroom"] = method.headroom
            if program and control.iso_max is not None:
                values["iso"] = round(program.iso, DIGITS)
            if program and (time or control.time_max or control.mains):
                values[exposure.name]["sets_time"] = False
                # All places that state the time must agree.
                steps = (step.name for step in chain.steps)
                for table in (RENDER, *(n for n in steps if TIME in chain.settings.table(n))):
                    values[table] = {TIME: float(f"{program.time:.9g}")}
        else:
            is_lit = bool(np.any(image))
        if balance:
            gains: Mapping[str, float] = {}
            if is_lit:
                gains = measure(balance, chain_of(values) if values else chain)
            metered |= gains
            followed = {
                name: round(2 ** follow(name, math.log2(gains[name]) if gains else None), DIGITS)
                for name in GAINS
            }
            values[balance.name] = {"method": "gains", **followed}
        return Reading(values, metered)

    def _measure(
        self, chain: Chain, step: Step, image: Array, image_key: str
    ) -> Mapping[str, float]:
        """Return the numbers that a step estimates from a frame.

        Raises:
            ImageError, DeviceError: as for :class:`~clpipe.engine.service.Development`.
        """
        part, key = chain.up_to([step.name]), noise_key(chain.settings, image_key)
        options = RunOptions(boxes=[CORNER])  # the picture itself is not needed
        return self._develop(Frame(part, image, key, options=options)).estimates[step.name]


def metered_jobs(
    loader: ImageLoader,
    jobs: Iterable[Job],
    develop: Callable[[Frame], Result],
    load: Callable[[ImageLoader, Job], LoadedImage],
) -> Iterator[Job]:
    """Yield the frames of sequences with the settings of their sequence.

    Draws get one value for each sequence, unless they drift, and exposure and white balance follow
    their control loops, see :class:`Meter`. A frame that cannot be read keeps its settings.

    Args:
        loader: the loader of the run.
        jobs: the frames, each with its place, in the order of
            :func:`~clpipe.inputs.sequences.in_sequences`.
        develop: as for :class:`Meter`.
        load: loads a frame that is metered, with its own loader.
    """
    for _, frames in groupby(jobs, key=sequence_of):
        meter = Meter(develop)
        for job in frames:
            drawn = job
            values: Mapping[str, Any] = {}
            # The run reads the frame again, and reports the error.
            with suppress(ImageError, RequestError, MemoryError):
                drawn = with_drawn(loader, job)
                own = loader.for_job(drawn)
                is_fixed = own.kept or own.raw.is_raw(job.path)
                if not is_fixed and any(loops_of(own.chain)):
                    values = read_frame(own, drawn, meter, load(own, drawn))
            yield with_values(drawn, values)


def read_frame(
    loader: ImageLoader, job: Job, meter: Meter, loaded: LoadedImage
) -> Mapping[str, Any]:
    """Meter a frame, and return what the loops set.

    Args:
        loader: the loader of the frame.
        job: the frame.
        meter: the meter of its sequence.
        loaded: its image.

    Raises:
        RequestError, DeviceError: as for :meth:`Meter.read`.
    """
    assert job.place

    def chain_of(values: Mapping[str, Any]) -> Chain:
        request = loader.request.for_image(job.key, merged(job.values, values))
        entered = replace(loader, request=request).enter(job, loaded.source)  # it has the layers
        assert entered  # None is possible only with --start-at
        return entered.chain

    source = loaded.source
    return meter.read(loaded.chain, source.pixels, loaded.key, job.place.index, chain_of).values


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

    The rows have the frames' keys, so a run of the manifest makes the same noise.

    Raises:
        ImageError: the manifest cannot be written.
    """
    rows = []
    for job in jobs:
        for file in job.paths:
            is_named = file is job.path and not job.is_panorama  # a panorama's key names no view
            key = job.key if is_named else str(PurePosixPath(job.key).with_name(file.name))
            name = f"{job.name}.{file.stem}" if job.name and file is not job.path else job.name
            rows.append(replace(job, path=file, key=key, name=name))
    write_new(path, manifest_text(path.parent, rows))
