"""The command line, from the outside."""

import json
import os
import re
import subprocess
import sys
from dataclasses import replace

import click
import numpy as np
import OpenImageIO as oiio
import pytest
from PIL import Image

from clpipe.base.errors import DeviceError
from clpipe.camera.profile import built_in_cameras, load_camera
from clpipe.commands.cameras import camera_record, camera_tables
from clpipe.commands.main import COMMANDS, main
from clpipe.commands.printing import short_text
from clpipe.engine import discovery
from tests.conftest import ROOT, STILL_LIFE, run_python, values_of, written


@pytest.fixture
def small(write_exr):
    pixels = np.random.default_rng(0).random((24, 32, 3)).astype(np.float32)
    return write_exr("in/small.exr", pixels)


def read_exr(path):
    file = oiio.ImageInput.open(str(path))
    pixels = file.read_image(oiio.FLOAT)
    return np.squeeze(pixels), file.spec()


def read_png(path):
    with Image.open(path) as image:
        return np.asarray(image)


def test_the_main_job(clpipe, tmp_path):
    clpipe("run", STILL_LIFE, "-o", "out", "--iso", 1600)
    assert written(tmp_path / "out") == ["still_life.jpg", "still_life.json"]
    with Image.open("out/still_life.jpg") as image:
        assert image.size == (960, 640)
    sidecar = json.loads((tmp_path / "out" / "still_life.json").read_text())
    assert len(sidecar["sha256"]) == 64
    assert sidecar["image_key"] == f"still_life.exr@{sidecar['sha256'][:16]}"
    assert sidecar["noise_key"] == f"{sidecar['image_key']}@ISO1600"
    assert sidecar["iso"] == 1600
    stages = {s["name"]: s for s in sidecar["stages"]}
    assert stages["sensor_noise"]["parameters"]["a"] == pytest.approx(5.0419 / 15871)
    assert stages["white_balance"]["parameters"] == {"red_gain": 2.77, "blue_gain": 1.36}
    for name, given in (
        ("sensor_noise", {"a", "b"}),
        ("motion_blur", {"length"}),
        ("optical_blur", {"sigma", "pixel_pitch"}),
    ):
        assert stages[name]["parameters"].keys() == given  # only those without default values
    assert None not in [v for s in stages.values() for v in s.get("parameters", {}).values()]
    assert (tmp_path / "out" / "still_life.json").stat().st_size < 6000
    noise = sidecar["noise"]
    assert noise["signal"]["a"] == pytest.approx(5.0419 / 15871)
    assert noise["emva1288"]["system_gain"] == pytest.approx(5.0419)
    assert noise["paper"]["theta"] / noise["paper"]["chi"] == pytest.approx(5.0419 / 15871)


def test_numpy_gives_the_same_picture(clpipe, small, tmp_path):
    run = ("run", small, "--iso", 3200, "--format", "png", "--keep", "quantize")
    clpipe(*run, "-o", "a")
    clpipe(*run, "-o", "b", "--device", "numpy")
    assert written(tmp_path / "a") == ["small.json", "small.png", "small.quantize.exr"]
    one, two = (read_png(f"{f}/small.png").astype(int) for f in "ab")
    assert np.abs(one - two).max() <= 1
    assert np.array_equal(*(read_exr(f"{f}/small.quantize.exr")[0] for f in "ab"))
    assert values_of(tmp_path / "b" / "small.json")["device"]["name"] == "numpy"


@pytest.mark.slow
def test_float_exr_of_the_last_stage(clpipe, small):
    quiet = ("--set", "sensor_noise.a=0", "--set", "sensor_noise.b=0")
    stages = ("--stages", "mosaic,sensor_noise", *quiet)
    clpipe("run", small, "-o", "out", "--format", "exr", *stages)
    pixels, spec = read_exr("out/small.exr")
    source, _ = read_exr(small)
    assert spec.channelnames == ("Y",)
    assert np.array_equal(pixels[::2, ::2], source[::2, ::2, 0])
    assert np.array_equal(pixels[1::2, ::2], source[1::2, ::2, 1])


