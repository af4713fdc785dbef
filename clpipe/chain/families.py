"""Families: chains that differ only in numbers, computed from one that was built.

Building a chain runs the code of each stage. If an ISO or a parameter is drawn for each image, the
same code would run for each image to compute a few numbers. Therefore the code is traced once (see
:mod:`clpipe.base.tracing`), and the trace is replayed with other numbers. The values are the same
to the last bit, in a hundredth of the time. Code that cannot be traced runs every time.
"""

from collections.abc import Callable, Hashable, Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any

from clpipe.base.cache import BoundedCache, Identity
from clpipe.base.digests import stamp_of
from clpipe.base.tracing import Trace, with_attributes, with_changes
from clpipe.camera.profile import Camera
from clpipe.chain.chain import Chain, Step
from clpipe.chain.registry import all_stages
from clpipe.chain.settings import Settings
from clpipe.stage import Method

# Families for settings that differ only in numbers, such as ISOs of different gain stages.
MAX_FAMILIES = 16
MAX_SETTINGS = 256

Numbers = Sequence[Any]  # floats, or the objects that replace them while code is traced
MakeChain = Callable[[Numbers], Chain]


class Family:
    """Chains that differ only in numbers.

    Args:
        make: builds a chain from numbers, which may be traced.
        numbers: the numbers to trace with.

    Raises:
        NotTraceableError: the computation cannot be traced.
    """

    def __init__(self, make: MakeChain, numbers: Numbers) -> None:
        self._make = make
        self._traced = numbers
        self._is_checked = False
        self._derived: dict[Callable[[Chain], Chain], Families] = {}
        trace = Trace(numbers)
        chain = make(trace.inputs).traced(trace)
        self._steps = trace.repeat(chain.steps)
        self._attributes = trace.repeat({**vars(chain), "steps": None, "settings": None})

    def steps(self, numbers: Numbers) -> tuple[Step, ...]:
        """Return the steps of the chain for these numbers."""
        steps: tuple[Step, ...] = self._steps(numbers)
        return steps

    def chain(self, numbers: Numbers) -> Chain | None:
        """Return the chain for these numbers; None if it does not belong to the family.

        The first chain whose numbers were not traced is also built in full and compared.
        """
        try:
            attributes = self._attributes(numbers)
        except (ArithmeticError, ValueError):
            return None  # building the chain raises a better message
        if attributes is None:
            return None
        del attributes["steps"]
        chain = with_attributes(ComputedChain, {**attributes, "family": self, "numbers": numbers})
        if not self._is_checked and numbers != self._traced:
            self._is_checked = self._is_equal(chain, numbers)
            if not self._is_checked:
                self._attributes = lambda numbers: None
                return None
        return chain

    def _is_equal(self, chain: Chain, numbers: Numbers) -> bool:
        try:
            return chain.equals(self._make(numbers))
        except Exception:  # the error is raised again where the chain itself is built
            return False

    def derive(self, make: Callable[[Chain], Chain], chain: Chain, numbers: Numbers) -> Chain:
        """Return ``make(chain)`` for the chain of these numbers."""
        families = self._derived.setdefault(make, Families())
        return families.chain(
            numbers, lambda numbers: make(self._make(numbers)), lambda: make(chain)
        )


class ComputedChain(Chain):
    """A chain of a family. Its steps are computed on first access."""

    family: Family | None = None  # None in a copy with other steps
    numbers: Numbers = ()

    @cached_property
    def steps(self) -> tuple[Step, ...]:
        """The steps."""
        assert self.family
        return self.family.steps(self.numbers)

    def derive(self, make: Callable[[Chain], Chain]) -> Chain:
        if not self.family:
            return make(self)
        found = self.family.derive(make, self, self.numbers)
        return found.with_settings(self.settings)


