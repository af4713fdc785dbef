"""Every kernel against its NumPy reference: odd sizes, 1xN images, all four patterns."""

from dataclasses import replace

import numpy as np
import pytest

from clpipe.check import SIZES, check_method, check_raw, compare
from clpipe.config import Settings, make_chain
from clpipe.device import Device
from clpipe.registry import all_stages
from clpipe.run import Runner
from clpipe.stage import Kind, variant_label, variants

METHODS = [(stage, method) for stage in all_stages().values() for method in stage.methods]
VARIANTS = [
    pytest.param(stage, method, values, id=f"{stage.name}-{variant_label(method, values)}")
    for stage, method in METHODS
    for values in variants(method)
]
KERNELS = {
    "exposure",
    "mosaic",
    "site_gains",
    "sensor_noise_gaussian",
    "line_noise",
    "quantize",
    "normalize",
    "gray_world",
    "white_patch",
    "demosaic_bilinear",
    "demosaic_edge_directed",
    "demosaic_edge_directed_median",
    "demosaic_malvar2004",
    "demosaic_median",
    "demosaic_menon2007",
    "denoise_bilateral",
    "color_matrix",
    "curve",
}


@pytest.fixture(scope="module")
def scalar_device(device: Device) -> Device:
    """The same device as if it were a GPU: one lane, so the kernels are plain scalar code."""
    return Device(replace(device.info, lanes=1))


@pytest.mark.parametrize(("stage", "method", "values"), VARIANTS)
def test_kernel_agrees_with_its_reference(device, stage, method, values):
    result = check_method(device, stage, method, values=values)
    assert result.samples > 1000
    assert result.passed, result


@pytest.mark.parametrize(("stage", "method", "values"), VARIANTS)
def test_kernel_agrees_with_its_reference_on_one_lane(scalar_device, stage, method, values):
    result = check_method(scalar_device, stage, method, SIZES[:6], ("GRBG", "BGGR"), values)
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


def test_raw_is_bit_for_bit_the_references(device, scalar_device):
    for any_device in (device, scalar_device):
        result = check_raw(any_device)
        assert result.differing == 0, result


@pytest.mark.parametrize("radius", [1, 3, 7])
def test_wide_stencils_on_small_images(device, radius):
    settings = Settings(
        stages=("denoise",),
        parameters={
            "denoise": {
                "radius": radius,
                "luma_sigma": 0.2,
                "chroma_sigma": 0.3,
                "spatial_sigma": 3,
            }
        },
    )
    _, _, largest = compare(device, settings, Kind.RGB, ((1, 1), (1, 5), (4, 3), (9, 8), (33, 70)))
    assert largest < 2e-4


def test_a_wrong_kernel_is_caught(device, monkeypatch):
    stage = all_stages()["exposure"]
    method = stage.methods[0]
    monkeypatch.setattr(method, "reference", lambda self, image, frame: image * np.float32(1.001))
    assert not check_method(device, stage, method).passed


def test_every_kernel_file_belongs_to_a_method():
    assert {method.kernel for _, method in METHODS if method.kernel} == KERNELS
