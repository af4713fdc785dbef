"""Development of samples on a device: images with truth, raws, and the variance of noise."""

import os
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from operator import itemgetter
from typing import Any

import numpy as np

from clpipe.base.cache import BoundedCache, Identity
from clpipe.base.errors import RequestError
from clpipe.base.types import Array
from clpipe.chain.chain import Chain, Step
from clpipe.chain.truth import noisy_mosaic, picture_without_noise
from clpipe.dataset.arrays import UINT16_MAX, ArrayFormat
from clpipe.engine.device import Device
from clpipe.engine.options import RunOptions
from clpipe.engine.runner import Result, Runner, submit_batch
from clpipe.images.read import SourceImage
from clpipe.outputs.patches import Patch, Patches, metadata_of, variance_at, variance_steps
from clpipe.stage import Kind

Sample = dict[str, Any]
MAX_STRUCTURES = 256


@dataclass(frozen=True)
class SampleSpec:
    """The contents of a sample.

    Args:
        arrays: the format of arrays.
        keep: steps whose images are added.
        truth: the image without noise to add, as for :func:`picture_without_noise`.
        variance: whether to add the variance of the noise in the mosaic.
    """

    arrays: ArrayFormat
    keep: tuple[str, ...]
    truth: str | None
    variance: bool

    def check(self, chain: Chain, patches: Patches | None) -> None:
        """Check that a chain can make the samples, or patches.

        Raises:
            RequestError: it cannot.
        """
        if patches and self.arrays.raw == "packed" and patches.size % 2:
            raise RequestError(
                f"found patch {patches.size}, but a packed raw has planes of half the size. Use an "
                "even size"
            )
        if self.arrays.raw == "packed" and not chain.filter_array.bayer:
            raise RequestError(
                f"raw='packed': planes need a Bayer pattern, but the mosaic is "
                f"{chain.filter_array.name}. Use raw='mosaic'"
            )
        self.arrays.check(chain.result)
        if self.truth:
            picture_without_noise(self.truth, chain)  # rejects a chain without noise
        if self.arrays.raw:
            raw_step(chain, self.arrays)
        if self.variance:
            variance_steps(chain)


def raw_step(chain: Chain, arrays: ArrayFormat) -> str:
    """Return the step of the raw: the last one in DN, or the noisy mosaic in signal.

    Raises:
        RequestError: there is no such step.
    """
    if not arrays.is_in_dn:
        return noisy_mosaic(chain).steps[-1].name
    producer, context = chain.raw_step_name, chain.raw_context
    if producer is None:
        raise RequestError(
            f"the chain {chain.label} makes no raw in DN. Add the stage quantize, or use "
            "dtype='float32' for a raw scaled to signal"
        )
    if not context.knots and (context.white_level or 0) > UINT16_MAX:
        raise RequestError(
            f"the raw has values to {context.white_level:.0f} DN, more than uint16 holds. Use "
            f"dtype='float32' for a raw scaled to signal, or {producer}.method=pwl"
        )
    return producer


@dataclass(frozen=True)
class DevelopTask:
    """An image to develop for samples.

    Args:
        chain: the chain.
        source: the image.
        noise_key: the key of its noise.
        patches: the patches that are samples. () is one sample of the whole picture.
    """

    chain: Chain
    source: SourceImage
    noise_key: str
    patches: Sequence[Patch]

    @property
    def options(self) -> RunOptions:
        """The options of the run."""
        boxes = [patch.box for patch in self.patches]
        return RunOptions(unchanged=True, boxes=boxes, later_exposures=self.source.later)