def test_gray_world_gains_are_in_the_sidecar(clpipe, small, tmp_path):
    clpipe("run", small, "-o", "out", "--set", "white_balance.method=gray_world")
    sidecar = json.loads((tmp_path / "out" / "small.json").read_text())
    estimates = next(s["estimates"] for s in sidecar["stages"] if s["name"] == "white_balance")
    assert estimates["red_gain"] == pytest.approx(2.77, rel=0.1)
    assert estimates["blue_gain"] == pytest.approx(1.36, rel=0.1)


@pytest.mark.slow
def test_a_configuration_with_options_over_it(clpipe, small, tmp_path):
    (tmp_path / "p.toml").write_text(
        'iso = 200\nskip = ["denoise"]\n[mosaic]\npattern = "GBRG"\n[exposure]\nev = 1\n'
    )
    over = ("--iso", 400, "--set", "exposure.ev=-1", "--skip", "row_noise")
    clpipe("run", small, "-o", "out", "-c", "p.toml", *over)
    sidecar = json.loads((tmp_path / "out" / "small.json").read_text())
    stages = {s["name"]: s.get("parameters") for s in sidecar["stages"]}
    assert sidecar["iso"] == 400
    assert stages["mosaic"] == {"pattern": "GBRG"}
    assert stages["exposure"] == {"ev": -1}
    assert not {"denoise", "row_noise"} & set(stages)


def test_a_folder_keeps_its_structure_and_a_bad_file_stops_nobody(clpipe, write_exr, tmp_path):
    pixels = np.full((8, 8, 3), 0.5, np.float32)
    for name in ("in/a.exr", "in/sub/b.exr", "in/sub/deep/a.exr"):
        write_exr(name, pixels)
    (tmp_path / "in" / "broken.exr").write_bytes(b"no image")
    (tmp_path / "in" / "notes.txt").write_text("not looked at")
    result = clpipe("run", "in", "-o", "out", status=1)
    assert "in/broken.exr: cannot be read as an image" in result.stderr
    assert "3 of 4 images done, 1 failed" in result.stderr
    made = ["a.jpg", "a.json", "sub/b.jpg", "sub/b.json", "sub/deep/a.jpg", "sub/deep/a.json"]
    assert written(tmp_path / "out") == made
    records = [json.loads((tmp_path / "out" / m).read_text()) for m in made if "json" in m]
    keys = [record["image_key"].partition("@")[0] for record in records]
    assert keys == ["a.exr", "sub/b.exr", "sub/deep/a.exr"]


def test_inputs_that_cannot_be(clpipe, small, tmp_path):
    (tmp_path / "empty").mkdir()
    assert "this folder has no images" in clpipe("run", "empty", "-o", "out", status=2).stderr
    assert "no file matches" in clpipe("run", "*.nothing", "-o", "out", status=2).stderr
    result = clpipe("run", small, "-o", small.parent, "--format", "exr", status=2)
    assert "this input would be overwritten" in result.stderr
    assert "--output: found an empty name" in clpipe("run", small, "-o", "", status=2).stderr
    little = clpipe("run", small, "-o", "out", "--memory", "1K", status=2)
    assert "--memory: too little" in little.stderr


def test_a_kept_stage_never_overwrites_an_input_or_another_result(clpipe, write_exr, tmp_path):
    pixels = np.full((4, 4, 3), 0.5, np.float32)
    one, two = write_exr("in/a.exr", pixels), write_exr("in/a.demosaic.exr", pixels)
    before = two.read_bytes()
    keep = ("--keep", "demosaic")
    result = clpipe("run", one, two, "-o", "in", *keep, status=2)
    assert "a.demosaic.exr: this input would be overwritten" in result.stderr
    assert two.read_bytes() == before
    result = clpipe("run", one, two, "-o", "out", *keep, "--format", "exr", status=2)
    assert "would both write out/a.demosaic.exr" in result.stderr


def test_the_order_of_assignments_does_not_matter(clpipe, small, tmp_path):
    (tmp_path / "p.toml").write_text('[denoise]\nmethod = "bilateral"\nspatial_sigma = 3\n')
    method, size = ("--set", "denoise.method=bilateral"), ("--set", "denoise.luma_size=7")
    for options in ((*method, *size), (*size, *method)):
        clpipe("run", small, "-o", "out", "-c", "p.toml", "--device", "numpy", *options)
        sidecar = json.loads((tmp_path / "out" / "small.json").read_text())
        values = next(s["parameters"] for s in sidecar["stages"] if s["name"] == "denoise")
        assert (values["luma_size"], values["spatial_sigma"]) == (7, 3)
    (tmp_path / "q.toml").write_text("[white_balance]\nred_gain = 2\n")
    clpipe("run", small, "-o", "out", "-c", "q.toml", "--set", "white_balance.method=gray_world")


