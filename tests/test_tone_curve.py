"""Tone curves: picture styles, and curves from files."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from clpipe.base.errors import RequestError
from clpipe.chain.making import make_chain
from clpipe.chain.settings import settings_from
from clpipe.reference.transfer import srgb_curve
from clpipe.stage import run_reference
from clpipe.stages.inverse_tone_curve import Standard as InverseStandard
from clpipe.stages.tone_curve import CAMERA_RAW, Standard
from clpipe.stages.tone_curve.standard import GREY, GREY_OUT
from clpipe.stages.tone_curve.table import load_table

RAMP = np.linspace(0, 1, 300, dtype=np.float32).reshape(10, 10, 3)


def chain_with(path):
    return make_chain(settings_from({"tone_curve": {"method": "file", "path": str(path)}}))


@pytest.mark.parametrize(
    ("name", "text", "x", "y"),
    [
        ("a.csv", "x,y\n0,0\n0.5,0.25\n1,1\n", [0, 0.5, 1], [0, 0.25, 1]),
        ("semicolons.csv", "# mine\n0; 0.1\n1; 0.9\n", [0, 0.5, 1], [0.1, 0.5, 0.9]),
        ("bom.csv", "\ufeff0 0\n1 1", [0, 0.25, 1], [0, 0.25, 1]),
        ("short.csv", "0.25,0\n0.75,1\n", [0, 0.25, 0.5, 0.75, 1], [0, 0, 0.5, 1, 1]),
        (
            "a.cube",
            'TITLE "t"\nLUT_1D_SIZE 3\nDOMAIN_MIN 0 0 0\nDOMAIN_MAX 1 1 1\n0 0 0\n.2 .2 .2\n1 1 1',
            [0, 0.25, 0.5, 0.75],
            [0, 0.1, 0.2, 0.6],
        ),
        (
            "resolve.CUBE",
            "LUT_1D_SIZE 2\nLUT_1D_INPUT_RANGE 0.0 2.0\n0 0 0\n1 1 1\n",
            [0, 0.5, 1],
            [0, 0.25, 0.5],
        ),
    ],
)
def test_a_curve_from_a_file(develop, tmp_path, name, text, x, y):
    (tmp_path / name).write_text(text)
    image = np.repeat(np.float32(x)[None, :, None], 3, axis=2)
    settings = {"stages": ["tone_curve"], "tone_curve": {"method": "file"}}
    settings["tone_curve"]["path"] = str(tmp_path / name)
    for numpy in (False, True):
        result = develop(image, numpy=numpy, **settings).final
        assert result[0, :, 1] == pytest.approx(y, abs=2e-4)


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("a.csv", "", "a curve has at least two lines of x,y; this file has 0"),
        ("a.csv", "x,y\n", "a curve has at least two lines of x,y; this file has 0"),
        ("a.csv", "0,0\n", "a curve has at least two lines of x,y; this file has 1"),
        ("a.csv", "0,0\n0.5,0.5\n0.4,0.6\n", "line 3: x is 0.4 after 0.5; x must ascend"),
        ("a.csv", "0,0\n0.5,0.5\n0.5,0.6\n", "line 3: x is 0.5 after 0.5; x must ascend"),
        ("a.csv", "0,0\n1e-320,1\n1,1\n", "line 2: x is .* after 0; x must ascend"),
        (
            "a.csv",
            "0,0\n255,255\n",
            "line 2: x and y must be within 0 and 1; this line is '255,255'",
        ),
        ("a.csv", "0,0\n1,nan\n", "line 2: .*within 0 and 1"),
        ("a.csv", "0,0,0\n1,1,1\n", "line 1: expected two columns, x,y; this line has 3"),
        ("a.csv", "0,0\nwhite,1\n", "line 2: 'white,1' is not of the form x,y"),
        ("a.cube", "LUT_3D_SIZE 2\n", "line 1: the table has three dimensions"),
        ("a.cube", "LUT_1D_SIZE 3\n0 0 0\n1 1 1\n", "LUT_1D_SIZE 3, but 2 rows"),
        ("a.cube", f"LUT_1D_SIZE {'9' * 400}\n0 0 0\n1 1 1\n", "LUT_1D_SIZE inf, but 2 rows"),
        ("a.cube", "0 0 0\n1 1 1\n", "no LUT_1D_SIZE, but 2 rows"),
        ("a.cube", "LUT_1D_SIZE 2\n0 0 0\n1 1 .9\n", "line 3: red, green and blue differ"),
        ("a.cube", "LUT_1D_SIZE 2\n0 0\n1 1\n", "line 2: expected three numbers; this line has 2"),
        ("a.cube", "LUT_1D_SIZE x\n0 0 0\n1 1 1\n", "line 1: .*does not consist of numbers"),
        (
            "a.cube",
            "LUT_1D_SIZE 2\nDOMAIN_MIN 1 1 1\n0 0 0\n1 1 1\n",
            "its domain is 1 to 1",
        ),
        ("a.cube", "SHAPER 2\n", "line 1: 'SHAPER 2' is not valid"),
        ("a.txt", "0,0\n1,1\n", "expected a file with the extension .csv or .cube"),
    ],
)
def test_a_file_that_is_no_curve(tmp_path, name, text, message):
    (tmp_path / name).write_text(text)
    with pytest.raises(RequestError, match=rf"tone_curve.path: found '.*{name}': {message}"):
        chain_with(tmp_path / name)


def test_a_file_that_cannot_be_read(tmp_path):
    with pytest.raises(RequestError, match=r"tone_curve.path: .*cannot be read: No such file"):
        chain_with(tmp_path / "no.csv")
    (tmp_path / "bytes.csv").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(RequestError, match="not a text file"):
        chain_with(tmp_path / "bytes.csv")


def test_a_file_that_changed_is_read_again(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("0,0\n1,1\n")
    one = load_table(str(path))
    path.write_text("0,0\n1,0.5\n")
    assert one[-1] == 1
    assert load_table(str(path))[-1] == 0.5


def test_camera_raws_curve_is_a_file_of_the_same_form(develop):
    def curve(image, **values):
        return develop(image, stages=["tone_curve"], tone_curve=values).final

    named = curve(RAMP, method="camera_raw")
    assert np.array_equal(named, curve(RAMP, method="file", path=CAMERA_RAW))
    grey = curve(np.full((1, 1, 3), 0.2, np.float32), method="camera_raw")
    assert grey == pytest.approx(0.4294, abs=1e-4)


def test_a_linear_tone_curve_gives_the_headroom_back_and_changes_nothing_else(develop):
    linear = {"method": "linear"}
    assert np.array_equal(develop(RAMP, stages=["tone_curve"], tone_curve=linear).final, RAMP)
    for headroom in (1.0, 2.0):
        stages = {"stages": ["exposure", "tone_curve"], "exposure": {"headroom": headroom}}
        for numpy in (False, True):
            result = develop(RAMP, numpy=numpy, keep=("exposure",), tone_curve=linear, **stages)
            assert np.array_equal(result.kept["exposure"] * 2**headroom, RAMP)
            assert np.array_equal(result.final, RAMP)


STYLES = st.fixed_dictionaries(
    {
        "toe": st.floats(0, 1),
        "shoulder": st.floats(0.05, 1),
        "saturation": st.floats(0.6, 2),
    }
)


@given(STYLES)
def test_every_style_rises_and_keeps_black_grey_and_white(values):
    style = Standard(**values)
    curve = style.curve(np.linspace(0, 1, 2001, dtype=np.float32))
    assert np.diff(curve).min() > -1e-6  # rounding
    ends = style.curve(np.float32([0, GREY, 1]))
    assert ends == pytest.approx([0, GREY_OUT, 1], abs=1e-6)


@given(STYLES, st.integers(0, 1000))
def test_a_style_is_undone(values, seed):
    light = np.random.default_rng(seed).random((9, 11, 3), np.float32) ** 2
    style = Standard(**values)
    curved = run_reference(style, light)
    again = run_reference(InverseStandard(**values), curved)
    # Light cannot be recovered where the curve is level, or where colours left 0 to 1.
    mean = np.square(light).sum(-1, keepdims=True) / light.sum(-1, keepdims=True)
    step = style.curve(mean + np.float32(1e-3)) - style.curve(mean - np.float32(1e-3))
    ends = curved.min(-1, keepdims=True), curved.max(-1, keepdims=True)
    invertible = (step > 1e-4) & (ends[0] > 0) & (ends[1] < 1)
    assert np.abs(np.where(invertible, again - light, 0)).max() < 1e-4


def test_what_the_parameters_of_a_style_say():
    x = np.geomspace(0.002, 0.9, 400).astype(np.float32)
    ends = np.float32([0, 1e-4, 1 - 1e-4, 1])
    first, _, last = np.diff(Standard(toe=0.5, shoulder=0.05).curve(ends)) / np.diff(ends)
    assert first == pytest.approx(0.5 * GREY_OUT / GREY, rel=0.03)
    assert last == pytest.approx(0.45, rel=0.01)
    dark, bright = x < GREY, x > GREY
    assert (Standard(toe=0.9).curve(x) < Standard(toe=0.2).curve(x))[dark].all()
    assert (Standard(shoulder=0.9).curve(x) > Standard(shoulder=0.2).curve(x))[bright].all()
    colour = np.float32([[[0.3, 0.2, 0.1]]])
    ranges = [np.ptp(run_reference(Standard(saturation=s), colour)) for s in (0.8, 1.0, 1.2)]
    assert ranges[0] < ranges[1] < ranges[2]


def test_a_style_keeps_ratios_and_the_range_of_pure_colours():
    colours = np.random.default_rng(0).random((20, 20, 3), np.float32)
    styled = run_reference(Standard(), colours)
    ratios = [c / c.max(-1, keepdims=True) for c in (colours, styled)]
    assert np.abs(ratios[0] - ratios[1]).max() < 1e-5
    pure = run_reference(Standard(), np.float32([[[1, 0, 0], [0, 1, 1], [0, 0, 0.5], [0, 0, 0]]]))
    assert pure.max() < 1 + 1e-6 and pure[0, 0, 0] == pytest.approx(1) and not pure[0, 3].any()


def test_a_style_has_no_kink_that_would_skew_noise():
    """Its display value as a function of the root of light bends little wherever noise is seen."""
    root = np.linspace(0, 1, 4001)
    light = np.clip(Standard().curve(np.square(root).astype(np.float32)), 0, 1).astype(np.float64)
    level = 255 * srgb_curve(light)
    slope = np.gradient(level, root)
    bend = np.convolve(np.gradient(np.log(np.maximum(slope, 1e-6)), root), np.ones(41) / 41, "same")
    for low, high, least, most in ((80, 112, -1, 2), (112, 160, -3, 0.5), (160, 220, -5.5, -2)):
        inside = (level >= low) & (level < high)
        assert least < bend[inside].min() and bend[inside].max() < most
