"""Warnings about the input of a chain: implausible values, and assumed values."""

from clpipe.chain.chain import Chain
from clpipe.chain.registry import stage_in
from clpipe.chain.settings import Settings
from clpipe.images.read import SourceImage
from clpipe.stage import Kind, StageRole


def brightness_warnings(source: SourceImage, chain: Chain) -> list[str]:
    """Return warnings about samples that do not fit the unit in which the chain starts."""
    black = getattr(chain.steps[0].method, "black_level", None)
    brightest = float(source.pixels.max())
    warnings: list[str] = []
    if chain.source is Kind.RAW and black is not None and brightest <= black:
        warnings.append(
            f"the largest sample is {brightest:g}, which is not above the black level of "
            f"{black:g} DN"
        )
    if chain.source is Kind.MOSAIC and brightest > 16:
        warnings.append(
            f"the largest sample is {brightest:g}, but the white level is 1 here; "
            f"for a raw in DN, use --start-at {stage_in(StageRole.LEVELS).name}"
        )
    return warnings


def input_warnings(source: SourceImage, chain: Chain) -> list[str]:
    """Return :func:`brightness_warnings`, and one warning for each value that had to be assumed."""
    warnings = brightness_warnings(source, chain)
    if "settings" in source.attributes:
        return warnings
    first = chain.steps[0].method
    if chain.settings.iso == Settings().iso and chain.step_in(StageRole.DENOISING):
        warnings.append(
            f"the file does not state its ISO; clpipe assumes {chain.settings.iso:g} (--iso)"
        )
    if chain.source in (Kind.RAW, Kind.MOSAIC):
        constants = chain.settings.constants()
        key = f"{stage_in(StageRole.PATTERN).name}.pattern"
        if key not in constants:
            pattern = chain.steps[0].context.pattern
            warnings.append(
                f"the file does not state its CFA pattern; clpipe assumes {pattern} (--set {key})"
            )
        black = getattr(first, "black_level", None)
        name = stage_in(StageRole.LEVELS).name
        levels = f"{name}.black_level", f"{name}.white_level"
        if black is not None and not {*levels} <= constants.keys():
            white = getattr(first, "white_level", 1)
            warnings.append(
                f"the file does not state its levels; clpipe assumes black {black:g} and white "
                f"{white:g} (--set {', '.join(levels)})"
            )
    return warnings
