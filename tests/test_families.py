"""Traced chains equal resolved chains when only numbers differ."""

import math
import operator
import re
from contextlib import suppress
from functools import partial
from random import Random

import numpy as np
import pytest

from clpipe.base.cache import BoundedCache
from clpipe.base.errors import RequestError
from clpipe.base.pure import pure
from clpipe.base.tracing import NotTraceableError, Trace, call
from clpipe.camera.profile import built_in_cameras, load_camera
from clpipe.chain.chain import COMPUTED, Chain
from clpipe.chain.families import ComputedChain
from clpipe.chain.limits import field_limits
from clpipe.chain.making import make_chain
from clpipe.chain.registry import all_stages
from clpipe.chain.settings import overlay, settings_from
from clpipe.engine.ops import chain_ops
from clpipe.stage import CompileTime


def slow(seed):
    return pytest.param(seed, marks=pytest.mark.slow)


@pytest.fixture
def families(monkeypatch):
    """Clear the cache of chains."""
    known = BoundedCache(64)
    monkeypatch.setattr("clpipe.chain.families.FAMILIES", known)
    return known


def made(settings, monkeypatch):
    """Resolve the chain of settings without a family."""
    with monkeypatch.context() as alone:
        alone.setattr("clpipe.chain.families.FAMILIES", BoundedCache(1))
        return make_chain(settings)


def assert_equal(chain, other):
    assert len(chain.steps) == len(other.steps)
    for step, own in zip(chain.steps, other.steps, strict=True):
        assert step.equals(own), step.name
        assert step.arguments.keys() == own.arguments.keys()
        for name, value in step.arguments.items():
            expected = own.arguments[name]
            assert type(value) is type(expected), (step.name, name)
            if not isinstance(value, CompileTime):
                assert value.tobytes() == expected.tobytes(), (step.name, name)
    assert [repr(step.method) for step in chain.steps] == [repr(s.method) for s in other.steps]


def numbers_of_stages():
    """Each number that a method takes, with its limits and the method's example."""
    for stage in all_stages().values():
        for method in stage.methods:
            for name in method.model_fields:
                if limits := field_limits(method, name):
                    yield stage.name, method, name, limits


def drawn_at_random(random):
    """Settings of six images, which differ in a few numbers."""
    base, drawn = {"camera": random.choice(list(built_in_cameras()))}, {}
    if random.random() < 0.3:
        base["mosaic"] = {"method": "array", "array": random.choice(["RCCB", "mono", "x-trans"])}
    for stage, method, name, limits in random.sample(list(numbers_of_stages()), 3):
        if stage not in base:
            base[stage] = {**method.example, "method": method.method}
            base[stage].pop(name, None)
            drawn[stage, name] = max(limits.low, -2, 1e-3), min(limits.high, 5), limits.whole
    low, high = load_camera(base["camera"]).iso_range
    for _ in range(6):
        values = {"iso": random.uniform(low, high)}
        for (stage, name), (least, most, whole) in drawn.items():
            value = random.choice([least, most, *[random.uniform(least, most)] * 3])
            values[stage] = {name: round(value) if whole else float(value)}
        with suppress(RequestError):
            yield overlay(settings_from(base), values)


@pytest.mark.parametrize("seed", [*range(24), *(slow(n) for n in range(24, 120))])
def test_chains_of_numbers_at_random_are_those_that_are_made(seed, families, monkeypatch):
    for settings in drawn_at_random(Random(seed)):
        try:
            expected = made(settings, monkeypatch)
        except RequestError as error:
            with pytest.raises(RequestError, match=re.escape(str(error))):
                make_chain(settings)
            continue
        assert_alike(make_chain(settings), expected)


def assert_alike(chain, expected):
    """Check that a chain and its truths are as expected."""
    assert_equal(chain, expected)
    for name in {*COMPUTED} - {"_resamplings"}:
        assert repr(getattr(chain, name)) == repr(getattr(expected, name))
    assert chain_ops(chain, chain.arguments) == chain_ops(expected, expected.arguments)
    for derived in (Chain.without_noise_or_denoising, Chain.without_noise):
        try:
            truth = derived(expected)
        except RequestError:
            with pytest.raises(RequestError):
                derived(chain)
            continue
        assert_equal(derived(chain), truth)


def test_chains_of_one_structure_have_one_plan(families):
    general = settings_from({"camera": "canon-5d2"})
    chains = [make_chain(overlay(general, {"iso": iso})) for iso in (400.0, 500, 620, 710, 730)]
    one, other = chains[-2:]
    assert one.structure is other.structure
    assert one.without_noise_or_denoising().structure is not one.structure
    ops = [chain_ops(c, {s.name: s.arguments for s in c.steps}) for c in (one, other)]
    assert ops[0] == ops[1]


