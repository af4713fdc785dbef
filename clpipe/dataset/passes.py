"""The epochs of the passes over a dataset, which workers of a ``DataLoader`` share."""

import os
import tempfile
import weakref
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from clpipe.base.errors import RequestError
from clpipe.base.files import discard
from clpipe.base.process_folder import process_folder
from clpipe.base.system import lock_file
from clpipe.base.workers import rank, trainer

MAX_WORKERS = 1024


def part_of(index: int | None, of: int | None) -> tuple[int, int]:
    """Return which part of how many a caller asks for; by default that of :func:`rank`.

    Raises:
        RequestError: the part does not exist, or only one number is set.
    """
    if index is None and of is None:
        return rank()
    if index is None or of is None or not 0 <= index < of:
        expected = f"0 to {of - 1}" if of else "both numbers, or none"
        raise RequestError(f"found shard {index} of {of}; expected {expected}")
    return index, of


class Passes:
    """Counts the passes over a dataset, each of which is an epoch.

    The numbers are in a file that a process and the workers of its loaders map. Therefore workers
    see the epoch that their parent sets, and new workers continue after those that ended. Any other
    process that gets a copy counts for itself.

    Args:
        epoch: the epoch of the first pass.

    >>> passes = Passes(epoch=3)
    >>> [passes.begin(0, 1) for _ in range(2)], passes.epoch
    ([3, 4], 5)
    """

    def __init__(self, epoch: int) -> None:
        self._create([0, *[epoch] * MAX_WORKERS])

    def _create(self, numbers: Sequence[int]) -> None:
        """Create the file: the number of workers, and the epoch of the next pass of each."""
        self._trainer = trainer()
        self._path: Path | None = None
        self._numbers: NDArray[np.int64] = np.array(numbers, np.int64)
        if folder := process_folder():
            with suppress(OSError):
                file, name = tempfile.mkstemp(prefix="epochs-", dir=folder)
                with open(file, "wb") as opened:
                    self._numbers.tofile(opened)
                self._path = Path(name)
                self._numbers = _mapped(self._path)
                weakref.finalize(self, _remove, self._path, os.getpid())

    def __reduce__(self) -> tuple[object, ...]:
        return _reopened, (self._path, self._trainer, self._own().tolist())

    def copy(self) -> "Passes":
        """Return a copy that is counted separately."""
        return _reopened(None, 0, self._own().tolist())

    def _own(self) -> NDArray[np.int64]:
        """Return the numbers of this process and its workers."""
        if self._trainer != trainer():
            self._create(self._numbers.tolist())
        return self._numbers

    @property
    def epoch(self) -> int:
        """The epoch of the next pass."""
        numbers = self._own()
        count = int(numbers[0])
        return int(numbers[1] if count <= 1 else numbers[1 : 1 + count].max())

    def set(self, epoch: int, number: int = 0, count: int = 1) -> None:
        """Set the epoch of the next pass: of every worker, or of one of several."""
        numbers = self._own()
        with self._locked():
            if count == 1 or numbers[0] != count:
                numbers[:] = [count if count > 1 else 0, *[epoch] * MAX_WORKERS]
            numbers[1 + number] = epoch

    @contextmanager
    def _locked(self) -> Iterator[None]:
        with open(self._path or os.devnull, "rb") as file:
            lock_file(file.fileno(), exclusive=True)
            yield

    def begin(self, number: int, count: int) -> int:
        """Count a pass of one of ``count`` workers, and return its epoch.

        Passes of the same epoch have the same number of workers. With another number, all workers
        start with the epoch after the last one.
        """
        numbers = self._own()
        with self._locked():
            if numbers[0] != count:
                numbers[:] = [count, *[self.epoch] * MAX_WORKERS]
            numbers[1 + number] += 1
            return int(numbers[1 + number]) - 1


def _mapped(path: Path) -> NDArray[np.int64]:
    return np.memmap(path, np.int64, "r+").view(np.ndarray)  # its items cost fewer calls


def _reopened(path: Path | None, owner: int, numbers: Sequence[int]) -> Passes:
    """Return the passes of another process, for its worker, or a copy of them."""
    passes = Passes.__new__(Passes)
    passes._path, passes._trainer, passes._numbers = path, owner, np.array(numbers, np.int64)
    if path:
        with suppress(OSError, ValueError):
            passes._numbers = _mapped(path)
    return passes


def _remove(path: Path, process: int) -> None:
    if os.getpid() == process:  # a forked child also runs this
        discard(path)