def test_links_to_folders_are_followed_once(clpipe, write_exr, tmp_path):
    write_exr("real/a.exr", np.zeros((4, 4, 3), np.float32))
    (tmp_path / "in").mkdir()
    (tmp_path / "in" / "linked").symlink_to(tmp_path / "real")
    (tmp_path / "real" / "back").symlink_to(tmp_path / "in")
    clpipe("run", "in", "-o", "out")
    assert written(tmp_path / "out") == ["linked/a.jpg", "linked/a.json"]


def test_an_output_folder_inside_the_input_is_no_input(clpipe, small, tmp_path):
    for _ in range(2):
        clpipe("run", "in", "-o", "in/out", "--format", "exr", "--keep", "mosaic")
    made = ["small.exr", "small.json", "small.mosaic.exr"]
    assert written(tmp_path / "in" / "out") == made


def test_odd_names(clpipe, write_exr, tmp_path):
    write_exr("in/sp ace \u00e9\u4e2d.exr", np.zeros((4, 4, 3), np.float32))
    (tmp_path / os.fsdecode(b"in/bad\xff.exr")).write_bytes(b"x")
    result = clpipe("run", "in", "-o", "out", status=1)
    assert "its name is not UTF-8" in result.stderr
    assert written(tmp_path / "out") == ["sp ace \u00e9\u4e2d.jpg", "sp ace \u00e9\u4e2d.json"]
    assert "File name too long" in clpipe("run", "a" * 300, "-o", "out", status=1).stderr
    assert "an input is empty" in clpipe("run", "", "-o", "out", status=2).stderr


def test_nothing_is_left_half_written(clpipe, small, tmp_path, monkeypatch):
    def no_space(self, target):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("pathlib.Path.replace", no_space)
    result = clpipe("run", small, "-o", "out", status=1)
    assert "No space left on device" in result.stderr
    assert written(tmp_path / "out") == []


def test_a_jpeg_has_its_limit(clpipe, write_exr):
    wide = write_exr("wide.exr", np.zeros((1, 65600, 3), np.float32))
    assert "use --format png" in clpipe("run", wide, "-o", "out", status=1).stderr
    clpipe("run", wide, "-o", "out", "--format", "png")


def test_plan(clpipe):
    result = clpipe("plan", "--set", "white_balance.method=gray_world")
    assert "Launches: 5. Slots: 1. Memory" in result.stdout
    assert "Launch 2 runs in bands of 8 rows" in result.stdout
    record = json.loads(clpipe("plan", "--json", "--keep", "sensor_noise").stdout)
    assert record["kept"] == ["sensor_noise"]
    numbers = [launch["number"] for launch in record["launches"]]
    assert numbers == ["1", "2", "2.1", "2.2", "3", *(f"3.{i}" for i in range(1, 6))]


def test_stages(clpipe):
    assert "bounded, edge_directed_median" in clpipe("stages").stdout
    assert "from the camera and ISO" in clpipe("stages", "sensor_noise").stdout
    assert "did you mean 'demosaic'" in clpipe("stages", "demosaik", status=2).stderr
    assert len(json.loads(clpipe("stages", "--json").stdout)["stages"]) >= 13


def test_devices(clpipe):
    state = json.loads(clpipe("devices", "--json").stdout)
    rows, cache = state["devices"], state["kernel_cache"]
    assert 0 <= cache["usable"] <= cache["programs"] and not cache["problem"]
    assert sum(row["status"] == "used by default" for row in rows) == 1
    assert rows[-1]["index"] == "numpy"
    shown = clpipe("devices").stdout
    assert "used by default" in shown
    assert f"kernel cache: {cache['folder']}, " in shown


