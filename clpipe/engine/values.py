"""The values of kernel parameters that depend on an image's chain, size and noise key."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from clpipe.base.cache import BoundedCache, Identity
from clpipe.base.types import Array
from clpipe.chain.chain import Chain, cached_by_structure
from clpipe.engine.bindings import (
    ArgumentValue,
    Bind,
    EncodedCurves,
    ResamplingValue,
    StreamWord,
    Value,
)
from clpipe.engine.ir import Plan
from clpipe.reference.curve import compose, to_8_bit
from clpipe.reference.random import Stream
from clpipe.stage import Method, NoiseScope, Resample

TABLES: BoundedCache[Array] = BoundedCache(32)  # composed curves, by the curves' tables


def binding(
    chain: Chain,
    plan: Plan,
    size: tuple[int, int],
    noise_key: str,
) -> Bind:
    """Return a function that returns the values of kernel parameters for one image.

    Args:
        chain: the image's chain.
        plan: the chain's plan.
        size: width and height of the image in px.
        noise_key: the text from which the noise is seeded.
    """
    arguments = chain.arguments
    streams: dict[tuple[str, NoiseScope], Stream] = {}
    sizes = plan.sizes(*size)

    def non_argument(value: Value) -> Any:
        match value:
            case ResamplingValue(level, name):
                return plan.resamplings[level].values(*sizes[level])[name]
            case EncodedCurves(steps):
                return encoding_table([np.asarray(arguments[s]["table"]) for s in steps])
            case StreamWord(step, scope, word):
                if (step, scope) not in streams:
                    streams[step, scope] = chain.stream(step, scope, noise_key)
                return getattr(streams[step, scope], word)

    def bind(values: Sequence[Value]) -> list[Any]:
        return [
            arguments[each.step][each.name] if type(each) is ArgumentValue else non_argument(each)
            for each in values
        ]

    return bind


@cached_by_structure
def has_size_estimates(chain: Chain) -> bool:
    """Return whether a stage derives numbers from the size of the image."""
    return any(type(s.method).estimates_for is not Method.estimates_for for s in chain.steps)


def size_estimates(chain: Chain, width: int, height: int) -> dict[str, dict[str, float]]:
    """Return the numbers that steps derive from the size of their image, by step and name.

    ``width`` and ``height`` are those of the source in pixels.
    """
    found: dict[str, dict[str, float]] = {}
    for step in chain.steps if has_size_estimates(chain) else ():
        if values := step.method.estimates_for(width, height):
            found[step.name] = dict(values)
        for pass_ in step.passes:
            if isinstance(pass_.access, Resample):
                width, height = pass_.access.resampler.resized(width, height)
    return found


def encoding_table(curves: Sequence[Array]) -> Array:
    """Return one table for curves in a row and the conversion to eight bits.

    ``curves`` are the tables of the curves. Equal parameters must give the same table object.
    """

    def composed() -> Array:
        *first, last = curves
        table: Array = to_8_bit(last)
        for curve in reversed(first):
            table = compose(curve, table)
        return table

    return TABLES.get(tuple(map(Identity, curves)), composed)
