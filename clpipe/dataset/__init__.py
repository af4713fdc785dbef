"""Training data straight from renders: samples, and patches of them, developed when needed.

Nothing is written. It imports ``pipeline`` and below, but not ``batch`` and ``analysis``.
"""

from clpipe.dataset.dataset import Dataset

__all__ = ["Dataset"]
