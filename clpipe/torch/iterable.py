"""PyTorch's ``IterableDataset``, or a substitute if PyTorch is not installed."""

__all__ = ["IterableDataset"]

try:
    from torch.utils.data import IterableDataset
except ModuleNotFoundError:

    class IterableDataset:  # type: ignore[no-redef]
        """A substitute for the class if PyTorch is not installed."""
