"""The pictures of an image, with the chain and the noise of each."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache

from clpipe.base.errors import KeyedError, RequestError
from clpipe.chain.baseline import baseline_of, noise_matching
from clpipe.chain.chain import Chain, Step
from clpipe.chain.formats import DNG, FORMATS
from clpipe.chain.identity import bracket_key, noise_key
from clpipe.chain.registry import stage_in
from clpipe.chain.rendition import (
    BASELINES,
    CLEAN,
    DEVELOPMENT,
    LIGHTS,
    MOSAIC,
    NOISY,
    PICTURES,
    TRUTHS,
    VARIANCE,
    Rendition,
    Role,
)
from clpipe.chain.settings import overlay
from clpipe.chain.truth import light_of, noisy_mosaic, picture_without_noise, signal_and_noise
from clpipe.outputs.baseline_noise import NoiseMatcher
from clpipe.outputs.negative import dng_of
from clpipe.stage import StageRole


def required_results(
    chain: Chain, formats: Sequence[str], keep: Sequence[str]
) -> tuple[tuple[str, ...], bool, bool]:
    """Return the results of a chain that its files require.

    Args:
        chain: the chain.
        formats: the formats of the last image and of the raw.
        keep: the names of steps. Names that the chain does not contain are ignored.

    Returns:
        The steps whose images are required, whether the last image is required in 8 bits, and
        whether it is required in floats.

    Raises:
        RequestError: a DNG is needed, and the chain has no raw for one.
    """
    last = [FORMATS[name].bits for name in formats if name != DNG]
    steps = [step.name for step in chain.steps if step.name in keep]
    if DNG in formats and (raw := dng_of(chain).step):
        steps.append(raw)
    return tuple(dict.fromkeys(steps)), 8 in last, any(bits > 8 for bits in last)


@dataclass(frozen=True)
class Recipe:
    """How to compute a rendition of an image.

    Args:
        rendition: the rendition.
        chain: the chain that computes it.
        noise: for a variance map, the steps whose noise has this variance in the chain's last
            image, see :func:`clpipe.chain.truth.variance_of`; otherwise ().
        key: the key of the image.
        matcher: measures the noise of a baseline, which is put into the chain afterwards.
        estimates: measured values of the noise of a baseline.
    """

    rendition: Rendition
    chain: Chain
    noise: tuple[Step, ...]
    key: str
    matcher: NoiseMatcher | None = None
    estimates: Mapping[str, float] = field(default_factory=dict)

    @property
    def noise_key(self) -> str:
        """The key that seeds its noise."""
        return noise_key(self.chain.settings, self.key, self.rendition.frame)

    @property
    def full_chain(self) -> Chain:
        """The chain, with the steps of ``noise`` in place of its last step if there are any."""
        if not self.noise:
            return self.chain
        return replace(self.chain, steps=(*self.chain.steps[:-1], *self.noise))


@lru_cache(maxsize=64)
def renditions(
    frames: int | None = None,
    truths: tuple[str, ...] = (),
    bracket: tuple[float, ...] = (),
    baselines: tuple[str, ...] = (),
) -> tuple[Rendition, ...]:
    """Return the renditions of an image, exposure by exposure.

    Args:
        frames: the number of frames of a burst; None is one picture. A burst also has its developed
            ground truth.
        truths: members of :data:`clpipe.chain.rendition.TRUTHS`.
        bracket: the EV to add to each exposure; () is one exposure.
        baselines: members of :data:`clpipe.chain.rendition.BASELINES`. Any of them adds the ground
            truths that are pictures.

    >>> [each.suffix for each in renditions(2)]
    ['.frame0', '.frame1', '.truth']
    >>> [each.suffix for each in renditions(None, ("mosaic",), (-2, 0))]
    ['.ev-2', '.ev-2.truth_mosaic', '.ev+0', '.ev+0.truth_mosaic']
    """
    selected = {NOISY, *truths, *baselines, *((DEVELOPMENT,) if frames else ())}
    selected |= {*PICTURES} if baselines else set()
    return tuple(
        Rendition(role, ev, frame, frames)
        for ev in bracket or (None,)
        for role in (NOISY, *TRUTHS, *BASELINES)
        if role in selected
        for frame in (range(frames) if frames and role == NOISY else (None,))
    )


def recipes(selected: Iterable[Rendition], chain: Chain, key: str) -> list[Recipe]:
    """Return a recipe for each rendition of an image.

    The first frame equals the picture without a burst, and an exposure at 0 EV the picture without
    a bracket.

    Args:
        selected: the renditions. A baseline comes after the pictures that it is measured on.
        chain: the chain of the noisy picture.
        key: the key of the image.

    Raises:
        RequestError: the chain has no such ground truth, or no such exposure.
    """
    found: list[Recipe] = []
    matchers: dict[float | None, NoiseMatcher] = {}  # all baselines of one exposure share a matcher
    for each in selected:
        exposed_chain = chain if each.ev is None else with_exposure(chain, each.ev)
        exposed_key = bracket_key(key, each.ev or 0.0)
        recipe = Recipe(each, *chain_and_noise(each.role, exposed_chain), exposed_key)
        if each.role in BASELINES:
            matcher = NoiseMatcher(
                reference_pictures(each),
                noise_matching(exposed_chain),
                exposed_chain.settings.output,
            )
            recipe = replace(recipe, matcher=matchers.setdefault(each.ev, matcher))
        found.append(recipe)
    return found


def reference_pictures(baseline: Rendition) -> tuple[Rendition, Rendition, Rendition]:
    """Return the pictures to which a baseline is matched: the noisy one and two ground truths."""
    return baseline.with_role(NOISY), baseline.with_role(DEVELOPMENT), baseline.with_role(CLEAN)


@lru_cache(maxsize=64)  # plans are cached per chain, see chain_and_noise
def with_exposure(chain: Chain, ev: float) -> Chain:
    """Return a chain whose exposure is increased by ``ev``, with different noise.

    Raises:
        RequestError: the chain has no exposure step, or the sum is not allowed.
    """
    step = chain.step_in(StageRole.EXPOSURE)
    before = getattr(step and step.method, "ev", None)
    if step is None or before is None:
        names = ", ".join(each.name for each in chain.steps)
        name = stage_in(StageRole.EXPOSURE).name
        raise RequestError(
            f"--bracket: this option changes {name}.ev, but this chain has no stage {name}: "
            f"{names}. Add that stage"
        )
    if not ev:
        return chain
    try:
        settings = overlay(chain.settings, {step.name: {"ev": before + ev}})
    except KeyedError as error:
        raise RequestError(
            f"--bracket: {ev:+g} EV added to {step.name}.ev={before:g} is not allowed; {error}"
        ) from None
    if settings.noise_key:
        settings = replace(settings, noise_key=bracket_key(settings.noise_key, ev))
    method = settings.method(step.name).resolve(step.context)
    return replace(chain.with_methods({step.name: method}), settings=settings)


@lru_cache(maxsize=64)  # plans are cached per chain, and most images of a run share one chain
def chain_and_noise(role: Role, chain: Chain) -> tuple[Chain, tuple[Step, ...]]:
    """Return the chain of a rendition, and the noise of a variance map, see :class:`Recipe`.

    Args:
        role: the role of the rendition.
        chain: the chain of the noisy picture.

    Raises:
        RequestError: the chain has no such ground truth or baseline.
    """
    if role == VARIANCE:
        return signal_and_noise(chain)
    if role == MOSAIC:
        return noisy_mosaic(chain).without_noise(), ()
    if role in LIGHTS:
        return light_of(role, chain), ()
    if role in BASELINES:
        return baseline_of(chain), ()
    return chain if role == NOISY else picture_without_noise(role, chain), ()
