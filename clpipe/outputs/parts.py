"""What files hold of a result: all of it, or its patches, in the types of their formats. Pure."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from operator import itemgetter

import numpy as np

from clpipe.base.types import Array, Floats
from clpipe.chain.formats import Format
from clpipe.engine.runner import Result
from clpipe.outputs.patches import Patch, variance_at
from clpipe.outputs.recipes import Recipe
from clpipe.reference.curve import to_16_bit
from clpipe.stage import Kind


def parts_of(
    recipe: Recipe, result: Result, patches: Sequence[Patch]
) -> Iterator[tuple[int | None, Result]]:
    """What is written of a result: all of it, or each of its patches, turned, with its number.

    The last image of a variance map becomes the variance.
    """
    if not patches:
        yield None, with_variance(result, recipe, None)
    for number, patch in enumerate(patches):
        part = with_variance(mapped(result, itemgetter(number)), recipe, patch)
        yield number, mapped(part, patch.turned)


def with_variance(result: Result, recipe: Recipe, patch: Patch | None) -> Result:
    """A result whose last image is the variance of the noise, if the rendition is a map of it."""
    if not recipe.noise:
        return result
    assert result.final is not None
    return replace(result, final=variance_at(recipe.noise, result.final, patch))


def mapped(result: Result, change: Callable[[Array], Array]) -> Result:
    """A result whose images are changed."""
    return Result(
        None if result.final is None else change(result.final),
        None if result.encoded is None else change(result.encoded),
        {name: change(image) for name, image in result.kept.items()},
        result.estimates,
    )


def samples(result: Result, format_: Format) -> Array:
    """The last image as a format for display holds it: uint8, uint16 or float32."""
    if format_.bits == 8:
        assert result.encoded is not None
        return result.encoded
    assert result.final is not None
    return result.final if format_.floats else to_16_bit(result.final)


def typed(image: Floats, kind: Kind, white_level: float | None = None) -> Array:
    """An image as ``.npy`` holds it: uint16 in DN, float16 of display values, else float32.

    DN of more than 16 bits, by their white level, are uint32.

    >>> typed(np.array([[511.0, 7e4]]), Kind.RAW)
    array([[  511, 65535]], dtype=uint16)
    """
    if kind is Kind.RAW:
        dtype = np.uint16 if white_level is None or white_level <= 65535 else np.uint32
        return np.clip(np.rint(image), 0, np.iinfo(dtype).max).astype(dtype)
    return image.astype(np.float16 if kind is Kind.DISPLAY else np.float32, copy=False)
