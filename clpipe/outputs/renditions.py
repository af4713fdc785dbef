"""Renditions: the pictures that are made of one image, a burst of frames and truths beside it.

A bracket has all of these at each of its exposures.
"""

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache

from clpipe.base.errors import KeyedError, RequestError
from clpipe.chain.baseline import BASELINES, baseline_of, matching_of
from clpipe.chain.chain import Chain, Step
from clpipe.chain.identity import noise_key, of_bracket
from clpipe.chain.settings import overlay
from clpipe.chain.truth import (
    CLEAN,
    DEVELOPMENT,
    MOSAIC,
    PICTURES,
    TRUTHS,
    VARIANCE,
    noisy_mosaic,
    picture_without_noise,
    signal_and_noise,
)
from clpipe.outputs.spread import Spread

# What is put behind the image's name for each truth.
SUFFIXES = {
    DEVELOPMENT: ".truth",
    CLEAN: ".truth_clean",
    MOSAIC: ".truth_mosaic",
    VARIANCE: ".truth_variance",
}

# Mosaics in float, whatever the format of pictures is.
FLOAT_MOSAICS = (MOSAIC, VARIANCE)

EXPOSURE = "exposure"  # the step whose ev a bracket adds to


@dataclass(frozen=True)
class Rendition:
    """One picture of an image.

    Args:
        name: what is put behind the image's name.
        chain: how it is made.
        key: the key of the image.
        frame: its number in a burst; None is no frame.
        noise: for a variance map, the steps whose noise has this variance in the chain's last
            image, see :func:`clpipe.chain.truth.variance_of`; else ().
        baseline: of :data:`clpipe.chain.baseline.BASELINES`; "" is none.
        spread: what its noise is measured on, of a baseline; the chain has it when that is known.
        estimates: what was found about its noise, of a baseline.
    """

    name: str
    chain: Chain
    key: str
    frame: int | None = None
    noise: tuple[Step, ...] = ()
    baseline: str = ""
    spread: Spread | None = None
    estimates: Mapping[str, float] = field(default_factory=dict)

    @property
    def noise_key(self) -> str:
        """What its noise is made of."""
        return noise_key(self.chain.settings, self.key, self.frame)

    @property
    def whole(self) -> Chain:
        """The chain with the steps of ``noise``."""
        if not self.noise:
            return self.chain
        return replace(self.chain, steps=(*self.chain.steps[:-1], *self.noise))


@dataclass(frozen=True)
class RenditionPlan:
    """Which renditions are made of each image.

    Args:
        frames: how many frames; None is one picture. A burst has the truth of its development, too.
        truths: which of :data:`clpipe.chain.truth.TRUTHS`.
        bracket: what is added to the exposure's EV, for each exposure; () is the exposure alone.
        baselines: which of :data:`clpipe.chain.baseline.BASELINES`; they bring the truths that are
            pictures along.
    """

    frames: int | None = None
    truths: tuple[str, ...] = ()
    bracket: tuple[float, ...] = ()
    baselines: tuple[str, ...] = ()

    def names(self) -> tuple[str, ...]:
        """The name of each rendition.

        >>> RenditionPlan(2).names(), RenditionPlan(truths=("mosaic",)).names()
        (('.frame0', '.frame1', '.truth'), ('', '.truth_mosaic'))
        >>> RenditionPlan(truths=("clean",), bracket=(-2, 0.5)).names()
        ('.ev-2', '.ev-2.truth_clean', '.ev+0.5', '.ev+0.5.truth_clean')
        """
        truths = [SUFFIXES[truth] for truth in self._all_truths()]
        own = (*self._frame_names(), *truths, *map(baseline_name, self._all_baselines()))
        return tuple(exposure + name for exposure in self._exposures() for name in own)

    def needed(self, names: Sequence[str]) -> set[str]:
        """These renditions, with those that a baseline among them is measured on."""
        needed = set(names)
        for name in names:
            if baseline := baseline_named(name):
                exposure = name.removesuffix(baseline_name(baseline))
                needed |= {exposure + own for own in self._measured()}
        return needed

    def _measured(self) -> tuple[str, str, str]:
        """The names of what baselines are measured on: the noisy picture, and its truths."""
        return self._frame_names()[0], SUFFIXES[DEVELOPMENT], SUFFIXES[CLEAN]

    def _exposures(self) -> dict[str, float | None]:
        """The EV of each exposure, by the name that stands before those of its renditions.

        Without a bracket it is None, of the chain as it is.
        """
        return {bracket_name(ev): ev for ev in self.bracket} or {"": None}

    def _frame_names(self) -> tuple[str, ...]:
        if self.frames is None:
            return ("",)
        digits = len(str(self.frames - 1))
        return tuple(f".frame{i:0{digits}}" for i in range(self.frames))

    def _all_truths(self) -> list[str]:
        truths = (*self.truths, *([DEVELOPMENT] if self.frames else []))
        if self.baselines:
            truths += PICTURES
        return [truth for truth in TRUTHS if truth in truths]

    def _all_baselines(self) -> list[str]:
        return [each for each in BASELINES if each in self.baselines]

    def renditions(self, chain: Chain, key: str) -> list[Rendition]:
        """The renditions of an image, in the order of :meth:`names`.

        The first frame is the same picture as that without a burst, and an exposure at 0 EV as that
        without a bracket.

        Raises:
            RequestError: the chain has no such truth, or no such exposure.
        """
        numbers = [None] if self.frames is None else range(self.frames)
        named = list(zip(self._frame_names(), numbers, strict=True))
        renditions: list[Rendition] = []
        for exposure, ev in self._exposures().items():
            own = chain if ev is None else exposed(chain, ev)
            own_key = of_bracket(key, ev or 0.0)
            renditions += [Rendition(exposure + name, own, own_key, n) for name, n in named]
            for truth in (truth_of(each, own) for each in self._all_truths()):
                renditions.append(replace(truth, name=exposure + truth.name, key=own_key))
            renditions += self._baselines_of(own, own_key, exposure)
        return renditions

    def _baselines_of(self, chain: Chain, key: str, exposure: str) -> list[Rendition]:
        """The baselines of a picture, by its chain, its key and the name of its exposure."""
        if not self.baselines:
            return []
        baseline = baseline_of(chain)
        names = tuple(exposure + name for name in self._measured())
        spread = Spread(names, matching_of(chain), chain.settings.output)
        return [
            Rendition(exposure + baseline_name(each), baseline, key, baseline=each, spread=spread)
            for each in self._all_baselines()
        ]


