"""Every kernel against its NumPy reference: odd sizes, 1xN images, all four patterns."""

import json
from dataclasses import replace
from types import MappingProxyType

import numpy as np
import pytest

from clpipe.chain.making import make_chain
from clpipe.chain.registry import all_stages
from clpipe.chain.settings import Settings
from clpipe.engine.check import (
    ISO,
    SIZES,
    Difference,
    chain_for,
    check_formats,
    check_method,
    check_raw,
    compare,
    depends_on_pattern,
    example,
    filter_arrays_for,
    sensor_parameters,
    stages_to_raw,
)
from clpipe.engine.runner import Runner
from clpipe.engine.sources import kernel_folder
from clpipe.stage import Kind, variant_label, variants
from clpipe.stages.denoise.strength import WindowDenoiser
from tests import methods

VARIANTS = [
    pytest.param(
        stage,
        method,
        values,
        id=f"{stage.name}-{variant_label(method, values)}",
        marks=[pytest.mark.slow] if values else [],
    )
    for stage, method in methods.METHODS
    for values in variants(method)
]
SMALL_SIZES = SIZES[:6]


def on_one(device, stage, method, sizes=SIZES, values=MappingProxyType({})):
    """Compare a method with its reference on one Bayer pattern and one filter array, as it needs.

    The array is X-Trans, whose period fits no number of lanes.
    """
    arrays, total = filter_arrays_for(stage, method, values)[:1], Difference()
    bayer = ("GRBG",) * (depends_on_pattern(stage, method, values) or not arrays)
    for pattern in method.only_arrays or (*bayer, *arrays):
        total += compare(device, chain_for(stage, method, values, pattern), sizes)
    return total


@pytest.mark.parametrize(("stage", "method", "values"), VARIANTS)
def test_kernel_agrees_with_its_reference(device, stage, method, values):
    found = on_one(device, stage, method, values=values)
    assert found.samples > 1000
    assert found.largest <= method.tolerance


ON_FILTERS = [
    pytest.param(stage, method, id=f"{stage.name}-{method.method}")
    for stage, method in methods.METHODS
    if depends_on_pattern(stage, method, {}) or filter_arrays_for(stage, method, {})
]


@pytest.mark.slow  # every method reads the pattern by the functions of lib/cfa.h
@pytest.mark.parametrize(("stage", "method"), ON_FILTERS)
def test_kernel_agrees_with_its_reference_where_filters_are_elsewhere(device, stage, method):
    # GRBG's red is in another row and in another column. All arrays are tested only here.
    result = check_method(device, stage, method, patterns=("GBRG",))
    assert result.passed, result


@pytest.mark.parametrize(("stage", "method"), methods.ALL)
def test_kernel_agrees_with_its_reference_on_one_lane(scalar_device, stage, method):
    assert on_one(scalar_device, stage, method, SMALL_SIZES).largest <= method.tolerance


def test_structural_choices_are_found():
    methods = all_stages()["demosaic"].by_name
    assert list(variants(methods["edge_directed_median"])) == [
        {},
        {"classifier": "laroche_prescott"},
        {"classifier": "hibbard"},
        {"size": 5},
    ]
    assert list(variants(methods["bilinear"])) == [{}]
    assert list(variants(all_stages()["mosaic"].methods[0])) == [{}]


@pytest.mark.slow
@pytest.mark.parametrize("size", [3, 5])
def test_median_of_zeros_and_ones(device, size):
    # By the zero-one principle a network that sorts zeros and ones right sorts everything right.
    random = np.random.default_rng(size)
    image = (random.random((301, 403)) < 0.5).astype(np.float32)
    settings = Settings(
        stages=("demosaic",), parameters={"demosaic": {"method": "median", "size": size}}
    )
    chain = make_chain(settings, Kind.MOSAIC)
    one, two = (Runner(chain, d, final=True).run(image, "k").final for d in (device, None))
    assert np.array_equal(one, two)


@pytest.mark.parametrize(
    ("noise", "pattern", "lanes"),
    [
        ("skewed_gaussian", "GRBG", "many"),
        # The quick tests compare each of these methods alone with its reference, bit for bit.
        pytest.param("gaussian", "GRBG", "many", marks=pytest.mark.slow),
        pytest.param("poisson", "GRBG", "many", marks=pytest.mark.slow),
        pytest.param("skewed_gaussian", "GBRG", "many", marks=pytest.mark.slow),
        pytest.param("skewed_gaussian", "GRBG", "one", marks=pytest.mark.slow),
    ],
)
def test_raw_is_bit_for_bit_the_references(device, scalar_device, noise, pattern, lanes):
    result = check_raw(scalar_device if lanes == "one" else device, noise, patterns=(pattern,))
    assert result.difference.differing == 0, result


def test_images_enter_and_leave_as_the_references_say(device, scalar_device):
    for any_device, sizes in ((device, SIZES), (scalar_device, SMALL_SIZES)):
        result = check_formats(any_device, sizes)
        assert result.passed, result


# Noise that is loud, so that filters do something to a random image.
LOUD = {"luma_noise": 0.1, "chroma_noise": 0.1}
SMALL = ((1, 1), (1, 5), (40, 1), (4, 3), (9, 8), (17, 70))
WINDOWS = [
    (method, min(15, method.largest_size))
    for method in all_stages()["denoise"].methods
    if issubclass(method, WindowDenoiser)
]


