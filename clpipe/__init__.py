"""clpipe puts a clean, linear render through a camera: mosaic, sensor noise, development."""

__version__ = "0.1.0"

from clpipe.dataset import Dataset
from clpipe.errors import ClpipeError, DeviceError, ImageError, RequestError
from clpipe.pipeline import Pipeline
from clpipe.run import Result

__all__ = [
    "ClpipeError",
    "Dataset",
    "DeviceError",
    "ImageError",
    "Pipeline",
    "RequestError",
    "Result",
]
