"""The place of this process in PyTorch's loaders and ranks, without importing PyTorch."""

import os
import sys
from hashlib import blake2b
from multiprocessing import current_process, parent_process
from typing import Any


def worker() -> tuple[int, int]:
    """Return the number of this worker of a ``DataLoader``, and how many there are."""
    info = _worker_info()
    return (info.id, info.num_workers) if info else (0, 1)


def rank() -> tuple[int, int]:
    """Return the rank of this process in ``torch.distributed``, and how many ranks there are."""
    distributed = sys.modules.get("torch.distributed")
    if distributed and distributed.is_available() and distributed.is_initialized():
        return distributed.get_rank(), distributed.get_world_size()
    return 0, 1


def trainer() -> int:
    """Return the id of the process that iterates: of this one, or of a worker's parent."""
    parent = parent_process()
    return parent.pid or 0 if parent and _worker_info() else os.getpid()


def _worker_info() -> Any:
    data = sys.modules.get("torch.utils.data")  # a worker has imported it
    return data.get_worker_info() if data else None


class Place:
    """Where an object draws random numbers, so that it draws others in each process.

    A worker of a ``DataLoader`` has a seed, which ``torch.manual_seed`` determines. Other processes
    of ``multiprocessing`` differ by name, and those that ``os.fork`` made by their ids.
    """

    def __init__(self) -> None:
        self._process: tuple[str, int] | None = None

    def __reduce__(self) -> tuple[object, ...]:
        return Place, ()

    def words(self) -> tuple[str, ...]:
        """Return what distinguishes this place; () in the main process of the first rank."""
        process = current_process().name, os.getpid()
        number = rank()[0] or os.environ.get("RANK", "0")  # of torchrun, also in workers
        words = [f"rank {number}"] if str(number) != "0" else []
        if info := _worker_info():
            return (*words, f"worker {info.seed}")
        self._process = self._process or process
        if process[0] != "MainProcess":
            words.append(process[0])
        if process[0] == self._process[0] and process[1] != self._process[1]:
            words.append(f"fork {process[1]}")
        return tuple(words)


def seed_at(seed: int, words: tuple[str, ...]) -> int:
    """Return a seed for a place, of 63 bits; ``seed`` itself for no words."""
    if not words:
        return seed
    digest = blake2b(repr((seed, words)).encode(), digest_size=8).digest()
    return int.from_bytes(digest, "little") >> 1
