"""How samples are numbered: image after image, epoch after epoch. Pure."""

from bisect import bisect_right
from collections.abc import Iterator, Sequence
from itertools import accumulate

TOGETHER = 64  # patches of an image that are developed at a time


class Numbering:
    """The numbers of samples: image after image, epoch after epoch.

    Args:
        counts: how many samples there are of each image.

    >>> numbering = Numbering([2, 3])
    >>> numbering.place(4), numbering.place(5), next(numbering.groups(1))
    ((0, 1, 2), (1, 0, 0), (0, 0, range(1, 2)))
    """

    def __init__(self, counts: Sequence[int]) -> None:
        self._ends = list(accumulate(counts, initial=0))

    @property
    def of_epoch(self) -> int:
        """How many samples an epoch has."""
        return self._ends[-1]

    def place(self, number: int) -> tuple[int, int, int]:
        """Epoch, image, and number within the image of a sample; each counts from 0."""
        epoch, rest = divmod(number, self.of_epoch)
        image = bisect_right(self._ends, rest) - 1
        return epoch, image, rest - self._ends[image]

    def groups(self, first: int) -> Iterator[tuple[int, int, range]]:
        """All samples from a number on, those of an image at most :data:`TOGETHER` at a time.

        It does not end.
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
