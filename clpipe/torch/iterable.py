"""PyTorch's base class for iterable data sets, or a stand-in without PyTorch."""

from typing import Any

__all__ = ["IterableDataset", "worker"]

try:
    from torch.utils.data import IterableDataset, get_worker_info
except ModuleNotFoundError:

    class IterableDataset:  # type: ignore[no-redef]
        """Replaces PyTorch's class if PyTorch is not installed."""

    def get_worker_info() -> Any:
        """Replaces PyTorch's function."""


def worker() -> tuple[int, int]:
    """Return the number of this worker of a ``DataLoader``, and the number of workers."""
    info = get_worker_info()
    return (info.id, info.num_workers) if info else (0, 1)
