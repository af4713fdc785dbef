"""Many chains in parallel: the values that each stage needs of each of them, as tensors."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from clpipe.base.errors import RequestError
from clpipe.chain.chain import Chain, Step
from clpipe.reference.cfa import sites
from clpipe.reference.random import Stream
from clpipe.stage import NoiseScope, SignalMethod
from clpipe.stage.signal import scalar_arguments
from clpipe.torch.backend import TorchBackend
from clpipe.torch.numbers import Streams

AT_ONCE = 1 << 17  # pixels on a CPU, which fit its cache


@dataclass(frozen=True)
class Drawn:
    """The drawn values for the samples of a batch.

    Args:
        table: the chains.
        chains: the number of each sample's chain; (sample,).
        keys: the keys of the noise, (2, sample).
        places: row and column of the upper left corner on the sensor.
        area: height and width of the part of a sensor that contains the places.
    """

    table: "Table"
    chains: NDArray[np.intp]
    keys: Tensor
    places: Sequence[tuple[int, int]]
    area: tuple[int, int]


@dataclass(frozen=True)
class Variant:
    """One method of a stage, and the chains that have it.

    Args:
        method: the method.
        steps: the step of each chain; None if it has another method.
        sensors: for each chain, the stream of values that are fixed to its camera.
        numbers: the kernel's arguments by name, (chain,); 0 for chains with another method.
        stage: the stage's number in random streams.
    """

    method: type[SignalMethod]
    steps: Sequence[Step | None]
    sensors: Sequence[Stream]
    numbers: dict[str, NDArray[np.float32]]
    stage: int

    def noisy(self, mosaics: Tensor, drawn: Drawn, samples: NDArray[np.intp]) -> Tensor:
        """Return the mosaics of a batch after this method, which changes those of its chains."""
        chains = drawn.chains[samples]
        has = np.array([self.steps[chain] is not None for chain in chains])
        if not has.any():
            return mosaics
        own, on = mosaics, mosaics.device
        if not has.all():
            rows = torch.from_numpy(np.flatnonzero(has)).to(on)
            own, samples, chains = mosaics[rows], samples[has], chains[has]
        values = np.array([each[chains] for each in self.numbers.values()], np.float32)
        tensors = torch.from_numpy(values).to(on)[..., None, None]
        backend = TorchBackend(
            steps=[step for chain in chains if (step := self.steps[chain])],
            streams=Streams(drawn.keys[:, torch.from_numpy(samples)].to(on), self.stage),
            sensors=[self.sensors[chain] for chain in chains],
            places=[drawn.places[sample] for sample in samples],
            area=drawn.area,
            size=(mosaics.shape[1], mosaics.shape[2]),
        )
        numbers = dict(zip(self.numbers, tensors, strict=True))
        noisy = self.method.apply(own, numbers, backend)
        return noisy if has.all() else mosaics.index_copy(0, rows, noisy)


class Table:
    """Chains from a clean mosaic to the noisy one.

    Args:
        chains: the chains, all with the same steps.

    Raises:
        RequestError: a method does not run on tensors.
    """

    def __init__(self, chains: Sequence[Chain]) -> None:
        self.chains = chains
        self._variants = [
            variant
            for position in range(len(chains[0].steps))
            for variant in _variants(chains, position)
        ]
        # For each chain, the plane (R, Gr, Gb, B) of each site of the filter array, by rows.
        orders = []
        for chain in chains:
            named = sites(chain.context_after.pattern).values()
            places = [2 * row.start + column.start for row, column in named]
            orders.append(np.argsort(places))
        self.planes = torch.from_numpy(np.stack(orders))

    def noisy(self, mosaics: Tensor, drawn: Drawn) -> Tensor:
        """Return mosaics with noise, (sample, height, width)."""
        at_once = len(mosaics)
        if mosaics.device.type == "cpu":
            at_once = max(1, AT_ONCE // (mosaics.shape[1] * mosaics.shape[2]))
        parts = []
        for begin in range(0, len(mosaics), at_once):
            part = mosaics[begin : begin + at_once]
            samples = np.arange(begin, begin + len(part))
            for variant in self._variants:
                part = variant.noisy(part, drawn, samples)
            parts.append(part)
        return parts[0] if len(parts) == 1 else torch.cat(parts)


def _variants(chains: Sequence[Chain], position: int) -> list[Variant]:
    """Return the methods of a step that are not empty, each with the chains that have it.

    Raises:
        RequestError: a method does not run on tensors.
    """
    found: dict[tuple[object, ...], dict[int, Step]] = {}
    for number, chain in enumerate(chains):
        step = chain.steps[position]
        if passes := step.passes:
            alike = type(step.method), *(each.function for each in passes)
            found.setdefault(alike, {})[number] = step
    variants = []
    for steps in found.values():
        number, example = next(iter(steps.items()))
        method = type(example.method)
        if not issubclass(method, SignalMethod) or not method.on_tensors():
            raise RequestError(
                f"{example.name}.method={example.method.method} is not available in "
                "clpipe.torch; use clpipe.RawNoise"
            )
        arguments = {number: scalar_arguments(step.arguments) for number, step in steps.items()}
        numbers = {
            name: np.array(
                [arguments[k][name] if k in steps else 0 for k in range(len(chains))], np.float32
            )
            for name in arguments[number]
        }
        sensors = [chain.stream(example.name, NoiseScope.CAMERA, "") for chain in chains]
        stage = sensors[0].stage
        own = [steps.get(k) for k in range(len(chains))]
        variants.append(Variant(method, own, sensors, numbers, stage))
    return variants
