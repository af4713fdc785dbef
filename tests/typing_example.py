"""A user's script for the type checker. mypy checks it; nothing calls it."""

from typing import Any, assert_type

import numpy as np
from numpy.typing import NDArray

import clpipe


def script() -> None:
    camera = clpipe.Pipeline(iso=3200, sensor_noise={"a": 1e-4}, denoise={"method": "mean"})
    clpipe.Pipeline(sensor_noise={"a": {"log_uniform": [1e-4, 1e-2]}}, prnu={"sigma": np.float32()})
    clpipe.Pipeline(sensor_noise={"gain": 1e-4})  # type: ignore[typeddict-unknown-key]
    clpipe.Pipeline(denoise={"method": "mena"})  # type: ignore[typeddict-item]
    clpipe.Pipeline(sensor_nois={"a": 1e-4})  # type: ignore[call-arg]
    others: dict[str, Any] = {
        "denoise_2": {"method": "median"}
    }  # of repeated stages, and of users'
    clpipe.Pipeline(**others)
    shot = camera.process(np.zeros((480, 640, 3), np.float32), "frame_0001")
    assert_type(camera, clpipe.Pipeline)
    assert_type(shot, clpipe.Result)
    assert_type(shot.image, NDArray[Any])
    assert_type(shot.kept["quantize"], NDArray[np.float32])
    assert_type(shot.estimates["white_balance"]["red_gain"], float)
    assert_type(clpipe.load_camera("sony-a7r2").noise(800).a, float)
    for sample in clpipe.Dataset("renders/"):
        assert_type(sample, dict[str, Any])
