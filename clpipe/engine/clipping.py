"""The share of clipped pixels, which warns about renders in other units than the sensor's."""

import math

import numpy as np

from clpipe.chain.chain import Chain
from clpipe.engine.runner import Result
from clpipe.stage import Kind

WARNING_SHARE = 0.25  # the smallest share of clipped pixels that causes a warning

MIN_PIXELS = 1 << 18  # the fewest pixels to count in large images; counting all would take too long


def clipped_share(result: Result, chain: Chain) -> float | None:
    """Return the share of clipped pixels in the last image of a chain or in its patches, 0 to 1.

    A pixel is clipped if one of its channels has the largest display value or the white level of
    the raw. In large images only pixels on a grid are counted.

    Args:
        result: the result of an image.
        chain: the chain that made it.

    Returns:
        The share; None if the last image has no upper limit, or was not requested.
    """
    image = result.final if result.encoded is None else result.encoded
    # If only a raw is requested, the chain ends there: the raw is both final and kept.
    kept = [chain.step_named(name) for name, each in result.kept.items() if each is image]
    kind = kept[0].stage.writes if kept else chain.result
    clip_level: float | None = None
    if kind is Kind.DISPLAY:
        clip_level = 255 if result.encoded is not None else 1
    elif kind is Kind.RAW:
        context = kept[0].method.next_context(kept[0].context) if kept else chain.context_after
        clip_level = context.white_level
    if image is None or clip_level is None:
        return None
    has_channels = len(kind.channels) > 1
    image = image.reshape(-1, *image.shape[-1 - has_channels :])  # patches below each other
    step = max(math.isqrt(image.shape[0] * image.shape[1] // MIN_PIXELS), 1)
    sampled = image[::step, ::step]
    channels = sampled.reshape(*sampled.shape[:2], -1)
    # NumPy takes the largest of two arrays many times faster than that along a short axis.
    brightest = np.maximum.reduce([channels[..., i] for i in range(channels.shape[2])])
    return float(np.mean(brightest >= clip_level))


def clipping_text(share: float) -> str:
    """Return the warning about a share of clipped pixels.

    >>> clipping_text(0.997)
    '99.7 % of its pixels are clipped. Check exposure.ev, and whether its values are 0 to 255.'
    """
    text = f"{100 * share:.3g} % of its pixels are clipped"
    return f"{text}. Check exposure.ev, and whether its values are 0 to 255."
