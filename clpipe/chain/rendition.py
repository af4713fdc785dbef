"""Renditions: which of the pictures that are made of one image.

There is the noisy picture or a burst of frames of it, truths and baselines beside it; a bracket has
all of these at each of its exposures.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cache
from typing import Any, Literal, get_args

from pydantic import FiniteFloat, TypeAdapter, ValidationError

from clpipe.base.errors import RequestError
from clpipe.chain.identity import MAX_FRAMES

Role = Literal["noisy", "development", "clean", "mosaic", "variance", "iid", "intensity"]

NOISY, *_ = ROLES = get_args(Role)
DEVELOPMENT, CLEAN, MOSAIC, VARIANCE = TRUTHS = ROLES[1:5]
IID, INTENSITY = BASELINES = ROLES[5:]

# What is the same picture without noise; the other truths are mosaics in float, whatever the format
# of pictures is.
PICTURES, FLOAT_MOSAICS = TRUTHS[:2], TRUTHS[2:]


@dataclass(frozen=True)
class Rendition:
    """One of the pictures that are made of an image.

    Args:
        role: the noisy picture, one of :data:`TRUTHS` or one of :data:`BASELINES`.
        ev: what its exposure in a bracket adds, in EV; None without a bracket.
        frame: the number of a noisy picture in its burst; None where it is no frame.
        frames: how many frames the burst has; None without one.
    """

    role: Role = NOISY
    ev: FiniteFloat | None = None
    frame: int | None = None
    frames: int | None = None

    @property
    def suffix(self) -> str:
        """What is put behind the image's name.

        >>> Rendition(frame=3, frames=20).suffix, Rendition("clean", ev=-0.5).suffix
        ('.frame03', '.ev-0.5.truth_clean')
        """
        exposure = "" if self.ev is None else f".ev{self.ev:+g}"
        if self.frame is None:
            return exposure + self.label
        return f"{exposure}.frame{self.frame:0{len(str((self.frames or 1) - 1))}}"

    @property
    def label(self) -> str:
        """The role as names of files say it, "" for a noisy picture."""
        if self.role in TRUTHS:
            return ".truth" if self.role == DEVELOPMENT else f".truth_{self.role}"
        return f".{self.role}" if self.role in BASELINES else ""

    @property
    def is_first(self) -> bool:
        """Whether it is the noisy picture, or the first frame of its burst."""
        return self.role == NOISY and not self.frame

    def beside(self, role: Role) -> "Rendition":
        """The rendition of a role at the same exposure; of a noisy burst, its first frame."""
        return replace(self, role=role, frame=0 if role == NOISY and self.frames else None)

    @classmethod
    def from_record(cls, values: Mapping[str, Any]) -> "Rendition":
        """The rendition that a sidecar's values are of.

        Raises:
            KeyError, TypeError, ValueError: they are damaged.
        """
        own = {each.name: values[each.name] for each in fields(cls)}
        try:
            found = _adapter().validate_python(own)
        except ValidationError:
            raise ValueError(f"found {own}") from None
        numbers = range(found.frames or 0) if found.role == NOISY and found.frames else (None,)
        is_possible = 0 < (found.frames or 1) <= MAX_FRAMES and found.frame in numbers
        if not is_possible or values["picture"] != found.suffix:
            raise ValueError(f"found picture {values['picture']!r} of {own}")
        return found


@cache
def _adapter() -> TypeAdapter[Rendition]:
    return TypeAdapter(Rendition)  # which takes 10 ms to make


FIRST = Rendition()


def parse_bracket(evs: str | Sequence[float]) -> tuple[float, ...]:
    """The exposures of a bracket, from EVs or a text with commas between them.

    >>> parse_bracket("-2, 0, +2")
    (-2.0, 0.0, 2.0)

    Raises:
        RequestError: one is not a number, or occurs twice.
    """
    try:
        # As their names say them, so that a replay has the same ones.
        items = evs.split(",") if isinstance(evs, str) else evs
        bracket = tuple(float(f"{float(item):g}") + 0.0 for item in items)
    except ValueError:
        bracket = (math.nan,)
    if not all(math.isfinite(ev) and "e" not in f"{ev:g}" for ev in bracket):
        raise RequestError(f"--bracket: found {evs!r}; expected EVs, such as -2,0,2")
    for ev in bracket:
        if bracket.count(ev) > 1:
            raise RequestError(f"--bracket: found {evs!r}, with {ev:+g} EV twice; give it once")
    return bracket