def test_check(clpipe):
    record = json.loads(clpipe("check", "mosaic", "quantize", "--small", "--json").stdout)
    assert record["failed"] == 0
    assert {c["stage"] for c in record["checks"]} == {"mosaic", "quantize"}
    assert record["device"]["driver"] and record["versions"]["pyopencl"] and record["clpipe"]
    assert "unknown stage 'mosiac'" in clpipe("check", "mosiac", status=2).stderr
    assert "numpy, which is the reference" in clpipe("check", "--device", "numpy", status=2).stderr


def test_a_device_that_is_no_cpu_is_to_be_reported(clpipe, monkeypatch):
    command = ("check", "mosaic", "--small")
    assert "--json" not in clpipe(*command).stdout
    describe = discovery.describe
    monkeypatch.setattr(discovery, "describe", lambda *a: replace(describe(*a), type="GPU"))
    assert "this GPU, run the same command with --json and send the output" in " ".join(
        clpipe(*command).stdout.split()
    )


def test_bench(clpipe):
    record = json.loads(clpipe("bench", "--size", "640x480", "--repeat", 2, "--json").stdout)
    assert record["mp_per_s"] > 0
    assert len(record["launches"]) == 7 and record["device"]["lanes"]
    assert all(launch["mp_per_s"] > 0 for launch in record["launches"])
    assert "expected WIDTHxHEIGHT" in clpipe("bench", "--size", "big", status=2).stderr


@pytest.mark.parametrize(
    "asked", ["--start-at normalize", "--start-at demosaic", "--stages normalize,white_balance"]
)
def test_bench_makes_an_input_that_the_chain_starts_on(clpipe, asked):
    size = ("--size", "64x48", "--repeat", 1, "--json")
    record = json.loads(clpipe("bench", *size, *asked.split()).stdout)
    assert record["launches"][0]["name"].startswith(asked.split()[1].partition(",")[0])


@pytest.mark.slow
def test_bench_of_methods(clpipe):
    options = ("--size", "320x200", "--repeat", 1)
    method, strength = ("--set", "denoise.method=mean"), ("--set", "denoise.luma_strength=0.5")
    text = clpipe("bench", "--methods", "denoise", *options, *method, *strength).stdout
    assert "mean luma_strength=0.5" in text
    small = ("--size", "64x48", "--repeat", 1)
    mosaics = clpipe("bench", "--methods", "demosaic", *small).stdout
    assert "malvar2004" in mosaics and "gray" not in mosaics
    gray = ("bench", "--methods", "demosaic", "--set", "demosaic.method=gray")
    assert "sensors of one channel" in clpipe(*gray, *small, status=2).stderr
    white = clpipe("bench", "--methods", "white_balance", "--size", "320x200", "--json").stdout
    records = json.loads(white)["methods"]
    launches = {record["method"]: record["launches"] for record in records}
    assert launches["as_shot"] == 1
    assert launches["gray_world"] > 2
    assert all(record["mp_per_s"] > 0 for record in records if record["launches"])
    assert "did you mean 'denoise'" in clpipe("bench", "--methods", "denoize", status=2).stderr


def test_a_stage_is_explained_for_a_camera_and_an_iso(clpipe):
    low, high = (clpipe("stages", "denoise", "--iso", iso).stdout for iso in (100, 6400))
    assert "sony-a7r2, ISO 6400" in high
    assert "luma_noise = sqrt(sum of" in high
    assert low != high
    assert "from 100 to 25600" in clpipe("stages", "denoise", "--iso", 1, status=2).stderr
    assert "unknown camera" in clpipe("stages", "denoise", "--camera", "x", status=2).stderr
    records = json.loads(clpipe("stages", "sensor_noise", "--iso", 800, "--json").stdout)["stages"]
    automatic = records[0]["methods"][0]["automatic"]
    assert {k for k, v in automatic.items() if v != "none"} == {"a", "b"}
    rows = json.loads(clpipe("stages", "row_noise", "--iso", 800, "--json").stdout)["stages"]
    assert rows[0]["methods"][0]["automatic"] == {"sigma": f"{0.12 * 2.94 / 15871:.4g}"}


