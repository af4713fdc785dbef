"""Renditions: the pictures that are made of one image, a burst of frames and truths beside it."""

from dataclasses import dataclass, replace
from functools import lru_cache

from clpipe.chain.chain import Chain, Step
from clpipe.chain.identity import noise_key
from clpipe.chain.truth import (
    CLEAN,
    DEVELOPMENT,
    MOSAIC,
    TRUTHS,
    VARIANCE,
    noisy_mosaic,
    picture_without_noise,
    signal_and_noise,
)

# What is put behind the image's name for each truth.
SUFFIXES = {
    DEVELOPMENT: ".truth",
    CLEAN: ".truth_clean",
    MOSAIC: ".truth_mosaic",
    VARIANCE: ".truth_variance",
}

# Mosaics in float, whatever the format of pictures is.
FLOAT_MOSAICS = (SUFFIXES[MOSAIC], SUFFIXES[VARIANCE])


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
    """

    name: str
    chain: Chain
    key: str
    frame: int | None = None
    noise: tuple[Step, ...] = ()

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
    """

    frames: int | None = None
    truths: tuple[str, ...] = ()

    def names(self) -> tuple[str, ...]:
        """The name of each rendition.

        >>> RenditionPlan(2).names(), RenditionPlan(truths=("mosaic",)).names()
        (('.frame0', '.frame1', '.truth'), ('', '.truth_mosaic'))
        """
        return (*self._frame_names(), *(SUFFIXES[truth] for truth in self._all_truths()))

    def _frame_names(self) -> tuple[str, ...]:
        if self.frames is None:
            return ("",)
        digits = len(str(self.frames - 1))
        return tuple(f".frame{i:0{digits}}" for i in range(self.frames))

    def _all_truths(self) -> list[str]:
        truths = (*self.truths, *([DEVELOPMENT] if self.frames else []))
        return [truth for truth in TRUTHS if truth in truths]

    def renditions(self, chain: Chain, key: str) -> list[Rendition]:
        """The renditions of an image, in the order of :meth:`names`.

        The first frame is the same picture as that without a burst.

        Raises:
            RequestError: the chain has no such truth.
        """
        numbers = [None] if self.frames is None else range(self.frames)
        named = zip(self._frame_names(), numbers, strict=True)
        frames = [Rendition(name, chain, key, number) for name, number in named]
        return [*frames, *(replace(truth_of(t, chain), key=key) for t in self._all_truths())]


def truth_named(name: str) -> str | None:
    """Which truth a rendition is, by its name; None for a frame.

    >>> truth_named(".truth_mosaic"), truth_named(".frame3")
    ('mosaic', None)
    """
    return next((truth for truth, suffix in SUFFIXES.items() if suffix == name), None)


@lru_cache(maxsize=16)  # most images of a run share one chain, and plans are cached per chain
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
