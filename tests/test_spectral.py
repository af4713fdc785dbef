"""Spectral bands in files: they are recognised by their names, and never dropped without a word."""

import numpy as np
import OpenImageIO as oiio
import pytest

from clpipe.base.errors import NoPictureError
from clpipe.images.read import read_image
from clpipe.images.spectral import spectra_in


def test_names_of_wavelengths():
    for form in ("S0.{},25nm", "S0.{}.25nm", "{}.25nm", "band.{}.25nm", "my.layer.{},25nm"):
        names = ["B", *(form.format(nm) for nm in (700, 400, 500, 600)), "A"]
        [spectrum] = spectra_in(names)
        assert spectrum.wavelengths == (400.25, 500.25, 600.25, 700.25), form
        assert spectrum.channels == (2, 3, 4, 1)
        assert spectrum.layer == form.partition("{}")[0].rstrip(".")


def test_other_units_and_exponents():
    names = ["0.4um", "4.5e-7m", "S0.5,0E2nm", "599.584916THz", "550nm", "600nm"]
    [spectrum] = spectra_in(names)
    assert spectrum.wavelengths == pytest.approx((400, 450, 500, 550, 600))
    assert spectra_in([*names, *(f"S0.{nm}nm" for nm in (400, 450, 600))])[1].layer == "S0"


def test_stokes_and_reflective_layers_are_apart():
    names = [f"{layer}.{nm},0nm" for layer in ("S1", "S0", "T") for nm in range(400, 800, 100)]
    assert [each.layer for each in spectra_in(names)] == ["S0", "S1", "T"]
    assert spectra_in(names)[0].channels == (4, 5, 6, 7)


@pytest.mark.parametrize(
    "names",
    [
        ["R", "G", "B", "A", "Z"],
        ["400nm", "500nm", "600nm"],
        ["Depth.Z", "uv.m", "12m.x", "S0.nm", "S0.,5nm", "nm", "5 nm", "4mm", "5mm", "6mm"],
    ],
)
def test_other_channels_are_no_spectrum(names):
    assert spectra_in(names) == []


@pytest.fixture
def write(tmp_path):
    def written(names):
        path = tmp_path / "spectral.exr"
        spec = oiio.ImageSpec(12, 8, len(names), oiio.FLOAT)
        spec.channelnames = names
        output = oiio.ImageOutput.create(str(path))
        assert output.open(str(path), spec)
        output.write_image(np.random.default_rng(0).random((8, 12, len(names)), np.float32))
        output.close()
        return path

    return written


BANDS = [f"S0.{nm},00nm" for nm in range(400, 710, 10)]


def test_bands_next_to_a_picture_are_named(write):
    image = read_image(write(["R", "G", "B", *BANDS]))
    [warning] = image.warnings
    assert warning == (
        "its 31 spectral bands from 400 to 700 nm (layer S0) are not used; its R, G and B were read"
    )


def test_bands_alone_are_no_picture(write):
    with pytest.raises(NoPictureError, match=r"31 spectral bands from 400 to 700 nm \(layer S0\)"):
        read_image(write(BANDS))