def test_cameras_are_listed_and_shown(clpipe):
    listed = clpipe("cameras").stdout
    for name in ("sony-a7r2", "sony-a7s2", "canon-5d2", "oppo-reno-10x"):
        assert name in listed
    shown = clpipe("cameras", "sony-a7s2", "--iso", 3200).stdout
    # K, sigGs and sigR of PMN's table at ISO 3200.
    assert "3.06" in shown and "0.4454" in shown and "PMN" in shown
    [record] = json.loads(clpipe("cameras", "sony-a7s2", "--iso", 3200, "--json").stdout)["cameras"]
    (noise,) = record["noise"]
    emva, paper = noise["emva1288"], noise["paper"]
    dark = (emva["system_gain"] * emva["read_noise"]) ** 2 + emva["adc_noise"] ** 2
    assert dark**0.5 == pytest.approx(3.91938)
    assert noise["row_noise"] == pytest.approx(0.445435)
    b = paper["theta"] ** 2 * paper["b_before"] + paper["b_after"]
    assert b == pytest.approx(noise["signal"]["b"]) == pytest.approx((3.91938 / 15871) ** 2)
    assert len(json.loads(clpipe("cameras", "--json").stdout)["cameras"]) >= 4
    text = clpipe("cameras", "canon-5d2", "--iso", 12800, status=2).stderr
    assert "found 12800, but camera canon-5d2 goes from 100 to 6400" in text
    assert "(most similar: sony-a7s2)" in clpipe("cameras", "sony-a7s", status=2).stderr
    assert "but no camera is named" in clpipe("cameras", "--iso", 100, status=2).stderr


@pytest.mark.parametrize("name", built_in_cameras())
def test_every_value_of_a_profile_is_shown(name):
    camera = load_camera(name)
    *tables, (_, _, fixed) = camera_tables(camera, None)
    shown = {key: value.replace("\n", " ") for key, value, _ in fixed}
    record = camera_record(camera)
    titles = {"make", "model"}
    assert all(getattr(camera, key) in tables[0][0] for key in titles)
    if curves := camera.sensitivities:
        assert shown["sensitivities"] == curves.summary
        assert record["sensitivities"] == curves.model_dump()
    others = {"gain_stages", "sources", "sensitivities"}
    for key in camera.model_fields_set - titles - others:
        assert shown[key] == short_text(getattr(camera, key))
        assert record[key] == getattr(camera, key) and key not in record["unknown"]
    columns = {
        heading.partition(":")[0]: [row[column] for row in rows if row[0]]
        for _, headings, rows in tables
        for column, heading in enumerate(headings)
    }
    renamed = {"iso": "ISO", "read_noise": "both", "row_noise": "row", "column_noise": "column"}
    row = 0
    for stage in camera.gain_stages:
        for key in stage.model_fields_set:
            cells = columns[renamed.get(key, key)][row : row + len(stage.iso)]
            for cell, value in zip(cells, getattr(stage, key), strict=True):
                numbers = [float(part) for part in cell.split(", ")]
                assert numbers == pytest.approx(np.ravel(value), rel=0.005), key
        row += len(stage.iso)


def test_a_burst_is_frames_and_one_truth(clpipe, write_exr, tmp_path):
    render = write_exr("scene.exr", np.full((16, 24, 3), 0.2, np.float32))
    out = tmp_path / "out"
    clpipe("run", render, "-o", out, "--iso", 3200, "--frames", 3, "--keep", "normalize")
    names = [f"scene.{name}" for name in ("truth", "frame0", "frame1", "frame2")]
    for name in names:
        assert {f"{name}.jpg", f"{name}.json", f"{name}.normalize.exr"} <= set(written(out))
    assert len(written(out)) == 12
    truth, *frames = [read_exr(out / f"{name}.normalize.exr")[0] for name in names]
    assert len(np.unique(truth[::2, ::2])) == 1
    for i, one in enumerate(frames):
        assert 0.5 < (one - truth).std() / np.sqrt(6.35e-4 * 0.13) < 1.5
        assert not any(np.array_equal(one, other) for other in frames[:i])
    records = [json.loads((out / f"{name}.json").read_text()) for name in names]
    keys = [record["noise_key"].removeprefix(record["image_key"]) for record in records]
    assert keys == ["@ISO3200", "@ISO3200", "#1@ISO3200", "#2@ISO3200"]
    assert json.loads((out / "scene.truth.json").read_text())["noise"] is None
    clpipe("run", render, "-o", tmp_path / "one", "--iso", 3200)
    assert (tmp_path / "one" / "scene.jpg").read_bytes() == (out / "scene.frame0.jpg").read_bytes()
    quiet = ("--skip", "sensor_noise", "--skip", "row_noise", "--frames", 2)
    assert "adds noise" in clpipe("run", render, "-o", out, *quiet, status=2).stderr


