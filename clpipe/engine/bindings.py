"""Bindings: the values and buffers that the parameters of a kernel stand for at a launch."""

from dataclasses import dataclass

from clpipe.stage import NoiseScope


@dataclass(frozen=True)
class Buffer:
    """A buffer on the device.

    Args:
        name: "src" and "dst" for the image that is sent and the pixels that are encoded, else as in
            :func:`~clpipe.engine.tiles.buffer_sizes`.
        written: whether the kernel writes it; else it only reads it.
    """

    name: str
    written: bool


@dataclass(frozen=True)
class ExtentNumber:
    """A number of the tile's extent, or of the ``larger`` image's that it is resampled from."""

    name: str
    larger: bool = False


@dataclass(frozen=True)
class TileNumber:
    """The number of tiles before this one."""


@dataclass(frozen=True)
class ArgumentValue:
    """A run-time argument of a step."""

    step: str
    name: str


@dataclass(frozen=True)
class StreamWord:
    """A word of a step's random stream: an attribute of :class:`clpipe.reference.random.Stream`."""

    step: str
    scope: NoiseScope
    word: str


@dataclass(frozen=True)
class EncodedCurves:
    """One table for the curves of these steps and the conversion to eight bits."""

    steps: tuple[str, ...]


@dataclass(frozen=True)
class ResamplingValue:
    """A value of the resampling that leads on from a level."""

    level: int
    name: str


# What follows from the image's chain, its key and its size.
Value = ArgumentValue | StreamWord | EncodedCurves | ResamplingValue


Bound = Buffer | ExtentNumber | TileNumber | Value


@dataclass(frozen=True)
class Parameter:
    """One kernel parameter: its OpenCL declaration, and what is bound to it.

    What is bound is not part of the kernel's text.
    """

    declaration: str
    bound: Bound


def slot_buffer(number: int) -> str:
    """The name of a slot's buffer."""
    return f"slot{number}"


def step_buffer(content: str, step: str) -> str:
    """The name of a step's buffer: its lines, sums, partials, counts, histogram or estimates."""
    return f"{content}.{step}"
