"""The raw noise of a camera as a transform of tensors."""

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from clpipe.base.cache import BoundedCache
from clpipe.base.errors import ImageError, RequestError
from clpipe.base.readonly import ReadOnly
from clpipe.base.text import as_texts
from clpipe.base.validation import check_argument_types
from clpipe.base.workers import Place, seed_at
from clpipe.chain.chain import Chain
from clpipe.chain.drawing import plain_settings
from clpipe.chain.files import load_settings
from clpipe.chain.making import make_chain
from clpipe.chain.paths import resolve_paths
from clpipe.chain.python_words import errors_in_python
from clpipe.chain.registry import stage_in
from clpipe.chain.settings import overlay, settings_from
from clpipe.stage import NoiseScope, StageRole
from clpipe.torch.table import SampleDraws, Table

MAX_CHAINS = 1024  # number of chains if values are drawn
POSITION_RANGE = 512  # px; positions are drawn from a sensor that is this much larger than a sample


class RawNoise(ReadOnly, nn.Module):
    """A module that adds the raw noise of a camera to clean mosaics, on their device.

    Like :class:`clpipe.RawNoise`, it runs from ``crosstalk`` to ``normalize``: sensor noise, row,
    column and pixel defects, clipping and rounding to DN. Each sample gets its own noise, and its
    own camera, ISO and other values if these are drawn. On a CPU, a sample with a key gets the same
    bits as from the chain with this ``noise_key``.

    Each call draws new noise, also in workers of a ``DataLoader``, in processes that were forked or
    spawned, and in ranks. The module has no weights, and training and evaluation mode are the same.

    It is differentiable in the clean mosaic. Noise grows with the signal, clipping stops
    the gradient, and rounding passes it. Poisson noise passes it, and its own derivative is 0.

    Args:
        camera: a name from ``clpipe cameras``, or the TOML file of a profile.
            ``{"choice": [...]}`` is drawn.
        iso: the ISO. ``{"log_uniform": [800, 12800]}`` or another draw is made for each sample.
        seed: None draws from PyTorch's generator, so that ``torch.manual_seed`` determines the
            noise. With a number, the calls of an object give the same sequence of noise. In
            workers of a ``DataLoader``, the sequence also depends on the worker's seed.
        config: a built-in configuration or a TOML file, or several.
        **settings: as for :class:`clpipe.Pipeline`, such as ``sensor_noise={"method": "poisson"}``.

    Raises:
        RequestError: a name or value is not allowed, or a user's stage is in this part of the
            chain.

    >>> import torch
    >>> from clpipe.torch import RawNoise
    >>> add_noise = RawNoise("sony-a7r2", {"log_uniform": [800, 12800]}, seed=1)
    >>> noisy = add_noise(torch.full((8, 4, 32, 32), 0.2))
    >>> noisy.shape, bool(noisy.std() > 0)
    (torch.Size([8, 4, 32, 32]), True)
    """

    @errors_in_python()
    @check_argument_types
    def __init__(
        self,
        camera: str | Path | Mapping[str, Any],
        iso: float | Mapping[str, Any],
        *,
        seed: int | None = None,
        config: str | Path | Sequence[str | Path] = "default",
        **settings: Any,
    ) -> None:
        camera_value = camera if isinstance(camera, Mapping) else str(camera)
        values = {**settings, "camera": camera_value, "iso": iso, "seed": seed or 0}
        super().__init__()
        values = resolve_paths(None, plain_settings(values))
        self._settings = overlay(load_settings(*as_texts(config)), values)
        self._seed = seed
        self._place = Place()
        self._chains: BoundedCache[Chain] = BoundedCache(MAX_CHAINS)  # empty in a pickled copy
        self._tables: BoundedCache[Table] = BoundedCache(1)
        self._start()
        Table([self._chain("")])  # raises an error for stages without a PyTorch version

    def _start(self) -> None:
        """Begin the sequence of noise."""
        self._random = torch.Generator()
        self._seeded: tuple[str, ...] | None = None  # the place for which the generator is seeded

    def __getstate__(self) -> dict[str, Any]:
        state = {k: v for k, v in vars(self).items() if k not in ("_random", "_seeded")}
        return {**state, "_settings": self._settings.record()}

    def __setstate__(self, state: dict[str, Any]) -> None:
        super().__setstate__(state)
        self._settings = settings_from(state["_settings"])
        self._start()

    def __setattr__(self, name: str, value: Any) -> None:
        if name == "training":  # set by train() and eval()
            nn.Module.__setattr__(self, name, value)
        else:
            super().__setattr__(name, value)

    def __repr__(self) -> str:
        return f"RawNoise({self._settings.label})"

    def forward(self, mosaic: Tensor, key: Sequence[str] | str | None = None) -> Tensor:
        """Return mosaics with noise.

        Args:
            mosaic: linear signal, where 0 is black and 1 is white, in float16, bfloat16, float32 or
                float64. Noise is computed in float32. The mosaic is (batch, 1, height, width) with
                the camera's CFA pattern. Or it is packed as planes R, Gr, Gb, B, (batch, 4,
                height / 2, width / 2). Gr is green in the rows of red. The batch axis may be
                absent.
            key: a name for each mosaic of the batch, for repeatable noise. Pass others in each
                epoch. Fixed patterns are then taken from the upper left corner of the sensor. None
                draws new noise and a position on the sensor for each mosaic.

        Returns:
            The noisy mosaics, of the same shape and type, on the same device.

        Raises:
            ImageError: the tensor has a wrong shape or type.
            RequestError: the number of keys is not the number of mosaics.
        """
        shape = tuple(mosaic.shape)
        if len(shape) not in (3, 4) or shape[-3] not in (1, 4) or 0 in shape:
            raise ImageError(
                f"found a tensor of shape {shape}; expected mosaics, (batch, 1, height, width), "
                "or their planes, (batch, 4, height / 2, width / 2), or one of these"
            )
        if not mosaic.dtype.is_floating_point:
            raise ImageError(
                f"found {mosaic.dtype}; expected floats in signal units. Subtract the black level "
                "from DN, and divide by the white level minus the black level"
            )
        if mosaic.dtype != torch.float32:
            noisy: Tensor = self(mosaic.float(), key)
            return noisy.to(mosaic.dtype)
        if len(shape) == 3:
            single: Tensor = self(mosaic[None], [key] if isinstance(key, str) else key)[0]
            return single
        if key is not None and (isinstance(key, str) or len(key) != len(mosaic)):
            raise RequestError(f"key: found {key!r}; expected {len(mosaic)}, one for each mosaic")
        draws = self._draw(mosaic, key)
        table = draws.table
        order = table.planes[torch.from_numpy(draws.chains)].to(mosaic.device)
        mosaics = mosaic[:, 0] if shape[1] == 1 else _unpacked(mosaic, order)
        if shape[1] == 1 and bool((table.planes != table.planes[0]).any()):
            raise RequestError(
                f"{self!r}: the cameras have several CFA patterns. Pass planes, (batch, 4, ...)"
            )
        with torch.autocast(mosaic.device.type, enabled=False):
            noisy = table.noisy(mosaics, draws)
        return noisy[:, None] if shape[1] == 1 else _packed(noisy, order)

    def _draw(self, mosaic: Tensor, keys: Sequence[str] | None) -> "SampleDraws":
        """Return the random draws for mosaics."""
        count, cell = len(mosaic), 2 if mosaic.shape[1] == 4 else 1
        size = cell * mosaic.shape[2], cell * mosaic.shape[3]
        if keys is None:
            table = self._tables.get((), self._all_chains)
            self._seed_generator()

            def random(high: int, *shape: int) -> Tensor:
                return torch.randint(high, shape, generator=self._random)

            chains = random(len(table.chains), count).numpy()
            offsets = (2 * random(POSITION_RANGE // 2, count, 2)).tolist()
            positions = [(row, column) for row, column in offsets]
            area = size[0] + POSITION_RANGE, size[1] + POSITION_RANGE
            return SampleDraws(table, chains, random(1 << 32, 2, count), positions, area)
        chains_by_key = [self._chain(key) for key in keys]
        unique_chains = list(dict.fromkeys(chains_by_key))
        chains = np.array([unique_chains.index(chain) for chain in chains_by_key])
        streams = [
            chain.stream(chain.steps[0].name, NoiseScope.IMAGE, key)
            for chain, key in zip(chains_by_key, keys, strict=True)
        ]
        words = torch.tensor([[s.key0 for s in streams], [s.key1 for s in streams]])
        return SampleDraws(Table(unique_chains), chains, words, [(0, 0)] * count, size)

    def _seed_generator(self) -> None:
        """Seed the generator for a call, or once in each place if the object has a seed."""
        words = self._place.words()
        if self._seed is None:
            number = int(torch.randint(1 << 62, ()))  # a worker's generator has its own seed
            self._random.manual_seed(seed_at(number, words))
        elif words != self._seeded:
            self._random.manual_seed(seed_at(self._seed, words))
            self._seeded = words

    def _all_chains(self) -> "Table":
        """Return the chains to draw from: a single chain if no value is drawn."""
        count = MAX_CHAINS if self._settings.draws else 1
        return Table([self._chain(str(number)) for number in range(count)])

    def _chain(self, name: str) -> Chain:
        """Return the chain of a sample's name, on which draws depend."""
        name = name if self._settings.draws else ""
        first, last = (stage_in(role).name for role in (StageRole.SENSOR, StageRole.LEVELS))
        make = partial(make_chain, start_at=first, until=last)
        return self._chains.get(name, lambda: make(self._settings.drawn(name)))


def _unpacked(planes: Tensor, order: Tensor) -> Tensor:
    """Return the mosaics of planes, (sample, 4, height, width).

    ``order`` is the plane of each pixel of a cell.
    """
    each = torch.arange(len(planes), device=planes.device)[:, None]
    mosaics: Tensor = functional.pixel_shuffle(planes[each, order], 2)[:, 0]
    return mosaics


def _packed(mosaics: Tensor, order: Tensor) -> Tensor:
    """Return the planes of mosaics, the inverse of :func:`_unpacked`."""
    each = torch.arange(len(mosaics), device=mosaics.device)[:, None]
    cells: Tensor = functional.pixel_unshuffle(mosaics[:, None], 2)
    return cells[each, order.argsort(1)]
