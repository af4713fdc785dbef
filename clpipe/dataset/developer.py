"""Samples, developed on a device: pictures with their truth, raws, and the variance of noise."""

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
from clpipe.engine.runner import Result, Runner, submit_together
from clpipe.images.read import SourceImage
from clpipe.outputs.patches import Patch, Patches, facts_of, variance_at, variance_steps
from clpipe.stage import Kind

Sample = dict[str, Any]
MAX_STRUCTURES = 256


@dataclass(frozen=True)
class SampleSpec:
    """What a sample has.

    Args:
        arrays: how they look.
        keep: steps whose image it has.
        truth: which picture without noise it has, as :func:`picture_without_noise` takes it.
        variance: whether it has the variance of the noise in its mosaic.
    """

    arrays: ArrayFormat
    keep: tuple[str, ...]
    truth: str | None
    variance: bool

    def check(self, chain: Chain, patches: Patches | None) -> None:
        """See that a chain makes it, of patches where there are any.

        Raises:
            RequestError: it does not.
        """
        if patches and self.arrays.raw == "packed" and patches.size % 2:
            raise RequestError(
                f"found patch {patches.size}; a packed raw has planes of half the size, so give an "
                "even one"
            )
        if self.arrays.raw == "packed" and not chain.filters.bayer:
            raise RequestError(
                f"raw='packed': its planes are of a Bayer pattern, but the mosaic is "
                f"{chain.filters.name}; say raw='mosaic'"
            )
        self.arrays.check(chain.result)
        if self.truth:
            picture_without_noise(self.truth, chain)  # refuses a chain that adds no noise
        if self.arrays.raw:
            raw_step(chain, self.arrays)
        if self.variance:
            variance_steps(chain)


def raw_step(chain: Chain, arrays: ArrayFormat) -> str:
    """The step whose image is the raw: the last one in DN, or the noisy mosaic in signal.

    Raises:
        RequestError: there is none.
    """
    if not arrays.is_in_dn:
        return noisy_mosaic(chain).steps[-1].name
    maker, after = chain.maker_of_raw, chain.context_of_raw
    if maker is None:
        raise RequestError(
            f"the chain {chain.label} makes no raw in DN, which quantize does; put that stage in, "
            "or say dtype='float32' for a raw in signal"
        )
    if not after.knots and (after.white_level or 0) > HIGHEST:
        raise RequestError(
            f"the raw in DN goes to {after.white_level:.0f}, which uint16 does not hold; say "
            f"dtype='float32' for a raw in signal, or {maker}.method=pwl"
        )
    return maker


@dataclass(frozen=True)
class Order:
    """An image of which samples are made.

    Args:
        chain: how it is developed.
        source: the image.
        noise_key: what its noise is made of.
        patches: the parts of the picture that are samples; () is one sample, all of it.
    """

    chain: Chain
    source: SourceImage
    noise_key: str
    patches: Sequence[Patch]

    @property
    def options(self) -> RunOptions:
        """How it is run."""
        boxes = [patch.box for patch in self.patches]
        return RunOptions(unchanged=True, boxes=boxes, later=self.source.later)


class Developer:
    """Develops images on a device, in the order in which they are begun.

    Args:
        device: where; None is NumPy.
        spec: what of each.
    """

    def __init__(self, device: Device | None, spec: SampleSpec) -> None:
        self.process = os.getpid()
        self._device = device
        self._spec = spec
        self._lock = threading.Lock()  # guards the runners, and lets one thread use the device
        self._raws: BoundedCache[dict[str, str]] = BoundedCache(MAX_STRUCTURES)
        self._latest: dict[str, Runner] = {}

    def begin(self, orders: Sequence[Order]) -> list[Callable[[], list[Sample]]]:
        """Begin with the arrays and facts of samples of images, small ones together.

        Returns:
            What waits for those of each image and gives them, called in order; it raises the same
            errors.

        Raises:
            ImageError, RequestError, MemoryError: an image cannot be developed.
        """
        with self._lock:
            raws = [self._raws_of(order.chain) for order in orders]
            runs = [self._runs(o.chain, own) for o, own in zip(orders, raws, strict=True)]
            begun = submit_together(
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
        """What makes "image", "truth", and the "signal" that a variance is computed from."""
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
        """The steps whose images are the raws of "image" and "truth"."""
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
        """The samples of what was begun."""
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
        """Wait for what was begun."""
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
        """The arrays of the sample of an image, or of a patch.

        Args:
            chain: of the image.
            raws: the steps whose images are raws, by the names of results.
            results: what came out.
            patch: the patch; None is the image.
            noise: the steps that the variance follows from.
            part: returns the sample's part of an image of a result.
        """
        arrays = self._spec.arrays
        pattern = chain.filters.pattern

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
    """The last step of a truth up to a step of its chain, which the truth may do without."""
    names = chain.step_names
    until = names[: names.index(name) + 1]
    return [step for step in truth.step_names if step in until][-1]
