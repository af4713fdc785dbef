"""Staggered exposures: several in sequence, each with its own time span."""

from itertools import accumulate
from typing import ClassVar, Self

import numpy as np
from pydantic import PrivateAttr

from clpipe.base.types import Floats
from clpipe.reference.filter_array import LANES
from clpipe.stage import Arguments, Context, Span, parameter
from clpipe.stages.sensor_noise.readouts import MAX_READOUTS, Readout, Readouts

NO_IMAGES = np.zeros((MAX_READOUTS - 1, 1, 1), np.float32)  # default before there is an image


class Staggered(Readouts):
    """Staggered exposures (DOL): 2 to 4 in sequence, each ``ratio`` times shorter than the last.

    In each row the longest exposure comes first, and the next begins when it ends. If sub-frames or
    the flicker of ``shutter`` change the light, each exposure sees its own time span. They are
    merged like in a sensor without motion detection.
    """

    method: ClassVar = "staggered"
    summary: ClassVar = "two to four exposures, each shorter than the one before, merged"
    other_examples: ClassVar = ({"count": 4},)

    count: int = parameter(3, "Number of exposures.", structural=True, ge=2, le=MAX_READOUTS)

    _light_changes: bool = PrivateAttr(False)  # each exposure sees different light
    # The light of an image in all exposures after the first.
    _later_images: Floats | None = PrivateAttr(None)

    @property
    def readouts(self) -> tuple[Readout, ...]:
        assert self.ratio is not None
        return tuple(Readout(i, self.ratio**-i, 1) for i in range(self.count))

    def resolve(self, context: Context) -> Self:
        return super().resolve(context).with_state(_light_changes=context.light_changes)

    @property
    def spans(self) -> tuple[Span, ...]:
        """The span of time that each exposure sees; a single one if all see the same light."""
        lengths = [each.share for each in self.readouts]
        starts = accumulate(lengths, initial=0.0)
        needs_images = self._light_changes and self._later_images is None
        return tuple(map(Span, starts, lengths)) if needs_images else (Span(),)

    def with_later_images(self, images: Floats) -> Self:
        """Return the (resolved) method with the light of all exposures but the first.

        Args:
            images: of the method's kind, (exposure, height, width).
        """
        return self.with_state(_later_images=images)

    @property
    def is_exact(self) -> bool:
        return super().is_exact and not self._light_changes

    @property
    def function(self) -> tuple[str, ...]:
        return (
            ("exposures", "later", "columns", "rows") if self._light_changes else super().function
        )

    def arguments(self, context: Context) -> Arguments:
        if not self._light_changes:
            return super().arguments(context)
        later = NO_IMAGES if self._later_images is None else self._later_images
        later = np.pad(later, ((0, 0), (0, 0), (0, LANES)))
        rows, columns = later.shape[1:]
        return {**super().arguments(context), "later": later, "columns": columns, "rows": rows}

    def light_on(self, image: Floats, photodiode: int) -> Floats:
        return (
            image
            if self._later_images is None or not photodiode
            else self._later_images[photodiode - 1]
        )

    def variance(self, input_variance: Floats, signal: Floats, context: Context) -> Floats | None:
        return None if self._light_changes else super().variance(input_variance, signal, context)
