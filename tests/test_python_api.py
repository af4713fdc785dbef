"""The package for Python users: exported names, short reprs, read-only attributes."""

import inspect
import re
from doctest import SKIP, DocTestParser

import numpy as np
import pytest

import clpipe
from clpipe.stages import DEFAULT_CHAIN
from tests.conftest import ROOT, STILL_LIFE, run_python


def test_every_exported_name_is_there_and_has_an_example():
    page = (ROOT / "docs" / "api.md").read_text()
    for name in clpipe.__all__:
        exported = getattr(clpipe, name)
        assert name in dir(clpipe)
        if name != "__version__":
            examples = DocTestParser().get_examples(exported.__doc__)
            assert examples, name
            assert not any(SKIP in example.options for example in examples), name
            assert f"::: clpipe.{name}\n" in page
    with pytest.raises(AttributeError, match="no attribute 'Pipelin'"):
        _ = clpipe.Pipelin


@pytest.mark.parametrize(
    ("function", "owner"),
    [
        (clpipe.run, clpipe.run),
        (clpipe.Pipeline.__init__, clpipe.Pipeline),
        (clpipe.Pipeline.process, clpipe.Pipeline.process),
        (clpipe.Pipeline.carry, clpipe.Pipeline.carry),
        (clpipe.Dataset.__init__, clpipe.Dataset),
        (clpipe.RawNoise.__init__, clpipe.RawNoise),
        (clpipe.RawNoise.__call__, clpipe.RawNoise.__call__),
        (clpipe.StreamingDataset.__init__, clpipe.StreamingDataset),
        (clpipe.Patches.__init__, clpipe.Patches),
    ],
)
def test_every_parameter_is_documented_and_none_has_an_empty_default(function, owner):
    for parameter in inspect.signature(function).parameters.values():
        if parameter.name != "self":
            stars = {parameter.VAR_KEYWORD: r"\*\*", parameter.VAR_POSITIONAL: r"\*"}
            name = stars.get(parameter.kind, "") + parameter.name
            assert re.search(rf"^ +(\w+, )*{name}(, \w+)*: \S", owner.__doc__, re.M), name
            assert parameter.default != ()


def test_the_type_checkers_names_are_the_lazy_ones():
    text = (ROOT / "clpipe" / "__init__.py").read_text()
    for module, names in clpipe._NAMES.items():
        assert f"    from {module} import {', '.join(names)}\n" in text
    assert {name for names in clpipe._NAMES.values() for name in names} < {*clpipe.__all__}


def test_importing_it_imports_nothing_heavy():
    heavy = ("numpy", "pydantic", "pyopencl", "OpenImageIO", "click")
    code = f"import clpipe, sys; print([name for name in {heavy} if name in sys.modules])"
    assert run_python("-c", code).stdout == "[]\n"


def test_a_camera_is_called_and_a_wrong_request_is_a_value_error():
    camera = clpipe.Pipeline(iso=3200, device="numpy")
    render = np.full((24, 32, 3), 0.2, np.float32)
    shots = [camera(render, "a").image, camera.process(render, "a").image, camera(render).image]
    np.testing.assert_array_equal(shots[0], shots[1])
    assert (shots[0] != shots[2]).any()
    with pytest.raises(ValueError, match="unknown key 'noize'"):
        clpipe.Pipeline(noize=1)


def test_reprs_are_short():
    camera = clpipe.Pipeline(iso=3200, device="numpy", until="quantize")
    assert repr(camera) == f"Pipeline(sony-a7r2, ISO 3200, {DEFAULT_CHAIN[0]}..quantize, on numpy)"
    shot = camera.process(np.zeros((4, 6, 3), np.float32), "a")
    assert repr(shot) == "Result(final: (4, 6) float32)"
    assert repr(camera.chain) == f"Chain(sony-a7r2, ISO 3200, {DEFAULT_CHAIN[0]}..quantize)"
    assert repr(camera.chain.step_named("exposure")) == "Step(exposure, gain)"
    samples = clpipe.Dataset(STILL_LIFE, iso={"choice": [100, 800]}, epochs=3)
    assert repr(samples) == "Dataset(1 images, 3 epochs, sony-a7r2, drawn ISO)"
    assert len(repr(clpipe.load_camera("sony-a7r2"))) < 80


def test_what_cannot_be_assigned_refuses():
    camera = clpipe.Pipeline(device="numpy")
    with pytest.raises(AttributeError, match=r"cannot set iso: .* Create another one with iso="):
        camera.iso = 800
    with pytest.raises(AttributeError, match="cannot set truth"):
        clpipe.Dataset(STILL_LIFE).truth = True
    shot = camera.process(np.zeros((4, 6, 3), np.float32), "a")
    with pytest.raises(AttributeError):
        shot.encoded = None


@pytest.mark.parametrize("until", [None, "normalize"])
def test_a_notebook_shows_a_result(until):
    camera = clpipe.Pipeline(device="numpy", until=until)
    shot = camera.process(np.full((4, 6, 3), 0.5, np.float32), "a")
    assert shot._repr_png_().startswith(b"\x89PNG")
