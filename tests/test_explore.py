"""``clpipe explore``: repeated development of an image, and saved settings."""

import json
import os
import shlex
import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from clpipe.base.errors import ClpipeError, ImageError, KeyedError, RequestError
from clpipe.chain.request import Request
from clpipe.chain.settings import Settings, overlay
from clpipe.commands.chain_options import settings_in
from clpipe.commands.main import main
from clpipe.engine.device import open_device
from clpipe.images.write import write_exr as write
from clpipe.inputs.find import find_jobs
from tests.conftest import ROOT, cli_output

pytest.importorskip("starlette", reason="needs Starlette, in the extra explore")

from clpipe.camera.lens import calibration_of
from clpipe.camera.profile import load_camera
from clpipe.explorer.controls import key_controls
from clpipe.explorer.explorer import Explorer
from clpipe.explorer.export import exported, inputs_of, options_of, run_command
from clpipe.explorer.view import View

NOISY = {
    "iso": 6400,
    "seed": 3,
    "skip": ["sharpen"],
    "denoise": {"luma_strength": 0.5},
    "white_balance": {"method": "gray_world"},
    "output": {"jpeg_quality": 80},
}


def explorer_of(*inputs, device=None, **options) -> Explorer:
    jobs = find_jobs([str(each) for each in inputs], Path("nowhere"))
    return Explorer(jobs, Request.from_options(**options), open_device(device))


@pytest.fixture(scope="module")
def explorer(two_renders):
    return explorer_of(two_renders)


def commands_of(explorer, image, values) -> dict[str, list[str]]:
    """Save values as a configuration; the words of its commands, by their names."""
    texts = exported(explorer, image, values)
    Path("camera.toml").write_text(texts["config"], "utf-8")
    return {name: shlex.split(texts[name])[1:] for name in ("folder", "command")}


@pytest.mark.parametrize("image", [0, 1])
def test_what_is_seen_is_what_run_makes_of_the_configuration_and_of_the_command(
    clpipe, explorer, image
):
    seen = explorer.develop(image, NOISY, View())
    jpegs = []
    for command in commands_of(explorer, image, NOISY).values():
        clpipe(*command, "--format", "png", "--format", "jpg", "--quiet")
        path = Path("out", ("a", "left/b")[image])
        np.testing.assert_array_equal(np.asarray(Image.open(f"{path}.png")), seen.shown)
        jpegs.append(Path(f"{path}.jpg").read_bytes())
        shutil.rmtree("out")
    assert jpegs[0] == jpegs[1]


def test_a_command_leaves_out_what_is_set_of_stages_that_are_switched_off(clpipe, explorer):
    values = {"skip": ["denoise"], "denoise": {"luma_strength": 0.5}}
    command = commands_of(explorer, 0, values)["command"]
    assert "luma_strength" in Path("camera.toml").read_text("utf-8")
    clpipe(*command, "--quiet", "--device", "numpy")  # which refuses them


def test_options_are_the_same_settings(two_renders):
    options = options_of(
        NOISY | {"lens": "a b", "noise_key": "it's", "stages": ["mosaic", "demosaic"]}
    )
    text = ["run", str(two_renders), "-o", "out", *options]
    context = main.get_command(None, "run").make_context("run", text[1:])
    params = context.params
    others = {"noise_key": "it's", "lens": "a b", "stages": ["mosaic", "demosaic"]}
    assert {key: params.pop(key) for key in others} == others
    settings = settings_in(params)
    assert settings.pop("iso") == "6400"
    given = Request.from_options(values={"iso": 6400.0, **settings})
    assert given.settings() == overlay(Settings(), NOISY)


def test_what_is_drawn_is_saved_as_a_draw_and_seen_as_run_draws_it(clpipe, two_renders):
    drawn = {"iso": {"choice": [400, 3200]}, "denoise": {"luma_strength": {"uniform": [0, 1]}}}
    Path("own.toml").write_text(
        "iso = { choice = [400, 3200] }\n[denoise]\nluma_strength = { uniform = [0, 1] }\n"
    )
    explorer = explorer_of(two_renders / "a.exr", config="own.toml", device="numpy")
    assert explorer.initial == drawn
    seen = explorer.develop(0, explorer.initial, View())
    command = commands_of(explorer, 0, explorer.initial)["command"]
    assert "-c" in command
    clpipe(*command, "--format", "png", "--quiet", "--device", "numpy")
    np.testing.assert_array_equal(np.asarray(Image.open("out/a.png")), seen.shown)