def test_a_plan_says_what_opens_a_launch(clpipe):
    def opened_by(*options):
        launches = json.loads(clpipe("plan", *options, "--json").stdout)["launches"]
        return [launch["opened_by"] for launch in launches]

    options = ("-c", "paper", "--keep", "sensor_noise")
    opened = opened_by(*options)
    assert "sensor_noise is kept" in opened and "white_balance: sums" in opened
    assert "denoise: stencil, radius 2" in opened
    assert "white_balance: histogram" in opened_by("--set", "white_balance.method=white_patch")
    text = clpipe("plan", *options).stdout
    assert "sensor_noise is kept" in text and "Slots: " in text and "bytes per pixel" in text


def test_a_plan_prints_the_source_of_a_launch(clpipe):
    by_number, by_name = (
        clpipe("plan", "--source", launch).stdout for launch in (2.3, "demosaic.bounded_green")
    )
    assert by_number == by_name and "#define LANES 8" in by_number
    assert re.search(r"__kernel .*\nvoid launch_[0-9a-f]{16}\(", by_number)
    in_bands = clpipe("plan", "--source", 2).stdout
    assert "bounded_green(" in in_bands and "for (int band = " in in_bands
    for unknown in ("0", "3", "denoise"):
        stderr = clpipe("plan", "--source", unknown, status=2).stderr
        assert (
            f"unknown launch '{unknown}'" in stderr
            and "1 lines, 2 inverse_color_matrix..gamma, 2.1 inverse_color_matrix, 2.2" in stderr
        )
    assert "use only one" in clpipe("plan", "--source", 4, "--json", status=2).stderr


@pytest.mark.slow
def test_a_chain_printed_as_toml_makes_the_same_picture(clpipe, small, tmp_path):
    options = ("--iso", 1600, "--set", "demosaic.method=menon2007", "--skip", "denoise")
    (tmp_path / "mine.toml").write_text(clpipe("plan", "--toml", "-c", "paper", *options).stdout)
    clpipe("run", small, "-o", "a", "-c", "paper", *options)
    clpipe("run", small, "-o", "b", "-c", "mine.toml")
    one, two = ((tmp_path / x / "small.jpg").read_bytes() for x in "ab")
    assert one == two


@pytest.mark.slow
def test_no_platform_at_all(tmp_path):
    command = ("-m", "clpipe", "run", STILL_LIFE, "-o", tmp_path / "out")
    done = run_python(*command, status=None, OCL_ICD_VENDORS=tmp_path)
    if "no OpenCL platform was found" not in done.stderr:
        # The pip loader may bring its own PoCL whatever OCL_ICD_VENDORS says.
        with pytest.raises(DeviceError, match="no OpenCL platform was found"):
            discovery.choose(None, [])
    else:
        assert done.returncode == 3


@pytest.mark.slow
def test_a_missing_linker_is_said_before_it_aborts_the_process(tmp_path):
    done = run_python("-m", "clpipe", "check", "--small", status=3, PATH=tmp_path)
    assert "PoCL needs a linker" in done.stderr


@pytest.mark.slow
@pytest.mark.parametrize("arguments", ["--help", "--version", "stages", "cameras --json", "plan"])
def test_text_that_cannot_be_printed_has_a_message(arguments):
    command = [sys.executable, "-m", "clpipe", *arguments.split()]
    with open("/dev/full", "w") as full:
        result = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True, cwd=ROOT)
    assert result.stderr == "clpipe: cannot print: No space left on device\n"
    assert result.returncode == 2


