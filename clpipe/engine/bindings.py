"""Bindings: the values and buffers that a launch passes to the parameters of a kernel.

These classes are named tuples, because Python creates them seven times faster than dataclasses.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

from clpipe.stage import NoiseScope


class Buffer(NamedTuple):
    """A buffer on the device.

    Args:
        name: "src" for the uploaded image, "dst" for the encoded pixels, else a name of
            :func:`~clpipe.engine.tiles.buffer_sizes`.
        written: whether the kernel writes to it.
    """

    name: str
    written: bool


class ExtentNumber(NamedTuple):
    """A number of the tile's extent or, if ``of_input``, of the extent that is resampled."""

    name: str
    of_input: bool = False


class StripNumber(NamedTuple):
    """The "columns" or "rows" of a strip; see :mod:`clpipe.engine.bands`."""

    name: str


class TileNumber(NamedTuple):
    """The number of this tile, from 0."""


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
    """A value of the resampling from a level to the next."""

    level: int
    name: str


# The values that depend on the image's chain, noise key and size.
Value = ArgumentValue | StreamWord | EncodedCurves | ResamplingValue

Bind = Callable[[Sequence[Value]], list[Any]]  # returns NumPy scalars and arrays


Binding = Buffer | ExtentNumber | TileNumber | StripNumber | Value


class Parameter(NamedTuple):
    """One kernel parameter: its OpenCL declaration, and the value or buffer bound to it.

    The binding is not part of the kernel's source.
    """

    declaration: str
    binding: Binding


RINGS = "rings"  # the buffer of the rows between launches that run in bands


def slot_buffer(number: int) -> str:
    """Return the name of a slot's buffer."""
    return f"slot{number}"


def step_buffer(content: str, step: str) -> str:
    """Return the name of a step's buffer.

    ``content`` is "sums", "partials", "counts", "histogram", "estimates" or a line table's name.
    """
    return f"{content}.{step}"
