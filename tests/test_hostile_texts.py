"""Malformed texts, numbers and names: one clear message, and no other image is lost."""

import json
import os
import re
import tarfile
from pathlib import Path

import numpy as np
import pytest

from clpipe.analysis.crops import choose_crops
from clpipe.base.errors import RequestError
from clpipe.base.reading import parse_toml
from clpipe.camera.profile import built_in_cameras, load_camera
from clpipe.chain.files import load_config
from clpipe.chain.settings import settings_from
from clpipe.chain.toml import toml_value
from clpipe.commands.chain_options import patch_count
from clpipe.inputs.find import parse_shard
from clpipe.inputs.kept import embedded_settings
from clpipe.inputs.manifest import read_manifest
from clpipe.scenes.view_request import parse_frames, parse_resolution
from tests.conftest import reseal, run_python


def test_a_member_that_is_in_a_tar_twice_is_packed_once(clpipe, write_exr):
    run = ("run", write_exr("a.exr", np.full((4, 6, 3), 0.25)), "-o", "out", "--device", "numpy")
    clpipe(*run, "--webdataset", 1)
    whole = Path("out/000000.tar").read_bytes()
    info = tarfile.TarInfo("a.jpg")
    info.size = 512
    Path("out/000000.tar").write_bytes(
        info.tobuf(tarfile.GNU_FORMAT) + b"another".ljust(512) + whole
    )
    clpipe(*run, "--webdataset", 1)
    assert Path("out/000000.tar").read_bytes() == whole


def test_half_a_character_in_a_sidecar(clpipe, write_exr):
    run = ("run", write_exr("a.exr", np.full((4, 6, 3), 0.25)), "-o", "out", "--device", "numpy")
    clpipe(*run)
    sidecar = Path("out/a.json")
    whole = sidecar.read_text()
    for key in ('"name": "a', '"input": "', '"image_name": "'):
        assert key in whole
        reseal(sidecar, json.loads(whole.replace(key, key + r"\ud800")))
        again = clpipe("replay", sidecar, "-o", "again", "--device", "numpy", status=2)
        assert f"{sidecar}: this sidecar was changed after clpipe wrote it" in again.stderr
        clpipe(*run)
        assert r"\ud800" not in sidecar.read_text()


def test_a_noise_key_and_a_name_that_are_not_utf8(clpipe, write_exr):
    path = write_exr("in/a.exr", np.full((4, 6, 3), 0.25))
    os.link(path, os.fsencode(path.parent) + b"/\xff.exr")
    run = ("run", "in", "-o", "out", "--device", "numpy", "--noise-key", os.fsdecode(b"\xff"))
    result = clpipe(*run, status=1)
    assert r"\udcff.exr': its name is not UTF-8; rename it" in result.stderr
    assert "1 of 2 images done, 1 failed" in result.stderr


def test_a_header_of_very_many_columns_is_refused(tmp_path):
    path = tmp_path / "m.csv"
    path.write_text("path," + ",".join(f"x{i}" for i in range(40_000)))
    with pytest.raises(RequestError, match="unknown column 'x0'"):
        read_manifest(path)


def test_a_chain_of_very_many_stages_is_refused():
    with pytest.raises(RequestError, match="stages: found 100000 stages; list at most 256"):
        settings_from({"stages": ["denoise"] * 100_000})


@pytest.mark.parametrize(
    ("old", "new", "key"),
    [
        (r"read_noise = \[", "read_noise = [1e300, ", r"gain_stages\[0\].read_noise\[0\]"),
        (r"xyz_to_camera = \[\[", "xyz_to_camera = [[1e200, ", r"xyz_to_camera\[0\]\[0\]"),
    ],
)
def test_figures_of_a_camera_that_no_sensor_has(tmp_path, old, new, key):
    text = built_in_cameras()["canon-5d2"].read_text("utf-8")
    path = tmp_path / "mine.toml"
    path.write_text(re.sub(old + r"[-\d.]+, ", new, text, count=1))
    with pytest.raises(RequestError, match=rf"mine\.toml: {key}: found 1e\+\d00: .* less than"):
        load_camera(str(path))


@pytest.mark.slow
def test_a_working_directory_that_has_gone(tmp_path):
    gone = tmp_path / "gone"
    gone.mkdir()
    code = "import os, sys; os.rmdir(os.getcwd()); from clpipe.commands.main import main; main()"
    run = ("run", "a.exr", "-o", "out", "--device", "numpy")
    result = run_python("-c", code, *run, cwd=gone, status=2)
    assert (
        result.stderr == "clpipe: the working directory no longer exists; change to another one\n"
    )


