"""Errors of pydantic as one line for a user: the value's key, the value and the reason."""

import inspect
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import wraps
from pathlib import Path
from types import UnionType
from typing import Any, Literal, ParamSpec, TypeVar, Union, get_args, get_origin

from pydantic import ConfigDict, TypeAdapter, ValidationError

from clpipe.base.errors import RequestError

P = ParamSpec("P")
R = TypeVar("R")


@dataclass(frozen=True)
class Fault:
    """The first fault in a table of values.

    Attributes:
        path: the names of tables and the numbers of list items that lead to the value. It is empty
            if values contradict each other.
        problem: the kind of fault.
        text: the value and the reason.
    """

    path: tuple[str | int, ...]
    problem: Literal["unknown", "missing", "invalid"]
    text: str

    @property
    def name(self) -> str:
        """The last part of the path; "" if the path is empty."""
        return str(self.path[-1]) if self.path else ""

    @property
    def key(self) -> str:
        """The path as a text.

        >>> Fault(("gain_stages", 1, "iso"), "missing", "").key
        'gain_stages[1].iso'
        """
        parts = (f"[{part}]" if isinstance(part, int) else f".{part}" for part in self.path)
        return "".join(parts).lstrip(".")


def first_fault(error: ValidationError) -> Fault:
    """Return the first fault of a pydantic error.

    >>> from pydantic import BaseModel, Field
    >>> class Lens(BaseModel):
    ...     stops: float = Field(ge=1)
    >>> try:
    ...     Lens(stops=0.5)
    ... except ValidationError as error:
    ...     fault = first_fault(error)
    >>> fault.key, fault.text
    ('stops', 'found 0.5: should be greater than or equal to 1')
    """
    first = error.errors()[0]
    path = first["loc"]
    if first["type"] == "extra_forbidden":
        return Fault(path, "unknown", "there is no such key")
    if first["type"] == "missing":
        return Fault(path, "missing", "it is missing")
    reason = first["msg"].removeprefix("Value error, ").removeprefix("Input ")
    # A whole table is too long to repeat; its path identifies it.
    shown = bool(path) and not isinstance(first["input"], Mapping)
    return Fault(path, "invalid", f"found {first['input']!r}: {reason}" if shown else reason)


def check_argument_types(function: Callable[P, R]) -> Callable[P, R]:
    """Decorate a function, so that it rejects arguments of other types than annotated.

    >>> @check_argument_types
    ... def keep(names: str, truth: bool = False) -> None: ...
    >>> keep("normalize", truth="mosaic")
    Traceback (most recent call last):
    clpipe.base.errors.RequestError: found truth 'mosaic'; expected true or false

    The arguments are not converted.

    Raises:
        RequestError: an argument has another type.
    """
    signature = inspect.signature(function)
    annotations = {
        name: parameter.annotation
        for name, parameter in signature.parameters.items()
        if parameter.annotation is not parameter.empty and parameter.kind != parameter.VAR_KEYWORD
    }
    strict = ConfigDict(strict=True)

    @wraps(function)
    def checked(*args: P.args, **kwargs: P.kwargs) -> R:
        for name, value in signature.bind(*args, **kwargs).arguments.items():
            if name not in annotations:
                continue
            try:
                TypeAdapter(annotations[name], config=strict).validate_python(value)
            except ValidationError:
                expected = describe_type(annotations[name])
                raise RequestError(f"found {name} {value!r}; expected {expected}") from None
        return function(*args, **kwargs)

    return checked


def describe_type(annotation: Any) -> str:
    """Return the values that a type allows, in words.

    >>> describe_type(bool | Literal["clean", "noisy"] | None)
    "true or false, 'clean', 'noisy' or None"
    >>> describe_type(str | Sequence[str | Path])
    'a text or a list of texts or paths'
    """
    *others, last = dict.fromkeys(_describe_parts(annotation))
    return f"{', '.join(others)} or {last}" if others else last


def _describe_parts(annotation: Any) -> Iterator[str]:
    origin, parts = get_origin(annotation), get_args(annotation)
    if origin is Literal:
        yield from map(repr, parts)
    elif origin in (Union, UnionType):
        for part in parts:
            yield from _describe_parts(part)
    elif origin is Sequence:
        plural = (each.split(" ", 1)[-1] + "s" for each in _describe_parts(parts[0]))
        yield f"a list of {' or '.join(plural)}"
    elif origin is Mapping:
        yield "a table"
    else:
        yield TYPE_NAMES.get(annotation, getattr(annotation, "__name__", str(annotation)))


TYPE_NAMES: dict[Any, str] = {
    str: "a text",
    Path: "a path",
    int: "a whole number",
    float: "a number",
    bool: "true or false",
    type(None): "None",
    Any: "anything",
}
