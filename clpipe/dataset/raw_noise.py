"""The noise of a camera for clean mosaics from other sources."""

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from clpipe.base.errors import ImageError, RequestError
from clpipe.base.readonly import ReadOnly
from clpipe.base.types import Array
from clpipe.base.validation import check_argument_types
from clpipe.base.workers import Place, seed_at
from clpipe.chain.python_words import errors_in_python
from clpipe.chain.registry import stage_in
from clpipe.dataset.arrays import packed, unpacked
from clpipe.images.arrays import as_array
from clpipe.pipeline import Pipeline
from clpipe.reference.cfa import PATTERNS
from clpipe.stage import StageRole

MOSAIC, PACKED = 1, 4  # numbers of channels


class RawNoise(ReadOnly):
    """A transform that adds the raw noise of a camera to clean mosaics in signal units.

    >>> import numpy as np
    >>> import clpipe
    >>> add_noise = clpipe.RawNoise("sony-a7r2", iso=3200, device="numpy")
    >>> planes = np.full((4, 16, 16), 0.25, np.float32)  # R, Gr, Gb, B
    >>> noisy = add_noise(planes, "frame_0001")
    >>> noisy.shape, bool(noisy.std() > 0)
    ((4, 16, 16), True)

    It runs the default chain from ``crosstalk`` to ``normalize``: sensor noise, row, column and
    pixel defects, clipping and rounding to DN. Noise depends on the mosaic, the ISO, the seed and
    the key. With a ``noise_key``, the result equals the whole chain's result with this key.

    The process that first calls it opens the device. OpenCL does not survive a fork, so workers of
    a process that has used it must be spawned.

    Args:
        camera: a name from ``clpipe cameras``, or the TOML file of a profile.
        iso: the ISO. ``{"log_uniform": [800, 12800]}`` or another draw is made for each mosaic.
        seed: None gives other noise in each process and at each call without a key. With a number,
            calls without a key give the same sequence of noise in each main process. Workers of a
            ``DataLoader`` then have their own sequences, which ``torch.manual_seed`` determines.
        device: as for :class:`~clpipe.Pipeline`.
        **settings: as for :class:`~clpipe.Pipeline`, such as ``sensor_noise={"a": 1e-3}``.

    Raises:
        RequestError: a name or value is not allowed.
    """

    @errors_in_python()
    @check_argument_types
    def __init__(
        self,
        camera: str | Path,
        iso: float | Mapping[str, Any],
        *,
        seed: int | None = None,
        device: str | int | None = None,
        **settings: Any,
    ) -> None:
        first, last = (stage_in(role).name for role in (StageRole.SENSOR, StageRole.LEVELS))
        for name in ("start_at", "until"):
            if name in settings:
                raise RequestError(
                    f"RawNoise: found {name}, but it always runs from {first} to {last}"
                )
        self._settings = {**settings, "camera": str(camera), "iso": iso, "seed": seed or 0}
        self._settings |= {"start_at": first, "until": last}
        self._seed = seed
        self._device = device
        self._pattern = self._pipeline("numpy").chain.filter_array.pattern
        self._opened: tuple[int, Pipeline] | None = None
        self._place = Place()
        self._generator: tuple[tuple[str, ...], np.random.Generator] | None = None

    def __getstate__(self) -> Mapping[str, Any]:
        # A device cannot leave its process.
        return {**self.__dict__, "_opened": None, "_generator": None}

    def __repr__(self) -> str:
        return f"RawNoise({self._settings['camera']!r}, {self._settings['iso']!r})"

    def __call__(self, mosaic: Array, key: str | np.random.Generator | None = None) -> Array:
        """Return a mosaic with noise.

        Args:
            mosaic: linear signal, where 0 is black and 1 is white, in float16, float32 or float64.
                It is (height, width) or (1, height, width) with the camera's CFA pattern. Or it is
                packed as planes R, Gr, Gb, B, (4, height / 2, width / 2). Gr is green in the rows
                of red. A batch has another axis in front.
            key: a name for repeatable noise. Pass another one in each epoch. Mosaics of a batch
                differ by their index. None, or a generator, draws a new name.

        Returns:
            The noisy mosaic, in the shape and type of the clean one. Negative values remain, down
            to 0 DN. Values are clipped at 1.

        Raises:
            ImageError: the array has a wrong shape or type, or is not finite.
            RequestError: the key has a wrong type.
            DeviceError: there is no usable device.
        """
        pipeline = self._open()
        mosaic = as_array(mosaic, "mosaic")
        shape = mosaic.shape
        channels = MOSAIC if len(shape) == 2 else shape[-3] if len(shape) in (3, 4) else 0
        if channels not in (MOSAIC, PACKED) or 0 in shape:
            raise ImageError(
                f"found an array of shape {shape}; expected a mosaic, (height, width), its planes, "
                "(4, height / 2, width / 2), or a batch, (mosaic, 1 or 4, height, width)"
            )
        if mosaic.dtype.kind != "f":
            raise ImageError(
                f"found {mosaic.dtype}; expected floats in signal units. Subtract the black level "
                "from DN, and divide by the white level minus the black level"
            )
        if key is None or isinstance(key, np.random.Generator):
            key = f"{(key or self._random()).integers(2**63):016x}"
        if not isinstance(key, str):
            raise RequestError(f"found key {key!r}; expected a text, a generator or None")
        if mosaic.ndim == 4:
            noisy = [self._noisy(pipeline, each, f"{key}/{i}") for i, each in enumerate(mosaic)]
            return np.stack(noisy)
        return self._noisy(pipeline, mosaic, key)

    def _noisy(self, pipeline: Pipeline, clean: Array, key: str) -> Array:
        """Return one mosaic with noise, of two or three dimensions."""
        is_packed = clean.ndim == 3 and len(clean) == PACKED
        if is_packed and self._pattern not in PATTERNS:
            raise RequestError(
                f"found planes, but the camera's pattern {self._pattern} is not a Bayer pattern. "
                "Pass a mosaic, (height, width)"
            )
        mosaic = unpacked(clean, self._pattern) if is_packed else clean.reshape(clean.shape[-2:])
        noisy = pipeline.process(mosaic, key).image
        noisy = packed(noisy, self._pattern) if is_packed else noisy.reshape(clean.shape)
        return noisy.astype(clean.dtype, copy=False)

    def _random(self) -> np.random.Generator:
        """Return the generator of names in this process."""
        words = self._place.words()
        if self._generator is None or self._generator[0] != words:
            seed = None if self._seed is None else seed_at(self._seed, words)
            self._generator = words, np.random.default_rng(seed)
        return self._generator[1]

    def _open(self) -> Pipeline:
        """Return the pipeline of this process.

        Raises:
            DeviceError: there is no usable device, or a parent process has opened it.
        """
        if self._opened is None or self._opened[0] != os.getpid():
            self._opened = os.getpid(), self._pipeline(self._device)
        return self._opened[1]

    def _pipeline(self, device: str | int | None) -> Pipeline:
        return Pipeline(device=device, **self._settings)
