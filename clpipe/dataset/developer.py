"""Development of samples on a device: images with truth, raws, and the variance of noise."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from operator import itemgetter
from typing import Any

import numpy as np

from clpipe.base.cache import cached_hash
from clpipe.base.errors import RequestError
from clpipe.base.types import Array
from clpipe.chain.chain import Chain, Step, cached_by_structure
from clpipe.chain.truth import noisy_mosaic, picture_without_noise
from clpipe.dataset.arrays import UINT16_MAX, ArrayFormat
from clpipe.engine.options import RunOptions
from clpipe.engine.runner import Result
from clpipe.engine.service import Frame
from clpipe.images.read import SourceImage
from clpipe.outputs.patches import Patch, Patches, metadata_of, variance_at, variance_steps
from clpipe.stage import Kind

Sample = dict[str, Any]


@cached_hash
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

    def frames(
        self, chain: Chain, source: SourceImage, noise_key: str, patches: Sequence[Patch]
    ) -> dict[str, Frame]:
        """Return the frames "image", "truth", and "signal", from which the variance follows.

        Args:
            chain: the chain of the image.
            source: the image.
            noise_key: the key of its noise.
            patches: the patches that are samples. () is one sample of the whole picture.

        Raises:
            RequestError: the chain cannot make the samples.
        """
        boxes = [patch.box for patch in patches]
        options = RunOptions(unchanged=True, boxes=boxes, later_exposures=source.later)
        encode = chain.result is Kind.DISPLAY and self.arrays.dtype is None
        raws = raws_of(chain, self)
        chains = {"image": chain}
        if self.truth:
            chains["truth"] = picture_without_noise(self.truth, chain)

        def frame(chain: Chain, keep: tuple[str, ...], encode: bool) -> Frame:
            kept = steps_in(chain, keep)
            return Frame(chain, source.pixels, noise_key, kept, encode, not encode, options)

        frames = {
            name: frame(each, (*self.keep, raws[name]) if raws else self.keep, encode)
            for name, each in chains.items()
        }
        if self.variance:
            frames["signal"] = frame(variance_steps(chain)[0], (), encode=False)
        return frames


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
    """Samples of an image that are developed.

    Args:
        spec: the contents of samples.
        chain: the chain of the image.
        source: the image. It holds the layers that steps read, which chains do not.
        patches: the patches that are samples. () is one sample of the whole picture.
        frames: the frames to develop, by name.
        carried: the layers of the image, by name.
        facts: the facts of the image that each sample contains.
    """

    spec: SampleSpec
    chain: Chain
    source: SourceImage
    patches: Sequence[Patch]
    frames: Mapping[str, Frame]
    carried: Sample
    facts: Sample

    def samples(self, results: Mapping[str, Result]) -> list[Sample]:
        """Return the samples, from the results of the frames."""
        noise = variance_steps(self.chain)[1] if self.spec.variance else ()
        if not self.patches:
            samples = [self._sample(results, None, noise, lambda image: image)]
        else:
            samples = [
                self._sample(results, patch, noise, itemgetter(i))
                for i, patch in enumerate(self.patches)
            ]
        metadata = metadata_of(self.chain).items()
        for sample in samples:
            copied = {name: v.copy() if isinstance(v, np.ndarray) else v for name, v in metadata}
            sample.update(copied, **self.facts)
        return samples

    def _sample(
        self,
        results: Mapping[str, Result],
        patch: Patch | None,
        noise: tuple[Step, ...],
        part: Callable[[Array], Array],
    ) -> Sample:
        """Return the arrays of one sample.

        Args:
            results: the results of the frames.
            patch: the patch. None is the whole picture.
            noise: the steps from which the variance follows.
            part: returns the part of an image that belongs to the sample.
        """
        arrays, raws = self.spec.arrays, raws_of(self.chain, self.spec)
        pattern = self.chain.filter_array.pattern

        def orient(image: Array) -> Array:
            return patch.orient(part(image)) if patch else image

        sample: Sample = {}
        for name in ("image", "truth") if self.spec.truth else ("image",):
            result, prefix = results[name], "" if name == "image" else f"{name}."
            for step, image in result.kept.items():
                if step in self.spec.keep:
                    sample[prefix + step] = arrays.ordered(orient(image))
            sample[name] = arrays.picture(orient(result.image), self.chain.result)
            if arrays.raw:
                sample[f"{prefix}raw"] = arrays.mosaic(orient(result.kept[raws[name]]), pattern)
        if noise:
            variance = variance_at(noise, part(results["signal"].image), patch)
            variance = patch.orient(variance) if patch else variance
            sample["variance"] = arrays.variance(variance, pattern)
        if patch:
            sample |= {"place": np.array([patch.left, patch.top]), "turn": patch.orientation}
        for name, layer in self.carried.items():
            sample[name] = arrays.ordered(patch.crop(layer) if patch else layer)
        return sample


@cached_by_structure
def steps_in(chain: Chain, names: tuple[str, ...]) -> tuple[str, ...]:
    """Return those of several steps that a chain contains, in its order."""
    return tuple(step for step in chain.step_names if step in names)


@cached_by_structure
def raws_of(chain: Chain, spec: SampleSpec) -> Mapping[str, str]:
    """Return the steps of the raws of "image" and "truth".

    Raises:
        RequestError: there is no such step.
    """
    if not spec.arrays.raw:
        return {}
    last = raw_step(chain, spec.arrays)
    if not spec.truth:
        return {"image": last}
    truth = picture_without_noise(spec.truth, chain)
    return {"image": last, "truth": last_until(truth, chain, last)}


def last_until(truth: Chain, chain: Chain, name: str) -> str:
    """Return the last step of a truth up to a step of its chain, which the truth may lack."""
    names = chain.step_names
    allowed = names[: names.index(name) + 1]
    return [step for step in truth.step_names if step in allowed][-1]
