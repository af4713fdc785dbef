"""What renditions share on a device: runners, and arrays for results."""

import threading
from collections import deque

from clpipe.base.errors import ImageError, RequestError
from clpipe.base.types import Array
from clpipe.chain.chain import Chain
from clpipe.chain.rendition import DEFAULT_RENDITION
from clpipe.engine.device import Device
from clpipe.engine.runner import Runner
from clpipe.outputs.recipes import Recipe
from clpipe.outputs.writer import OutputWriter


class Runners:
    """The runners of one device. Chains of equal structure share plans and compiled kernels.

    Args:
        writer: decides which results of a rendition are needed.
        device: the device; None is NumPy.
        chain: the chain of the first image, whose kernels are compiled.
        half: whether images are expected in half floats.

    Raises:
        RequestError: the memory of the device is too small for any image.
        DeviceError: a kernel does not compile.
    """

    def __init__(
        self, writer: OutputWriter, device: Device | None, chain: Chain, half: bool
    ) -> None:
        self._writer = writer
        self._device = device
        first = writer.runner(Recipe(DEFAULT_RENDITION, chain, (), ""), device)
        try:
            first.compile(half)
        except ImageError as error:  # the memory is not enough for 8x8 pixels
            raise RequestError(f"--memory: too little for any image: {error}") from None
        self._latest = [(chain, first)]
        self._by_results = {(first.keep, first.encode, first.final): first}

    def of(self, recipe: Recipe) -> Runner:
        """Return the runner of a rendition."""
        for chain, runner in self._latest:
            if chain is recipe.chain:
                return runner
        runner = self._writer.runner(recipe, self._device)
        existing = self._by_results.setdefault((runner.keep, runner.encode, runner.final), runner)
        if existing is not runner:
            runner = existing.for_chain(recipe.chain)  # shares the plans
        self._latest.insert(1, (recipe.chain, runner))
        del self._latest[4:]
        return runner


class SpareArrays:
    """Arrays to be used again, because allocating new memory costs time.

    >>> import numpy as np
    >>> spare = SpareArrays(2)
    >>> spare.give(np.zeros((2, 3)))
    >>> spare.take((3, 2)) is None, spare.take((2, 3)).shape, spare.take((2, 3)) is None
    (True, (2, 3), True)
    """

    def __init__(self, count: int) -> None:
        self._arrays: deque[Array] = deque(maxlen=count)
        self._lock = threading.Lock()  # guards the arrays

    def take(self, shape: tuple[int, ...]) -> Array | None:
        """Return an array of a shape, or None if there is none."""
        with self._lock:
            for place, array in enumerate(self._arrays):
                if array.shape == shape:
                    del self._arrays[place]
                    return array
        return None

    def give(self, array: Array) -> None:
        """Add an array. If there are more than ``count``, the oldest is dropped."""
        with self._lock:
            self._arrays.append(array)
