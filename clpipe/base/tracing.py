"""Tracing: run code once on numbers that record their computation, then repeat the computation.

A :class:`Traced` replaces each float. Each operation becomes a line of a Python function, and each
comparison a guard. The function repeats the computation for other numbers, in the same order and
precision, without the surrounding code. If a guard fails, the code would have taken another path,
so it must be traced again. PyTorch's Dynamo and JAX work in the same way.
"""

import math
import operator
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from types import FunctionType, MethodType
from typing import Any, TypeVar

import numpy as np
from pydantic import BaseModel

T = TypeVar("T")
Repeat = Callable[[Sequence[Any]], Any]

INFIX: dict[Callable[..., Any], str] = {
    operator.add: "+",
    operator.sub: "-",
    operator.mul: "*",
    operator.truediv: "/",
    operator.pow: "**",
    operator.mod: "%",
    operator.lt: "<",
    operator.le: "<=",
    operator.gt: ">",
    operator.ge: ">=",
    operator.eq: "==",
    operator.ne: "!=",
}
UFUNCS = {np.add: operator.add, np.subtract: operator.sub, np.multiply: operator.mul}
NUMBER_TYPES = float, int, np.number


class NotTraceableError(Exception):
    """A result contains traced numbers where they cannot be replaced, such as in a closure."""


class Traced:
    """A number whose computation a :class:`Trace` records.

    It has the operators of a float. NumPy's functions of scalars are traced, and :func:`call`
    traces any other function. Code that needs a plain float gets the value, and a guard then
    requires this value. A traced number is not hashable, so that no cache keeps it.

    >>> (x,) = Trace([0.3]).inputs
    >>> [type(f(x)).__name__ for f in (np.sqrt, np.sinc, math.floor, math.sin)]
    ['Traced', 'Traced', 'Traced', 'float']
    """

    __slots__ = ("name", "trace", "value")
    __hash__ = None  # type: ignore[assignment]

    def __init__(self, trace: "Trace", name: str, value: Any) -> None:
        self.trace = trace
        self.name = name
        self.value = value

    def __bool__(self) -> bool:
        return bool(self.trace.guard(operator.ne, self, 0))

    def __float__(self) -> float:
        self.trace.guard(operator.eq, self, self.value)
        self.trace.value_used = True
        return float(self.value)

    def __len__(self) -> int:
        size = len(self.value)
        self.trace.guard(operator.eq, call(len, self), size)
        return size

    def __int__(self) -> int:
        return int(float(self))

    def __round__(self, *digits: int) -> Any:
        return call(round, self, *digits)

    def __format__(self, spec: str) -> str:
        return format(float(self), spec)

    def __repr__(self) -> str:
        return repr(float(self))

    def item(self) -> Any:
        """Return the Python number of a NumPy number, like NumPy's method."""
        return call(_ITEM, self) if isinstance(self.value, np.generic) else self

    def __array_ufunc__(self, ufunc: Any, method: str, *inputs: Any, **options: Any) -> Any:
        if method != "__call__":
            return getattr(ufunc, method)(*map(_plain, inputs), **options)
        return self.__array_function__(UFUNCS.get(ufunc, ufunc), (), inputs, options)

    def __array_function__(self, function: Any, types: Any, inputs: Any, options: Any) -> Any:
        if not options and all(isinstance(each, (Traced, *NUMBER_TYPES)) for each in inputs):
            result = function(*map(value_of, inputs))
            if isinstance(result, NUMBER_TYPES):
                return self.trace.number(function, inputs, result)
        return function(*map(_plain, inputs), **{k: _plain(v) for k, v in options.items()})


def _calculation(function: Callable[..., Any], swapped: bool = False) -> Callable[..., Any]:
    """Return a method of :class:`Traced` for an operator; swapped, for the reflected operator."""

    def calculated(self: Traced, *others: Any) -> Any:
        if not all(isinstance(other, (Traced, *NUMBER_TYPES)) for other in others):
            return NotImplemented
        return call(function, *others, self) if swapped else call(function, self, *others)

    return calculated


def _comparison(function: Callable[..., Any]) -> Callable[..., Any]:
    def compared(self: Traced, other: Any) -> Any:
        if not isinstance(other, (Traced, *NUMBER_TYPES)):
            return NotImplemented
        return self.trace.guard(function, self, other)

    return compared


for _name in ("add", "sub", "mul", "truediv", "pow", "mod"):
    setattr(Traced, f"__{_name}__", _calculation(getattr(operator, _name)))
    setattr(Traced, f"__r{_name}__", _calculation(getattr(operator, _name), swapped=True))
for _name in ("neg", "abs"):
    setattr(Traced, f"__{_name}__", _calculation(getattr(operator, _name)))
for _name in ("floor", "ceil", "trunc"):
    setattr(Traced, f"__{_name}__", _calculation(getattr(math, _name)))
