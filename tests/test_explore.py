"""``clpipe explore``: what its server answers, and what its page does in a browser."""

import http.client
import json
import logging
import os
import shlex
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from contextlib import closing
from pathlib import Path
from urllib.parse import urlsplit

import numpy as np
import pytest
from click.testing import CliRunner
from PIL import Image

from clpipe.base.errors import ClpipeError, ImageError, KeyedError, RequestError
from clpipe.chain.request import Request
from clpipe.chain.settings import Settings, overlay
from clpipe.commands.main import main
from clpipe.engine.device import open_device
from clpipe.images.write import write_exr as write
from clpipe.inputs.find import find_jobs
from tests.conftest import ROOT
from tests.conftest import cli_output as clpipe

pytest.importorskip("starlette")

from clpipe.explorer.explorer import Explorer
from clpipe.explorer.export import exported, inputs_of, options_of, run_command
from clpipe.explorer.server import Server, in_json
from clpipe.explorer.view import View

NOISY = {
    "iso": 6400,
    "seed": 3,
    "skip": ["sharpen"],
    "denoise": {"luma_strength": 0.5},
    "white_balance": {"method": "gray_world"},
    "output": {"jpeg_quality": 80},
}


@pytest.fixture(scope="module")
def renders(tmp_path_factory):
    """Two small renders, one of them in a folder of the folder."""
    folder = tmp_path_factory.mktemp("explore") / "renders"
    (folder / "left").mkdir(parents=True)
    y, x = np.mgrid[0:63, 0:96] / 96
    for i, name in enumerate(("a", "left/b")):
        picture = np.stack([0.2 + 0.5 * x, 0.6 - 0.5 * y, 0.3 + 0.2 * np.sin(9 * x + i)], -1)
        write(folder / f"{name}.exr", picture.astype(np.float32), ("R", "G", "B"), {})
    return folder


def explorer_of(*inputs, device=None, **options) -> Explorer:
    jobs = find_jobs([str(each) for each in inputs], Path("nowhere"))
    return Explorer(jobs, Request.from_options(**options), open_device(device))


@pytest.fixture(scope="module")
def explorer(renders):
    return explorer_of(renders)


@pytest.mark.parametrize("image", [0, 1])
def test_what_is_seen_is_what_run_makes_of_the_configuration_and_of_the_command(
    explorer, renders, tmp_path, monkeypatch, image
):
    monkeypatch.chdir(tmp_path)
    seen = explorer.develop(image, NOISY, View())
    texts = exported(explorer, image, NOISY)
    Path("camera.toml").write_text(texts["config"], "utf-8")
    for name in ("folder", "command"):
        _, *command = shlex.split(texts[name])
        clpipe(*command, "--format", "png", "--quiet")
        made = np.asarray(Image.open(f"out/{('a', 'left/b')[image]}.png"))
        np.testing.assert_array_equal(made, seen.shown)
        shutil.rmtree("out")


