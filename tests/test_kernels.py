"""Every kernel against its NumPy reference: odd sizes, 1xN images, all four patterns."""

import json

import numpy as np
import pytest

from clpipe.chain.making import make_chain
from clpipe.chain.registry import all_stages
from clpipe.chain.settings import Settings
from clpipe.engine.check import (
    SIZES,
    Difference,
    chain_for,
    check_ends,
    check_method,
    check_raw,
    compare,
    depends_on_pattern,
    example,
)
from clpipe.engine.runner import Runner
from clpipe.engine.sources import kernel_folder
from clpipe.reference.cfa import PATTERNS
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


@pytest.mark.parametrize(("stage", "method", "values"), VARIANTS)
def test_kernel_agrees_with_its_reference(device, stage, method, values):
    result = check_method(device, stage, method, patterns=("GRBG",), values=values)
    assert result.difference.samples > 1000
    assert result.passed, result


ON_PATTERNS = [
    pytest.param(stage, method, id=f"{stage.name}-{method.method}")
    for stage, method in methods.METHODS
    if depends_on_pattern(stage, method, {})
]


@pytest.mark.slow  # every method reads the pattern by the functions of lib/cfa.h
@pytest.mark.parametrize(("stage", "method"), ON_PATTERNS)
def test_kernel_agrees_with_its_reference_in_every_pattern(device, stage, method):
    # In several launches, patterns in which red stands in either row and in either column.
    in_one = len(chain_for(stage, method, {}, "GRBG").steps[0].method.passes()) == 1
    result = check_method(device, stage, method, patterns=PATTERNS if in_one else ("GBRG",))
    assert result.passed, result


@pytest.mark.parametrize("pattern", PATTERNS)
def test_bilinear_agrees_with_its_reference_in_every_pattern(device, pattern):
    stage = all_stages()["demosaic"]
    result = check_method(device, stage, stage.by_name["bilinear"], patterns=(pattern,))
    assert result.passed, result


@pytest.mark.parametrize(("stage", "method"), methods.ALL)
def test_kernel_agrees_with_its_reference_on_one_lane(scalar_device, stage, method):
    result = check_method(scalar_device, stage, method, SMALL_SIZES, ("GRBG",))
    assert result.passed, result


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


@pytest.mark.parametrize("noise", ["skewed_gaussian", "gaussian", "poisson"])
def test_raw_is_bit_for_bit_the_references(device, noise):
    result = check_raw(device, noise, patterns=("GRBG",))
    assert result.difference.differing == 0, result


@pytest.mark.slow
@pytest.mark.parametrize("noise", ["skewed_gaussian", "gaussian", "poisson"])
def test_raw_is_bit_for_bit_the_references_in_every_way(device, scalar_device, noise):
    for pattern in PATTERNS if noise == "skewed_gaussian" else ():
        assert check_raw(device, noise, patterns=(pattern,)).difference.differing == 0
    assert check_raw(scalar_device, noise, patterns=("GRBG",)).difference.differing == 0


def test_images_enter_and_leave_as_the_references_say(device, scalar_device):
    for any_device, sizes in ((device, SIZES), (scalar_device, SMALL_SIZES)):
        result = check_ends(any_device, sizes)
        assert result.passed, result


# Noise that is loud, so that filters do something to a random image.
LOUD = {"luma_noise": 0.1, "chroma_noise": 0.1}
SMALL = ((1, 1), (1, 5), (40, 1), (4, 3), (9, 8), (17, 70))
WINDOWS = [
    (method, sizes)
    for method in all_stages()["denoise"].methods
    if issubclass(method, WindowDenoiser)
    for sizes in ((1, 5), (15, 7))  # those of 3 and 5 are compared above
    if max(sizes) <= method.largest_size
]


@pytest.mark.slow
@pytest.mark.parametrize(("method", "sizes"), WINDOWS, ids=lambda x: str(getattr(x, "method", x)))
def test_windows_of_all_sizes_on_small_images(device, scalar_device, method, sizes):
    values = {"method": method.method, "luma_size": sizes[0], "chroma_size": sizes[1], **LOUD}
    settings = Settings(iso=3200, stages=("denoise",), parameters={"denoise": values})
    chain = make_chain(settings)
    assert compare(device, chain, SMALL).largest < 2e-4
    if sizes == (1, 5):
        assert compare(scalar_device, chain, SMALL[:5]).largest < 2e-4


@pytest.mark.parametrize("method", all_stages()["denoise"].methods, ids=lambda x: x.method)
def test_a_strength_of_0_is_off(device, method):
    values = {"method": method.method, "luma_strength": 0.0, "chroma_strength": 0.0, **LOUD}
    settings = Settings(stages=("denoise",), parameters={"denoise": values})
    runner = Runner(make_chain(settings), device, encode=False, final=True)
    image = example(Kind.RGB, (33, 70))
    assert np.abs(runner.run(image, "k").final - image).max() < 2e-6


# One pattern in every way, the others for what depends on the pattern: each is compiled anew.
MOSAIC_WINDOWS = [("GRBG", 1), ("GRBG", 15), ("GBRG", 7)]


@pytest.mark.slow
@pytest.mark.parametrize(("pattern", "size"), MOSAIC_WINDOWS)
def test_mosaic_windows_of_all_sizes_on_small_images(device, scalar_device, pattern, size):
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
