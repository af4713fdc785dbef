"""The space of a search: the methods of the development's stages, and their numbers.

New methods and parameters of these stages are included automatically, unless a method needs a file
or matrix of the user. This module adds what cameras do but the default chain does not: smaller
pictures, the sensor's own colours, and smoother chroma.
"""

import math
import typing
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Union, get_args, get_origin

from clpipe.base.errors import ClpipeError
from clpipe.chain.chain import Chain
from clpipe.chain.making import make_chain
from clpipe.chain.registry import all_stages
from clpipe.chain.settings import Settings, overlay
from clpipe.stage import Method

# The stages whose methods and numbers are searched, in the order in which they are tried.
DEVELOPMENT = ("denoise", "demosaic", "sharpen")
TONE = "tone_curve"
RESIZE, SCALES = "resize", (0.5, 2 / 3, 0.75)  # scales of cameras' smaller picture sizes
BEFORE = TONE  # a stage that the chain lacks is inserted before this one
SHARPEN = "sharpen"
# Cameras smooth chroma again with a wider filter, at a half or a quarter of the resolution.
SMOOTHER = {"method": "bilateral", "luma_size": 1, "luma_strength": 0.0, "chroma_size": 7}
COARSER = {"method": "biweight", "luma_strength": 0.0, "chroma_scale": 4}
# Units of searched numbers; numbers in signal units follow from the noise.
SEARCHED_UNITS = ("", "px")
# Noise does not tell these: a picture's colours are those of its scene, and edges come later.
NOT_SEARCHED = ("tone_curve.saturation", "sharpen.limit")
MOST = {"sharpen.amount": 2.0}  # more makes noise finer, and edges sharper than in any camera
SPAN = 8.0  # a number is searched within this factor of its initial value


@dataclass(frozen=True)
class Dimension:
    """A number to search: its dotted name, range, first value and scale."""

    name: str
    low: float
    high: float
    start: float
    logarithmic: bool = False

    def value(self, share: float) -> float:
        """Return the value at a share of the range, 0 to 1, to four digits.

        >>> Dimension("a.b", 1, 100, 10, logarithmic=True).value(0.5)
        10.0
        """
        share = min(max(share, 0.0), 1.0)
        if self.logarithmic:
            value = self.low * (self.high / self.low) ** share
        else:
            value = self.low + (self.high - self.low) * share
        return min(max(float(f"{value:.4g}"), self.low), self.high)

    def share(self, value: float) -> float:
        """Return the share of the range for a value; the inverse of :meth:`value`."""
        value = min(max(value, self.low), self.high)
        if self.logarithmic:
            return math.log(value / self.low) / math.log(self.high / self.low)
        return (value - self.low) / (self.high - self.low)


@dataclass(frozen=True)
class Choice:
    """A choice for a part of the development: values of a configuration, and stages to add.

    Each of ``stages`` is inserted before the stage that it is mapped to, unless the chain has it.
    """

    text: str
    values: Mapping[str, Any] = field(default_factory=dict)
    stages: Mapping[str, str] = field(default_factory=dict)

    def over(self, settings: Settings) -> Settings:
        """Return the settings with this choice applied.

        Raises:
            KeyedError: the settings do not allow it.
        """
        names = list(settings.stages)
        for name, before in self.stages.items():
            names.insert(names.index(before), name)
        return overlay(settings, {**self.values, "stages": names})


@dataclass(frozen=True)
class Space:
    """The choices to compare, by part, and the number that sets the strength of noise, if any.

    ``is_toned`` is set if a chart has set the tone curve, so that it is not searched.
    """

    choices: Mapping[str, tuple[Choice, ...]]
    strength: Dimension | None
    is_toned: bool = False

    @cached_property
    def first(self) -> dict[str, Choice]:
        """The first choice of each part."""
        return {part: choices[0] for part, choices in self.choices.items()}


def is_number(annotation: Any) -> bool:
    """Return whether a parameter is a float, not a choice, a list or a whole number.

    >>> is_number(float | None), is_number(int)
    (True, False)
    """
    if get_origin(annotation) in (Union, type(int | str)):
        return any(map(is_number, get_args(annotation)))
    return annotation is float


def dimensions_of(chain: Chain, is_toned: bool = False) -> list[Dimension]:
    """Return the numbers of a chain's development that are kernel arguments, with their ranges.

    A share is searched from 0 to 1. Other numbers are searched within a factor of 8 of their value
    in the chain, as far as their limits allow. A number that is 0 is turned off, and stays 0.
    Numbers without an upper limit are not searched. Nor are numbers in units of the signal, because
    they follow from the noise.

    Args:
        chain: the chain.
        is_toned: whether to leave out those of the tone curve.
    """
    found = []
    searched = DEVELOPMENT if is_toned else (*DEVELOPMENT, TONE)
    for step in chain.steps:
        if step.stage.name not in searched:
            continue
        for name, declared in type(step.method).model_fields.items():
            extra: Any = declared.json_schema_extra
            dotted = f"{step.name}.{name}"
            if (
                extra["structural"]
                or extra["unit"] not in SEARCHED_UNITS
                or dotted in NOT_SEARCHED
                or not is_number(declared.annotation)
            ):
                continue
            low, high = limits_of(declared.metadata)
            start = float(getattr(step.method, name))
            high = min(high, MOST.get(dotted, high))
            if start > 0 and 0 <= low < high <= 1:
                found.append(Dimension(dotted, low, high, start))
            elif start > 0 and math.isfinite(low + high):
                ends = max(start / SPAN, low), min(start * SPAN, high)
                found.append(Dimension(dotted, *ends, start, logarithmic=True))
    return found