class Families:
    """The families of chains with the same settings: one for each path through the code."""

    def __init__(self) -> None:
        self._known: list[Family] = []
        self._is_new = True
        self._may_trace = True

    def chain(self, numbers: Numbers, make: MakeChain, plain: Callable[[], Chain]) -> Chain:
        """Return the chain for these numbers.

        Args:
            numbers: the numbers.
            make: builds a chain from numbers, which may be traced.
            plain: builds the chain for these numbers without tracing.

        Raises:
            RequestError: the chain cannot be built.
        """
        for family in self._known:
            if chain := family.chain(numbers):
                return chain
        chain = plain()
        if self._may_trace and not self._is_new:  # the first request is not traced
            self._add(numbers, make, chain)
        self._is_new = False
        return chain

    def _add(self, numbers: Numbers, make: MakeChain, chain: Chain) -> None:
        try:
            family = Family(make, numbers)
            computed = family.chain(numbers)
        except Exception:  # a stage's code may raise any error if its numbers are not floats
            computed = None
        if computed and computed.equals(chain):
            self._known.append(family)
        else:
            self._may_trace = False
        self._may_trace &= len(self._known) < MAX_FAMILIES


FAMILIES: BoundedCache[Families] = BoundedCache(MAX_SETTINGS)


def chain_of_family(
    settings: Settings, camera: Camera, ends: Hashable, make: Callable[[Settings], Chain]
) -> Chain:
    """Return the chain of settings. It is computed if one that differs only in numbers is known.

    Args:
        settings: settings without draws.
        camera: the camera of the settings.
        ends: the other values that the chain depends on.
        make: builds the chain.

    Raises:
        RequestError: the chain cannot be built.
    """
    others, numbers = numbers_of(settings)
    render = settings.render
    timeless = render if render.exposure_time is None else with_changes(render, {TIME: None})
    key = (
        ends,
        Identity(camera),
        Identity(all_stages()),
        *(getattr(settings, name) for name in KEY_SETTINGS),
        timeless,
        others,
        *((file, stamp_of(Path(file))) for file in settings.files()),
    )
    try:
        families = FAMILIES.get(key, Families)
    except TypeError:  # a value without a hash
        return make(settings)
    chain = families.chain(
        numbers, lambda numbers: make(with_numbers(settings, numbers)), lambda: make(settings)
    )
    return chain.with_settings(settings)


KEY_SETTINGS = ("stages", "skip", "lens", "focal_length", "aperture", "focus_distance")

TIME = "exposure_time"  # of the render; auto exposure changes it from frame to frame


def numbers_of(settings: Settings) -> tuple[Hashable, tuple[float, ...]]:
    """Return all values that are not floats, and the floats among the values that are set."""
    numbers, others = [settings.iso], []
    time = settings.render.exposure_time
    if time is not None:
        numbers.append(time)
    for step, method in _methods_with_values(settings):
        table = settings.parameters[step]
        values = [getattr(method, name) for name in table]
        kinds = [None if type(value) is float else value for value in values]
        others.append((step, type(method), *table, *kinds))
        numbers += [value for value in values if type(value) is float]
    return (time is None, tuple(settings.parameters), *others), tuple(numbers)


def with_numbers(settings: Settings, numbers: Numbers) -> Settings:
    """Return settings with other floats, in the order of :func:`numbers_of`."""
    remaining = iter(numbers)
    iso, render = next(remaining), settings.render
    if render.exposure_time is not None:
        render = with_changes(render, {TIME: next(remaining)})
    parameters, validated = dict(settings.parameters), dict(settings.validated)
    for step, method in _methods_with_values(settings):
        table = settings.parameters[step]
        floats = {name: next(remaining) for name in table if type(getattr(method, name)) is float}
        parameters[step] = {**table, **floats}
        validated[step] = parameters[step], with_changes(method, floats) if floats else method
    return replace(settings, iso=iso, render=render, parameters=parameters, validated=validated)


def _methods_with_values(settings: Settings) -> list[tuple[str, Method]]:
    """Return the methods of the steps that have a value set, with the steps' names."""
    set_ = (step for step in settings.step_names if step in settings.parameters)
    return [(step, settings.method(step)) for step in set_]
