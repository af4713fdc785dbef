"""Images developed again and again with other settings, as ``clpipe run`` would develop them."""

import threading
import time
from collections import OrderedDict
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np

from clpipe.analysis.measure import measure
from clpipe.analysis.report import NoiseReport
from clpipe.base.cache import BoundedCache
from clpipe.base.digests import stamp_of
from clpipe.base.errors import ImageError, RequestError
from clpipe.chain.chain import Chain
from clpipe.chain.identity import noise_key
from clpipe.chain.rendition import DEVELOPMENT, PICTURES
from clpipe.chain.request import Request
from clpipe.chain.settings import Settings
from clpipe.chain.truth import picture_without_noise
from clpipe.engine.clipping import clipped_share
from clpipe.engine.device import Device
from clpipe.engine.ir import AnyLaunch
from clpipe.engine.options import RunOptions, Timing
from clpipe.engine.runner import Result, Runner
from clpipe.explorer.controls import steps_of
from clpipe.explorer.named import check_named, files_in
from clpipe.explorer.view import UNITS, Sample, View, cut, part_as_read, shown_of
from clpipe.images.read import SourceImage
from clpipe.images.tags import upright
from clpipe.inputs.find import Job
from clpipe.inputs.loader import ImageLoader, LoadedImage
from clpipe.outputs.writer import OutputWriter
from clpipe.stage import Kind

SOURCES = 2  # images that stay decoded
SAMPLES = 3  # of what was made, that can always still be asked for
KEPT = 1 << 28  # bytes, up to which more are
AT_START = (
    "camera",
    "iso",
    "seed",
    "stages",
    "skip",
)  # of Settings.record(), which always has them