def limits_of(metadata: list[Any]) -> tuple[float, float]:
    """Return the declared limits of a parameter; infinite if there are none."""
    low, high = -math.inf, math.inf
    for limit in metadata:
        for key in ("ge", "gt"):
            low = max(low, getattr(limit, key, low))
        for key in ("le", "lt"):
            high = min(high, getattr(limit, key, high))
    return low, high


def space_for(settings: Settings, iso_is_given: bool) -> Space:
    """Return the whole space: all parts of the development, and the ISO if it is not set.

    Parts with the largest effect come first, so that others are compared near the final result.
    """
    choices: dict[str, tuple[Choice, ...]] = {}
    if RESIZE not in settings.stages:
        choices[RESIZE] = (Choice("full size"), *smaller(settings))
    choices["chroma"] = tuple(chroma_options(settings))
    is_toned = TONE in settings.parameters
    for name in DEVELOPMENT if is_toned else (*DEVELOPMENT, TONE):
        stage = all_stages()[name]
        added = {} if name in settings.stages else {name: BEFORE}
        own = [
            Choice(f"{name} {m.method}", {name: {"method": m.method}}, added)
            for m in stage.methods
            if usable(m)
        ]
        own = [choice for choice in own if fits(choice, settings)]
        without = [Choice(f"no {name}")] if added else []
        choices[name] = (*without, *own)
    low, high = settings.isos().low, settings.isos().high
    strength = Dimension("iso", low, high, math.sqrt(low * high), logarithmic=True)
    return Space(choices, None if iso_is_given else strength, is_toned)


def smaller(settings: Settings) -> Iterator[Choice]:
    """Yield choices for a smaller picture: each scale and method, before or after sharpening."""
    for scale in SCALES:
        for method in all_stages()[RESIZE].methods:
            values = {RESIZE: {"method": method.method, "scale": scale}}
            text = f"{RESIZE} {method.method} {scale:.3g}"
            yield Choice(text, values, {RESIZE: BEFORE})
            if SHARPEN in settings.stages:
                yield Choice(f"{text}, then sharpen", values, {RESIZE: SHARPEN})


def chroma_options(settings: Settings) -> Iterator[Choice]:
    """Yield choices for the noise of chroma: colours of the sensor or scene, smoothed again."""
    before = SHARPEN if SHARPEN in settings.stages else BEFORE
    colours: dict[str, dict[str, Any]] = {"colours of the camera": {}}
    if "inverse_color_matrix" in settings.stages:
        colours["colours of the scene"] = {"inverse_color_matrix": {"method": "none"}}
    for text, values in colours.items():
        yield Choice(text, values)
        for more, again in ((", coarser", COARSER), (", smoother", SMOOTHER)):
            yield Choice(text + more, {**values, "denoise_2": again}, {"denoise": before})


def usable(method: type[Method]) -> bool:
    """Return whether a method works without a file of the user."""
    fields: list[Any] = [f.json_schema_extra for f in method.model_fields.values()]
    return not any(extra["file"] for extra in fields)


def fits(choice: Choice, settings: Settings) -> bool:
    """Return whether settings allow a choice; a method may be for other sensors, for example."""
    try:
        make_chain(choice.over(settings))
    except ClpipeError:
        return False
    return True


def variants_of(settings: Settings, step: str) -> Iterator[Choice]:
    """Yield a step's method with one structural parameter a step up or down, or another choice.

    A window of one pixel is turned off, and stays so.
    """
    method = settings.method(step)
    table = settings.parameters.get(step, {})
    for name, declared in type(method).model_fields.items():
        extra: Any = declared.json_schema_extra
        own = getattr(method, name)
        if not extra["structural"]:
            continue
        values: list[Any] = []
        if get_origin(declared.annotation) is typing.Literal:
            values = [value for value in get_args(declared.annotation) if value != own]
        elif declared.annotation is int and own > 1:
            values = [own - 2, own - 1, own + 1, own + 2, own + 4]
        elif declared.annotation is float:
            values = [float(f"{own * factor:.3g}") for factor in (0.5, 0.7, 1.4, 2.0)]
        for value in values:
            choice = Choice(f"{step}.{name} {value}", {step: {**table, name: value}})
            if fits(choice, settings):
                yield choice
