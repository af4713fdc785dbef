"""Simulate a camera for linear renders: optics, mosaic, sensor noise and development.

This package exports the Python API. Names are imported on first use, so ``import clpipe`` is fast.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from clpipe.base.about import __version__

if TYPE_CHECKING:
    from clpipe.base.errors import ClpipeError, DeviceError, ImageError, RequestError
    from clpipe.batch.api import run
    from clpipe.batch.outcome import Outcome
    from clpipe.batch.session import Run
    from clpipe.camera.noise import NoiseModel
    from clpipe.camera.profile import Camera, built_in_cameras, load_camera
    from clpipe.chain.camera_info import CameraInfo
    from clpipe.dataset import Dataset, Patches, RawNoise
    from clpipe.dataset.streaming import StreamingDataset
    from clpipe.engine.runner import Result
    from clpipe.pipeline import Pipeline
    from clpipe.stream import Shot, Stream

_NAMES = {
    "clpipe.base.errors": ("ClpipeError", "DeviceError", "ImageError", "RequestError"),
    "clpipe.batch.api": ("run",),
    "clpipe.batch.outcome": ("Outcome",),
    "clpipe.batch.session": ("Run",),
    "clpipe.camera.noise": ("NoiseModel",),
    "clpipe.camera.profile": ("Camera", "built_in_cameras", "load_camera"),
    "clpipe.chain.camera_info": ("CameraInfo",),
    "clpipe.dataset": ("Dataset", "Patches", "RawNoise"),
    "clpipe.dataset.streaming": ("StreamingDataset",),
    "clpipe.engine.runner": ("Result",),
    "clpipe.pipeline": ("Pipeline",),
    "clpipe.stream": ("Shot", "Stream"),
}

__all__ = [
    "Camera",
    "CameraInfo",
    "ClpipeError",
    "Dataset",
    "DeviceError",
    "ImageError",
    "NoiseModel",
    "Outcome",
    "Patches",
    "Pipeline",
    "RawNoise",
    "RequestError",
    "Result",
    "Run",
    "Shot",
    "Stream",
    "StreamingDataset",
    "__version__",
    "built_in_cameras",
    "load_camera",
    "run",
]


def __getattr__(name: str) -> Any:
    for module, names in _NAMES.items():
        if name in names:
            return getattr(import_module(module), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