for _name in ("lt", "le", "gt", "ge", "eq", "ne"):
    setattr(Traced, f"__{_name}__", _comparison(getattr(operator, _name)))


def value_of(number: Any) -> Any:
    """Return the value of a traced number; return any other object unchanged."""
    return number.value if isinstance(number, Traced) else number


_ITEM = operator.methodcaller("item")


def _plain(value: Any) -> Any:
    """Return a value without traced numbers: a guard requires their values."""
    if isinstance(value, (list, tuple)):
        return [_plain(each) for each in value]
    return float(value) if isinstance(value, Traced) else value


def call(function: Callable[..., Any], *arguments: Any) -> Any:
    """Return the result of a pure function of numbers, traced if one of its arguments is traced.

    The function must return a number or a tuple of numbers.

    >>> call(max, 1.0, 2.0)
    2.0
    """
    traces = [each.trace for each in arguments if isinstance(each, Traced)]
    result = function(*map(value_of, arguments))
    if not traces:
        return result
    number = traces[0].number(function, arguments, result)
    if not isinstance(result, tuple):
        return number
    return tuple(call(operator.getitem, number, place) for place in range(len(result)))


class Trace:
    """A recorded computation.

    Args:
        values: the numbers that the computation starts from.

    >>> trace = Trace([3.0])
    >>> (x,) = trace.inputs
    >>> repeat = trace.repeat({"square": x * x if x > 0 else x})
    >>> repeat([4.0]), repeat([-4.0])
    ({'square': 16.0}, None)
    """

    def __init__(self, values: Sequence[Any]) -> None:
        self.inputs = [Traced(self, f"x{n}", value) for n, value in enumerate(values)]
        self.value_used = False  # whether code has used the value of a number as a constant
        self._lines: list[str] = []
        self._line_numbers: dict[str, int] = {}  # expression -> number of its line, if not removed
        self._constants: dict[str, Any] = {
            "with_changes": with_changes,
            "with_attributes": with_attributes,
        }
        self._names: dict[int, str] = {}  # id of a constant -> its name

    def number(self, function: Callable[..., Any], arguments: Sequence[Any], result: Any) -> Traced:
        """Return the result of a function of numbers, traced."""
        text = self._text(function, arguments)
        index = self._line_numbers.get(text, len(self._lines))
        line = f"v{index} = {text}"
        if self._lines[index : index + 1] != [line]:  # otherwise the value has been computed before
            index = self._line_numbers[text] = len(self._lines)
            self._lines.append(f"v{index} = {text}")
        return Traced(self, f"v{index}", result)

    def guard(self, function: Callable[..., Any], *arguments: Any) -> bool:
        """Return the outcome of a comparison. The computation is valid only for this outcome."""
        outcome = bool(function(*map(value_of, arguments)))
        condition = self._text(function, arguments)
        line = f"if {'not ' if outcome else ''}({condition}): return None"
        index = self._line_numbers.get(line, len(self._lines))
        if self._lines[index : index + 1] != [line]:
            self._line_numbers[line] = len(self._lines)
            self._lines.append(line)
        return outcome

    @contextmanager
    def attempt(self) -> Iterator[None]:
        """Trace an optional part: its lines are removed if it fails or uses a number's value.

        Raises:
            NotTraceableError: the part failed, or used a number's value.
        """
        before, count, self.value_used = self.value_used, len(self._lines), False
        try:
            yield
            if self.value_used:
                raise NotTraceableError
        except Exception:
            del self._lines[count:]
            raise NotTraceableError from None
        finally:
            self.value_used = before

    def contains_traced(self, value: Any) -> bool:
        """Return whether an object contains traced numbers."""
        count = len(self._lines)
        text = _CopyWriter(self).text(value)
        del self._lines[count:]
        return text is not None

    def repeat(self, result: Any) -> Repeat:
        """Return a function that computes the result for other numbers.

        Args:
            result: any object. Tuples, lists, dicts and attributes may contain traced numbers.
                The function copies these parts with new values, and shares all other parts.

        Returns:
            The function. It returns None if a guard fails.

        Raises:
            NotTraceableError: the result contains traced numbers in other places.
        """
        text = _CopyWriter(self).text(result) or self._constant(result)
        inputs = "".join(f"{each.name}, " for each in self.inputs)
        body = [f"{inputs}= values" if inputs else "pass"]
        body += needed_lines([*self._lines, f"return {text}"])
        source = "\n    ".join(["def repeat(values):", *body])
        exec(compile(source, "<trace>", "exec"), self._constants)  # noqa: S102  # of lines above
        repeat: Repeat = self._constants["repeat"]
        return repeat

    def _text(self, function: Callable[..., Any], arguments: Sequence[Any]) -> str:
        texts = [a.name if isinstance(a, Traced) else self._constant(a) for a in arguments]
        if function in INFIX:
            return f" {INFIX[function]} ".join(texts)
        return f"{self._constant(function)}({', '.join(texts)})"

    def _constant(self, value: Any) -> str:
        """Return the name of a constant."""
        name = self._names.setdefault(id(value), f"k{len(self._names)}")
        self._constants[name] = value
        return name


