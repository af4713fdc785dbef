"""A camera's noise alone, put into clean raws that come from elsewhere."""

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from clpipe.base.errors import ImageError, RequestError
from clpipe.base.readonly import ReadOnly
from clpipe.base.types import Array
from clpipe.base.validation import typed
from clpipe.dataset.arrays import packed, unpacked
from clpipe.images.arrays import as_array
from clpipe.pipeline import Pipeline
from clpipe.reference.cfa import PATTERNS

FIRST, LAST = (
    "crosstalk",
    "normalize",
)  # what a chain does between the clean mosaic and the noisy one
MOSAIC, PACKED = 1, 4  # channels


class RawNoise(ReadOnly):
    """Puts a camera's noise into clean raws: a transform, to be called with each.

    It runs the default chain from ``crosstalk`` to ``normalize``: sensor noise, what a sensor does
    to rows, columns and single pixels, clipping and rounding to DN. Noise depends on the raw, the
    ISO, the seed and the key; with one ``noise_key``, the bits are those that the raw gets in the
    chain.

    The process that first calls it opens the device. OpenCL does not survive a fork: workers of a
    process that has used it must be spawned.

    Args:
        camera: a name that ``clpipe cameras`` lists, or the TOML file of a profile.
        iso: its ISO; ``{"log_uniform": [800, 12800]}`` or another draw is made for each raw.
        seed: None is other noise in each process and at each call without a key; with a number,
            calls without a key give the same noise in the same order, in each process.
        device: as for :class:`~clpipe.Pipeline`.
        **settings: as for :class:`~clpipe.Pipeline`, such as ``sensor_noise={"a": 1e-3}``.

    Raises:
        RequestError: a name or value that is not allowed.
    """

    @typed
    def __init__(
        self,
        camera: str | Path,
        iso: float | Mapping[str, Any],
        *,
        seed: int | None = None,
        device: str | int | None = None,
        **settings: Any,
    ) -> None:
        for name in ("start_at", "until"):
            if name in settings:
                raise RequestError(f"RawNoise: found {name}, but it runs from {FIRST} to {LAST}")
        self._settings = {**settings, "camera": str(camera), "iso": iso, "seed": seed or 0}
        self._seed = seed
        self._device = device
        self._pattern = self._pipeline("numpy").chain.filters.pattern
        self._opened: tuple[int, Pipeline, np.random.Generator] | None = None

    def __getstate__(self) -> Mapping[str, Any]:
        return {**self.__dict__, "_opened": None}  # a device stays with its process

    def __repr__(self) -> str:
        return f"RawNoise({self._settings['camera']!r}, {self._settings['iso']!r})"

    def __call__(self, raw: Array, key: str | np.random.Generator | None = None) -> Array:
        """A raw with noise.

        Args:
            raw: linear signal, 0 is black and 1 is white, in float16, float32 or float64: a mosaic,
                (height, width) or (1, height, width), with the camera's CFA pattern; or its planes
                R, Gr, Gb, B, (4, height / 2, width / 2), where Gr is green in the rows of red; or a
                batch of these, (raw, channel, height, width).
            key: its name, for noise that can be had again; give it another one in each epoch. Raws
                of a batch are told apart by their numbers in it. None, or a generator, is a new
                name, drawn.

        Returns:
            The noisy raw, in the shape and type of the clean one. Values below 0 stay as they are,
            down to 0 DN; above 1 there are none.

        Raises:
            ImageError: an array of another shape or type, or one that is not finite.
            RequestError: a key of another type.
            DeviceError: there is no usable device.
        """
        pipeline, random = self._open()
        raw = as_array(raw, "raw")
        shape = raw.shape
        channels = MOSAIC if len(shape) == 2 else shape[-3] if len(shape) in (3, 4) else 0
        if channels not in (MOSAIC, PACKED) or 0 in shape:
            raise ImageError(
                f"found an array of shape {shape}; expected a mosaic, (height, width), its planes, "
                "(4, height / 2, width / 2), or a batch, (raw, 1 or 4, height, width)"
            )
        if raw.dtype.kind != "f":
            raise ImageError(
                f"found {raw.dtype}; expected floats in signal: raws in DN less the black level, "
                "over white less black"
            )
        if key is None or isinstance(key, np.random.Generator):
            key = f"{(key or random).integers(2**63):016x}"
        if not isinstance(key, str):
            raise RequestError(f"found key {key!r}; expected a text, a generator or None")
        if raw.ndim == 4:
            noisy = [self._noisy(pipeline, each, f"{key}/{i}") for i, each in enumerate(raw)]
            return np.stack(noisy)
        return self._noisy(pipeline, raw, key)

    def _noisy(self, pipeline: Pipeline, raw: Array, key: str) -> Array:
        """One raw with noise, of two or three dimensions."""
        is_packed = raw.ndim == 3 and len(raw) == PACKED
        if is_packed and self._pattern not in PATTERNS:
            raise RequestError(
                f"found planes, but the mosaic is {self._pattern}, no Bayer pattern; give mosaics"
            )
        mosaic = unpacked(raw, self._pattern) if is_packed else raw.reshape(raw.shape[-2:])
        noisy = pipeline.process(mosaic, key).image
        noisy = packed(noisy, self._pattern) if is_packed else noisy.reshape(raw.shape)
        return noisy.astype(raw.dtype, copy=False)

    def _open(self) -> tuple[Pipeline, np.random.Generator]:
        """The pipeline of this process, and what it draws names from.

        Raises:
            DeviceError: there is no usable device, or another process had opened it.
        """
        if self._opened is None or self._opened[0] != os.getpid():
            pipeline = self._pipeline(self._device)
            self._opened = os.getpid(), pipeline, np.random.default_rng(self._seed)
        return self._opened[1:]

    def _pipeline(self, device: str | int | None) -> Pipeline:
        return Pipeline(device=device, start_at=FIRST, until=LAST, **self._settings)
