"""Which pictures are made of an image: one or a burst, and the truth beside them."""

from dataclasses import dataclass, replace
from functools import lru_cache

from clpipe.chain.chain import Chain, Step
from clpipe.chain.truth import noisy_mosaic, signal_and_noise

DEVELOPMENT, MOSAIC, VARIANCE = TRUTHS = ("development", "mosaic", "variance")


NAMES = {DEVELOPMENT: ".truth", MOSAIC: ".truth_mosaic", VARIANCE: ".truth_variance"}


MAPS = (NAMES[MOSAIC], NAMES[VARIANCE])  # are mosaics in float, whatever the format of pictures


@dataclass(frozen=True)
class Rendition:
    """One picture of an image: what stands behind the image's name, how it is made, its key.

    Where ``noise`` is given, it is the variance that these steps make of the chain's last image,
    see :func:`clpipe.chain.truth.variance_of`.
    """

    name: str
    chain: Chain
    key: str
    noise: tuple[Step, ...] = ()

    @property
    def whole(self) -> Chain:
        """The chain with the steps of ``noise``."""
        if not self.noise:
            return self.chain
        return replace(self.chain, steps=(*self.chain.steps[:-1], *self.noise))


@dataclass(frozen=True)
class RenditionPlan:
    """How many frames are made of each image, and what of their truth, as :data:`TRUTHS` has it.

    None is one frame; a number is a burst, which has the truth's development in any case.
    """

    frames: int | None = None
    truths: tuple[str, ...] = ()

    def names(self) -> tuple[str, ...]:
        """What stands behind the image's name for each picture that is made of it.

        >>> RenditionPlan(2).names(), RenditionPlan(truths=("mosaic",)).names()
        (('.frame0', '.frame1', '.truth'), ('', '.truth_mosaic'))
        """
        return (*self._frames(), *(NAMES[truth] for truth in self._truths()))

    def _frames(self) -> tuple[str, ...]:
        if self.frames is None:
            return ("",)
        digits = len(str(self.frames - 1))
        return tuple(f".frame{i:0{digits}}" for i in range(self.frames))

    def _truths(self) -> list[str]:
        wanted = (*self.truths, *([DEVELOPMENT] if self.frames else []))
        return [truth for truth in TRUTHS if truth in wanted]

    def shots(self, chain: Chain, key: str) -> list[Rendition]:
        """The pictures of an image, as :meth:`names` has them.

        The first frame is the picture that there is without a burst.

        Raises:
            RequestError: the truth of this chain cannot be known.
        """
        names = enumerate(self._frames())
        frames = [Rendition(name, chain, f"{key}#{i}" if i else key) for i, name in names]
        return [*frames, *(replace(truth_of(t, chain), key=key) for t in self._truths())]


def truth_named(name: str) -> str | None:
    """Which of :data:`TRUTHS` a picture is, by what stands behind the image's name.

    >>> truth_named(".truth_mosaic"), truth_named(".frame3")
    ('mosaic', None)
    """
    return next((truth for truth, its in NAMES.items() if its == name), None)


@lru_cache(maxsize=16)  # most images of a run have one chain, and what it is planned as is kept too
def truth_of(truth: str, chain: Chain) -> Rendition:
    """What is to be known of the truth of a chain's images, one of :data:`TRUTHS`; without a key.

    Raises:
        RequestError: it cannot be known.
    """
    if truth == VARIANCE:
        signal, noise = signal_and_noise(chain)
        return Rendition(NAMES[truth], signal, "", noise)
    noisy = noisy_mosaic(chain) if truth == MOSAIC else chain
    return Rendition(NAMES[truth], noisy.without_noise(), "")
