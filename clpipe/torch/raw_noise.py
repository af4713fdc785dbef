"""A camera's noise in clean raws, as a transform of tensors."""

from collections.abc import Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from clpipe.base.errors import ImageError, RequestError
from clpipe.base.readonly import ReadOnly
from clpipe.base.text import several
from clpipe.base.types import plain
from clpipe.base.validation import typed
from clpipe.chain.chain import Chain
from clpipe.chain.files import load_settings
from clpipe.chain.making import make_chain
from clpipe.chain.settings import overlay
from clpipe.stage import NoiseScope
from clpipe.torch.table import Drawn, Table

FIRST, LAST = "crosstalk", "normalize"
DRAWN = 1024  # chains, where something is drawn
ROOM = 512  # px, over the height and width of a sample: of a sensor's part that has places


class RawNoise(ReadOnly):
    """Puts a camera's noise into clean raws that are tensors, where these are: CPU or GPU.

    It is what :class:`clpipe.RawNoise` does, from ``crosstalk`` to ``normalize``: sensor noise,
    what a sensor does to rows, columns and single pixels, clipping and rounding to DN. Every sample
    has noise of its own, with a camera, an ISO and other values of its own where these are drawn.
    On a CPU a sample that has a key has the bits that the chain gives it for that ``noise_key``.

    It is differentiable in the clean raw: noise grows with the signal, clipping stops a gradient,
    and rounding lets it through; so does Poisson noise, whose own derivative is taken as 0.

    Args:
        camera: a name that ``clpipe cameras`` lists, or the TOML file of a profile;
            ``{"choice": [...]}`` is drawn.
        iso: its ISO; ``{"log_uniform": [800, 12800]}`` or another law is drawn for each sample.
        seed: None is other noise in each object; with a number, an object's calls give the same
            noise in the same order.
        config: a built-in configuration or a TOML file, or several.
        **settings: as for :class:`clpipe.Pipeline`, such as ``sensor_noise={"method": "poisson"}``.

    Raises:
        RequestError: a name or value that is not allowed, or a stage of one's own between the two.

    >>> add_noise = RawNoise("sony-a7r2", {"log_uniform": [800, 12800]}, seed=1)
    >>> noisy = add_noise(torch.full((8, 4, 32, 32), 0.2))
    >>> noisy.shape, bool(noisy.std() > 0)
    (torch.Size([8, 4, 32, 32]), True)
    """

    @typed
    def __init__(
        self,
        camera: str | Path | Mapping[str, Any],
        iso: float | Mapping[str, Any],
        *,
        seed: int | None = None,
        config: str | Path | Sequence[str | Path] = "default",
        **settings: Any,
    ) -> None:
        own = camera if isinstance(camera, Mapping) else str(camera)
        given = {**settings, "camera": own, "iso": iso, "seed": seed or 0}
        self._settings = overlay(load_settings(*several(config)), plain(given))
        self._random = torch.Generator()
        if seed is None:
            self._random.seed()
        else:
            self._random.manual_seed(seed)
        self._table: Table | None = None
        self._one = lru_cache(maxsize=DRAWN)(self._chain)
        Table([self._chain("")])  # refuses what has no twin

    def __repr__(self) -> str:
        return f"RawNoise({self._settings.label})"

    def __call__(self, raw: Tensor, keys: Sequence[str] | str | None = None) -> Tensor:
        """Raws with noise.

        Args:
            raw: linear signal, 0 is black and 1 is white, float32: a batch of mosaics, (raw, 1,
                height, width), with the camera's CFA pattern, or of their planes R, Gr, Gb, B,
                (raw, 4, height / 2, width / 2), where Gr is green in the rows of red; or one of
                them, without the first axis.
            keys: names of the raws, for noise that can be had again; give them others in each
                epoch. What is fixed to a sensor is then that of its upper left corner. None is new
                noise, and a place on the sensor, for each.

        Returns:
            The noisy raws, of the same shape, on the same device.

        Raises:
            ImageError: a tensor of another shape or type.
            RequestError: as many keys as there are raws are needed.
        """
        if raw.dim() not in (3, 4) or raw.shape[-3] not in (1, 4) or 0 in raw.shape:
            raise ImageError(
                f"found a tensor of shape {tuple(raw.shape)}; expected mosaics, (raw, 1, height, "
                "width), or their planes, (raw, 4, height / 2, width / 2), or one of these"
            )
        if raw.dtype != torch.float32:
            raise ImageError(f"found {raw.dtype}; expected torch.float32, in signal")
        if raw.dim() == 3:
            own = None if keys is None else [keys] if isinstance(keys, str) else keys
            one: Tensor = self(raw[None], own)[0]
            return one
        if keys is not None and (isinstance(keys, str) or len(keys) != len(raw)):
            raise RequestError(f"keys: found {keys!r}; expected {len(raw)}, one for each raw")
        drawn = self._drawn(raw, keys)
        table = drawn.table
        order = table.planes[torch.from_numpy(drawn.chains)].to(raw.device)
        mosaics = raw[:, 0] if raw.shape[1] == 1 else _unpacked(raw, order)
        if raw.shape[1] == 1 and bool((table.planes != table.planes[0]).any()):
            raise RequestError(
                f"{self!r}: the cameras have several CFA patterns; give planes, (raw, 4, ...)"
            )
        noisy = table.noisy(mosaics, drawn)
        return noisy[:, None] if raw.shape[1] == 1 else _packed(noisy, order)

    def _drawn(self, raw: Tensor, keys: Sequence[str] | None) -> "Drawn":
        """What is drawn for raws."""
        count, cell = len(raw), 2 if raw.shape[1] == 4 else 1
        size = cell * raw.shape[2], cell * raw.shape[3]
        if keys is None:
            self._table = self._table or self._of_all()
            table = self._table

            def random(high: int, *shape: int) -> Tensor:
                return torch.randint(high, shape, generator=self._random)

            chains = random(len(table.chains), count).numpy()
            corners = (2 * random(ROOM // 2, count, 2)).tolist()
            places = [(row, column) for row, column in corners]
            area = size[0] + ROOM, size[1] + ROOM
            return Drawn(table, chains, random(1 << 32, 2, count), places, area)
        chains_of = [self._one(key) for key in keys]
        distinct = list({id(chain): chain for chain in chains_of}.values())
        table = Table(distinct)
        chains = np.array(
            [next(i for i, c in enumerate(distinct) if c is own) for own in chains_of]
        )
        streams = [
            chain.stream(chain.steps[0].name, NoiseScope.IMAGE, key)
            for chain, key in zip(chains_of, keys, strict=True)
        ]
        words = torch.tensor([[s.key0 for s in streams], [s.key1 for s in streams]])
        return Drawn(table, chains, words, [(0, 0)] * count, size)

    def _of_all(self) -> "Table":
        """The chains that are drawn from: one where nothing is drawn."""
        count = DRAWN if self._settings.draws else 1
        return Table([self._chain(str(number)) for number in range(count)])

    def _chain(self, name: str) -> Chain:
        """The chain of a sample's name, on which draws depend; one where there are none."""
        if not self._settings.draws:
            name = ""
        return make_chain(self._settings.drawn(name), start_at=FIRST, until=LAST)


def _unpacked(planes: Tensor, order: Tensor) -> Tensor:
    """Mosaics of planes, (sample, 4, height, width); ``order`` has each place's plane."""
    each = torch.arange(len(planes), device=planes.device)[:, None]
    mosaics: Tensor = functional.pixel_shuffle(planes[each, order], 2)[:, 0]
    return mosaics


def _packed(mosaics: Tensor, order: Tensor) -> Tensor:
    """The planes of mosaics, as :func:`_unpacked` takes them."""
    each = torch.arange(len(mosaics), device=mosaics.device)[:, None]
    places: Tensor = functional.pixel_unshuffle(mosaics[:, None], 2)
    return places[each, order.argsort(1)]
