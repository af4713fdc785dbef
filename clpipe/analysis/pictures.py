"""Loads images to measure, from files of any stage, with their kind, levels and clipping."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from clpipe.base.errors import ImageError, RequestError
from clpipe.base.types import Floats, Mask
from clpipe.chain.making import make_chain
from clpipe.chain.settings import Settings
from clpipe.images.raw import RAW_SUFFIXES
from clpipe.images.read import SourceImage, read_finished, read_image
from clpipe.images.samples import holds_mosaic, photograph_info
from clpipe.inputs.kept import embedded_settings
from clpipe.stage import Context, Kind

WHOLE = "mosaic"  # the channel of all sites together


@dataclass(frozen=True)
class Picture:
    """An image whose noise is measured.

    ``kind`` is display, rgb, mosaic (signal) or values (a mosaic of unknown levels). ``pixels`` is
    (height, width, 3) or (height, width). Samples at or beyond ``black`` and ``white`` are clipped;
    None means that the limit is not known.
    """

    path: Path
    kind: str
    pixels: Floats
    pattern: str = "RGGB"  # a Bayer pattern, or rows of letters
    black: float | None = None
    white: float | None = None
    # For a kept mosaic, the white balance gains that were removed and applied, as text.
    balance: str = ""
    iso: float | None = None  # None if the file does not state it
    step: float = 0.0  # rounding step of a finished picture
    is_coded: bool = False  # whether it is a frame of a video, from which a codec removes noise

    @property
    def what(self) -> str:
        """The kind, pattern and size as text."""
        height, width = self.pixels.shape[:2]
        name = "mosaic without known levels" if self.kind == "values" else self.kind
        bayer = f" {self.pattern}" if self.pixels.ndim == 2 else ""
        return f"{name}{bayer}, {width}x{height}"

    def clipped(self) -> Mask:
        """A mask that is True for clipped samples, with the shape of the pixels."""
        clipped = np.zeros(self.pixels.shape, bool)
        if self.kind == "rgb":
            # Linear RGB may be negative, but clipped values are exactly 0.
            clipped |= self.pixels == 0
        if self.black is not None:
            clipped |= self.pixels <= self.black
        if self.white is not None:
            clipped |= self.pixels >= self.white
        return clipped


def load_picture(path: Path, pattern: str = "RGGB") -> Picture:
    """Read an image of any stage: a kept EXR, a render, a mosaic or a finished picture.

    A kept raw is converted from DN to signal with its levels. A mosaic without clpipe's settings
    stays in the unit of the file, and gets ``pattern``.

    Raises:
        ImageError: the file cannot be read, is a camera raw, or its settings are invalid.
    """
    if path.suffix.lower() in RAW_SUFFIXES:  # some raws also contain a small picture
        raise ImageError(
            f"{path}: this command does not read camera raws. First run 'clpipe run' with "
            "'--format png' to develop the raw, or with '--keep normalize' to keep its mosaic"
        )
    iso, bits = photograph_info(path)
    # 8-bit grey is a picture; grey of more bits may be a mosaic.
    finished = read_finished(path, grey=bits == 8)
    if finished is not None:
        step = 1 / (2**bits - 1)
        return Picture(path, "display", finished.pixels, black=0.0, white=1.0, iso=iso, step=step)
    mosaic = holds_mosaic(path)
    source = read_image(path, mosaic)
    pixels = source.pixels.astype(np.float32)
    kind = source.attributes.get("kind")
    try:
        settings = embedded_settings(source.attributes)
        context = context_after(settings, source.attributes.get("stage")) if settings else None
    except RequestError as error:
        raise ImageError(f"{path}: the settings in this file are invalid: {error}") from None
    iso = context.iso if context else None
    if not mosaic:
        if kind == Kind.DISPLAY.label:
            shown = np.clip(pixels, 0, 1)  # like finished pictures
            return Picture(path, "display", shown, black=0.0, white=1.0, iso=iso)
        return Picture(path, "rgb", pixels, white=1.0, iso=iso)
    if context is None:
        return Picture(path, "values", pixels, pattern)
    removed, applied = (
        f"red {red:g}, blue {blue:g}" for red, blue in (context.gains, context.applied_gains)
    )
    balance = f"without the gains {removed} and with the gains {applied}"
    black, white, full = context.black_level, context.white_level, np.float32(context.full_scale)
    pattern, highest = context.filter_array.pattern, float(full)
    own = Picture(path, "mosaic", pixels, pattern, white=highest, balance=balance, iso=iso)
    if black is None or white is None:  # not digitised, so nothing is clipped at black
        return own
    if kind == Kind.RAW.label and context.knots:
        raise ImageError(
            f"{path}: a curve has compressed its DN; give the image that is kept after the "
            "next stage, which undoes the curve"
        )
    if kind == Kind.RAW.label:
        pixels = (pixels - np.float32(black)) / np.float32(white - black) * full
    return replace(own, pixels=pixels, black=float(-black / (white - black) * full))


def context_after(settings: Settings, stage: str | None) -> Context:
    """Return the context of an image that the chain of these settings kept after ``stage``.

    Raises:
        RequestError: the chain has no such stage.
    """
    step = make_chain(settings).step_named(stage or "")
    return step.method.next_context(step.context)


def finished_picture(path: Path) -> SourceImage:
    """Return a finished picture in colour: display values, (height, width, 3), 0 to 1.

    Raises:
        ImageError: the file cannot be read, or is another kind of image.
    """
    source = read_finished(path)
    if source is None:
        raise ImageError(
            f"{path}: this is not a finished picture; give a JPEG, PNG or TIFF in colour"
        )
    return source
