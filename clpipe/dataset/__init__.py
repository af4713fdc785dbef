"""Training data: samples and patches of renders, developed when needed; noise for clean raws.

The package writes no files. It imports ``pipeline`` and below, but not ``batch`` or ``analysis``.
"""

from clpipe.dataset.dataset import Dataset
from clpipe.dataset.raw_noise import RawNoise
from clpipe.outputs.patches import Patches

__all__ = ["Dataset", "Patches", "RawNoise"]
