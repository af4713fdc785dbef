"""Mistakes in first commands: each message states the mistake and a suggestion."""

import json
from pathlib import Path

import click
import numpy as np
import pytest

from clpipe.commands.main import COMMANDS, main

RUN = ("run", "render.exr", "-o", "out")
IS_MISSING = "there is no such file or folder"


@pytest.fixture
def folder(write_exr):
    """A render, a folder of renders and a folder of PNGs."""
    for name in ("render.exr", "renders/a.exr"):
        write_exr(name, np.full((32, 48, 3), 0.2))
    Path("pngs").mkdir()
    Path("a.json").touch()
    for name in "abc":
        Path(f"pngs/{name}.png").touch()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("rnu",), "No such command 'rnu'. Did you mean 'clpipe run'?"),
        (("denoise", "--help"), "It is a stage; to see what it does, use 'clpipe stages denoise'."),
        (("help", "rnu"), "Did you mean 'clpipe run'?"),
        (("import", "a.dng"), "Did you mean 'clpipe cameras import'?"),
        (("sony-a7r2",), "use 'clpipe cameras sony-a7r2'"),
        (("render.exr",), "use 'clpipe run render.exr -o OUT'"),
        (("version",), "Did you mean 'clpipe --version'?"),
        (("quux",), "The commands are demo, run, replay, "),
        (("--iso", "800", "run"), "Options follow the command"),
        (("stages", "noise"), "did you mean 'sensor_noise', 'row_noise', 'column_noise' or 'pict"),
        ((*RUN, "--skip", "noize"), "did you mean 'noise'?); allowed: noise, "),
        ((*RUN, "--set", "luma_strength=2"), "did you mean 'denoise.luma_strength=2'?"),
        ((*RUN, "--set", "luma_strenght=2"), "did you mean 'denoise.luma_strength=2'?"),
        ((*RUN, "--set", "iso=800"), "use --iso 800"),
        ((*RUN, "--set", "noise_key=a"), "use --noise-key a"),
        ((*RUN, "--set", "denoise=mean"), "did you mean 'denoise.method=mean'?"),
        ((*RUN, "--set", "exposure.ev 1"), "'clpipe stages' lists the stages"),
        (("cameras", "canon", "--iso", "800"), "most similar: canon-5d2, canon-5d3, canon-5d4, "),
        ((*RUN, "--iso", "99999"), "use 25600; no built-in camera comes closer"),
        (
            (*RUN, "--camera", "canon-6d", "--iso", "9e3"),
            "use 6400, or a camera that has this ISO: fuji",
        ),
        ((*RUN, "--iso", "60"), "use 100, or a camera that has this ISO: sony-a7s2"),
        (
            (*RUN, "--iso", "9"),
            "use 100; the built-in camera that comes closest is sony-a7s2, with",
        ),
        (
            (*RUN, "--iso", "100", "200", "400"),
            "200: {}. To give --iso several values, use --iso 1",
        ),
        ((*RUN, "--skip", "gamma", "noise"), "several values, use --skip gamma --skip noise"),
        ((*RUN, "--lens", "Canon", "50mm"), "For a value with spaces, use --lens 'Canon 50mm'"),
        (("explore", "render.exr", "--iso", "100", "200"), "200: {}. --iso takes one value"),
        (("run", "a.json", "-o", "out"), "to recompute a sidecar's picture, use 'clpipe rep"),
        (
            (*RUN, "--camera", "pngs/a.png"),
            "to make one from a DNG or a noise model, use 'clpipe ca",
        ),
        ((*RUN, "--set", "camera.iso=800"), "use --iso 800"),
        (("run", "rendr.exr", "-o", "out"), "rendr.exr: {}. Did you mean render.exr?"),
        (("run", "rendrs/a.exr", "-o", "out"), "rendrs/a.exr: {}. Did you mean renders/a.exr?"),
        (("run", "pngs", "-o", "out"), "the folder has 3 .png. Finished pictures are not linear"),
        (("explore", "pngs"), "For renders, add --transfer srgb; for photographs, use -c unproc"),
    ],
)
def test_messages_suggest_what_was_meant(clpipe, folder, words, message):
    stderr = clpipe(*words, status=2).stderr
    assert message.format(IS_MISSING) in stderr
    assert not Path("out").exists()


def test_another_camera_is_not_built_in(clpipe, folder):
    stderr = clpipe(*RUN, "--camera", "sony a7iii", status=2).stderr
    assert "it is not built in" in stderr and "did you mean" not in stderr
    assert "'clpipe cameras import' or 'clpipe calibrate'" in stderr


def test_help_is_a_command(clpipe):
    assert clpipe("help", "stages").stdout == clpipe("stages", "--help").stdout
    assert clpipe("help").stdout == clpipe("--help").stdout
    assert "noiseprofiles.json" in clpipe("help", "cameras", "import").stdout


def test_a_part_of_a_name_lists_the_cameras(clpipe):
    assert len(json.loads(clpipe("cameras", "Canon 5D Mark", "--json").stdout)["cameras"]) == 3
    assert "canon-80d" in clpipe("cameras", "canon").stdout
    assert "Var[y]" in clpipe("cameras", "nikon", "d850", "--iso", 800).stdout
    assert "canon-80d" not in clpipe("cameras", "nikon").stdout


