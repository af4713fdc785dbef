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
    from clpipe.dataset import Dataset, Patches, RawNoise
    from clpipe.dataset.streaming import StreamingDataset
    from clpipe.engine.runner import Result
    from clpipe.pipeline import Pipeline
    from clpipe.stream import Shot, Stream

_MODULES = {
    "Camera": "clpipe.camera.profile",
    "ClpipeError": "clpipe.base.errors",
    "Dataset": "clpipe.dataset",
    "DeviceError": "clpipe.base.errors",
    "ImageError": "clpipe.base.errors",
    "NoiseModel": "clpipe.camera.noise",
    "Outcome": "clpipe.batch.outcome",
    "Patches": "clpipe.dataset",
    "Pipeline": "clpipe.pipeline",
    "RawNoise": "clpipe.dataset",
    "RequestError": "clpipe.base.errors",
    "Result": "clpipe.engine.runner",
    "Run": "clpipe.batch.session",
    "Shot": "clpipe.stream",
    "Stream": "clpipe.stream",
    "StreamingDataset": "clpipe.dataset.streaming",
    "built_in_cameras": "clpipe.camera.profile",
    "load_camera": "clpipe.camera.profile",
    "run": "clpipe.batch.api",
}

__all__ = [
    "Camera",
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
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(_MODULES[name]), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
