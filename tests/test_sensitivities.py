"""Spectral sensitivities in camera profiles, and their import."""

import json

import numpy as np
import pytest

from clpipe.analysis.noise_models.read import import_camera
from clpipe.base.errors import RequestError
from clpipe.camera.profile import built_in_cameras, load_camera
from tests.conftest import run_cli

# Illuminant D65 from 380 to 780 nm in steps of 10 (CIE 15:2018, table 5).
D65 = """49.98 54.65 82.75 91.49 93.43 86.68 104.87 117.01 117.81 114.86 115.92 108.81 109.35 107.80
104.79 107.69 104.41 104.05 100 96.33 95.79 88.69 90.01 89.60 87.70 83.29 83.70 80.03 80.21 82.28
78.28 69.72 71.61 74.35 61.60 69.89 75.09 63.59 46.42 66.81 63.38"""
CSV = "wavelength,R,G,B\n400,0.01,0.02,0.9\n500,0.1,0.8,0.5\n600,0.9,0.3,0.02\n"


def rawtoaces(rows, colours=("R", "G", "B"), **header):
    about = {"manufacturer": "Maker", "model": "M1", "license": "Apache-2.0", **header}
    data = {"index": {"main": list(colours)}, "data": {"main": rows}}
    return json.dumps({"header": about, "spectral_data": {"units": "relative", **data}})


@pytest.fixture
def imported(tmp_path):
    def run(name, text, camera="nikon-d800"):
        path = tmp_path / name
        path.write_text(text)
        output = tmp_path / "mine.toml"
        import_camera(path, camera, output)
        return load_camera(output)

    return run


def test_built_in_curves_agree_with_the_white_balance_of_other_sources():
    """The gains of these profiles are from Adobe's matrices, the curves were measured."""
    found = [load_camera(name) for name in built_in_cameras()]
    measured = [camera for camera in found if camera.sensitivities]
    assert len(measured) == 9
    light, at = np.array(D65.split(), float), np.arange(380.0, 781, 10)
    for camera in measured:
        red, green, blue = light @ camera.sensitivities.at(at)
        gains = green / red, green / blue
        assert gains == pytest.approx(camera.white_balance_gains, rel=0.1), camera.name
        assert "Apache-2.0" in camera.sources["sensitivities"]


@pytest.mark.parametrize("name", ["curves.csv", "curves.json"])
def test_curves_are_added_to_a_camera(name, imported):
    rows = {nm: [float(v) for v in values] for nm, *values in map(str.split, CSV_ROWS)}
    text = CSV if name.endswith("csv") else rawtoaces(rows, laboratory="a bench")
    camera, known = imported(name, text), load_camera("nikon-d800")
    assert camera.sensitivities.wavelengths == (400, 500, 600)
    assert camera.sensitivities.curves["G"] == (0.02, 0.8, 0.3)
    assert camera.name == "mine"
    for key in ("gain_stages", "white_level", "xyz_to_camera", "iso_range", "model"):
        assert getattr(camera, key) == getattr(known, key)
    assert camera.sources.keys() == known.sources.keys() | {"sensitivities"}
    expected = (
        "curves.csv" if name.endswith("csv") else "curves.json: Maker M1, a bench, Apache-2.0"
    )
    assert camera.sources["sensitivities"] == expected


CSV_ROWS = [line.replace(",", " ") for line in CSV.splitlines()[1:]]


def test_a_camera_with_curves_gets_others(imported):
    camera = imported("curves.csv", CSV, "canon-5d3")
    assert len(camera.sensitivities.wavelengths) == 3
    assert camera.sources["sensitivities"] == "curves.csv"


def test_other_colours_and_uneven_steps(imported):
    text = " wavelength , C,M,Y,W\n400,1,2,3,4\n403.5,1,1,0,1\n\n700,0,0,-0.001,1\n"
    curves = imported("curves.csv", text).sensitivities
    assert list(curves.curves) == ["C", "M", "Y", "W"]
    assert curves.at(np.array([401.75]))[0].tolist() == [1, 1.5, 1.5, 2.5]
    assert curves.at(np.array([399.0, 701.0])).tolist() == [[0] * 4] * 2
    text = "wavelength,infrared_cut,G\n400,1,0.5\n700,0.5,1\n"
    curves = imported("curves.csv", text).sensitivities
    assert curves.infrared_cut == (1, 0.5) and curves.at(np.array([700.0])).tolist() == [[0.5]]


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("a.csv", "nm,R\n400,1\n", "expected a first column 'wavelength'"),
        ("a.csv", "wavelength\n400\n", "expected a first column 'wavelength'"),
        ("a.csv", "wavelength,R\n400,1\n500\n", "row 3 has 1 values, but there are 2 headings"),
        ("a.csv", "wavelength,R\n400,1\n500,x\n", "curves.R"),
        ("a.csv", "wavelength,R\n500,1\n400,1\n", "wavelengths must ascend"),
        ("a.csv", "wavelength,R\n400,1\n", "wavelengths"),
        ("a.csv", "wavelength,R\n", "wavelengths"),
        ("a.csv", "wavelength,R\n400,0\n500,0\n", "curves.R is nowhere above 0"),
        ("a.csv", "wavelength,R\n400,nan\n500,1\n", "curves.R"),
        ("a.csv", "wavelength,R\n0.4,1\n0.5,1\n", "wavelengths"),
        ("a.json", '{"spectral_data": 3, "header": {}}', "not like rawtoaces' files"),
        ("a.json", rawtoaces({"400": [1]}, "RGB"), "not like rawtoaces' files"),
        ("a.json", rawtoaces({"red": [1]}, "R"), "not like rawtoaces' files"),
        ("a.json", '{"spectral_data": ', "not valid JSON"),
        ("a.csv", "wavelength,red\n400,1\n500,1\n", "found red; a colour is one of the letters R"),
        ("a.csv", "wavelength,R,R\n400,1,1\n500,1,1\n", "R twice"),
    ],
)
def test_rejected_curves(name, text, message, imported, tmp_path):
    with pytest.raises(RequestError) as error:
        imported(name, text)
    assert message in str(error.value)
    assert name in str(error.value)
    assert not (tmp_path / "mine.toml").exists()


def test_the_command_line(tmp_path):
    path = tmp_path / "curves.csv"
    path.write_text(CSV)
    assert "add --camera" in run_cli("cameras", "import", path, status=2).stderr
    words = ("cameras", "import", path, "--camera", "nikon-d800")
    printed = run_cli(*words).stdout
    assert "[sensitivities.curves]" in printed
    run_cli(*words, "-o", tmp_path / "d800.toml")
    shown = run_cli("cameras", tmp_path / "d800.toml").stdout
    assert "R 600 nm, G 500 nm, B 400 nm" in shown
    [record] = json.loads(run_cli("cameras", tmp_path / "d800.toml", "--json").stdout)["cameras"]
    assert record["sensitivities"]["curves"]["R"] == [0.01, 0.1, 0.9]
    [bare] = json.loads(run_cli("cameras", "nikon-d800", "--json").stdout)["cameras"]
    assert bare["sensitivities"] is None
