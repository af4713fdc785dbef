"""Repeated development of images with changing settings, with the results of ``clpipe run``."""

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
from clpipe.engine.runner import Result
from clpipe.engine.service import Service, picture
from clpipe.explorer.controls import steps_of
from clpipe.explorer.file_names import check_file_names, files_in
from clpipe.explorer.view import UNITS, Sample, View, cut, display_pixels, measurable_part
from clpipe.images.read import SourceImage
from clpipe.images.tags import upright
from clpipe.inputs.find import Job
from clpipe.inputs.loader import ImageLoader, LoadedImage
from clpipe.outputs.writer import OutputWriter

MAX_SOURCES = 2  # decoded images in memory
MIN_RESULTS = 3  # results that are always kept
MAX_RESULT_BYTES = 1 << 28  # bytes; up to this size, more than MIN_RESULTS are kept
ALWAYS_RECORDED = ("camera", "iso", "seed", "stages", "skip")  # always in Settings.record()


class Explorer:
    """Develops the images of a request with any settings, on one device.

    Several threads may use it.

    Args:
        jobs: the images.
        request: the request of the command line.
        device: the device. None is NumPy.

    Raises:
        RequestError: an image has its own settings, from a manifest.
    """

    def __init__(self, jobs: Sequence[Job], request: Request, device: Device | None) -> None:
        if listed := next((job for job in jobs if job.location), None):
            raise RequestError(
                f"{listed.location}: rows of a manifest may have their own settings. Name the "
                "images or their directories instead"
            )
        self.jobs = tuple(jobs)
        self.device = device
        self._request = request
        self._lock = threading.Lock()  # guards the samples
        self._service = Service([device])
        self._sources: BoundedCache[SourceImage] = BoundedCache(MAX_SOURCES)
        self._samples: OrderedDict[int, Sample] = OrderedDict()
        self._number = 0

    @property
    def label(self) -> str:
        """The number of images, and the device that develops them."""
        count = "1 image" if len(self.jobs) == 1 else f"{len(self.jobs)} images"
        return f"{count}, on {self.device.info.label if self.device else 'NumPy'}"

    @cached_property
    def initial(self) -> dict[str, Any]:
        """The initial values, nested like a configuration. Missing values are automatic."""
        settings = replace(self._request, image={}, image_name="").settings()
        requested = {**(self._request.config or {}), **self._request.options}
        record = settings.record()
        return {k: v for k, v in record.items() if k not in ALWAYS_RECORDED or k in requested}

    @cached_property
    def allowed_files(self) -> tuple[str, ...]:
        """The files in the initial settings."""
        return tuple(dict.fromkeys(name for _, name in files_in(self.initial)))

    @property
    def cameras(self) -> tuple[str, ...]:
        """The camera profiles among these files."""
        return tuple(dict.fromkeys(name for key, name in files_in(self.initial) if key == "camera"))

    def job(self, image: int) -> Job:
        """Return an image by its number.

        Raises:
            RequestError: there is no such image.
        """
        if not 0 <= image < len(self.jobs):
            raise RequestError(f"there is no image {image}; there are {len(self.jobs)}")
        return self.jobs[image]

    def check(self) -> None:
        """Check that the first image can be read.

        Raises:
            ImageError: it cannot be read.
        """
        job, loader = self.jobs[0], ImageLoader(self.request(self.initial))
        try:
            self._source(0, loader.for_job(job))
        except (ImageError, MemoryError) as error:
            raise ImageError(loader.error_text(job, error)) from None

    def request(self, values: Mapping[str, Any]) -> Request:
        """Return the request with values instead of the initial ones.

        Raises:
            KeyedError: a value names a file that the initial settings do not name.
        """
        check_file_names(values, self.allowed_files)
        none = replace(self._request, config=None, options={}, image={}, image_name="")
        if self.overrides_embedded:
            return replace(none, options=dict(values))
        return replace(none, config=dict(values))

    @property
    def overrides_embedded(self) -> bool:
        """Whether values override the settings in a kept image, because none were configured."""
        return self._request.start_at is not None and self._request.config is None

    def settings(self, image: int, values: Mapping[str, Any]) -> Settings:
        """Return all settings of an image, including embedded and drawn ones.

        Raises:
            ClpipeError: the errors of a run.
        """
        return self._load(image, values)[1]

    def develop(self, image: int, values: Mapping[str, Any], view: View) -> Sample:
        """Develop an image like ``clpipe run`` with a configuration of these values.

        Args:
            image: the number of the image.
            values: nested, as in a configuration file.
            view: the step and truth to show.

        Raises:
            ClpipeError: the errors of a run.
        """
        start = time.perf_counter()
        loaded, settings = self._load(image, values)
        timings: list[Timing] = []
        chain, result, launches = self._run(loaded, view, timings)
        orientation = OutputWriter.picture_orientation(loaded.source, chain)
        shown = upright(display_pixels(chain, result), orientation)
        facts = {
            "width": shown.shape[1],
            "height": shown.shape[0],
            "kind": chain.result.label,
            "steps": _steps(settings, loaded.chain),
            "camera": settings.camera,
            "iso": chain.settings.iso,
            "seed": chain.settings.seed,
            "launches": _launch_times(launches, timings) if self.device else [],
            "estimates": _finite_estimates(result.estimates),
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
            while len(self._samples) > MIN_RESULTS and self._result_bytes > MAX_RESULT_BYTES:
                self._samples.popitem(last=False)
        return sample

    @property
    def _result_bytes(self) -> int:
        return sum(each.image.nbytes + each.shown.nbytes for each in self._samples.values())

    def sample(self, number: int) -> Sample:
        """Return a recent result of :meth:`develop`.

        Args:
            number: "number" among its facts.

        Raises:
            RequestError: the result is no longer kept.
        """
        with self._lock:
            if number not in self._samples:
                raise RequestError(f"image {number} is no longer kept. Develop it again")
            return self._samples[number]

    def values_at(self, number: int, x: int, y: int) -> dict[str, Any]:
        """Return the values of a pixel of a recent result of :meth:`develop`.

        Args:
            number: "number" among its facts.
            x: the column in px.
            y: the row in px.

        Raises:
            RequestError: the result is no longer kept, or has no such pixel.
        """
        sample = self.sample(number)
        height, width = sample.image.shape[:2]
        if not (0 <= y < height and 0 <= x < width):
            raise RequestError(f"found pixel {x}, {y}, but the image has {width}x{height} pixels")
        found = np.atleast_1d(sample.image[y, x])
        return {"values": [float(value) for value in found], "unit": sample.unit}

    def noise(
        self, image: int, values: Mapping[str, Any], view: View, box: tuple[int, int, int, int]
    ) -> NoiseReport:
        """Measure the noise in a part of an image against its truth, like ``clpipe measure``.

        Args:
            image: as for :meth:`develop`.
            values: as for :meth:`develop`.
            view: as for :meth:`develop`.
            box: left, top, width and height in px. For mosaics they are rounded down to even.

        Raises:
            ClpipeError: the errors of a run, there is no noise, or the part is outside the image.
        """
        loaded, _ = self._load(image, values)
        pair = []
        for truth in ("", DEVELOPMENT):
            chain, result, _ = self._run(loaded, View(view.step, truth), None)
            picture = upright(result.image, OutputWriter.picture_orientation(loaded.source, chain))
            pair.append(measurable_part(truth or "picture", cut(picture, box), chain))
        return measure(pair[:1], pair[1])

    def _load(self, image: int, values: Mapping[str, Any]) -> tuple[LoadedImage, Settings]:
        """Return an image with its chain, and its settings.

        Raises:
            ClpipeError: the image cannot be read, or the values give no valid chain.
        """
        job, request = self.job(image), self.request(values)
        loader = ImageLoader(request).for_job(job)
        try:
            loaded = loader.enter(job, self._source(image, loader))
        except (ImageError, MemoryError) as error:
            raise ImageError(loader.error_text(job, error)) from None
        if loaded is None:
            raise ImageError(
                f"{job.path}: this image was not kept before the first step of the chain"
            )
        return loaded, loaded.chain.settings

    def _source(self, image: int, loader: ImageLoader) -> SourceImage:
        """Return the decoded pixels of an image. Settings with the same decoding share them."""
        stamp = stamp_of(self.jobs[image].path)
        key = image, stamp, loader.reads, loader.reads_overscan, loader.settings.dump_format
        return self._sources.get(key, lambda: loader.read(self.jobs[image]))

    def _run(
        self, loaded: LoadedImage, view: View, timings: list[Timing] | None
    ) -> tuple[Chain, Result, Sequence[AnyLaunch]]:
        """Return the chain of a view, its result, and all launches of its plan.

        Raises:
            ClpipeError: the chain has no such step or truth, or the device fails.
        """
        chain = loaded.chain
        if view.truth:
            if view.truth not in PICTURES:
                raise RequestError(f"found truth {view.truth!r}; it is {' or '.join(PICTURES)}")
            chain = picture_without_noise(view.truth, chain)
        if view.step:
            chain = chain.up_to([chain.step_named(view.step).name])
        pixels = loaded.source.pixels
        key = noise_key(chain.settings, loaded.key)
        frame = picture(chain, pixels, key, options=RunOptions(timings, unchanged=True))
        result = self._service.run(frame)
        return chain, result, frame.runner(self.device).plan_for(pixels).launches


def _steps(settings: Settings, chain: Chain) -> list[dict[str, Any]]:
    """Return all steps, each with its method and parameter values."""
    resolved = {step.name: step.method for step in chain.steps}
    steps = steps_of(settings)
    for step in steps:
        method = resolved.get(step["name"])
        requested = settings.method(step["name"]) if step["on"] else None
        step["method"] = (requested or method or settings.method(step["name"])).method
        step["values"] = method.model_dump(mode="json") if method else {}
        step["here"] = method is not None
        step["idle"] = method is None or not method.passes()
    return steps


def _finite_estimates(estimates: Mapping[str, Mapping[str, float]]) -> dict[str, dict[str, float]]:
    """Return the finite estimates, which JSON can represent."""
    return {
        step: {name: value for name, value in found.items() if np.isfinite(value)}
        for step, found in estimates.items()
    }


def _launch_times(launches: Sequence[AnyLaunch], timings: Sequence[Timing]) -> list[dict[str, Any]]:
    """Return the launches of a plan with their times in ms."""
    seconds = dict.fromkeys((each.name for each in (*launches, *timings)), 0.0)
    for timing in timings:
        seconds[timing.name] += timing.seconds
    return [{"name": each.name, "ms": seconds[each.name] * 1e3} for each in launches]