def needed_lines(lines: Sequence[str]) -> list[str]:
    """Return the lines of a function without those whose result no later line uses.

    >>> needed_lines(["v0 = x0 + k0", "v1 = x0 * x0", "return v0"])
    ['v0 = x0 + k0', 'return v0']
    """
    needed: set[str] = set()
    kept = []
    for line in reversed(lines):
        result, *used = re.findall(r"\w+", line)
        if result in needed or result in ("if", "return"):
            kept.append(line)
            needed.update(used)
    return kept[::-1]


def with_changes(template: T, attributes: Mapping[str, Any]) -> T:
    """Return a copy of an object with some attributes replaced, without validation."""
    other = with_attributes(type(template), {**vars(template), **attributes})
    if isinstance(template, BaseModel):
        for name in BaseModel.__slots__[1:]:
            object.__setattr__(other, name, getattr(template, name))
    return other


def with_attributes(kind: type[T], attributes: dict[str, Any]) -> T:
    """Return an object of a class whose ``__dict__`` is the given dict."""
    other = object.__new__(kind)
    object.__setattr__(other, "__dict__", attributes)
    return other


class _CopyWriter:
    """Writes the lines that copy a result with new numbers. See :meth:`Trace.repeat`."""

    def __init__(self, trace: Trace) -> None:
        self._trace = trace
        # Holds the object as well, to keep it alive.
        self._texts: dict[int, tuple[Any, str | None]] = {}
        self._open: set[int] = set()

    def text(self, value: Any) -> str | None:
        """Return an expression for a value; None if no part of the value is traced.

        Raises:
            NotTraceableError: as for :meth:`Trace.repeat`.
        """
        if isinstance(value, Traced):
            return value.name
        if isinstance(value, (str, type, type(None), *NUMBER_TYPES)):
            return None
        key = id(value)
        if key in self._open:  # the object refers to itself
            self._texts[key] = value, None
            return None
        if key not in self._texts:
            self._open.add(key)
            text = self._text_of(value)
            self._open.remove(key)
            if text and key in self._texts:
                raise NotTraceableError(f"{type(value).__name__} refers to itself")
            if text:
                name = f"o{len(self._texts)}"
                self._trace._lines.append(f"{name} = {text}")
                text = name
            self._texts[key] = value, text
        return self._texts[key][1]

    def _text_of(self, value: Any) -> str | None:
        if isinstance(value, tuple | list | dict):
            return self._text_of_container(value)
        attributes = getattr(value, "__dict__", None) or {}
        texts = {name: self.text(part) for name, part in attributes.items()}
        if any(map(self.text, _referenced(value))):
            raise NotTraceableError(f"{type(value).__name__} holds traced numbers")
        if not any(texts.values()):
            return None
        constant = self._trace._constant
        # Contains all names, to preserve their order.
        known = constant({n: None if text else attributes[n] for n, text in texts.items()})
        changes = ", ".join(f"{name!r}: {text}" for name, text in texts.items() if text)
        if isinstance(value, BaseModel):
            return f"with_changes({constant(value)}, {{**{known}, {changes}}})"
        return f"with_attributes({constant(type(value))}, {{**{known}, {changes}}})"

    def _text_of_container(self, value: Any) -> str | None:
        constant = self._trace._constant
        parts = list(value.values() if isinstance(value, dict) else value)
        texts = [self.text(part) for part in parts]
        if not any(texts):
            return None
        full = [text or constant(part) for text, part in zip(texts, parts, strict=True)]
        if isinstance(value, dict):
            pairs = zip(map(constant, value), full, strict=True)
            return f"{{{', '.join(f'{key}: {text}' for key, text in pairs)}}}"
        listed = "".join(f"{each}, " for each in full)
        if type(value) in (tuple, list):
            return f"[{listed}]" if isinstance(value, list) else f"({listed})"
        return f"{constant(type(value))}({listed})"  # a named tuple


def _referenced(value: Any) -> list[Any]:
    """Return the objects that an object refers to, apart from its attributes."""
    match value:
        case BaseModel():
            return [value.__pydantic_private__, value.__pydantic_extra__]
        case FunctionType():
            return [[cell.cell_contents for cell in value.__closure__ or ()], value.__defaults__]
        case MethodType():
            return [value.__self__]
        case partial():
            return [value.func, value.args, value.keywords]
        case np.ndarray():
            return value.ravel().tolist() if value.dtype == object else []
    slots = [n for t in type(value).__mro__ for n in getattr(t, "__slots__", ())]
    return [getattr(value, name, None) for name in slots]
