"""The numbering of samples: image after image, epoch after epoch. Pure."""

from bisect import bisect_right
from collections.abc import Iterator, Sequence
from itertools import accumulate

TOGETHER = 64  # patches of an image in one batch


class Numbering:
    """The numbers of samples: image after image, epoch after epoch.

    Args:
        counts: the number of samples of each image.

    >>> numbering = Numbering([2, 3])
    >>> numbering.place(4), numbering.place(5), next(numbering.groups(1))
    ((0, 1, 2), (1, 0, 0), (0, 0, range(1, 2)))
    """

    def __init__(self, counts: Sequence[int]) -> None:
        self._ends = list(accumulate(counts, initial=0))

    @property
    def of_epoch(self) -> int:
        """The number of samples in an epoch."""
        return self._ends[-1]

    def place(self, number: int) -> tuple[int, int, int]:
        """Return epoch, image, and number within the image of a sample, from 0."""
        epoch, rest = divmod(number, self.of_epoch)
        image = bisect_right(self._ends, rest) - 1
        return epoch, image, rest - self._ends[image]

    def groups(self, first: int) -> Iterator[tuple[int, int, range]]:
        """Yield all samples from a number on, at most :data:`TOGETHER` of an image at a time.

        The iterator is endless.
        """
        epoch, image, begin = self.place(first)
        while True:
            count = self._ends[image + 1] - self._ends[image]
            if begin < count:
                yield epoch, image, range(begin, min(begin + TOGETHER, count))
                begin += TOGETHER
            else:
                begin, image = 0, image + 1
                if image == len(self._ends) - 1:
                    epoch, image = epoch + 1, 0