class Explorer:
    """Develops the images of a request with any settings, on one device.

    It may be used by several threads; they take turns at the device.

    Args:
        jobs: the images.
        request: what was asked for at the start.
        device: where to run; None is NumPy.

    Raises:
        RequestError: an image has settings of its own, from a manifest.
    """

    def __init__(self, jobs: Sequence[Job], request: Request, device: Device | None) -> None:
        if listed := next((job for job in jobs if job.place), None):
            raise RequestError(
                f"{listed.place}: its rows may have settings of their own; give the images "
                "themselves, or folders"
            )
        self.jobs = tuple(jobs)
        self.device = device
        self._request = request
        self._lock = threading.Lock()  # guards the samples, and lets one thread use the device
        self._sources: BoundedCache[SourceImage] = BoundedCache(SOURCES)
        self._runners: dict[bool, Runner] = {}
        self._samples: OrderedDict[int, Sample] = OrderedDict()
        self._number = 0

    @property
    def label(self) -> str:
        """How many images, and where they are developed, for people."""
        count = "1 image" if len(self.jobs) == 1 else f"{len(self.jobs)} images"
        return f"{count}, on {self.device.info.label if self.device else 'NumPy'}"

    @cached_property
    def initial(self) -> dict[str, Any]:
        """The values that are set at the start, nested as in a configuration.

        Whoever changes them has a configuration: what is left out is automatic.
        """
        settings = replace(self._request, image={}, image_name="").settings()
        asked = {**(self._request.config or {}), **self._request.options}
        record = settings.record()
        return {k: v for k, v in record.items() if k not in AT_START or k in asked}

    @cached_property
    def named(self) -> tuple[str, ...]:
        """The files that the settings name at the start."""
        return tuple(dict.fromkeys(name for _, name in files_in(self.initial)))

    @property
    def cameras(self) -> tuple[str, ...]:
        """The camera profiles among these files."""
        return tuple(dict.fromkeys(name for key, name in files_in(self.initial) if key == "camera"))

    def job(self, image: int) -> Job:
        """An image by its number.

        Raises:
            RequestError: there is no such image.
        """
        if not 0 <= image < len(self.jobs):
            raise RequestError(f"there is no image {image}; there are {len(self.jobs)}")
        return self.jobs[image]

    def check(self) -> None:
        """See that the first image can be read.

        Raises:
            ImageError: it cannot.
        """
        job, loader = self.jobs[0], ImageLoader(self.request(self.initial))
        try:
            self._source(0, loader.for_job(job))
        except (ImageError, MemoryError) as error:
            raise ImageError(loader.error_text(job, error)) from None

    def request(self, values: Mapping[str, Any]) -> Request:
        """The request of values, which hold in place of those at the start.

        Raises:
            KeyedError: they name a file that was not named at the start.
        """
        check_named(values, self.named)
        none = replace(self._request, config=None, options={}, image={}, image_name="")
        if self.goes_on_from_embedded:
            return replace(none, options=dict(values))
        return replace(none, config=dict(values))

    @property
    def goes_on_from_embedded(self) -> bool:
        """Whether values lie over those that a kept image carries, as none were configured."""
        return self._request.start_at is not None and self._request.config is None

    def settings(self, image: int, values: Mapping[str, Any]) -> Settings:
        """All settings of an image, with those that it carries and those that are drawn.

        Raises:
            ClpipeError: as of a run.
        """
        return self._loaded(image, values)[1]

    def develop(self, image: int, values: Mapping[str, Any], view: View) -> Sample:
        """An image, developed as ``clpipe run`` does with a configuration of these values.

        Args:
            image: which of the jobs.
            values: nested, as in a configuration file.
            view: what of it.

        Raises:
            ClpipeError: as of a run.
        """
        start = time.perf_counter()
        loaded, settings = self._loaded(image, values)
        timings: list[Timing] = []
        chain, result, launches = self._run(loaded, view, timings)
        orientation = OutputWriter.picture_orientation(loaded.source, chain)
        shown = upright(shown_of(chain, result), orientation)
        facts = {
            "width": shown.shape[1],
            "height": shown.shape[0],
            "kind": chain.result.label,
            "steps": _steps(settings, loaded.chain),
            "camera": settings.camera,
            "iso": chain.settings.iso,
            "seed": chain.settings.seed,
            "launches": _times(launches, timings) if self.device else [],
            "estimates": _finite(result.estimates),
            "clipped": clipped_share(result, chain),
            "warnings": list(loaded.source.warnings),
            "seconds": time.perf_counter() - start,
        }
        is_shown = result.encoded is not None
        unit = "of 255" if is_shown else UNITS[chain.result]
        with self._lock:
            self._number += 1
            values_of = shown if is_shown else upright(result.image, orientation)
            sample = Sample(values_of, unit, shown, facts | {"number": self._number})
            self._samples[self._number] = sample
            while len(self._samples) > SAMPLES and self._kept > KEPT:
                self._samples.popitem(last=False)
        return sample

    @property
    def _kept(self) -> int:
        return sum(each.image.nbytes + each.shown.nbytes for each in self._samples.values())

    def sample(self, number: int) -> Sample:
        """What :meth:`develop` gave a short while ago.

        Args:
            number: of it, among its facts.

        Raises:
            RequestError: it is not kept any more.
        """
        with self._lock:
            if number not in self._samples:
                raise RequestError(f"image {number} is not kept any more; ask for it again")
            return self._samples[number]

    def values_at(self, number: int, x: int, y: int) -> dict[str, Any]:
        """The values of a pixel of what :meth:`develop` gave a short while ago.

        Args:
            number: of it, among its facts.
            x, y: the place, in px.

        Raises:
            RequestError: it is not kept any more, or has no such pixel.
        """
        sample = self.sample(number)
        height, width = sample.image.shape[:2]
        if not (0 <= y < height and 0 <= x < width):
            raise RequestError(f"there is no pixel {x}, {y} in {width}x{height}")
        found = np.atleast_1d(sample.image[y, x])
        return {"values": [float(value) for value in found], "unit": sample.unit}

    def noise(
        self, image: int, values: Mapping[str, Any], view: View, box: tuple[int, int, int, int]
    ) -> NoiseReport:
        """The noise in a part of an image, against the truth of its development.

        It is that of ``clpipe measure`` of these parts.

        Args:
            image, values, view: as for :meth:`develop`.
            box: left, top, width and height in px; of a mosaic they are made even.

        Raises:
            ClpipeError: as of a run; or there is no noise, or the part is none of the image.
        """
        loaded, _ = self._loaded(image, values)
        pair = []
        for truth in ("", DEVELOPMENT):
            chain, result, _ = self._run(loaded, View(view.step, truth), None)
            picture = upright(result.image, OutputWriter.picture_orientation(loaded.source, chain))
            pair.append(part_as_read(truth or "picture", cut(picture, box), chain))
        return measure(pair[:1], pair[1])

    def _loaded(self, image: int, values: Mapping[str, Any]) -> tuple[LoadedImage, Settings]:
        """An image with its chain, and the settings that are asked for it.

        Raises:
            ClpipeError: it cannot be read, or has no chain with these values.
        """
        job, request = self.job(image), self.request(values)
        loader = ImageLoader(request).for_job(job)
        try:
            loaded = loader.enter(job, self._source(image, loader))
        except (ImageError, MemoryError) as error:
            raise ImageError(loader.error_text(job, error)) from None
        if loaded is None:
            raise ImageError(f"{job.path}: is not the image that this chain goes on from")
        return loaded, loaded.chain.settings

    def _source(self, image: int, loader: ImageLoader) -> SourceImage:
        """An image's pixels, decoded once for all settings that read its file in the same way."""
        stamp = stamp_of(self.jobs[image].path)
        key = image, stamp, loader.reads, loader.reads_overscan, loader.settings.dump_format
        return self._sources.get(key, lambda: loader.read(self.jobs[image]))

    def _run(
        self, loaded: LoadedImage, view: View, timings: list[Timing] | None
    ) -> tuple[Chain, Result, Sequence[AnyLaunch]]:
        """The chain of a view, what it makes of an image, and all launches of its plan.

        Raises:
            ClpipeError: the chain has no such step or truth, or the device fails.
        """
        chain = loaded.chain
        if view.truth:
            if view.truth not in PICTURES:
                raise RequestError(f"found truth {view.truth!r}; it is {' or '.join(PICTURES)}")
            chain = picture_without_noise(view.truth, chain)
        if view.step:
            chain = chain.through([chain.step_named(view.step).name])
        pixels = loaded.source.pixels
        key = noise_key(chain.settings, loaded.key)
        with self._lock:
            runner = self._runner(chain)
            result = runner.run(pixels, key, RunOptions(timings, unchanged=True))
        return chain, result, runner.plan_for(pixels).launches

    def _runner(self, chain: Chain) -> Runner:
        """A runner of a chain, which shares plans with those before it."""
        encode = chain.result is Kind.DISPLAY
        if encode not in self._runners:
            self._runners[encode] = Runner(
                chain, self.device, (), encode, not encode, incremental=True
            )
        return self._runners[encode].for_chain(chain)