INPUTS = {
    "run": "run {} -o out",
    "explore": "explore {}",
    "measure": "measure {}",
    "measure --truth": "measure render.exr --truth {}",
    "replay": "replay {} -o out",
    "replay INPUT": "replay render.exr {} -o out",
    "dataset": "dataset {} -o set",
    "match": "match {} -o a.toml",
    "match --mean": "match render.exr --mean {} -o a.toml",
    "compare": "compare {} -o a.png",
    "calibrate": "calibrate {} -o a.toml",
    "calibrate --dark": "calibrate render.exr --dark {} -o a.toml",
    "calibrate --emva": "calibrate --emva {} -o a.toml",
    "cameras import": "cameras import {}",
    "report": "report {}",
    "poses": "poses {}",
    "--poses": "run render.exr -o out --poses {}",
    "--annotations": "run render.exr -o out --annotations {}",
    "--stage-file": "stages --stage-file {}.py",
    "--camera": "plan --camera {}.toml",
    "--config": "plan -c {}.toml",
}


@pytest.mark.parametrize("words", INPUTS.values(), ids=INPUTS)
def test_a_missing_input_has_one_status_and_one_line(clpipe, folder, words):
    stderr = clpipe(*words.format("gone").split(), status=2).stderr
    assert stderr.startswith("clpipe: gone") and IS_MISSING in stderr
    assert len(stderr.splitlines()) == 1


@pytest.mark.parametrize("name", ["jpeg", "TIFF", "tiff16", ".JPG"])
def test_formats_have_other_names(clpipe, folder, name):
    usual = {"TIFF": "tif", "tiff16": "tif16"}.get(name, "jpg")
    clpipe(*RUN, "--device", "numpy", "--format", name)
    record = json.loads(Path("out/render.json").read_text())
    assert record["request"]["formats"] == [usual]


@pytest.mark.parametrize("command", ["run render.exr", "dataset renders", "emva --camera canon-6d"])
@pytest.mark.parametrize("output", ["in_the_way", "in_the_way/out"])
def test_a_file_in_the_place_of_a_folder_is_named(clpipe, folder, command, output):
    Path("in_the_way").touch()
    stderr = clpipe(*command.split(), "-o", output, status=2).stderr
    assert stderr == "clpipe: --output: in_the_way is a file. Name an output directory.\n"


@pytest.mark.parametrize(
    "words", ["run {} -o out", "explore {}", "measure {0} {0}", "match {} -o a.toml"]
)
def test_an_array_of_numpy_is_called_one(clpipe, folder, words):
    clpipe(*RUN, "--device", "numpy", "--format", "npy")
    words = words.format("out/render.npy")
    stderr = clpipe(*words.split(), status=2).stderr
    assert stderr.startswith("clpipe: out/render.npy: this is a NumPy array")
    assert "numpy.load" in stderr


@pytest.mark.parametrize("name", ["render.png", "render.exr"])
def test_the_explorer_starts_with_an_image_that_can_be_read(clpipe, folder, name):
    pytest.importorskip("uvicorn", reason="needs uvicorn, in the extra explore")
    Path(name).write_bytes(b"no image")
    stderr = clpipe("explore", name, "--device", "numpy", status=2).stderr
    assert stderr.startswith(f"clpipe: {name}: cannot be read as an image")
    assert (
        "clpipe explore reads the same inputs as clpipe run" in stderr and stderr.count("\n") == 1
    )


def test_one_image_is_counted_as_one(clpipe, folder):
    run = (*RUN, "--device", "numpy")
    clpipe(*run)
    assert "1 of 1 image done (it was there already), 0 failed" in clpipe(*run).stderr


def test_a_layer_that_is_not_there(clpipe, folder):
    stderr = clpipe(*RUN, "--device", "numpy", "--carry", "Depth", status=1).stderr
    expected = "the file has no layers besides the picture, and there is no render_Depth.exr next"
    assert f"--carry: there is no layer 'Depth'; {expected}" in stderr


def test_every_command_has_a_form_for_programs():
    for name in COMMANDS:
        command = main.get_command(click.Context(main), name)
        options = {option for each in command.params for option in each.opts}
        lines = {
            "demo": "--json-lines",
            "run": "--json-lines",
            "dataset": "--json-lines",
            "stream": "--log",
        }
        assert lines.get(name, "--json") in options, name


def test_answers_are_json(clpipe, folder):
    def answer(*words):
        return json.loads(clpipe(*words, "--json").stdout)

    numpy = ("--device", "numpy")
    clpipe(*RUN, *numpy, "--format", "png", "--format", "dng")
    again = answer("replay", "out/render.json", "-o", "again", *numpy)
    assert again["picture"] == "again/render.png" and again["same"]
    imported = answer("cameras", "import", "out/render.dng")
    assert imported["profile"] is None and 'model = "' in imported["toml"]
    pictures = ("out/render.png", "again/render.png")
    compared = answer("compare", *pictures, "-o", "a.svg", "--crop", "sky=0,0,4x4")
    assert compared["figures"] == ["a.svg"] and compared["places"][0]["name"] == "sky"
    pytest.importorskip("jinja2", reason="needs jinja2, in the extra report")
    assert answer("report", "out")["report"] == "out/report.html"


def test_a_dataset_prints_its_log(clpipe, folder):
    result = clpipe("dataset", "renders", "-o", "set", "--device", "numpy", "--json-lines")
    lines = [json.loads(line) for line in result.stdout.splitlines()]
    assert len(lines) == 3 and lines[1]["status"] == "done"


def test_a_dataset_of_renders_needs_no_cameras(clpipe, folder):
    clpipe("dataset", "renders", "-o", "set", "--device", "numpy")
    assert Path("set/manifest.csv").is_file() and not list(Path("set").rglob("cameras.json"))