def test_what_a_kept_image_carries_holds_where_nothing_is_set(clpipe, two_renders):
    keep = ["--iso", 3200, "--skip", "sharpen", "--keep", "normalize", "--quiet"]
    clpipe("run", two_renders / "a.exr", "-o", "kept", *keep, "--device", "numpy")
    explorer = explorer_of("kept/a.normalize.exr", start_at="white_balance", device="numpy")
    values = {"denoise": {"luma_strength": 0.5}}
    seen = explorer.develop(0, values, View())
    assert seen.facts["iso"] == 3200
    command = commands_of(explorer, 0, values)["command"]
    saved = ["run", "kept/a.normalize.exr", "-o", "out", "--start-at", "white_balance"]
    for each in (command, [*saved, "-c", "camera.toml"]):
        clpipe(*each, "--format", "png", "--quiet", "--device", "numpy")
        (made,) = Path("out").glob("*.png")
        np.testing.assert_array_equal(np.asarray(Image.open(made)), seen.shown)
        shutil.rmtree("out")


def test_several_inputs_are_applied_to_as_they_were_given(two_renders):
    jobs = find_jobs([str(two_renders / "left"), str(two_renders / "a.exr")], Path("nowhere"))
    assert inputs_of(jobs) == [two_renders / "left", two_renders / "a.exr"]
    assert inputs_of(jobs[:1]) == [two_renders / "left"]
    assert inputs_of(jobs[1:]) == [two_renders]
    assert run_command([Path("-a.exr")], []) == "clpipe run ./-a.exr -o out"


@pytest.mark.slow
def test_noise_of_all_of_a_picture_is_that_of_measure(clpipe, explorer, two_renders):
    out = Path("out")
    options = ["--iso", 6400, "--truth", "development", "--truth", "mosaic", "--format", "png"]
    clpipe("run", two_renders / "a.exr", "-o", out, *options, "--keep", "normalize", "--quiet")
    pairs = {"": ("a.png", "a.truth.png"), "normalize": ("a.normalize.exr", "a.truth_mosaic.exr")}
    for step, (picture, truth) in pairs.items():
        box = (0, 0, 96, 63)
        report = explorer.noise(0, {"iso": 6400}, View(step), box)
        record = json.loads(
            clpipe("measure", out / picture, "--truth", out / truth, "--json").output
        )
        own = report.record()
        assert own["channels"].keys() == record["channels"].keys()
        for name, channel in own["channels"].items():
            if step == "":  # a mosaic of an odd height is cut to whole cells
                assert channel == record["channels"][name]
            assert channel["sigma"] == pytest.approx(record["channels"][name]["sigma"], rel=0.05)


def test_views_are_stages_and_truths_and_their_values(explorer):
    raw = explorer.develop(0, {"iso": 6400}, View("quantize"))
    assert raw.facts["kind"] == "raw"
    sample = explorer.values_at(raw.facts["number"], 5, 7)
    assert sample["unit"] == "DN"
    assert sample["values"] == [round(sample["values"][0])]
    clean = explorer.develop(0, {"iso": 6400}, View(truth="clean"))
    other = explorer.develop(0, {"iso": 6400, "seed": 9}, View(truth="clean"))
    np.testing.assert_array_equal(clean.shown, other.shown)
    noisy = explorer.develop(0, {"iso": 6400}, View())
    assert (noisy.shown != clean.shown).mean() > 0.5
    assert explorer.values_at(noisy.facts["number"], 5, 7)["values"] == noisy.shown[7, 5].tolist()
    with pytest.raises(RequestError, match="but the image has"):
        explorer.values_at(noisy.facts["number"], 96, 0)


def test_what_was_made_is_kept_as_far_as_memory_goes(explorer, monkeypatch):
    numbers = [explorer.develop(0, {"seed": n}, View()).facts["number"] for n in range(5)]
    assert [explorer.sample(number).facts["seed"] for number in numbers] == [0, 1, 2, 3, 4]
    monkeypatch.setattr("clpipe.explorer.explorer.MAX_RESULT_BYTES", 0)
    explorer.develop(0, {"seed": 5}, View())
    assert explorer.sample(numbers[-2]).facts["seed"] == 3
    with pytest.raises(RequestError, match="no longer kept"):
        explorer.sample(numbers[-3])


@pytest.mark.parametrize("device", [None, "numpy"])
def test_a_render_that_is_replaced_is_read_again(two_renders, tmp_path, device):
    path = Path(shutil.copy(two_renders / "a.exr", tmp_path / "a.exr"))
    explorer = explorer_of(path, device=device)
    before = explorer.develop(0, NOISY, View())
    for size in ((63, 96), (20, 33)):
        pixels = np.random.default_rng(0).random((*size, 3), np.float32)
        write(tmp_path / "new.exr", pixels, ("R", "G", "B"), {})
        os.replace(tmp_path / "new.exr", path)
        after = explorer.develop(0, NOISY, View())
        alone = explorer_of(path, device=device).develop(0, NOISY, View())
        np.testing.assert_array_equal(after.shown, alone.shown)
    # Values of a shown picture do not change if its file changes.
    sample = explorer.values_at(before.facts["number"], 5, 7)
    assert sample["values"] == before.shown[7, 5].tolist()
    path.write_bytes(path.read_bytes()[:200])
    with pytest.raises(ImageError, match=r"a\.exr"):
        explorer.develop(0, NOISY, View())
    path.unlink()
    with pytest.raises(ImageError, match=r"a\.exr: .*[Nn]o such file"):
        explorer.develop(0, NOISY, View())


