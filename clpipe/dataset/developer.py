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
from clpipe.dataset.arrays import HIGHEST, ArrayFormat
from clpipe.engine.device import Device
from clpipe.engine.options import RunOptions
from clpipe.engine.runner import Result, Runner, submit_batch
from clpipe.images.read import SourceImage
from clpipe.outputs.patches import Patch, Patches, facts_of, variance_at, variance_steps
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
    maker, after = chain.raw_step_name, chain.raw_context
    if maker is None:
        raise RequestError(
            f"the chain {chain.label} makes no raw in DN. Add the stage quantize, or use "
            "dtype='float32' for a raw scaled to signal"
        )
    if not after.knots and (after.white_level or 0) > HIGHEST:
        raise RequestError(
            f"the raw has values to {after.white_level:.0f} DN, more than uint16 holds. Use "
            f"dtype='float32' for a raw scaled to signal, or {maker}.method=pwl"
        )
    return maker


@dataclass(frozen=True)
class Order:
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

    def begin(self, orders: Sequence[Order]) -> list[Callable[[], list[Sample]]]:
        """Begin to develop samples of images. Small ones are developed together.

        Returns:
            For each image, a callable that waits for its samples. Call them in order. They raise
            the same errors.

        Raises:
            ImageError, RequestError, MemoryError: an image cannot be developed.
        """
        with self._lock:
            raws = [self._raws_of(order.chain) for order in orders]
            runs = [self._runs(o.chain, own) for o, own in zip(orders, raws, strict=True)]
            begun = submit_batch(
                [
                    (runner, order.source.pixels, order.noise_key, order.options)
                    for order, own in zip(orders, runs, strict=True)
                    for runner in own.values()
                ]
            )
        waits = iter(begun)
        return [
            partial(self._finish, order, names, dict(zip(own, waits, strict=False)))
            for order, names, own in zip(orders, raws, runs, strict=True)
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

        def found() -> dict[str, str]:
            last = raw_step(chain, spec.arrays)
            if not spec.truth:
                return {"image": last}
            truth = picture_without_noise(spec.truth, chain)
            return {"image": last, "truth": last_until(truth, chain, last)}

        if chain.structure is None:
            return found()
        return self._raws.get(Identity(chain.structure), found)

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
        self, order: Order, raws: Mapping[str, str], begun: Mapping[str, Callable[[], Result]]
    ) -> list[Sample]:
        """Return the samples of an order that was begun."""
        results = {}
        for name, wait in begun.items():
            with self._lock:
                results[name] = wait()
        noise = variance_steps(order.chain)[1] if self._spec.variance else ()
        if not order.patches:
            samples = [self._sample(order.chain, raws, results, None, noise, lambda image: image)]
        else:
            samples = [
                self._sample(order.chain, raws, results, patch, noise, itemgetter(i))
                for i, patch in enumerate(order.patches)
            ]
        facts = facts_of(order.chain).items()
        for sample in samples:
            sample |= {name: v.copy() if isinstance(v, np.ndarray) else v for name, v in facts}
        return samples

    def drain(self) -> None:
        """Wait for all orders that were begun."""
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

        def turned(image: Array) -> Array:
            return patch.turned(part(image)) if patch else image

        sample: Sample = {}
        for name in ("image", "truth") if self._spec.truth else ("image",):
            result, prefix = results[name], "" if name == "image" else f"{name}."
            for step, image in result.kept.items():
                if step in self._spec.keep:
                    sample[prefix + step] = arrays.ordered(turned(image))
            sample[name] = arrays.picture(turned(result.image), chain.result)
            if arrays.raw:
                sample[f"{prefix}raw"] = arrays.mosaic(turned(result.kept[raws[name]]), pattern)
        if noise:
            variance = variance_at(noise, part(results["signal"].image), patch)
            variance = patch.turned(variance) if patch else variance
            sample["variance"] = arrays.variance(variance, pattern)
        if patch:
            sample |= {"place": np.array([patch.left, patch.top]), "turn": patch.orientation}
        return sample


def last_until(truth: Chain, chain: Chain, name: str) -> str:
    """Return the last step of a truth up to a step of its chain, which the truth may lack."""
    names = chain.step_names
    until = names[: names.index(name) + 1]
    return [step for step in truth.step_names if step in until][-1]
