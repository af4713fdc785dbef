"""Training data: samples and patches of renders, developed when needed; noise for clean raws.

Nothing is written. It imports ``pipeline`` and below, but not ``batch`` and ``analysis``.
"""

from clpipe.dataset.dataset import Dataset
from clpipe.dataset.raw_noise import RawNoise
from clpipe.outputs.patches import Patches

__all__ = ["Dataset", "Patches", "RawNoise"]
