"""TODO."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from clpipe.analysis.statistics import Mask
from clpipe.base.errors import ImageError, RequestError
from clpipe.base.types import Floats
from clpipe.chain.chain import make_chain
from clpipe.chain.settings import Settings
from clpipe.images.read import holds_mosaic, read_finished, read_image
from clpipe.inputs.kept import carried_settings
from clpipe.reference.cfa import Pattern
from clpipe.stage import Context, Kind

SITES = ("R", "G1", "G2", "B")  # G1 stands in the rows of red
WHOLE = "mosaic"  # the channel that is all sites together


@dataclass(frozen=True)
class Picture:
    """An image to be measured.

    ``kind`` is display, rgb, mosaic (signal) or values (a mosaic that does not say its levels);
    ``pixels`` is (height, width, 3) or (height, width). Samples at ``black`` and ``white``, and
    beyond, are clipped; None where nothing is known to be.
    """

    path: Path
    kind: str
    pixels: Floats
    pattern: Pattern = "RGGB"
    black: float | None = None
    white: float | None = None
    balance: str = ""  # which white balance gains a kept mosaic is without and with
    iso: float | None = None  # of an image that clpipe kept

    @property
    def what(self) -> str:
        """Kind and size in words."""
        height, width = self.pixels.shape[:2]
        name = "mosaic that does not say its levels" if self.kind == "values" else self.kind
        bayer = f" {self.pattern}" if self.pixels.ndim == 2 else ""
        return f"{name}{bayer}, {width}x{height}"

    def clipped(self) -> Mask:
        """True where a sample is at the end of its range; the shape is that of the pixels."""
        clipped = np.zeros(self.pixels.shape, bool)
        if self.kind == "rgb":
            # Below 0 is nothing special here; exactly 0 is what clipping leaves.
            clipped |= self.pixels == 0
        if self.black is not None:
            clipped |= self.pixels <= self.black
        if self.white is not None:
            clipped |= self.pixels >= self.white
        return clipped


def load_picture(path: Path, pattern: Pattern = "RGGB") -> Picture:
    """Read an image of any stage: a kept EXR, a render, a mosaic, a finished picture.

    A kept raw is turned from DN to signal by its own levels. A mosaic that carries no settings is
    taken as it is, with ``pattern``.

    Raises:
        ImageError: it cannot be read, or the settings that it carries are of no use.
    """
    finished = read_finished(path)
    if finished is not None:
        return Picture(path, "display", finished.pixels, black=0.0, white=1.0)
    mosaic = holds_mosaic(path)
    source = read_image(path, mosaic)
    pixels = source.pixels.astype(np.float32)
    kind = source.attributes.get("kind")
    try:
        settings = carried_settings(source.attributes)
        context = context_after(settings, source.attributes.get("stage")) if settings else None
    except RequestError as error:
        raise ImageError(f"{path}: what it was made with cannot be used: {error}") from None
    iso = context.iso if context else None
    if not mosaic:
        if kind == Kind.DISPLAY.label:
            return Picture(path, "display", pixels, black=0.0, white=1.0, iso=iso)
        return Picture(path, "rgb", pixels, white=1.0, iso=iso)
    if context is None:
        return Picture(path, "values", pixels, pattern)
    without, with_ = (
        f"red {red:g}, blue {blue:g}" for red, blue in (context.gains, context.applied_gains)
    )
    balance = f"without the gains {without} and with the gains {with_}"
    black, white = context.black_level, context.white_level
    if black is None or white is None:  # not digitised: nothing clips below
        clean = Picture(path, "mosaic", pixels, context.pattern, white=1.0)
        return replace(clean, balance=balance, iso=iso)
    lowest = -black / (white - black)
    if kind == Kind.RAW.label:
        pixels = (pixels - np.float32(black)) / np.float32(white - black)
    return Picture(path, "mosaic", pixels, context.pattern, lowest, 1.0, balance, iso)


def context_after(settings: Settings, stage: str | None) -> Context:
    """What is known of an image after a step of the chain of some settings.

    Raises:
        RequestError: the chain has no such step.
    """
    step = make_chain(settings).step_named(stage or "")
    return step.method.after(step.context)
