"""Vocabularies: what files of a format can state, and what becomes of each statement.

Each reader of other programs' files has one. A warning names statements that are not in it, and
whose names are like those of colours, lenses or time. Dropping them may change what pixels mean.
"""

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Literal, Self

from clpipe.base.text import printable

Disposition = Literal["used", "checked", "rejected", "named", "ignored"]
DISPOSITIONS: Mapping[Disposition, str] = {
    "used": "it changes the result",
    "checked": "it must agree with another statement",
    "rejected": "files that state it are rejected",
    "named": "a warning says that it is not used",
    "ignored": "it does not concern the result",
}
# Parts of names that concern the meaning of pixels: their colours, their geometry, their time.
TELLING = re.compile(
    r"(?:colou?r|white|black)[ _.-]?(?:space|point|balance|level|matri|profile|transform|temp)"
    r"|colou?r_?(?:calib|encod)|chromatic|primar(?:y|ies)|gamma|gamut|transfer|tone_?(?:map|curve)|(?:^|_)lut"
    r"|ocio|encoding|premult|alpha_?(?:mode|type)|exposure|vignett|shading|dynamic_?range|gain_?map"
    r"|distort|fish_?eye|projection|panoram|equirect|lens_?(?:shift|model|type)|anamorph|squeeze"
    r"|principal|film_?(?:back|offset)|sensor_?shift|rectif|skew|tilt|prism|(?:^|_)fov|stereo|eye"
    r"|shutter|rolling|time_?stamp|frame_?time|read_?out",
    re.IGNORECASE,
)
SEPARATORS = re.compile(r"[/:]")  # between a program's prefix and the name itself
CAMEL = re.compile(r"(?<=[a-z0-9])(?=[A-Z])")


@dataclass(frozen=True)
class Statement:
    """What a file can state.

    Args:
        name: its name in the file.
        disposition: what becomes of it, one of :data:`DISPOSITIONS`.
        meaning: what it says; for ignored statements, why that does not matter.
    """

    name: str
    disposition: Disposition
    meaning: str


@dataclass(frozen=True)
class Vocabulary:
    """The statements of a format.

    >>> words = Vocabulary.of("OpenEXR", "its header", {"named": {"the look": "lookModTransform"}})
    >>> words.warnings(["lookModTransform", "Blender/RenderTime"])
    ['its lookModTransform (the look) is not used']
    >>> words.warnings(["vendor/lensDistortion"])
    ['clpipe does not know its vendor/lensDistortion, and does not use it']

    Args:
        format: the name of the format, and of what has the statements.
        source: where the format lists them.
        statements: by their names.
        telling: finds names that concern the meaning of pixels.
        consequence: what clpipe does with unknown statements.
    """

    format: str
    source: str
    statements: Mapping[str, Statement]
    telling: re.Pattern[str] = TELLING
    consequence: str = "does not use"

    @classmethod
    def of(
        cls,
        format_: str,
        source: str,
        meanings: Mapping[Disposition, Mapping[str, str]],
        telling: re.Pattern[str] = TELLING,
        consequence: str = "does not use",
    ) -> Self:
        """Return a vocabulary from names, separated by spaces, by disposition and meaning."""
        statements = {
            name: Statement(name, disposition, meaning)
            for disposition, of_meaning in meanings.items()
            for meaning, names in of_meaning.items()
            for name in names.split()
        }
        return cls(format_, source, statements, telling, consequence)

    def is_unknown(self, name: str) -> bool:
        """Return whether a name is not in the vocabulary, and like those of colours or lenses."""
        own = SEPARATORS.split(name)[-1]
        return name not in self.statements and bool(self.telling.search(CAMEL.sub("_", own)))

    def warnings(self, names: Iterable[str]) -> list[str]:
        """Return a sentence for each statement to name, and one for unknown ones.

        Args:
            names: the statements of a file that say something, not 0, false or "".
        """
        found, unknown = [], []
        for name in names:
            statement = self.statements.get(name)
            if statement and statement.disposition == "named":
                found.append(f"its {name} ({statement.meaning}) is not used")
            elif not statement and self.is_unknown(name):
                unknown.append(printable(name))
        if unknown:
            them = "them" if len(unknown) > 1 else "it"
            listed = ", ".join(unknown)
            found.append(f"clpipe does not know its {listed}, and {self.consequence} {them}")
        return found