def test_a_replay_that_cannot_be_names_its_sidecar(clpipe, write_exr):
    clpipe("run", write_exr("a.exr", np.full((4, 6, 3), 0.25)), "-o", "out", "--device", "numpy")
    values = json.loads(Path("out/a.json").read_text())
    values["request"]["options"] = {"camera": "/dev/zero"}
    reseal(Path("out/a.json"), values)
    result = clpipe("replay", "out/a.json", "-o", "b", "--device", "numpy", status=2)
    assert result.stderr.startswith("clpipe: out/a.json: unknown camera '/dev/zero'")


DEEP = {
    "parts": "a." * 50_000 + "a = 1",
    "quoted": '"a" . ' * 50_000 + "a = 1",
    "table": "[" + "a." * 50_000 + "a]",
    "inline": "x = { " + "a." * 50_000 + "a = 1 }",
    "arrays": "x = " + "[" * 100_000,
    "tables": "x = " + "{a=" * 100_000,
    "number": "iso = " + "9" * 100_000,
    "bytes": "\ufffd = 1",
}


@pytest.mark.parametrize("text", DEEP.values(), ids=DEEP)
def test_toml_that_would_take_all_memory_or_time(tmp_path, text):
    path = tmp_path / "a.toml"
    path.write_text(text, "utf-8")
    for load in (load_config, load_camera):
        with pytest.raises(RequestError, match=r"a\.toml") as refused:
            load(str(path))
        assert len(str(refused.value)) < 1000
    cell = text.removeprefix("x = ")
    assert toml_value(cell) == cell  # text, which no parameter takes


LONG = "9" * 4400  # more digits than int() takes


@pytest.mark.parametrize(
    ("parse", "text", "message"),
    [
        (parse_shard, f"1/{LONG}", "--shard: found '1/999"),
        (parse_frames, f"1-{LONG}", "each from 0 to 1048574"),
        (parse_frames, "0-99999999999", "each from 0 to 1048574"),
        (parse_resolution, f"{LONG}x9", "expected WIDTHxHEIGHT"),
        (patch_count, LONG, "expected a whole number from 1 to 9999, or grid"),
        (
            lambda text: choose_crops((text,), np.zeros((9, 9, 3), np.float32)),
            f"0,0,9x{LONG}",
            "expected X,Y,",
        ),
    ],
)
def test_options_with_a_number_of_too_many_digits(parse, text, message):
    with pytest.raises(RequestError, match=message):
        parse(text)


@pytest.mark.parametrize("command", [("bench",), ("emva", "--camera", "nikon-d850", "-o", "out")])
def test_a_size_of_too_many_digits(clpipe, command):
    stderr = clpipe(*command, "--size", f"640x{LONG}", status=2).stderr
    assert "expected WIDTHxHEIGHT" in stderr


def test_names_that_no_file_can_have():
    for name in ("a\0.toml", "a\udcff\ud800.toml"):
        for load in (load_config, load_camera):
            with pytest.raises(RequestError, match="no file can have this name"):
                load(name)


def test_usual_toml_is_no_deep_key():
    text = "name = '" + "Measured by hand. " * 40 + "'\nx = [0.5" + ", 0.25" * 99 + "]\n"
    assert parse_toml(text + "a.b.c.d = 1")["a"] == {"b": {"c": {"d": 1}}}


def test_json_that_is_nested_too_deeply_is_refused(tmp_path):
    deep = '{"channels": ' * 100_000
    (tmp_path / "a.json").write_text(deep)
    with pytest.raises(RequestError, match="not a report of clpipe measure"):
        settings_from(
            {"picture_noise": {"method": "iid_gaussian", "measured": str(tmp_path / "a.json")}}
        )
    with pytest.raises(RequestError, match="nested too deeply"):
        embedded_settings({"settings": deep})
    (tmp_path / "a.jsonl").write_text(deep)
    with pytest.raises(RequestError, match="row 1: this is not valid JSON"):
        read_manifest(tmp_path / "a.jsonl")


def test_a_giant_field_is_refused(tmp_path):
    (tmp_path / "a.csv").write_text("path\n" + "x" * 1_000_000)
    with pytest.raises(RequestError, match="row 2: this is not valid CSV: field larger than"):
        read_manifest(tmp_path / "a.csv")
