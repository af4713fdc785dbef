"""The numbering of samples: image after image, epoch after epoch."""

from bisect import bisect_right
from collections.abc import Iterator, Sequence
from itertools import accumulate

MAX_PATCHES = 64  # patches of an image in one batch


class Numbering:
    """The numbers of samples: image after image, epoch after epoch.

    Args:
        counts: the number of samples of each image.

    >>> numbering = Numbering([2, 3])
    >>> numbering.position(4), numbering.position(5), next(numbering.groups(1))
    ((0, 1, 2), (1, 0, 0), (0, 0, range(1, 2)))
    """

    def __init__(self, counts: Sequence[int]) -> None:
        self._ends = list(accumulate(counts, initial=0))

    @property
    def samples_per_epoch(self) -> int:
        """The number of samples in an epoch."""
        return self._ends[-1]

    def position(self, number: int) -> tuple[int, int, int]:
        """Return epoch, image, and number within the image of a sample, from 0."""
        epoch, rest = divmod(number, self.samples_per_epoch)
        image = bisect_right(self._ends, rest) - 1
        return epoch, image, rest - self._ends[image]

    def groups(self, first: int) -> Iterator[tuple[int, int, range]]:
        """Yield all samples, starting at a number, at most :data:`MAX_PATCHES` of an image at once.

        The iterator is endless.
        """
        epoch, image, begin = self.position(first)
        while True:
            count = self._ends[image + 1] - self._ends[image]
            if begin < count:
                yield epoch, image, range(begin, min(begin + MAX_PATCHES, count))
                begin += MAX_PATCHES
            else:
                begin, image = 0, image + 1
                if image == len(self._ends) - 1:
                    epoch, image = epoch + 1, 0
