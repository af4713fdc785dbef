"""Formats have a number and a JSON Schema, and sidecars name what their run shares.

:func:`tests.conftest.check_files` checks the files of all runs in tests, and what --json prints.
"""

import json
from pathlib import Path

import jsonschema
import numpy as np
import pytest

import clpipe as package
from clpipe.base.about import FORMAT
from clpipe.commands.main import main
from clpipe.images.write import write_planes
from clpipe.outputs.shared import shared_path, with_shared
from tests.conftest import ROOT, check_schema, reseal, run_cli, values_of
from tools.pages import schemas

NUMPY = ("--device", "numpy")


@pytest.fixture
def out(write_exr, clpipe):
    for name in ("a", "sub/b"):
        write_exr(f"in/{name}.exr", np.full((16, 24, 3), 0.2))
    run_cli("run", "in", "-o", "out", *NUMPY)
    return Path("out")


def test_the_schemas_are_those_of_the_models():
    found = {path.stem: path.read_text() for path in (ROOT / "clpipe/schemas").glob("*.json")}
    expected = {name: schemas.text_of(schema) for name, schema in schemas.schemas().items()}
    assert found == expected
    for schema in schemas.schemas().values():
        jsonschema.Draft202012Validator.check_schema(schema)


def test_every_command_with_json_has_a_schema():
    with_json = {
        name
        for name in main.list_commands(None)
        if any("--json" in p.opts for p in main.get_command(None, name).params)
    }
    named = {name.removeprefix("command.") for name in schemas.schemas() if "command" in name}
    assert with_json == named - {"cameras.import"} and len(with_json) > 15


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"iso": "high"}, "is not of type 'number'"),
        ({"format": 2}, "1 was expected"),
        ({"program": "abc"}, "does not match"),
        ({"clipped": 1.5}, "is greater than the maximum"),
        ({"new_key": 1}, "Additional properties"),
        ({"noise_key": None}, "is not of type 'string'"),
    ],
)
def test_a_schema_rejects(out, change, reason):
    values = json.loads((out / "a.json").read_text())
    check_schema("sidecar", values)
    with pytest.raises(AssertionError, match=reason):
        check_schema("sidecar", values | change)


def test_pictures_of_a_folder_share_a_file_that_is_checked(out):
    values = json.loads((out / "a.json").read_text())
    assert not {"device", "versions"} & values.keys() and "response" not in values["photometry"]
    shared = shared_path(out, values["run"])
    assert [path.name for path in out.glob("*.run")] == [shared.name]
    assert shared_path(out / "sub", values["run"]).read_bytes() == shared.read_bytes()
    whole = values_of(out / "a.json")
    assert whole["device"]["name"] == "numpy" and whole["versions"]["numpy"] == np.__version__
    assert len(whole["photometry"]["response"]["table"]) == 256
    shared.write_text(shared.read_text().replace("numpy", "gpu__", 1))
    assert with_shared(values, out) == values


def test_without_the_shared_file_a_picture_replays_and_its_camera_has_no_response(out):
    run_cli(
        "run", "in/a.exr", "-o", "posed", *NUMPY, "--set", "render.fx=30", "--set", "render.fy=30"
    )
    [shared] = Path("posed").glob("*.run")
    shared.unlink()
    run_cli("replay", "posed/a.json", "-o", "again", *NUMPY)
    output = run_cli("poses", "posed").output
    assert f"without its response to greys, because {shared.name} is missing" in output
    cameras = json.loads(Path("posed/cameras.json").read_text())
    check_schema("cameras", cameras)
    assert "responses" not in cameras and cameras["views"][0]["photometry"]["gain"] == 0.5


def test_responses_that_are_drawn_stay_in_sidecars(write_exr, clpipe):
    for name in "ab":
        write_exr(f"in/{name}.exr", np.full((16, 24, 3), 0.2))
    Path("c.toml").write_text("[tone_curve]\ntoe = { uniform = [0.5, 0.9] }\n")
    run_cli("run", "in", "-o", "drawn", "-c", "c.toml", *NUMPY)
    tables = [values_of(f"drawn/{name}.json")["photometry"]["response"] for name in "ab"]
    assert tables[0] != tables[1] and len([*Path("drawn").glob("*.run")]) == 1


@pytest.mark.parametrize("number", [FORMAT + 1, "x"])
def test_files_of_a_newer_version_are_named_and_stay(out, number):
    sidecar = out / "a.json"
    reseal(sidecar, {**json.loads(sidecar.read_text()), "format": number})
    newer = sidecar.read_bytes()
    stderr = run_cli("run", "in", "-o", "out", *NUMPY, status=1).stderr
    assert f"out/a.json: a newer clpipe wrote this file: its format has number {number}" in stderr
    assert sidecar.read_bytes() == newer
    assert "a newer clpipe" in run_cli("replay", sidecar, "-o", "b", *NUMPY, status=2).stderr
    assert "1 of 2" in run_cli("run", "in", "-o", "out", *NUMPY, status=1).stderr


def test_cameras_and_logs_of_a_newer_version(out):
    Path("cameras.json").write_text(json.dumps({"format": 9, "views": [{}]}))
    stderr = run_cli("run", "in", "-o", "o", "--poses", "cameras.json", status=2).stderr
    assert "cameras.json: a newer clpipe wrote this file: its format has number 9" in stderr
    log = out / "run.jsonl"
    log.write_text(log.read_text().replace('"format": 1', '"format": 9'))
    assert "a newer clpipe" in run_cli("status", "out", status=1).stderr


def test_sidecars_without_a_number_are_read(out):
    """Those of development versions have all values in themselves."""
    sidecar = out / "a.json"
    values = values_of(sidecar)
    del values["run"], values["format"]
    reseal(sidecar, values)
    run_cli("replay", sidecar, "-o", "again", *NUMPY)
    [outcome] = package.run("in/a.exr", "out", device="numpy")
    assert outcome.status == "skipped"


def test_files_of_many_kinds_of_runs_have_their_schemas(write_exr, clpipe):
    """Bursts, brackets, patches, tars, truths, carried layers, raws and kept images."""
    depth = np.full((16, 24), 2.0, np.float32)
    for name in "ab":
        write_exr(f"in/{name}.exr", np.full((16, 24, 3), 0.2))
        write_planes(Path(f"in/{name}_depth.exr"), {"Z": depth}, {})
    for number, options in enumerate(
        [
            (
                "--frames",
                2,
                "--carry",
                "depth",
                "--truth",
                "clean",
                "--truth",
                "variance",
                "--until",
                "normalize",
            ),
            ("--bracket", "-1,1", "--keep", "quantize", "--keep", "gamma"),
            ("--patch", 8, "--augment", "--format", "npy", "--truth", "mosaic"),
            ("--truth", "iid", "--truth", "intensity", "--set", "exposure.method=auto"),
            ("--until", "quantize", "--format", "dng", "--iso", "100,800"),
            ("--sequence", "-c", "video", "--set", "shutter.line_time=1e-5"),
            (
                "--set",
                "vignetting.method=cosine_fourth",
                "--set",
                "distortion.method=brown_conrady",
            ),
        ]
    ):
        lens = ("--set", "render.fx=30", "--set", "render.fy=30")
        run_cli("run", "in", "-o", f"o{number}", *NUMPY, *options, *lens, status=(0, 1))
        assert [*Path(f"o{number}").rglob("*.json")]
    outcomes = package.run("in", "tars", device="numpy", webdataset=1, patch=8)
    assert [each.status for each in outcomes] == ["done"] * 2