def _steps(settings: Settings, chain: Chain) -> list[dict[str, Any]]:
    """All steps, each with its method and the values that its parameters have."""
    resolved = {step.name: step.method for step in chain.steps}
    steps = steps_of(settings)
    for step in steps:
        method = resolved.get(step["name"])
        asked = settings.method(step["name"]) if step["on"] else None
        step["method"] = (asked or method or settings.method(step["name"])).method
        step["values"] = method.model_dump(mode="json") if method else {}
        step["here"] = method is not None
        step["idle"] = method is None or not method.passes()
    return steps


def _finite(estimates: Mapping[str, Mapping[str, float]]) -> dict[str, dict[str, float]]:
    """Estimates that JSON can hold."""
    return {
        step: {name: value for name, value in found.items() if np.isfinite(value)}
        for step, found in estimates.items()
    }


def _times(launches: Sequence[AnyLaunch], timings: Sequence[Timing]) -> list[dict[str, Any]]:
    """The launches of a plan, each with its time in ms; None where it was not run again."""
    seconds: dict[str, list[float]] = {}
    for timing in timings:
        if not timing.transfer:
            seconds.setdefault(timing.name, []).append(timing.seconds)
    return [
        {"name": each.name, "ms": sum(found) * 1e3 if (found := seconds.get(each.name)) else None}
        for each in launches
    ]
