"""File names in settings. A page may only use file names from the command line."""

from collections.abc import Collection, Iterator, Mapping
from typing import Any

from clpipe.base.errors import KeyedError
from clpipe.camera.profile import built_in_name
from clpipe.camera.spectra import ILLUMINANTS
from clpipe.chain.keys import RENDER
from clpipe.chain.methods import base_name
from clpipe.chain.paths import file_parameters
from clpipe.chain.registry import all_stages


def files_in(values: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    """Yield the file names in nested values and in draws, each with its dotted key.

    >>> list(files_in({"camera": "a.toml", "iso": 100, "tone_curve": {"path": "b.cube"}}))
    [('camera', 'a.toml'), ('tone_curve.path', 'b.cube')]
    >>> list(files_in({"camera": {"choice": ["sony-a7r2", "/b"]}}))
    [('camera', '/b')]
    """
    for key, value in values.items():
        stage = all_stages().get(base_name(key))
        if key == "camera":
            yield from ((key, name) for name in texts_in(value) if not built_in_name(name))
        elif key == RENDER and isinstance(value, Mapping):
            lamps = texts_in(value.get("illuminant", ""))
            yield from (
                (f"{key}.illuminant", lamp) for lamp in lamps if lamp not in ("", *ILLUMINANTS)
            )
        elif isinstance(value, Mapping) and stage:
            for name in sorted(file_parameters(stage) & value.keys()):
                yield from ((f"{key}.{name}", text) for text in texts_in(value[name]) if text)


def texts_in(value: Any) -> Iterator[str]:
    """Yield the texts in a nested value."""
    if isinstance(value, str):
        yield value
    elif isinstance(value, Mapping):
        yield from texts_in(list(value.values()))
    elif isinstance(value, list | tuple):
        for each in value:
            yield from texts_in(each)


def check_file_names(values: Mapping[str, Any], allowed_files: Collection[str]) -> None:
    """Check that values contain only file names in ``allowed_files``.

    Raises:
        KeyedError: a value names another file.
    """
    for key, name in files_in(values):
        if name not in allowed_files:
            what = "a built-in camera or a file" if key == "camera" else "a file"
            raise KeyedError(
                key,
                f"{key}: found {name!r}, but a page may only name {what} from the command line of "
                "clpipe explore",
            )
