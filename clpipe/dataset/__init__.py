"""Training data: samples and patches of renders, and noise for clean mosaics.

Samples are developed on demand, and no results are written. This package may import ``pipeline``
and lower packages, but not ``batch`` or ``analysis``.
"""

from clpipe.dataset.dataset import Dataset
from clpipe.dataset.raw_noise import RawNoise
from clpipe.outputs.patches import Patches

__all__ = ["Dataset", "Patches", "RawNoise"]
