"""PyTorch's ``IterableDataset``, or a substitute if PyTorch is not installed."""

from typing import Any

__all__ = ["IterableDataset", "worker"]

try:
    from torch.utils.data import IterableDataset, get_worker_info
except ModuleNotFoundError:

    class IterableDataset:  # type: ignore[no-redef]
        """A substitute for the class if PyTorch is not installed."""

    def get_worker_info() -> Any:
        """A substitute for the function: no worker."""


def worker() -> tuple[int, int]:
    """Return the number of this worker of a ``DataLoader``, and how many there are."""
    info = get_worker_info()
    return (info.id, info.num_workers) if info else (0, 1)