def test_the_jpeg_of_a_saved_configuration_is_that_of_its_command_byte_for_byte(
    explorer, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    texts = exported(explorer, 0, NOISY)
    Path("camera.toml").write_text(texts["config"], "utf-8")
    jpegs = []
    for name in ("folder", "command"):
        _, *command = shlex.split(texts[name])
        clpipe(*command, "--quiet")
        jpegs.append(Path("out/a.jpg").read_bytes())
        shutil.rmtree("out")
    assert jpegs[0] == jpegs[1]


def test_a_command_leaves_out_what_is_set_of_stages_that_are_switched_off(
    explorer, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    texts = exported(explorer, 0, {"skip": ["denoise"], "denoise": {"luma_strength": 0.5}})
    assert "luma_strength" in texts["config"]
    _, *command = shlex.split(texts["command"])
    clpipe(*command, "--quiet", "--device", "numpy")  # which refuses them


def test_options_are_the_same_settings(renders):
    options = options_of(
        NOISY | {"lens": "a b", "noise_key": "it's", "stages": ["mosaic", "demosaic"]}
    )
    text = ["run", str(renders), "-o", "out", *options]
    context = main.get_command(None, "run").make_context("run", text[1:])
    params = context.params
    own = {"iso": 6400, "seed": 3, "noise_key": "it's", "lens": "a b"}
    assert params["isos"] == "6400"
    assert {k: params[k] for k in ("seed", "noise_key", "lens")} == {
        k: own[k] for k in ("seed", "noise_key", "lens")
    }
    assert params["stages"] == "mosaic,demosaic"
    given = Request.from_options(
        iso=6400.0, seed=3, skip=params["skip"], assignments=params["assignments"]
    )
    assert given.settings() == overlay(Settings(), NOISY)


def test_what_is_drawn_is_saved_as_a_draw_and_seen_as_run_draws_it(renders, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    drawn = {"iso": {"choice": [400, 3200]}, "denoise": {"luma_strength": {"uniform": [0, 1]}}}
    Path("own.toml").write_text(
        "iso = { choice = [400, 3200] }\n[denoise]\nluma_strength = { uniform = [0, 1] }\n"
    )
    explorer = explorer_of(renders / "a.exr", config="own.toml", device="numpy")
    assert explorer.initial == drawn
    seen = explorer.develop(0, explorer.initial, View())
    texts = exported(explorer, 0, explorer.initial)
    Path("camera.toml").write_text(texts["config"], "utf-8")
    _, *command = shlex.split(texts["command"])
    assert "-c" in command
    clpipe(*command, "--format", "png", "--quiet", "--device", "numpy")
    np.testing.assert_array_equal(np.asarray(Image.open("out/a.png")), seen.shown)


def test_what_a_kept_image_carries_holds_where_nothing_is_set(renders, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    keep = ["--iso", 3200, "--skip", "sharpen", "--keep", "normalize", "--quiet"]
    clpipe("run", renders / "a.exr", "-o", "kept", *keep, "--device", "numpy")
    explorer = explorer_of("kept/a.normalize.exr", start_at="white_balance", device="numpy")
    values = {"denoise": {"luma_strength": 0.5}}
    seen = explorer.develop(0, values, View())
    assert seen.facts["iso"] == 3200
    texts = exported(explorer, 0, values)
    Path("camera.toml").write_text(texts["config"], "utf-8")
    _, *command = shlex.split(texts["command"])
    saved = ["run", "kept/a.normalize.exr", "-o", "out", "--start-at", "white_balance"]
    for each in (command, [*saved, "-c", "camera.toml"]):
        clpipe(*each, "--format", "png", "--quiet", "--device", "numpy")
        (made,) = Path("out").glob("*.png")
        np.testing.assert_array_equal(np.asarray(Image.open(made)), seen.shown)
        shutil.rmtree("out")


def test_several_inputs_are_applied_to_as_they_were_given(renders):
    jobs = find_jobs([str(renders / "left"), str(renders / "a.exr")], Path("nowhere"))
    assert inputs_of(jobs) == [renders / "left", renders / "a.exr"]
    assert inputs_of(jobs[:1]) == [renders / "left"]
    assert inputs_of(jobs[1:]) == [renders]
    assert run_command([Path("-a.exr")], []) == "clpipe run ./-a.exr -o out"


def test_noise_of_all_of_a_picture_is_that_of_measure(explorer, renders, tmp_path):
    out = tmp_path / "out"
    options = ["--iso", 6400, "--truth", "development", "--truth", "mosaic", "--format", "png"]
    clpipe("run", renders / "a.exr", "-o", out, *options, "--keep", "normalize", "--quiet")
    pairs = {"": ("a.png", "a.truth.png"), "normalize": ("a.normalize.exr", "a.truth_mosaic.exr")}
    for step, (picture, truth) in pairs.items():
        box = (0, 0, 96, 63)
        report = explorer.noise(0, {"iso": 6400}, View(step), box)
        said = json.loads(clpipe("measure", out / picture, "--truth", out / truth, "--json"))
        own = report.record()
        assert own["channels"].keys() == said["channels"].keys()
        for name, channel in own["channels"].items():
            if step == "":  # a mosaic of an odd height is cut to whole cells
                assert channel == said["channels"][name]
            assert channel["sigma"] == pytest.approx(said["channels"][name]["sigma"], rel=0.05)


def test_views_are_stages_and_truths_and_their_values(explorer):
    raw = explorer.develop(0, {"iso": 6400}, View("quantize"))
    assert raw.facts["kind"] == "raw"
    said = explorer.values_at(raw.facts["number"], 5, 7)
    assert said["unit"] == "DN"
    assert said["values"] == [round(said["values"][0])]
    clean = explorer.develop(0, {"iso": 6400}, View(truth="clean"))
    other = explorer.develop(0, {"iso": 6400, "seed": 9}, View(truth="clean"))
    np.testing.assert_array_equal(clean.shown, other.shown)
    noisy = explorer.develop(0, {"iso": 6400}, View())
    assert (noisy.shown != clean.shown).mean() > 0.5
    assert explorer.values_at(noisy.facts["number"], 5, 7)["values"] == noisy.shown[7, 5].tolist()
    with pytest.raises(RequestError, match="no pixel"):
        explorer.values_at(noisy.facts["number"], 96, 0)


def test_what_was_made_is_kept_as_far_as_memory_goes(explorer, monkeypatch):
    numbers = [explorer.develop(0, {"seed": n}, View()).facts["number"] for n in range(5)]
    assert [explorer.sample(number).facts["seed"] for number in numbers] == [0, 1, 2, 3, 4]
    monkeypatch.setattr("clpipe.explorer.explorer.KEPT", 0)
    explorer.develop(0, {"seed": 5}, View())
    assert explorer.sample(numbers[-2]).facts["seed"] == 3
    with pytest.raises(RequestError, match="not kept any more"):
        explorer.sample(numbers[-3])


@pytest.mark.parametrize("device", [None, "numpy"])
def test_a_render_that_is_replaced_is_read_again(renders, tmp_path, device):
    path = Path(shutil.copy(renders / "a.exr", tmp_path / "a.exr"))
    explorer = explorer_of(path, device=device)
    before = explorer.develop(0, NOISY, View())
    for size in ((63, 96), (20, 33)):
        pixels = np.random.default_rng(0).random((*size, 3), np.float32)
        write(tmp_path / "new.exr", pixels, ("R", "G", "B"), {})
        os.replace(tmp_path / "new.exr", path)
        after = explorer.develop(0, NOISY, View())
        alone = explorer_of(path, device=device).develop(0, NOISY, View())
        np.testing.assert_array_equal(after.shown, alone.shown)
    # What was shown stays what it was, whatever the file has become.
    said = explorer.values_at(before.facts["number"], 5, 7)
    assert said["values"] == before.shown[7, 5].tolist()
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


def test_a_page_may_switch_on_what_the_command_line_skipped(renders):
    explorer = explorer_of(renders, skip=["sharpen"], device="numpy")
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


def test_files_that_were_named_may_be_used(renders, tmp_path):
    profile = tmp_path / "own.toml"
    built_in = ROOT / "clpipe/camera/profiles/sony-a7r2.toml"
    profile.write_text(built_in.read_text("utf-8"), "utf-8")
    explorer = explorer_of(renders, camera=str(profile), device="numpy")
    assert explorer.cameras == (str(profile),)
    explorer.develop(0, {"camera": str(profile)}, View())
    assert f'camera = "{profile}"' in exported(explorer, 0, explorer.initial)["config"]


@pytest.mark.parametrize(
    ("box", "says"), [((90, 0, 10, 5), "not in the image"), ((0, 0, 0, 5), "empty")]
)
def test_a_rectangle_that_is_not_in_the_picture_is_refused(explorer, box, says):
    with pytest.raises(RequestError, match=says):
        explorer.noise(0, {}, View(), box)


def test_a_manifest_is_refused(renders, tmp_path):
    manifest = tmp_path / "list.csv"
    manifest.write_text(f"path,iso\n{renders / 'a.exr'},800\n")
    result = CliRunner().invoke(main, ["explore", str(manifest), "--device", "numpy"])
    assert result.exit_code == 2
    assert "rows may have settings of their own" in result.output


# The server.


@pytest.fixture(scope="module")
def served(explorer):
    server = Server(explorer)
    thread = threading.Thread(target=server.run, daemon=True)
    thread.start()
    yield server.address
    server.stop()
    thread.join(10)
    assert not thread.is_alive()


def answer(address, name, question=None, host=None, token=None):
    """The status, the headers and the body of an answer."""
    parts = urlsplit(address)
    body = question if question is None or isinstance(question, bytes) else json.dumps(question)
    path = f"/{token}/" if token is not None else parts.path
    headers = {"Host": host} if host else {}
    with closing(http.client.HTTPConnection(parts.hostname, parts.port, timeout=60)) as connection:
        connection.request("GET" if body is None else "POST", path + name, body, headers)
        response = connection.getresponse()
        return response.status, response.headers, response.read()


def pixels_of(found):
    """The facts and the pixels of an answer."""
    status, _, body = found
    assert status == 200, body
    length = int.from_bytes(body[:4], "little")
    facts = json.loads(body[4 : 4 + length])
    shape = facts["part"]["rows"], facts["part"]["columns"], 3
    return facts, np.frombuffer(body[4 + length :], np.uint8).reshape(shape)


def test_the_server_answers_with_pixels(served, explorer):
    part = {"left": 10, "top": 20, "width": 30, "height": 500, "by": 1}
    question = {"image": 0, "values": NOISY, "step": "", "truth": ""}
    facts, first = pixels_of(answer(served, "develop", question | part))
    shown = explorer.develop(0, NOISY, View()).shown
    np.testing.assert_array_equal(first, shown[20:, 10:40])
    _, whole = pixels_of(answer(served, "pixels", {"number": facts["number"]}))
    np.testing.assert_array_equal(whole, shown)
    _, small = pixels_of(answer(served, "develop", question | part | {"by": 4}))
    assert small.shape == (11, 8, 3)
    assert abs(small.mean() - first.mean()) < 2
    _, none = pixels_of(answer(served, "develop", question | part | {"left": 1000, "by": 0}))
    assert none.size == 0
    ran = [launch for launch in facts["launches"] if launch["ms"] is not None]
    assert ran
    assert all(launch["ms"] > 0 for launch in ran)


def test_nobody_without_the_token_gets_an_answer(served):
    assert answer(served, "")[0] == 200
    for token in ("", "x", "..", "%2e%2e"):
        assert answer(served, "", token=token)[0] == 404
        assert answer(served, "start", {}, token=token)[0] == 404
    for name in ("../../pyproject.toml", "%2e%2e/server.py", "/etc/passwd", "explore.html"):
        assert answer(served, name)[0] == 404


def test_another_host_name_is_refused(served):
    """So no page elsewhere can have its own name lead here."""
    assert answer(served, "", host="evil.example")[0] == 400


def test_the_page_may_load_nothing_from_elsewhere(served):
    headers = answer(served, "")[1]
    assert "default-src 'none'" in headers["Content-Security-Policy"]
    assert headers["Referrer-Policy"] == "no-referrer"
    assert "Access-Control-Allow-Origin" not in headers


@pytest.mark.parametrize(
    ("name", "question", "says"),
    [
        ("develop", [], "no JSON"),
        ("develop", {"image": 0, "values": {"\ud800": 1}}, "no JSON"),
        ("develop", b"[" * 100_000, "nested too deeply"),
        ("develop", {"image": 0, "values": {"\udc80": 1}}, "unknown key"),
        ("develop", {}, "whole numbers image"),
        ("develop", {"image": 7, "values": {}}, "no image 7"),
        ("develop", {"image": 0, "values": []}, "no values"),
        ("develop", {"image": 0, "values": {}, "step": "x"}, "stage in this chain"),
        ("develop", {"image": 0, "values": {}, "truth": "x"}, "development or clean"),
        ("values", {"number": 0, "x": 1.5, "y": 0}, "whole numbers"),
        ("noise", {"image": 0, "values": {}}, "whole numbers left"),
        ("export", {"image": -1, "values": {}}, "no image -1"),
        ("export", {"image": 0, "values": {"x": "y" * (1 << 20)}}, "longer than"),
    ],
)
def test_a_wrong_question_gets_one_message(served, name, question, says):
    status, _, body = answer(served, name, question)
    assert status in (400, 413)
    assert says in json.loads(body)["error"]


def test_a_browser_that_goes_away_leaves_the_others_alone(served, caplog, request):
    log = logging.getLogger("uvicorn.error")
    log.addHandler(caplog.handler)
    request.addfinalizer(lambda: log.removeHandler(caplog.handler))
    parts, question = urlsplit(served), {"image": 0, "values": NOISY}
    place = {"left": 0, "top": 0, "width": 96, "height": 63, "by": 1}
    body = json.dumps(question | place).encode()
    head = (
        f"POST {parts.path}develop HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: {len(body)}\r\n"
    )
    for sent in (f"{head}\r\n".encode() + body, f"{head}\r\n".encode() + body[:9]):
        with socket.create_connection((parts.hostname, parts.port)) as gone:
            gone.sendall(sent)
    assert pixels_of(answer(served, "develop", question | place))[1].shape == (63, 96, 3)
    assert not caplog.records


def test_a_connection_that_asks_nothing_whole_is_not_held(served, monkeypatch):
    monkeypatch.setattr("clpipe.explorer.patience.PATIENCE", 0.5)
    parts = urlsplit(served)
    head = f"POST {parts.path}start HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: 2\r\n"
    whole = f"{head}\r\n{{}}".encode()
    for sent in (b"", head.encode(), whole[:-1], whole + head.encode()):
        with socket.create_connection((parts.hostname, parts.port)) as slow:
            slow.settimeout(20)
            slow.sendall(sent)
            received = b"".join(iter(lambda: slow.recv(1 << 16), b""))  # until it is closed
        assert (b" 200 " in received[:20]) == sent.startswith(whole)


def test_a_question_may_take_longer_to_answer_than_to_ask(explorer, monkeypatch):
    monkeypatch.setattr("clpipe.explorer.patience.PATIENCE", 0.2)
    monkeypatch.setattr(Server, "_start", lambda self, question: time.sleep(1) or in_json({}))
    slow = Server(explorer)
    thread = threading.Thread(target=slow.run, daemon=True)
    thread.start()
    try:
        assert answer(slow.address, "start", {})[0] == 200
    finally:
        slow.stop()
        thread.join(10)


def test_two_explorers_at_once(served, renders):
    other = Server(explorer_of(renders / "a.exr", device="numpy"))
    thread = threading.Thread(target=other.run, daemon=True)
    thread.start()
    try:
        for address, count in ((served, 2), (other.address, 1)):
            assert len(json.loads(answer(address, "start", {})[2])["images"]) == count
    finally:
        other.stop()
        thread.join(10)


def test_a_port_in_use_is_said(renders):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = str(taken.getsockname()[1])
        command = ["explore", str(renders), "--device", "numpy", "--port", port]
        result = CliRunner().invoke(main, command)
    assert result.exit_code == 2
    assert f"--port {port}: cannot be used: Address already in use" in result.output


def test_ctrl_c_ends_it_quietly(renders):
    command = [sys.executable, "-m", "clpipe", "explore", str(renders), "--device", "numpy"]
    with subprocess.Popen(command, stdout=-1, stderr=-1, text=True) as process:
        line = process.stdout.readline()
        assert "http://127.0.0.1:" in line
        address = next(word for word in line.split() if word.startswith("http"))
        assert answer(address, "")[0] == 200
        process.send_signal(signal.SIGINT)
        _, errors = process.communicate(timeout=20)
    assert (process.returncode, errors) == (0, "")


# The page.


@pytest.fixture
def page(browser_page, served, monkeypatch, tmp_path):
    """The page in a browser, with its downloads in the working directory."""
    monkeypatch.chdir(tmp_path)
    browser_page.goto(served)
    settle(browser_page)
    return browser_page


def settle(page):
    page.wait_for_selector('body[data-settled="true"]', timeout=60_000)


def put(page, key, value):
    field = page.locator(f'#panel .row[data-key="{key}"] input:not([type="range"])').last
    field.evaluate("field => field.closest('details')?.setAttribute('open', '')")
    field.fill(value)
    field.press("Enter")
    settle(page)


def on_screen(page):
    """The whole picture as the page has it."""
    text = page.evaluate("Array.from(picture.pixels).join()")
    shape = page.evaluate("[picture.facts.height, picture.facts.width, 3]")
    return np.array(text.split(","), np.uint8).reshape(shape)


def test_controls_change_the_picture_and_what_is_saved_makes_it_again(page, renders):
    first = on_screen(page)
    put(page, "iso", "6400")
    put(page, "denoise.luma_strength", "0.5")
    page.click('.step[data-step="sharpen"] > input')
    settle(page)
    assert page.evaluate("state.values") == {
        "iso": 6400,
        "denoise": {"luma_strength": 0.5},
        "skip": ["sharpen"],
    }
    seen = on_screen(page)
    assert (seen != first).any()
    with page.expect_download() as download:
        page.click("#save")
    download.value.save_as("camera.toml")
    run = ["run", renders / "a.exr", "-o", "out", "--format", "png", "--quiet"]
    clpipe(*run, "-c", "camera.toml")
    np.testing.assert_array_equal(np.asarray(Image.open("out/a.png")), seen)
    page.click("#copy")
    page.wait_for_selector("dialog[open]")
    command = page.inner_text("#say-command")
    own = "--iso 6400 --set denoise.luma_strength=0.5 --skip sharpen"
    assert command == f"clpipe run {renders / 'a.exr'} -o out {own}"
    page.keyboard.press("Escape")
    for _ in range(3):
        page.click("#undo")
        settle(page)
    assert page.evaluate("state.values") == {}
    np.testing.assert_array_equal(on_screen(page), first)
    page.click("#redo")
    settle(page)
    page.wait_for_timeout(400)  # until it is in the address
    page.reload()
    settle(page)
    assert page.evaluate("state.values") == {"iso": 6400}


def test_stages_pixels_comparison_and_noise(page):
    put(page, "iso", "6400")
    page.keyboard.press("Tab")
    page.select_option("#step", "quantize")
    settle(page)
    page.mouse.move(*(page.locator("#picture").bounding_box()[side] + 300 for side in "xy"))
    page.wait_for_selector('#pixel:has-text("(DN)")')
    page.select_option("#step", "")
    settle(page)
    drawn = "document.getElementById('picture').toDataURL()"
    before = page.evaluate(drawn)
    page.select_option("#compare", "clean")
    settle(page)
    split = page.evaluate(drawn)
    assert split != before
    page.focus("#split")
    page.keyboard.press("ArrowRight")
    assert page.evaluate(drawn) != split
    page.select_option("#compare", "")
    settle(page)
    page.click("#zoom-max")
    assert page.inner_text("#zoom") == "800 %"
    page.click("#keep-b")
    put(page, "seed", "5")
    b_values = page.evaluate("settingB")
    assert b_values == {"iso": 6400}
    page.click("#swap-b")
    settle(page)
    swapped = {"iso": 6400, "seed": 5}
    assert page.evaluate("[state.values, settingB]") == [b_values, swapped]
    page.click("#undo")
    settle(page)
    assert page.evaluate("[state.values, settingB]") == [swapped, b_values]
    page.click("#redo")
    settle(page)
    assert page.evaluate("[state.values, settingB]") == [b_values, swapped]
    for field, value in (("left", "8"), ("top", "8"), ("width", "48"), ("height", "48")):
        page.fill(f"#{field}", value)
    page.click("#measure")
    page.wait_for_selector("#noise-plot svg", timeout=60_000)
    assert page.locator("#noise-table tbody tr").count() == 6


def test_a_mistake_is_said_and_marked_and_the_picture_stays(page):
    before = on_screen(page)
    put(page, "denoise.luma_strength", "-1")
    page.wait_for_selector("#problem:visible")
    assert "denoise.luma_strength" in page.inner_text("#problem")
    assert page.locator(".row.bad").count() == 1
    np.testing.assert_array_equal(on_screen(page), before)
    put(page, "seed", "3")
    assert "denoise.luma_strength" in page.inner_text("#problem")
    page.click("#back")
    settle(page)
    assert page.evaluate("state.values") == {}
    assert page.locator("#problem:visible").count() == 0


def test_a_method_that_needs_a_value_can_be_chosen_and_given_it(page):
    page.locator('.step[data-step="picture_noise"] summary').click()
    page.select_option('.row[data-key="picture_noise.method"] select', "iid_gaussian")
    settle(page)
    assert "picture_noise" in page.inner_text("#problem")
    put(page, "picture_noise.sigma", "0.05")
    assert page.locator("#problem:visible").count() == 0
    assert page.evaluate("state.values") == {
        "picture_noise": {"method": "iid_gaussian", "sigma": 0.05}
    }


def test_a_reload_after_a_mistake_brings_back_what_worked(page):
    put(page, "iso", "6400")
    put(page, "denoise.luma_strength", "-1")
    page.wait_for_timeout(400)
    page.reload()
    settle(page)
    assert page.evaluate("state.values") == {"iso": 6400}
    page.goto(page.url.partition("#")[0] + "#" + json.dumps({"image": 9, "values": {"x": 1}}))
    settle(page)
    page.reload()
    settle(page)
    assert page.evaluate("[state.image, state.values]") == [0, {}]


def test_a_narrow_page_is_not_wider_than_the_screen(page):
    page.set_viewport_size({"width": 400, "height": 800})
    assert page.evaluate("document.documentElement.scrollWidth") == 400
