"""Many chains in parallel, with the values of each stage as tensors."""

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

CPU_BATCH_PIXELS = 1 << 17  # pixels per batch on a CPU, which fit into its cache


@dataclass(frozen=True)
class SampleDraws:
    """The drawn values for the samples of a batch.

    Args:
        table: the chains.
        chains: the number of each sample's chain; (sample,).
        keys: the keys of the noise, (2, sample).
        positions: row and column of the upper left corner on the sensor.
        area: height and width of the part of a sensor that contains the positions.
    """

    table: "Table"
    chains: NDArray[np.intp]
    keys: Tensor
    positions: Sequence[tuple[int, int]]
    area: tuple[int, int]


@dataclass(frozen=True)
class Variant:
    """One method of a stage, and the chains that have it.

    Args:
        method: the method.
        steps: the step of each chain; None if it has another method.
        sensors: for each chain, the stream of values that are fixed to its camera.
        numbers: the kernel's arguments by name, (chain,); 0 for chains with another method.
    """

    method: type[SignalMethod]
    steps: Sequence[Step | None]
    sensors: Sequence[Stream]
    numbers: dict[str, NDArray[np.float32]]

    def noisy(self, mosaics: Tensor, draws: SampleDraws, samples: NDArray[np.intp]) -> Tensor:
        """Return the mosaics of a batch after this method, which changes those of its chains."""
        chains = draws.chains[samples]
        has_method = np.array([self.steps[chain] is not None for chain in chains])
        if not has_method.any():
            return mosaics
        selected, device = mosaics, mosaics.device
        if not has_method.all():
            rows = torch.from_numpy(np.flatnonzero(has_method)).to(device)
            selected, samples, chains = mosaics[rows], samples[has_method], chains[has_method]
        values = np.array([each[chains] for each in self.numbers.values()], np.float32)
        tensors = torch.from_numpy(values).to(device)[..., None, None]
        stage = self.sensors[0].stage
        backend = TorchBackend(
            steps=[step for chain in chains if (step := self.steps[chain])],
            streams=Streams(draws.keys[:, torch.from_numpy(samples)].to(device), stage),
            sensors=[self.sensors[chain] for chain in chains],
            positions=[draws.positions[sample] for sample in samples],
            area=draws.area,
            size=(mosaics.shape[1], mosaics.shape[2]),
        )
        numbers = dict(zip(self.numbers, tensors, strict=True))
        noisy = self.method.apply(selected, numbers, backend)
        return noisy if has_method.all() else mosaics.index_copy(0, rows, noisy)


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
        # For each chain, the plane (R, Gr, Gb, B) of each site of the filter array, row by row.
        plane_orders = []
        for chain in chains:
            site_slices = sites(chain.context_after.pattern).values()
            positions = [2 * row.start + column.start for row, column in site_slices]
            plane_orders.append(np.argsort(positions))
        self.planes = torch.from_numpy(np.stack(plane_orders))

    def noisy(self, mosaics: Tensor, draws: SampleDraws) -> Tensor:
        """Return mosaics with noise, (sample, height, width)."""
        batch_size = len(mosaics)
        if mosaics.device.type == "cpu":
            batch_size = max(1, CPU_BATCH_PIXELS // (mosaics.shape[1] * mosaics.shape[2]))
        parts = []
        for begin in range(0, len(mosaics), batch_size):
            part = mosaics[begin : begin + batch_size]
            samples = np.arange(begin, begin + len(part))
            for variant in self._variants:
                part = variant.noisy(part, draws, samples)
            parts.append(part)
        return parts[0] if len(parts) == 1 else torch.cat(parts)


def _variants(chains: Sequence[Chain], position: int) -> list[Variant]:
    """Return the methods of a step that are not empty, each with the chains that have it.

    Raises:
        RequestError: a method does not run on tensors.
    """
    steps_by_signature: dict[tuple[object, ...], dict[int, Step]] = {}
    for number, chain in enumerate(chains):
        step = chain.steps[position]
        if passes := step.passes:
            signature = type(step.method), *(each.function for each in passes)
            steps_by_signature.setdefault(signature, {})[number] = step
    variants = []
    for steps in steps_by_signature.values():
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
        chain_steps = [steps.get(k) for k in range(len(chains))]
        variants.append(Variant(method, chain_steps, sensors, numbers))
    return variants