def parse_bracket(text: str) -> tuple[float, ...]:
    """The exposures of a bracket, from EVs with commas between.

    >>> parse_bracket("-2, 0, +2")
    (-2.0, 0.0, 2.0)

    Raises:
        RequestError: one is no number, or is there twice.
    """
    try:
        # As their names say them, so that a replay has the same ones.
        bracket = tuple(float(f"{float(part):g}") + 0.0 for part in text.split(","))
    except ValueError:
        bracket = (math.nan,)
    names = [bracket_name(ev) for ev in bracket]
    if any(bracket_in(name) != (ev,) for name, ev in zip(names, bracket, strict=True)):
        raise RequestError(f"--bracket: found {text!r}; expected EVs, such as -2,0,2")
    for name in names:
        if names.count(name) > 1:
            raise RequestError(f"--bracket: found {text!r}, with {name[3:]} EV twice; give it once")
    return bracket


def bracket_name(ev: float) -> str:
    """What is put behind the image's name for an exposure of a bracket.

    >>> bracket_name(0.0), bracket_name(-0.5), bracket_in(".ev-0.5.frame1"), bracket_in(".truth")
    ('.ev+0', '.ev-0.5', (-0.5,), ())
    """
    return f".ev{ev:+g}"


def bracket_in(name: str) -> tuple[float, ...]:
    """The exposure of a rendition in a bracket, by its name; () where it is in none."""
    match = re.match(r"\.ev([+-]\d+(?:\.\d+)?)", name)
    return (float(match[1]),) if match else ()


@lru_cache(maxsize=64)  # as truth_of
def exposed(chain: Chain, ev: float) -> Chain:
    """A chain with so many EV more in its step ``exposure``, and with noise of its own.

    Raises:
        RequestError: it has no such step, or the sum is not allowed.
    """
    place = next((i for i, step in enumerate(chain.steps) if step.name == EXPOSURE), None)
    before = None if place is None else getattr(chain.steps[place].method, "ev", None)
    if place is None or before is None:
        names = ", ".join(step.name for step in chain.steps)
        raise RequestError(
            f"--bracket: it adds to {EXPOSURE}.ev, but this chain has no stage {EXPOSURE}: {names}"
        )
    if not ev:
        return chain
    try:
        settings = overlay(chain.settings, {EXPOSURE: {"ev": before + ev}})
    except KeyedError as error:
        raise RequestError(
            f"--bracket: {ev:+g} EV on {EXPOSURE}.ev={before:g} is too far; {error}"
        ) from None
    if settings.noise_key:
        settings = replace(settings, noise_key=of_bracket(settings.noise_key, ev))
    step = chain.steps[place]
    method = settings.method(EXPOSURE).resolve(step.context)
    steps = (*chain.steps[:place], replace(step, method=method), *chain.steps[place + 1 :])
    return replace(chain, steps=steps, settings=settings)


def baseline_name(baseline: str) -> str:
    """What is put behind the image's name for a baseline.

    >>> baseline_name("iid"), baseline_named(".ev+2.iid"), baseline_named(".truth")
    ('.iid', 'iid', '')
    """
    return f".{baseline}"


def baseline_named(name: str) -> str:
    """Which baseline a rendition is, by its name; "" is none."""
    return next((each for each in BASELINES if name.endswith(baseline_name(each))), "")


def truth_named(name: str) -> str | None:
    """Which truth a rendition is, by its name; None for a frame.

    >>> truth_named(".ev+2.truth_mosaic"), truth_named(".frame3")
    ('mosaic', None)
    """
    return next((truth for truth, suffix in SUFFIXES.items() if name.endswith(suffix)), None)


@lru_cache(maxsize=64)  # most images of a run share one chain, and plans are cached per chain
def truth_of(truth: str, chain: Chain) -> Rendition:
    """The rendition of a truth, without a key.

    Args:
        truth: one of :data:`clpipe.chain.truth.TRUTHS`.
        chain: of the noisy picture.

    Raises:
        RequestError: the chain has no such truth.
    """
    if truth == VARIANCE:
        signal, noise = signal_and_noise(chain)
        return Rendition(SUFFIXES[truth], signal, "", noise=noise)
    if truth == MOSAIC:
        return Rendition(SUFFIXES[truth], noisy_mosaic(chain).without_noise(), "")
    return Rendition(SUFFIXES[truth], picture_without_noise(truth, chain), "")
