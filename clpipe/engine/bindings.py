"""Bindings: the values and buffers that the parameters of a kernel stand for at a launch.

They are tuples because these classes are made seven times faster than dataclasses.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

from clpipe.stage import NoiseScope


class Buffer(NamedTuple):
    """A buffer on the device.

    Args:
        name: "src" and "dst" for the image that is sent and the pixels that are encoded, else as in
            :func:`~clpipe.engine.tiles.buffer_sizes`.
        written: whether the kernel writes it; else it only reads it.
    """

    name: str
    written: bool


class ExtentNumber(NamedTuple):
    """A number of the tile's extent, or of the ``larger`` image's that it is resampled from."""

    name: str
    larger: bool = False


class TileNumber(NamedTuple):
    """The number of tiles before this one."""


class ArgumentValue(NamedTuple):
    """A run-time argument of a step."""

    step: str
    name: str


class StreamWord(NamedTuple):
    """A word of a step's random stream: an attribute of :class:`clpipe.reference.random.Stream`."""

    step: str
    scope: NoiseScope
    word: str


class EncodedCurves(NamedTuple):
    """One table for the curves of these steps and the conversion to eight bits."""

    steps: tuple[str, ...]


class ResamplingValue(NamedTuple):
    """A value of the resampling that leads on from a level."""

    level: int
    name: str


# What follows from the image's chain, its key and its size.
Value = ArgumentValue | StreamWord | EncodedCurves | ResamplingValue

Bind = Callable[[Sequence[Value]], list[Any]]  # returns NumPy scalars and arrays


Bound = Buffer | ExtentNumber | TileNumber | Value


class Parameter(NamedTuple):
    """One kernel parameter: its OpenCL declaration, and what is bound to it.

    What is bound is not part of the kernel's text.
    """

    declaration: str
    bound: Bound


def slot_buffer(number: int) -> str:
    """The name of a slot's buffer."""
    return f"slot{number}"


def step_buffer(content: str, step: str) -> str:
    """The name of a step's buffer: sums, partials, counts, histogram, estimates, a line table."""
    return f"{content}.{step}"