@pytest.mark.parametrize("places", [("render",), ("render", "shutter", "dark_current")])
def test_exposure_times_of_auto_exposure_are_one_family(places, families, monkeypatch):
    """A stream has another time in each frame, and must not resolve its chain each time."""
    general = {"camera": "canon-5d2", "shutter": {"flicker_depth": 0.3, "line_time": 1e-5}}
    base = settings_from(general)
    chains = []
    for time in (0.01, 0.0112, 0.0131, 0.0147):
        settings = overlay(base, {place: {"exposure_time": time} for place in places})
        chains.append(make_chain(settings))
        assert_equal(chains[-1], made(settings, monkeypatch))
        assert chains[-1].optics.exposure_time == time == chains[-1].settings.render.exposure_time
    assert [isinstance(chain, ComputedChain) for chain in chains] == [False, False, True, True]
    other = overlay(base, {place: {"exposure_time": 0.02} for place in places})
    with pytest.raises(RequestError, match="contradicts"):
        make_chain(overlay(other, {"shutter": {"exposure_time": 0.03}}))


def test_code_that_computes_beside_its_arguments_is_found_out(families, monkeypatch):
    """The first untraced chain is compared with the resolved chain."""
    from clpipe.stages.exposure.gain import Gain

    seen = []

    def resolve(self, context):
        seen.append(float(getattr(self.ev, "value", self.ev)))  # what no trace sees
        return self.model_copy(update={"headroom": seen[-1] + 1})

    monkeypatch.setattr(Gain, "resolve", resolve)
    general = settings_from({})
    for ev in (0.1, 0.2, 0.3, 0.4):
        chain = make_chain(overlay(general, {"exposure": {"method": "gain", "ev": ev}}))
        assert chain.step_named("exposure").method.headroom == ev + 1


def test_a_changed_file_is_read_again(families, tmp_path):
    curve = tmp_path / "curve.csv"
    means = []
    for ev, values in enumerate(("0,0\n1,1\n", "0,0\n1,1\n", "0,0\n1,1\n", "0,0\n0.5,0.9\n1,1\n")):
        curve.write_text(values)
        table = {"method": "file", "path": str(curve)}
        settings = settings_from({"tone_curve": table, "exposure": {"ev": float(ev)}})
        means.append(make_chain(settings).step_named("tone_curve").arguments["table"].mean())
    assert means[0] == means[1] == means[2] < means[3]


def test_operations_are_repeated_in_order():
    halves = pure(lambda x: divmod(x, 0.5))

    def computed(x, y):
        z = x / y - 2 * x + y**2 if x > y else -x + 1 / y
        numpys = [np.log(x), np.sqrt(2 * y)]
        return {
            "a": (z, abs(z) % 3, *halves(x)),
            "b": [max(x, y), 7, *numpys],
            "c": pure(np.float32)(x) * np.float32(0.1),
        }

    trace = Trace([3.0, 2.0])
    repeat = trace.repeat(computed(*trace.inputs))
    for values in ([3.0, 2.0], [5.5, 0.1], [1e-3, 1e-9]):
        assert repeat(values) == computed(*values)
        assert type(repeat(values)["c"]) is np.float32
    assert repeat([1.0, 2.0]) is None


def test_a_value_that_is_taken_holds_for_that_value_only():
    trace = Trace([0.3, 0.5])
    x, y = trace.inputs
    repeat = trace.repeat(math.sin(x) + y)
    assert repeat([0.3, 0.9]) == math.sin(0.3) + 0.9
    assert repeat([0.4, 0.9]) is None


def test_a_part_that_fails_leaves_nothing():
    trace = Trace([2.0])
    (x,) = trace.inputs
    with pytest.raises(NotTraceableError), trace.attempt():
        assert float(x) == 2
    assert trace.repeat(x * 2)([3.0]) == 6.0


def test_what_cannot_be_replaced_is_refused():
    trace = Trace([2.0])
    (x,) = trace.inputs
    for hidden in (lambda: x, partial(operator.add, x), np.array([x])):
        with pytest.raises(NotTraceableError):
            trace.repeat([hidden])
    with pytest.raises(TypeError):
        hash(x)
    assert call(max, 1, 2) == 2


def test_a_trace_does_not_change_the_objects_it_copies(families):
    general = settings_from({"camera": "canon-5d2"})
    first = make_chain(overlay(general, {"iso": 400.0}))
    chains = [make_chain(overlay(general, {"iso": iso})) for iso in (500.0, 600.0, 640.0)]
    assert isinstance(first, Chain)
    assert [chain.steps[0].context.iso for chain in (first, *chains)] == [400, 500, 600, 640]
    assert len({chain.noise.a for chain in (first, *chains)}) == 4
