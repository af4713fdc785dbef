"""Renditions: the different pictures that are made of one image.

These are the noisy picture or a burst of noisy frames, its ground truth, and its baselines. A
bracket has all of these at each of its exposures.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cache
from typing import Any, Literal, get_args

from pydantic import FiniteFloat, TypeAdapter, ValidationError

from clpipe.base.errors import RequestError
from clpipe.chain.identity import MAX_FRAMES

Truth = Literal["development", "clean", "mosaic", "variance", "xyz", "srgb"]
Role = Literal["noisy", Truth, "iid", "intensity"]

NOISY, *_ = ROLES = get_args(Role)
DEVELOPMENT, CLEAN, MOSAIC, VARIANCE, XYZ, SRGB = TRUTHS = get_args(Truth)
IID, INTENSITY = BASELINES = ROLES[-2:]

# Truths that look like the noisy picture, the light before the sensor, truths that are always
# written in floats.
PICTURES, LIGHTS, FLOATS = TRUTHS[:2], TRUTHS[4:], TRUTHS[2:]


@dataclass(frozen=True)
class Rendition:
    """One of the pictures that clpipe makes from an image.

    Args:
        role: :data:`NOISY`, one of :data:`TRUTHS`, or one of :data:`BASELINES`.
        ev: its relative exposure in a bracket, in EV; None without a bracket.
        frame: the number of the noisy picture in its burst; None without a burst.
        frames: the number of frames of the burst; None without a burst.
    """

    role: Role = NOISY
    ev: FiniteFloat | None = None
    frame: int | None = None
    frames: int | None = None

    @property
    def suffix(self) -> str:
        """The part of the file name after the image's name.

        >>> Rendition(frame=3, frames=20).suffix, Rendition("clean", ev=-0.5).suffix
        ('.frame03', '.ev-0.5.truth_clean')
        """
        exposure = "" if self.ev is None else f".ev{self.ev:+g}"
        if self.frame is None:
            return exposure + self.label
        return f"{exposure}.frame{self.frame:0{len(str((self.frames or 1) - 1))}}"

    @property
    def label(self) -> str:
        """The role as it appears in file names; "" for a noisy picture."""
        if self.role in TRUTHS:
            return ".truth" if self.role == DEVELOPMENT else f".truth_{self.role}"
        return f".{self.role}" if self.role in BASELINES else ""

    @property
    def is_first(self) -> bool:
        """Whether this is the noisy picture, or the first frame of its burst."""
        return self.role == NOISY and not self.frame

    def with_role(self, role: Role) -> "Rendition":
        """Return the rendition with another role at the same exposure, or its first frame."""
        return replace(self, role=role, frame=0 if role == NOISY and self.frames else None)

    @classmethod
    def from_record(cls, values: Mapping[str, Any]) -> "Rendition":
        """Return the rendition that a sidecar's values describe.

        Raises:
            KeyError, TypeError, ValueError: the values are damaged.
        """
        record = {each.name: values[each.name] for each in fields(cls)}
        try:
            found = _adapter().validate_python(record)
        except ValidationError:
            raise ValueError(f"found {record}") from None
        numbers = range(found.frames or 0) if found.role == NOISY and found.frames else (None,)
        is_possible = 0 < (found.frames or 1) <= MAX_FRAMES and found.frame in numbers
        if not is_possible or values["picture"] != found.suffix:
            raise ValueError(f"found picture {values['picture']!r} of {record}")
        return found


@cache
def _adapter() -> TypeAdapter[Rendition]:
    return TypeAdapter(Rendition)  # takes 10 ms


DEFAULT_RENDITION = Rendition()


def parse_bracket(evs: str | Sequence[float]) -> tuple[float, ...]:
    """Return the exposures of a bracket, from EVs or a text of EVs separated by commas.

    >>> parse_bracket("-2, 0, +2")
    (-2.0, 0.0, 2.0)

    Raises:
        RequestError: an EV is not a number, or occurs twice.
    """
    try:
        # Rounded as in file names, so that a replay has the same exposures.
        items = evs.split(",") if isinstance(evs, str) else evs
        bracket = tuple(float(f"{float(item):g}") + 0.0 for item in items)
    except ValueError:
        bracket = (math.nan,)
    if not all(math.isfinite(ev) and "e" not in f"{ev:g}" for ev in bracket):
        raise RequestError(f"--bracket: found {evs!r}; expected EVs, such as -2,0,2")
    for ev in bracket:
        if bracket.count(ev) > 1:
            raise RequestError(
                f"--bracket: found {evs!r}, which repeats {ev:+g} EV; list each EV once"
            )
    return bracket