def test_a_log_that_cannot_be_written_is_named_and_the_summary_is_printed(clpipe, small, tmp_path):
    (tmp_path / "out/run.jsonl").mkdir(parents=True)
    (tmp_path / "in/b.exr").write_bytes(small.read_bytes())
    result = clpipe("run", "in", "-o", "out", "--device", "numpy", status=1)
    assert "clpipe: out/run.jsonl: cannot be written: Is a directory" in result.stderr
    (done,) = re.findall(r"(\d) of 2 images done, 0 failed", result.stderr)
    assert int(done) == len(list((tmp_path / "out").glob("*.jpg"))) > 0


@pytest.mark.slow
def test_a_screen_that_takes_no_more_ends_no_run(clpipe, small, tmp_path):
    run = [sys.executable, "-m", "clpipe", "run", small, "-o", tmp_path / "out"]
    with open("/dev/full", "w") as full:
        environment = {**os.environ, "PYTHONPATH": str(ROOT)}
        command = [*map(str, run), "--device", "numpy"]
        result = subprocess.run(command, stderr=full, env=environment, cwd=tmp_path)
    assert result.returncode == 0
    assert len(written(tmp_path / "out")) == 2


@pytest.mark.parametrize("name", COMMANDS)
def test_an_option_that_holds_one_value_is_given_once(clpipe, name):
    command = main.get_command(click.Context(main), name)
    options = [p for p in command.params if isinstance(p, click.Option)]
    for option in (o for o in options if not (o.multiple or o.is_flag)):
        long = option.opts[-1]
        for first in option.opts:
            message = clpipe(name, first, "1", f"{long}=2", status=2).stderr
            assert message.startswith(f"clpipe: {long}: found 2 times")


def test_an_output_folder_is_not_named_like_a_picture(clpipe, small, tmp_path):
    for name in ("out.jpg", "out.EXR", "out.dng"):
        message = clpipe("run", small, "-o", name, "--device", "numpy", status=2).stderr
        assert f"--output: found {name}, the name of a picture" in message
        assert not (tmp_path / name).exists()
    (tmp_path / "shots.exr").mkdir()
    clpipe("run", small, "-o", "shots.exr", "--device", "numpy")
    assert written(tmp_path / "shots.exr") == ["small.jpg", "small.json"]


def test_json_lines_are_those_of_the_log(small, clpipe):
    result = clpipe("run", small, "-o", "out", "--json-lines")
    lines = [json.loads(line) for line in result.stdout.splitlines()]
    assert [line["event"] for line in lines] == ["start", "image", "end"]
    assert lines[1]["outputs"] == ["small.jpg", "small.json"] and lines[2]["done"] == 1
    assert result.stdout == (small.parent.parent / "out" / "run.jsonl").read_text()
    assert "->" not in result.stderr


def test_many_images_have_a_line_every_so_often(small, clpipe, monkeypatch):
    monkeypatch.setattr("clpipe.commands.progress.MAX_LINES", 1)
    monkeypatch.setattr("clpipe.commands.progress.LINE_INTERVAL", 0)
    more = "--iso", "100,200,400"
    said = clpipe("run", small, "-o", "out", "--device", "numpy", *more).stderr
    assert re.search(r"^\d of 3 images; [\d.]+ MP/s; decode .*", said, re.M)
    assert "3 of 3 images done" in said and "->" not in said
    monkeypatch.setattr("clpipe.commands.progress.LINE_INTERVAL", 60)
    said = clpipe("run", small, "-o", "again", "--device", "numpy", *more).stderr
    assert "of 3 images;" not in said


@pytest.mark.parametrize("name", ["run", "dataset"])
def test_help_is_short_and_there_is_all_of_it(clpipe, name):
    short, whole = (clpipe(name, option).output for option in ("--help", "--help-all"))
    assert len(short.splitlines()) <= 70
    assert re.search(r"-o, --output .*\[required\]", short)
    command = main.get_command(click.Context(main), name)
    options = [o.opts[-1] for o in command.params if isinstance(o, click.Option)]
    assert [o for o in options if not re.search(rf"^  (-\w, )?{o}\b", whole, re.M)] == []
    shown = [o for o in options if re.search(rf"^  (-\w, )?{o}\b", short, re.M)]
    assert {"--iso", "--camera", "--set", "--truth", "--output"} <= set(shown) < set(options)
    assert "--help-all" in short
    choices = [o for o in command.params if o.name in {"truth", "redo"}]
    assert all(f"({value})" in short for o in choices for value in o.type.choices)
