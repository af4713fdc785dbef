"""Staggered exposures: several in a row, each with its own span of time."""

from itertools import accumulate
from typing import ClassVar, Self

import numpy as np
from pydantic import PrivateAttr

from clpipe.base.types import Floats
from clpipe.reference.filter_array import LANES
from clpipe.stage import Arguments, Context, Span, parameter
from clpipe.stages.sensor_noise.readouts import MOST, Readout, Readouts

NOTHING = np.zeros((MOST - 1, 1, 1), np.float32)  # is there before there is an image


class Staggered(Readouts):
    """Staggered exposures (DOL): 2 to 4 in a row, each ``ratio`` times shorter than the one before.

    In each row the longest comes first, and the next begins where it ends. Where the light changes
    meanwhile, by sub-frames or flicker of ``shutter``, each sees its own span of time, and they are
    merged as by a sensor that does not look for what moves.
    """

    method: ClassVar = "staggered"
    summary: ClassVar = "two to four exposures, each shorter than the one before, merged"
    other_examples: ClassVar = ({"count": 4},)

    count: int = parameter(3, "How many exposures there are.", structural=True, ge=2, le=MOST)

    _is_apart: bool = PrivateAttr(False)  # each exposure sees something else
    _later: Floats | None = PrivateAttr(None)  # what all but the first see, of an image

    @property
    def readouts(self) -> tuple[Readout, ...]:
        assert self.ratio is not None
        return tuple(Readout(i, self.ratio**-i, 1) for i in range(self.count))

    def resolve(self, context: Context) -> Self:
        own = super().resolve(context)
        own._is_apart = context.light_changes
        return own

    @property
    def spans(self) -> tuple[Span, ...]:
        """Of the exposures that the (resolved) method is to get; one where all see the same."""
        lengths = [each.share for each in self.readouts]
        starts = accumulate(lengths, initial=0.0)
        is_open = self._is_apart and self._later is None
        return tuple(map(Span, starts, lengths)) if is_open else (Span(),)

    def with_later(self, images: Floats) -> Self:
        """The (resolved) method with what all exposures but the first see.

        Args:
            images: of its kind, (exposure, height, width).
        """
        other = self.model_copy()
        other._later = images
        return other

    @property
    def is_exact(self) -> bool:
        return super().is_exact and not self._is_apart

    @property
    def function(self) -> tuple[str, ...]:
        return ("exposures", "later", "columns", "rows") if self._is_apart else super().function

    def arguments(self, context: Context) -> Arguments:
        if not self._is_apart:
            return super().arguments(context)
        later = NOTHING if self._later is None else self._later
        later = np.pad(later, ((0, 0), (0, 0), (0, LANES)))
        rows, columns = (np.int32(size) for size in later.shape[1:])
        return {**super().arguments(context), "later": later, "columns": columns, "rows": rows}

    def seen(self, image: Floats, photodiode: int) -> Floats:
        return image if self._later is None or not photodiode else self._later[photodiode - 1]

    def variance(self, before: Floats, signal: Floats, context: Context) -> Floats | None:
        return None if self._is_apart else super().variance(before, signal, context)
