"""Chains share validated methods, so making one chain must not change the numbers of another."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from itertools import product
from threading import Barrier

import numpy as np
import pytest
from pydantic import PrivateAttr

from clpipe.base.cache import BoundedCache
from clpipe.base.errors import RequestError
from clpipe.chain import families
from clpipe.chain.making import make_chain
from clpipe.chain.render_camera import RenderCamera
from clpipe.engine.check import chain_for
from clpipe.stage import Method
from tests.methods import METHODS

# Two cameras, ISOs and exposure times.
SHOTS = list(product(("sony-a7r2", "canon-5d2"), (100, 1600), (0.01, 2.0)))
IDS = [f"{stage.name}-{method.method}" for stage, method in METHODS]


def content(value):
    """A value in a form that compares by its content."""
    return (value.shape, value.tobytes()) if isinstance(value, np.ndarray) else repr(value)


def numbers(chain):
    """All numbers of a chain: parameters, private attributes and kernel arguments."""
    return [
        (
            repr(step.method),
            {name: content(value) for name, value in step.method.__pydantic_private__.items()},
            {name: content(v) for name, v in step.method.arguments(step.context).items()},
            repr(step.passes),
        )
        for step in chain.steps
    ]


def settings_of(stage, method, values):
    """Settings whose validated methods all chains share, like those of one configuration."""
    settings = chain_for(stage, method, values, "RGGB").settings
    empty: dict = {name: {} for name in settings.step_names}
    parameters = {**empty, **settings.parameters}
    shared = replace(settings, parameters=parameters)
    validated = {name: (parameters[name], shared.method(name)) for name in shared.step_names}
    return replace(shared, validated=validated)


def fully_set(stage, method):
    """The parameters of a method that resolving has nothing to add to; None if it allows none."""
    step = chain_for(stage, method, {}, "RGGB").steps[-1]
    if type(step.method) is not method:
        return None
    values = {k: v for k, v in dict(step.method).items() if v is not None}
    try:
        chain_for(stage, method, values, "RGGB")
    except RequestError:
        return None
    return values


def make(stage, settings, shot):
    """The chain of a shot, or why the stage rejects it."""
    camera, iso, time = shot
    render = RenderCamera(exposure_time=time)
    try:
        shot_settings = replace(settings, camera=camera, iso=iso, render=render)
        return make_chain(shot_settings, start_at=stage.name)
    except RequestError as error:
        return str(error)


def numbers_after(stage, settings, shots, at_once=False):
    """The numbers of all shots' chains, read after all chains were made anew."""
    families.FAMILIES = BoundedCache(families.MAX_SETTINGS)
    if at_once:
        barrier = Barrier(2)

        def half(number):
            barrier.wait(timeout=120)
            return {shot: make(stage, settings, shot) for shot in shots[number::2]}

        with ThreadPoolExecutor(2) as pool:
            first, second = pool.map(half, range(2))
        chains = first | second
    else:
        chains = {shot: make(stage, settings, shot) for shot in shots}
    return {s: c if isinstance(c, str) else numbers(c) for s, c in chains.items()}


@pytest.mark.parametrize(("stage", "method"), METHODS, ids=IDS)
def test_no_chain_changes_another(stage, method, monkeypatch):
    monkeypatch.setattr(families, "FAMILIES", families.FAMILIES)  # restored at the end
    for values in ({}, fully_set(stage, method)):
        if values is None:
            continue
        alone = {
            shot: numbers_after(stage, settings_of(stage, method, values), [shot])[shot]
            for shot in SHOTS
        }
        settings = settings_of(stage, method, values)
        for shots in (SHOTS, SHOTS[::-1]):
            assert numbers_after(stage, settings, shots) == alone
        assert numbers_after(stage, settings, SHOTS, at_once=True) == alone


def test_most_methods_are_also_tested_with_all_parameters_set():
    assert sum(fully_set(*each) is not None for each in METHODS) > 0.8 * len(METHODS)


class Gain(Method):
    method = "gain"
    value: float = 1.0
    _range: float = PrivateAttr(1.0)

    def resolve(self, context):
        self._range = 2.0
        return self


def test_a_method_cannot_be_changed():
    gain = Gain()
    with pytest.raises(AttributeError, match=r"Gain._range .* with_state\(_range=...\)"):
        gain.resolve(None)
    for name in ("value", "other", "_other"):
        with pytest.raises(AttributeError, match=rf"Gain.{name} cannot be set"):
            setattr(gain, name, 2.0)
    with pytest.raises(AttributeError, match="Gain declares no private attribute _renge"):
        gain.with_state(_renge=2.0)
    copy = gain.with_state(_range=2.0)
    assert (gain._range, copy._range) == (1.0, 2.0) and copy == copy.model_copy()
