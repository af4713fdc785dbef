"""Lights, the eye and a sensor's sight of spectra, against colour-science."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from clpipe.base.errors import RequestError
from clpipe.camera.colorimetry import adaptation, lab_of
from clpipe.camera.profile import SRGB_TO_XYZ, load_camera
from clpipe.camera.sensitivities import Sensitivities
from clpipe.camera.spectra import (
    GRID,
    ILLUMINANTS,
    STEP,
    Sight,
    band_weights,
    light,
    observer,
    reflectances,
    sight_of,
)

with np.printoptions():  # colour-science changes how NumPy prints numbers
    import colour

CAMERAS = ("sony-a7r2", "canon-5d3", "nikon-d850", "nikon-d7000", "fujifilm-x-t3")
SHAPE = colour.SpectralShape(380, 780, 5)
NM = np.arange(380.0, 781, 5)
AT = np.rint((NM - GRID[0]) / STEP).astype(int)  # places of these wavelengths on the grid
CHECKER = np.stack(
    [each.copy().align(SHAPE).values for each in colour.SDS_COLOURCHECKERS["ISO 17321-1"].values()]
)


def peer_light(name):
    return colour.SDS_ILLUMINANTS[{"F11": "FL11"}.get(name, name)].copy().align(SHAPE)


@pytest.mark.parametrize("name", ILLUMINANTS)
def test_lights(name):
    expected = peer_light(name).values
    found = light(name)[AT]
    assert found / found.max() == pytest.approx(expected / expected.max(), abs=1e-4)
    x, y, z = light(name) @ observer() * STEP
    assert y == pytest.approx(1)
    named = {"F11": "FL11"}.get(name, name)
    white = colour.CCS_ILLUMINANTS["CIE 1931 2 Degree Standard Observer"][named]
    assert (x / (x + y + z), y / (x + y + z)) == pytest.approx(white, abs=1e-3)


def test_the_observer():
    curves = colour.MSDS_CMFS["CIE 1931 2 Degree Standard Observer"].copy().align(SHAPE).values
    assert observer()[AT] * 106.857 == pytest.approx(curves, abs=2e-4)


def test_weights_are_exact_integrals():
    rng = np.random.default_rng(0)
    curves = rng.random((GRID.size, 2))
    bands = np.array([301.3, 310, 340.7, 341, 700, 1050])
    fine = np.linspace(*GRID[[0, -1]], 8_000_001)
    values = np.stack([np.interp(fine, GRID, curve) for curve in curves.T], -1)
    middles = (bands[1:] + bands[:-1]) / 2
    edges = [2 * bands[0] - middles[0], *middles, 2 * bands[-1] - middles[-1]]
    step = fine[1] - fine[0]
    expected = [values[(fine >= a) & (fine < b)].sum(0) * step for a, b in pairwise(edges)]
    assert band_weights(curves, bands) == pytest.approx(np.array(expected), rel=2e-4)


@pytest.mark.parametrize("name", CAMERAS)
@pytest.mark.parametrize("lamp", ILLUMINANTS)
def test_colours_of_a_checker(name, lamp):
    """A render's bands and colour-science's sums give the same raw colours, within 0.5 %."""
    camera = load_camera(name)
    sight, curves = sight_of(camera, lamp), camera.sensitivities.at(NM)
    raw = (CHECKER * peer_light(lamp).values) @ curves
    expected = raw / (peer_light(lamp).values @ curves)
    seen = (CHECKER * light(lamp)[AT]) @ sight.weights(NM, "RGB")
    assert seen == pytest.approx(expected, rel=5e-3)
    # The matrix makes of them nearly the colours that the eye sees.
    xyz = (CHECKER * light(lamp)[AT]) @ band_weights(observer(), NM)
    adapted = adaptation(sight.white_xyz, SRGB_TO_XYZ.sum(1))
    true = xyz @ (np.linalg.inv(SRGB_TO_XYZ) @ adapted).T
    errors = colour.delta_E(lab_of(seen @ sight.to_srgb.T), lab_of(true), method="CIE 2000")
    assert errors.mean() < 2.0
    assert sight.to_srgb.sum(1) == pytest.approx(1)
    if lamp == "A":  # the matrix for daylight is worse
        daylight = seen @ sight_of(camera, "D65").to_srgb.T
        assert errors.mean() < colour.delta_E(lab_of(daylight), lab_of(true)).mean()


@pytest.mark.parametrize("name", CAMERAS[:2])
def test_the_matrix_is_that_of_the_academy(name):
    """P-2013-001 in colour-science agrees for D65, which needs hardly any adaptation.

    Other lights differ by the model of adaptation, CAT02 there.
    """
    camera = load_camera(name)
    curves = colour.characterisation.RGB_CameraSensitivities(
        dict(zip(NM, camera.sensitivities.at(NM), strict=True))
    )
    idt, gains = colour.matrix_idt(
        curves.align(SHAPE),
        peer_light("D65"),
        training_data=colour.characterisation.read_training_data_rawtoaces_v1(),
    )
    sight = sight_of(camera, "D65")
    assert np.array(gains) == pytest.approx([sight.gains[0], 1, sight.gains[1]], rel=3e-3)
    seen = (CHECKER * light("D65")[AT]) @ sight.weights(NM, "RGB")
    aces = colour.models.RGB_COLOURSPACE_ACES2065_1
    white = colour.xy_to_XYZ(aces.whitepoint)
    to_srgb = np.linalg.inv(SRGB_TO_XYZ) @ adaptation(white, SRGB_TO_XYZ.sum(1))
    peer = seen @ (to_srgb @ aces.matrix_RGB_to_XYZ @ idt).T
    errors = colour.delta_E(lab_of(seen @ sight.to_srgb.T), lab_of(peer), method="CIE 2000")
    assert errors.max() < 0.5


def test_the_fit_is_a_minimum():
    sight = sight_of(load_camera("sony-a7r2"), "F11")
    seen = reflectances() @ (
        np.stack([sight.response(c) / sight.white(c) for c in "RGB"], -1)
        * (sight.light[:, None] * STEP)
    )
    xyz = reflectances() @ (observer() * sight.light[:, None] * STEP)
    adapted = adaptation(sight.white_xyz, SRGB_TO_XYZ.sum(1))
    true = lab_of(xyz @ (np.linalg.inv(SRGB_TO_XYZ) @ adapted).T)

    def cost(matrix):
        return ((lab_of(seen @ matrix.T) - true) ** 2).sum()

    best = cost(sight.to_srgb)
    for row in range(3):
        for change in ([1, -1, 0], [0, -1, 1]):
            for step in (1e-3, -1e-3):
                other = sight.to_srgb.copy()
                other[row] += step * np.array(change)
                assert cost(other) > best


@pytest.mark.parametrize("lamp", ILLUMINANTS)
def test_a_render_under_a_lamp(lamp):
    camera = load_camera("nikon-d850")
    sight, curves = sight_of(camera, lamp), camera.sensitivities.at(NM)
    basis = colour.recovery.MSDS_BASIS_FUNCTIONS_sRGB_MALLETT2019.values
    power = peer_light(lamp).values[:, None] * curves
    expected = (power.T @ basis) / power.sum(0)[:, None]
    assert sight.from_srgb == pytest.approx(expected, abs=3e-3)
    assert sight.from_srgb.sum(1) == pytest.approx(1)


def test_sums_that_are_not_red_green_and_blue():
    curves = {"R": (0, 0, 1), "G": (0, 1, 0), "B": (1, 0, 0), "I": (0, 0, 0.5)}
    sight = Sight(Sensitivities(wavelengths=(400, 500, 600), curves=curves), light("D65"))
    assert sight.white("W") == pytest.approx(sum(map(sight.white, "RGB")))
    assert sight.white("Y") == pytest.approx(sum(map(sight.white, "RG")))
    assert sight.white("I") == pytest.approx(sight.white("R") / 2)
    own = replace(
        sight,
        sensitivities=Sensitivities(wavelengths=(400, 600), curves={**{"W": (9, 9)}}),
    )
    assert own.white("W") == pytest.approx(
        9 * light("D65")[(GRID >= 400) & (GRID <= 600)].sum() * STEP
    )
    assert own.gains == (1, 1) and not own.has_colours
    with pytest.raises(RequestError, match="curves for W, but not for R, which the filter array"):
        own.white("L")


def test_quantum_efficiencies_lens_and_infrared_cut():
    values = {"wavelengths": (400, 600, 800), "curves": {"G": (0.2, 0.6, 0.4)}}
    relative = Sensitivities(**values)
    absolute = Sensitivities(
        **values,
        quantum_efficiencies=True,
        lens_transmission=(0.5, 0.5, 0.5),
        infrared_cut=(1, 1, 0),
    )
    at = np.array([400.0, 500, 600, 700, 800])
    assert absolute.at(at)[:, 0] == pytest.approx([40, 100, 180, 87.5, 0])
    # Relative curves are for energy: their quantum efficiency is highest where curve / nm is.
    sight = Sight(relative, light("D65"))
    efficiency = relative.at(GRID)[:, 0] / GRID / (0.6 / 600) * 0.5
    charge = (light("D65") * efficiency * GRID * 1e-9).sum() * STEP / (6.62607015e-34 * 299792458)
    assert sight.electrons("G", 0.5) == pytest.approx(charge, rel=1e-6)
    with pytest.raises(RequestError, match=r"set exposure\.quantum_efficiency"):
        sight.electrons("G", None)
    for wrong, message in (
        ({"infrared_cut": (1, 1)}, "infrared_cut has 2 values, but there are 3"),
        ({"lens_transmission": (1, 2, 1)}, "lens_transmission"),
        ({"curves": {"G": (2, 1, 1)}, "quantum_efficiencies": True}, "goes up to 2"),
    ):
        with pytest.raises(ValueError, match=message):
            Sensitivities(**{**values, **wrong})


def test_a_light_from_a_file(tmp_path):
    path = tmp_path / "lamp.csv"
    for text in ("wavelength (nm),power\n400,0\n500,2\n\n700,2\n", "#\n700,2\n500,2\n400,0\n,\n"):
        path.write_text(text)
        found = light(str(path))
        assert found[(GRID < 400) | (GRID > 700)].max() == 0
        at_450, at_500, at_700 = (found[GRID.searchsorted(nm - 0.05)] for nm in (450, 500, 700))
        assert at_450 == pytest.approx(at_500 / 2) and at_500 == at_700
    for text, message in (
        ("a,b\n", "the eye sees nothing of this light"),
        ("900,1\n950,1\n", "the eye sees nothing of this light"),
        ("400,1\n500\n", "row 2: found 500; expected a wavelength"),
        ("500,1\n500,1\n", "row 2: found 500, 1"),
        ("400,-1\n500,1\n", "row 1: found 400, -1"),
        ("400,1\nnan,1\n500,1\n", "row 2: found nan, 1"),
        ("nm,power\n400,x\n", "row 2: found 400, x"),
    ):
        path.write_text(text)
        with pytest.raises(RequestError, match=message):
            light(str(path))
    path.write_text("589,1\n")
    sodium = sight_of(load_camera("sony-a7r2"), str(path))
    with pytest.raises(RequestError, match="too few wavelengths"):
        _ = sodium.to_srgb
    for wrong in ("F12", "lamp.CSV"):
        with pytest.raises(RequestError, match=r"D65, F11, LED-B3; or name a \.csv file"):
            light(wrong)
    with pytest.raises(RequestError, match=r"no\.csv: No such file"):
        light("no.csv")
    with pytest.raises(RequestError, match=r"have them: canon-5d2, .* sony-a7s2"):
        sight_of(load_camera("nikon-d800"), "A")


def test_a_channel_that_sees_nothing_of_a_lamp():
    curves = {"R": (0, 1, 0), "G": (1, 0, 0), "B": (0.5, 0, 0), "I": (0, 0, 1)}
    infrared = Sensitivities(wavelengths=(700, 790, 900), curves=curves)
    assert Sight(infrared, light("A")).white("I") > 0
    with pytest.raises(RequestError, match="I of the camera sees nothing of the scene's light"):
        Sight(infrared, light("LED-B3")).white("I")