class Developer:
    """Develops images on a device, in the order of :meth:`begin`.

    Args:
        device: the device. None is NumPy.
        spec: the contents of samples.
    """

    def __init__(self, device: Device | None, spec: SampleSpec) -> None:
        self.process = os.getpid()
        self._device = device
        self._spec = spec
        self._lock = threading.Lock()  # guards the runners and the device
        self._raws: BoundedCache[dict[str, str]] = BoundedCache(MAX_STRUCTURES)
        self._latest: dict[str, Runner] = {}

    def begin(self, tasks: Sequence[DevelopTask]) -> list[Callable[[], list[Sample]]]:
        """Begin to develop samples of images. Small ones are developed together.

        Returns:
            For each image, a callable that waits for its samples. Call them in order. They raise
            the same errors.

        Raises:
            ImageError, RequestError, MemoryError: an image cannot be developed.
        """
        with self._lock:
            raws = [self._raws_of(task.chain) for task in tasks]
            runs = [self._runs(o.chain, runners) for o, runners in zip(tasks, raws, strict=True)]
            pending = submit_batch(
                [
                    (runner, task.source.pixels, task.noise_key, task.options)
                    for task, runners in zip(tasks, runs, strict=True)
                    for runner in runners.values()
                ]
            )
        pending_results = iter(pending)
        return [
            partial(self._finish, task, names, dict(zip(runners, pending_results, strict=False)))
            for task, names, runners in zip(tasks, raws, runs, strict=True)
        ]

    def _runs(self, chain: Chain, raws: Mapping[str, str]) -> dict[str, Runner]:
        """Return the runners of "image", "truth", and "signal", from which the variance follows."""
        spec = self._spec
        encode = chain.result is Kind.DISPLAY and spec.arrays.dtype is None
        chains = {"image": chain}
        if spec.truth:
            chains["truth"] = picture_without_noise(spec.truth, chain)
        runs = {
            name: self._runner(name, each, (*spec.keep, *filter(None, [raws.get(name)])), encode)
            for name, each in chains.items()
        }
        if spec.variance:
            signal, _ = variance_steps(chain)
            runs["signal"] = self._runner("signal", signal, (), encode=False)
        return runs

    def _raws_of(self, chain: Chain) -> dict[str, str]:
        """Return the steps of the raws of "image" and "truth"."""
        spec = self._spec
        if not spec.arrays.raw:
            return {}

        def find_raws() -> dict[str, str]:
            last = raw_step(chain, spec.arrays)
            if not spec.truth:
                return {"image": last}
            truth = picture_without_noise(spec.truth, chain)
            return {"image": last, "truth": last_until(truth, chain, last)}

        if chain.structure is None:
            return find_raws()
        return self._raws.get(Identity(chain.structure), find_raws)

    def _runner(self, name: str, chain: Chain, keep: Sequence[str], encode: bool) -> Runner:
        kept = tuple(step for step in chain.step_names if step in keep)
        latest = self._latest.get(name)
        if latest and latest.keep == kept and latest.encode == encode:
            runner = latest.for_chain(chain)  # shares its plans
        else:
            runner = Runner(chain, self._device, kept, encode, final=not encode)
        self._latest[name] = runner
        return runner

    def _finish(
        self,
        task: DevelopTask,
        raws: Mapping[str, str],
        pending: Mapping[str, Callable[[], Result]],
    ) -> list[Sample]:
        """Return the samples of a task that was started."""
        results = {}
        for name, wait in pending.items():
            with self._lock:
                results[name] = wait()
        noise = variance_steps(task.chain)[1] if self._spec.variance else ()
        if not task.patches:
            samples = [self._sample(task.chain, raws, results, None, noise, lambda image: image)]
        else:
            samples = [
                self._sample(task.chain, raws, results, patch, noise, itemgetter(i))
                for i, patch in enumerate(task.patches)
            ]
        metadata = metadata_of(task.chain).items()
        for sample in samples:
            sample |= {name: v.copy() if isinstance(v, np.ndarray) else v for name, v in metadata}
        return samples

    def drain(self) -> None:
        """Wait for all tasks that were started."""
        with self._lock:
            if self._device:
                self._device.drain()

    def _sample(
        self,
        chain: Chain,
        raws: Mapping[str, str],
        results: Mapping[str, Result],
        patch: Patch | None,
        noise: tuple[Step, ...],
        part: Callable[[Array], Array],
    ) -> Sample:
        """Return the arrays of the sample of an image or patch.

        Args:
            chain: the chain of the image.
            raws: the steps of the raws, by the names of results.
            results: the results.
            patch: the patch. None is the whole picture.
            noise: the steps from which the variance follows.
            part: returns the part of an image that belongs to the sample.
        """
        arrays = self._spec.arrays
        pattern = chain.filter_array.pattern

        def orient(image: Array) -> Array:
            return patch.orient(part(image)) if patch else image

        sample: Sample = {}
        for name in ("image", "truth") if self._spec.truth else ("image",):
            result, prefix = results[name], "" if name == "image" else f"{name}."
            for step, image in result.kept.items():
                if step in self._spec.keep:
                    sample[prefix + step] = arrays.ordered(orient(image))
            sample[name] = arrays.picture(orient(result.image), chain.result)
            if arrays.raw:
                sample[f"{prefix}raw"] = arrays.mosaic(orient(result.kept[raws[name]]), pattern)
        if noise:
            variance = variance_at(noise, part(results["signal"].image), patch)
            variance = patch.orient(variance) if patch else variance
            sample["variance"] = arrays.variance(variance, pattern)
        if patch:
            sample |= {"place": np.array([patch.left, patch.top]), "turn": patch.orientation}
        return sample


def last_until(truth: Chain, chain: Chain, name: str) -> str:
    """Return the last step of a truth up to a step of its chain, which the truth may lack."""
    names = chain.step_names
    allowed = names[: names.index(name) + 1]
    return [step for step in truth.step_names if step in allowed][-1]
