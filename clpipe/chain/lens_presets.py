"""Lenses without a name: values of stages for a typical lens, and for none."""

import tomllib
from collections.abc import Mapping, Sequence
from importlib.resources import files
from typing import Any

PRESETS: dict[str, dict[str, dict[str, Any]]] = {
    file.name.removesuffix(".toml"): tomllib.loads(file.read_text("utf-8"))
    for file in sorted(files("clpipe.chain").joinpath("lenses").iterdir(), key=str)
}


def with_preset(values: Mapping[str, Any], stages: Sequence[str]) -> Mapping[str, Any]:
    """Return values of a configuration, with those of the lens that they choose.

    Values of a stage take precedence over those of the lens. If they choose another method, they
    replace them.

    >>> with_preset({"lens": "none", "glare": {"method": "veil"}}, ["glare", "vignetting"])
    {'lens': 'none', 'glare': {'method': 'veil'}, 'vignetting': {'method': 'none'}}

    Args:
        values: as in a configuration file.
        stages: the stages of the chain, unless the values contain others.
    """
    lens, chain = values.get("lens"), values.get("stages", stages)
    tables: dict[str, Any] = {}
    for step, table in PRESETS.get(lens, {}).items() if isinstance(lens, str) else ():
        own = values.get(step, {})
        if step in chain and isinstance(own, Mapping):
            replaced = own.get("method", table["method"]) != table["method"]
            tables[step] = dict(own) if replaced else {**table, **own}
    return {**values, **tables}


def without_preset(lens: str, table: Mapping[str, Any], step: str) -> dict[str, Any]:
    """Return a step's values without those that a lens has set.

    >>> without_preset("none", {"method": "none"}, "glare"), without_preset("", {"share": 0.1}, "")
    ({}, {'share': 0.1})
    """
    set_by_lens = PRESETS.get(lens, {}).get(step, {})
    return {key: value for key, value in table.items() if key not in set_by_lens}
