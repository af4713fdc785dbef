"""Values that are set, but that nothing in a chain uses: neither a stage nor a control loop."""

from collections.abc import Iterator
from dataclasses import dataclass
from fractions import Fraction

from clpipe.chain.chain import Chain
from clpipe.chain.draws import Drift
from clpipe.chain.keys import CONTROL
from clpipe.chain.python_words import python_words
from clpipe.chain.registry import all_stages
from clpipe.chain.settings import Settings
from clpipe.stage import PREVIOUS, StageRole
from clpipe.stages.exposure.auto import Auto
from clpipe.stages.shutter import Rows
from clpipe.stages.white_balance.gains import EstimatedGains

OF_ROWS = ("exposure_time", "line_time", "frame_time")  # parameters of a shutter


@dataclass(frozen=True)
class ImageFacts:
    """Facts about the images of a chain.

    Args:
        is_sequence: whether they are frames of sequences.
        from_files: whether each comes from files, of which an exposure may have several.
        needs_rows: whether a ground truth shows each row at its own time.
        rate: the frames per second; None is not known.
    """

    is_sequence: bool = False
    from_files: bool = True
    needs_rows: bool = False
    rate: Fraction | None = None

    @property
    def remedy(self) -> str:
        """What to do about a value that needs a sequence."""
        return f"{'add --sequence' if self.from_files else 'use clpipe.Stream'}, or remove it"


def unused_values(settings: Settings, chain: Chain, images: ImageFacts) -> list[str]:
    """Return a sentence for each value that is set, but that nothing uses.

    >>> from clpipe.chain.making import make_chain
    >>> from clpipe.chain.settings import overlay
    >>> settings = overlay(Settings(), {"control": {"delay": 3}})
    >>> unused_values(settings, make_chain(settings), ImageFacts())
    ['control.delay acts only on frames of sequences; add sequence, or remove it']

    Args:
        settings: the settings of all images, with draws that are not drawn.
        chain: the chain of the first image.
        images: the images.
    """
    found = *_of_sequences(settings, chain, images), *_of_shutter(settings, chain, images)
    return [python_words(sentence) for sentence in found]


def _of_sequences(settings: Settings, chain: Chain, images: ImageFacts) -> Iterator[str]:
    own = ", ".join(f"{CONTROL}.{name}" for name in settings.table(CONTROL))
    loops = Auto, EstimatedGains
    if own and not images.is_sequence:
        verb = "act" if ", " in own else "acts"
        yield f"{own} {verb} only on frames of sequences; {images.remedy}"
    elif own and not any(isinstance(step.method, loops) for step in chain.steps):
        methods = [
            f"--set {stage.name}.method={method.method}"
            for stage in all_stages().values()
            for method in stage.methods
            if issubclass(method, loops)
        ]
        yield f"no loop uses {own}; add {', or '.join(methods)}, or remove it"
    if images.rate:
        yield from _longer_than_a_frame(
            f"{CONTROL}.time_max", settings.control.time_max, images.rate
        )
    for key, draw in settings.draws.items():
        if isinstance(draw, Drift) and not images.is_sequence:
            yield f"{key} drifts only through the frames of a sequence; {images.remedy}"
    for step in chain.steps:
        if not images.is_sequence and any(PREVIOUS in each.reads for each in step.passes):
            yield f"{step.name} changes only frames of sequences; {images.remedy}"


def _of_shutter(settings: Settings, chain: Chain, images: ImageFacts) -> Iterator[str]:
    shutter = chain.step_in(StageRole.SHUTTER)
    if shutter is None or not isinstance(shutter.method, Rows):
        return
    if shutter.method.subframes > 1 and not (images.from_files or images.is_sequence):
        yield (
            f"{shutter.name}.subframes averages the files of an exposure, but each image is one "
            "array; average the arrays first, or use clpipe.Stream"
        )
    given = [name for name in OF_ROWS if name in settings.table(shutter.name)]
    if given and not shutter.method.changes_light and not images.needs_rows:
        listed = ", ".join(f"{shutter.name}.{name}" for name in given)
        yield (
            f"{listed} changes no pixel, because each picture has one render and the light is "
            f"steady; set {shutter.name}.subframes or {shutter.name}.flicker_depth as well"
        )
    if images.rate and "exposure_time" in given:
        yield from _longer_than_a_frame(
            f"{shutter.name}.exposure_time", shutter.method.exposure_time, images.rate
        )


def _longer_than_a_frame(key: str, time: float | None, rate: Fraction) -> Iterator[str]:
    if time and time * rate > 1:
        yield (
            f"{key} is {time:g} s, but at {float(rate):g} frames per second a frame has "
            f"{float(1 / rate):.4g} s; correct it, or --fps"
        )
