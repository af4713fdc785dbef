"""What the renditions of many images share on a device: runners, and memory for results."""

import threading
from collections import deque

from clpipe.base.errors import ImageError, RequestError
from clpipe.base.types import Array
from clpipe.chain.chain import Chain
from clpipe.chain.rendition import FIRST
from clpipe.engine.device import Device
from clpipe.engine.runner import Runner
from clpipe.outputs.recipes import Recipe
from clpipe.outputs.writer import OutputWriter


class Runners:
    """The runners of one device. Chains of one structure share plans and compiled kernels.

    Args:
        writer: what of a rendition is written.
        device: where to run; None is NumPy.
        chain: that of the first image; its kernels are compiled.
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
        first = writer.runner(Recipe(FIRST, chain, (), ""), device)
        try:
            first.compile(half)
        except ImageError as error:  # not even one of 8x8 pixels fits
            raise RequestError(f"--memory: too little for any image: {error}") from None
        self._latest = [(chain, first)]
        self._by_results = {(first.keep, first.encode, first.final): first}

    def of(self, recipe: Recipe) -> Runner:
        """The runner of a rendition."""
        for chain, runner in self._latest:
            if chain is recipe.chain:
                return runner
        runner = self._writer.runner(recipe, self._device)
        alike = self._by_results.setdefault((runner.keep, runner.encode, runner.final), runner)
        if alike is not runner:
            runner = alike.for_chain(recipe.chain)  # shares the plans
        self._latest.insert(1, (recipe.chain, runner))
        del self._latest[4:]
        return runner


class SpareArrays:
    """Arrays that are not used any more, to be used again: new memory costs time.

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
        """An array of that shape; None where there is none."""
        with self._lock:
            for place, array in enumerate(self._arrays):
                if array.shape == shape:
                    del self._arrays[place]
                    return array
        return None

    def give(self, array: Array) -> None:
        """Take back an array that may be used again; beyond ``count`` the oldest is dropped."""
        with self._lock:
            self._arrays.append(array)
