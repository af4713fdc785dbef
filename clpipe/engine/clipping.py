"""The clipped share of a picture: a render in other units than the sensor's comes out white."""

import math

import numpy as np

from clpipe.chain.chain import Chain
from clpipe.engine.runner import Result
from clpipe.stage import Kind

MUCH = 0.25  # the share of clipped pixels from which on it is said

COUNTED = 1 << 18  # pixels, at least, where an image has as many; all would take too long


def clipped_share(result: Result, chain: Chain) -> float | None:
    """The share of clipped pixels in the last image of a chain, or in its patches, 0 to 1.

    A pixel is clipped where any of its channels is at the upper end: that of display values, or the
    white level of a raw. Of large images, pixels on a grid are counted.

    Args:
        result: what was made of an image.
        chain: by which it was made.

    Returns:
        None where the last image has no upper end, or was not asked for.
    """
    image = result.final if result.encoded is None else result.encoded
    # Of a chain that only has to give a raw, no more than that is run: it is final and kept.
    kept = [chain.step_named(name) for name, each in result.kept.items() if each is image]
    kind = kept[0].stage.writes if kept else chain.result
    top: float | None = None
    if kind is Kind.DISPLAY:
        top = 255 if result.encoded is not None else 1
    elif kind is Kind.RAW:
        after = kept[0].method.next_context(kept[0].context) if kept else chain.context_after
        top = after.white_level
    if image is None or top is None:
        return None
    has_channels = len(kind.channels) > 1
    image = image.reshape(-1, *image.shape[-1 - has_channels :])  # patches below each other
    step = max(math.isqrt(image.shape[0] * image.shape[1] // COUNTED), 1)
    counted = image[::step, ::step]
    channels = counted.reshape(*counted.shape[:2], -1)
    # NumPy takes the largest of two arrays many times faster than that along a short axis.
    brightest = np.maximum.reduce([channels[..., i] for i in range(channels.shape[2])])
    return float(np.mean(brightest >= top))


def clipping_text(share: float) -> str:
    """The warning about a share of clipped pixels.

    >>> clipping_text(0.997)
    '99.7 % of its pixels are clipped. Check exposure.ev, and whether its values are 0 to 255.'
    """
    text = f"{100 * share:.3g} % of its pixels are clipped"
    return f"{text}. Check exposure.ev, and whether its values are 0 to 255."