def test_steps_say_what_is_on_and_which_values_follow(explorer):
    steps = {step["name"]: step for step in explorer.develop(0, NOISY, View()).facts["steps"]}
    assert not steps["sharpen"]["on"]
    assert steps["sharpen"]["idle"]
    assert steps["denoise"]["values"]["luma_strength"] == 0.5
    assert steps["sensor_noise"]["values"]["a"] > 0
    assert steps["white_balance"]["method"] == "gray_world"


def test_stages_that_do_nothing_say_so(explorer):
    def idle(values):
        steps = explorer.develop(0, values, View()).facts["steps"]
        return {step["name"] for step in steps if step["on"] and step["idle"]}

    usual = idle({})
    assert "color_matrix" not in usual
    assert {"defocus", "motion_blur", "picture_noise"} <= usual
    assert not usual & {"sensor_noise", "sharpen", "denoise", "gamma"}
    none = {"sharpen": {"amount": 0}, "color_matrix": {"method": "none"}}
    assert idle(none) - usual == {"sharpen", "color_matrix"}
    assert "motion_blur" not in idle({"motion_blur": {"length": 3}})


def test_lenses_are_listed_or_the_extra_is_named(monkeypatch):
    def missing():
        raise ImportError

    monkeypatch.setattr("clpipe.camera.lens._load_database", missing)
    lens = key_controls()["lens"]
    assert {*lens["suggested"]} == {"none", "typical"} and "pip install lensfunpy" in lens["text"]


def test_every_lens_in_the_list_is_one():
    pytest.importorskip("lensfunpy", reason="needs lensfunpy, in the extra lens")
    presets, names = (
        key_controls()["lens"]["suggested"][part] for part in (slice(2), slice(2, None))
    )
    assert {*presets} == {"none", "typical"}
    assert len(names) > 500 and names == sorted(set(names))
    for name in names[::100]:
        try:
            assert calibration_of(name, load_camera("sony-a7r2")).focal_length > 0
        except RequestError as error:
            assert "is a zoom; set" in str(error)


def test_a_page_may_switch_on_what_the_command_line_skipped(two_renders):
    explorer = explorer_of(two_renders, values={"skip": ["sharpen"]}, device="numpy")
    assert explorer.initial == {"skip": ["sharpen"]}
    on = explorer.develop(0, {}, View()).facts["steps"]
    assert {step["name"]: step["on"] for step in on}["sharpen"]


@pytest.mark.parametrize(
    ("values", "key"),
    [
        ({"camera": "/etc/passwd.toml"}, "camera"),
        ({"camera": {"choice": ["sony-a7r2", "other.toml"]}}, "camera"),
        ({"tone_curve": {"method": "file", "path": "/etc/passwd"}}, "tone_curve.path"),
        ({"stage_files": ["/tmp/a.py"]}, "stage_files"),
        ({"iso": -1}, ""),
        ({"denoise": {"luma_strength": -1}}, "denoise.luma_strength"),
        ({"denoise": {"x": 1}}, "denoise.x"),
        ({"no_such": 1}, "no_such"),
    ],
)
def test_values_that_are_not_allowed_are_refused_with_their_key(explorer, values, key):
    with pytest.raises(ClpipeError) as refused:
        explorer.develop(0, values, View())
    assert (refused.value.key if isinstance(refused.value, KeyedError) else "") == key


def test_files_that_were_named_may_be_used(two_renders, tmp_path):
    profile = tmp_path / "own.toml"
    built_in = ROOT / "clpipe/camera/profiles/sony-a7r2.toml"
    profile.write_text(built_in.read_text("utf-8"), "utf-8")
    explorer = explorer_of(two_renders, values={"camera": str(profile)}, device="numpy")
    assert explorer.cameras == (str(profile),)
    explorer.develop(0, {"camera": str(profile)}, View())
    assert f'camera = "{profile}"' in exported(explorer, 0, explorer.initial)["config"]


@pytest.mark.parametrize(
    ("box", "says"), [((90, 0, 10, 5), "not in the image"), ((0, 0, 0, 5), "empty")]
)
def test_a_rectangle_that_is_not_in_the_picture_is_refused(explorer, box, says):
    with pytest.raises(RequestError, match=says):
        explorer.noise(0, {}, View(), box)


def test_a_manifest_is_refused(two_renders, tmp_path):
    manifest = tmp_path / "list.csv"
    manifest.write_text(f"path,iso\n{two_renders / 'a.exr'},800\n")
    output = cli_output("explore", manifest, "--device", "numpy", status=2)
    assert "rows of a manifest may have their own settings" in output