@pytest.mark.slow
@pytest.mark.parametrize(("method", "size"), WINDOWS, ids=lambda x: str(getattr(x, "method", x)))
def test_the_smallest_and_a_large_window_on_small_images(device, scalar_device, method, size):
    values = {"method": method.method, "luma_size": 1, "chroma_size": size, **LOUD}
    settings = Settings(iso=3200, stages=("denoise",), parameters={"denoise": values})
    chain = make_chain(settings)
    assert compare(device, chain, SMALL).largest < 2e-4
    assert compare(scalar_device, chain, SMALL[:5]).largest < 2e-4


@pytest.mark.parametrize("method", all_stages()["denoise"].methods, ids=lambda x: x.method)
def test_a_strength_of_0_is_off(device, method):
    values = {"method": method.method, "luma_strength": 0.0, "chroma_strength": 0.0, **LOUD}
    settings = Settings(stages=("denoise",), parameters={"denoise": values})
    runner = Runner(make_chain(settings), device, encode=False, final=True)
    image = example(Kind.RGB, (33, 70))
    if method.method == "biweight":
        result = runner.run(image, "k").final
        assert np.abs(result - image).max() > 0.1  # chroma is smoothed, and luma is not:
        image = np.repeat(np.maximum(image[..., :1], 0), 3, axis=2)
    assert np.abs(runner.run(image, "k").final - image).max() < 2e-6


# One pattern in every way, another for what depends on the pattern: each is compiled anew.
MOSAIC_WINDOWS = [("GRBG", 15), ("GBRG", 1)]


@pytest.mark.slow
@pytest.mark.parametrize(("pattern", "size"), MOSAIC_WINDOWS)
def test_the_smallest_and_a_large_mosaic_window_on_small_images(
    device, scalar_device, pattern, size
):
    parameters = {
        "mosaic": {"pattern": pattern},
        "inverse_white_balance": {"red_gain": 2.0, "blue_gain": 1.5},
        "mosaic_denoise": {"size": size, "a": 0.02, "b": 0.01},
    }
    before = ("mosaic", "inverse_white_balance")
    whole = pattern == "GRBG"
    for balance in ((), ("white_balance",)) if whole else ((),):
        stages = (*before, *balance, "mosaic_denoise")
        settings = Settings(stages=stages, parameters=parameters)
        chain = make_chain(settings)
        assert compare(device, chain, SMALL).largest < 2e-4
    if whole:
        assert compare(scalar_device, chain, SMALL[:4]).largest < 2e-4


@pytest.mark.slow
def test_sums_over_the_blocks_of_a_wide_stencil(device, scalar_device):
    stages = ("mosaic", "mosaic_denoise", "white_balance")
    parameters = {"mosaic_denoise": {"a": 0.02}, "white_balance": {"method": "gray_world"}}
    settings = Settings(stages=stages, parameters=parameters)
    for one in (device, scalar_device):
        assert compare(one, make_chain(settings), ((5, 3), (37, 150))).largest < 2e-4


def test_a_wrong_kernel_is_caught(device, monkeypatch):
    stage = all_stages()["exposure"]
    method = stage.methods[0]
    monkeypatch.setattr(method, "reference", lambda self, image, given: image * np.float32(1.001))
    assert not check_method(device, stage, method).passed


def test_every_kernel_file_belongs_to_a_method():
    files = {path.stem for path in kernel_folder().glob("*.cl")}
    assert {method.kernel for _, method in methods.METHODS if method.kernel} == files


@pytest.mark.slow
def test_the_command_checks_every_stage(clpipe, monkeypatch):
    noises = all_stages()["sensor_noise"].methods
    # The tests above run what it runs.
    monkeypatch.setattr("clpipe.engine.check.compare", lambda *_, **__: Difference(1))
    record = json.loads(clpipe("check", "--small", "--json").stdout)
    assert record["failed"] == 0 and len(record["checks"]) == len(VARIANTS) + len(noises) + 2
    checked = {(check["stage"], check["method"].split()[0]) for check in record["checks"]}
    assert checked >= {(stage.name, method.method) for stage, method in methods.METHODS}
    ends = {"exposure..quantize", "source..8 bit", "exposure..gamma"}
    assert ends <= {check["stage"] for check in record["checks"]}


def test_every_source_of_noise_is_checked_in_the_raw(monkeypatch):
    """Also that of a plug-in. A new stage that draws noise in the mosaic needs a sensor's role."""
    plugin = replace(all_stages()["row_noise"], name="my_noise")
    monkeypatch.setattr("clpipe.chain.registry._from_files", {"my_noise.py": plugin})
    sensor = {stage.name for stage in all_stages().values() if stage.is_sensor}
    for stage in all_stages().values():
        for method in stage.methods if stage.reads is stage.writes is Kind.MOSAIC else ():
            (step,) = chain_for(stage, method, {}, "GRBG").steps
            assert stage.name in sensor or not any(each.random for each in step.passes)
    settings = Settings(iso=ISO, stages=stages_to_raw(), parameters=sensor_parameters())
    enabled = {step.name for step in make_chain(settings).steps if step.passes}
    assert sensor <= enabled and len(sensor) == 14
