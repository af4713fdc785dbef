"""Warnings about an image that enters a chain: implausible values, and values that were assumed."""

from clpipe.chain.chain import Chain
from clpipe.chain.registry import stage_in
from clpipe.chain.settings import Settings
from clpipe.images.read import SourceImage
from clpipe.stage import Kind, StageRole


def brightness_warnings(source: SourceImage, chain: Chain) -> list[str]:
    """Warnings where the values of an image do not fit the unit that the chain starts on."""
    black = getattr(chain.steps[0].method, "black_level", None)
    brightest = float(source.pixels.max())
    warnings: list[str] = []
    if chain.source is Kind.RAW and black is not None and brightest <= black:
        warnings.append(
            f"its largest sample is {brightest:g}, not above the black level of {black:g} DN"
        )
    if chain.source is Kind.MOSAIC and brightest > 16:
        warnings.append(
            f"its largest sample is {brightest:g}, but 1 is the white level here; "
            f"a raw in DN enters with --start-at {stage_in(StageRole.LEVELS).name}"
        )
    return warnings


def input_warnings(source: SourceImage, chain: Chain) -> list[str]:
    """The warnings of :func:`brightness_warnings`, and one for each value that the image does not
    say and that the chain therefore assumes.
    """
    warnings = brightness_warnings(source, chain)
    if "settings" in source.attributes:
        return warnings
    first = chain.steps[0].method
    if chain.settings.iso == Settings().iso and chain.step_in(StageRole.DENOISING):
        warnings.append(f"it does not say its ISO; {chain.settings.iso:g} is taken (--iso)")
    if chain.source in (Kind.RAW, Kind.MOSAIC):
        constants = chain.settings.constants()
        key = f"{stage_in(StageRole.PATTERN).name}.pattern"
        if key not in constants:
            pattern = chain.steps[0].context.pattern
            warnings.append(f"it does not say its pattern; {pattern} is taken (--set {key})")
        black = getattr(first, "black_level", None)
        name = stage_in(StageRole.LEVELS).name
        levels = f"{name}.black_level", f"{name}.white_level"
        if black is not None and not {*levels} <= constants.keys():
            white = getattr(first, "white_level", 1)
            warnings.append(
                f"it does not say its levels; black {black:g} and white {white:g} are taken "
                f"(--set {', '.join(levels)})"
            )
    return warnings
