"""The text of a camera profile, and names of cameras in a form that can be compared."""

import json
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from clpipe.base.errors import RequestError


def profile_text(
    values: Mapping[str, Any],
    gain_stages: Sequence[Mapping[str, Sequence[float]]],
    sources: Mapping[str, str],
    tables: Mapping[str, Mapping[str, Any]] | None = None,
) -> str:
    """Return the text of a profile, for :func:`clpipe.camera.profile.load_camera`.

    Args:
        values: the keys of :class:`clpipe.camera.profile.Camera` that are in no table.
        gain_stages: the tables of each :class:`clpipe.camera.profile.GainStage`.
        sources: the source of each figure.
        tables: further tables, which may have tables themselves.
    """
    lines = _lines(values)
    for stage in gain_stages:
        lines += ["", "[[gain_stages]]", *_lines(stage)]
    for name, table in (tables or {}).items():
        inner = {key: value for key, value in table.items() if isinstance(value, Mapping)}
        plain = {key: value for key, value in table.items() if key not in inner}
        lines += ["", f"[{name}]", *_lines(plain)]
        for key, own in inner.items():
            lines += ["", f"[{name}.{key}]", *_lines(own)]
    lines += ["", "[sources]", *_lines(sources)]
    return "\n".join(lines) + "\n"


def _lines(values: Mapping[str, Any]) -> list[str]:
    return [f"{key} = {_toml(value)}" for key, value in values.items()]


def _toml(value: Any) -> str:
    """Return a TOML value: a text, a number to six digits, or a list of these.

    >>> _toml((100.0, 1 / 3)), _toml('a "b"')
    ('[100, 0.333333]', '"a \\\\"b\\\\""')
    """
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False)
    if isinstance(value, Sequence):
        return f"[{', '.join(_toml(part) for part in value)}]"
    return f"{value:.6g}"


def check_profile_name(path: Path) -> None:
    """Check that the name of a profile ends in .toml.

    Raises:
        RequestError: it does not.
    """
    if path.suffix != ".toml":
        raise RequestError(
            f"{path}: the name of a camera profile must end in .toml, for example camera.toml"
        )


def normalized_name(name: str) -> str:
    """Return the name of a camera in a form that makers, people and files share.

    >>> normalized_name("NIKON CORPORATION NIKON D850"), normalized_name("nikon-d850")
    ('nikond850', 'nikond850')
    """
    words = re.findall(r"[^\W_]+", name.casefold())
    return "".join(word for word in dict.fromkeys(words) if word != "corporation")
