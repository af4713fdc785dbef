"""``clpipe explore``: the server's responses, and the page in a browser."""

import http.client
import json
import logging
import re
import signal
import socket
import subprocess
import sys
import threading
from contextlib import closing, contextmanager, suppress
from urllib.parse import unquote, urlsplit

import numpy as np
import pytest
from PIL import Image

from tests.conftest import cli_output as clpipe
from tests.held import GUARD, wait_until

pytest.importorskip("starlette", reason="needs Starlette, in the extra explore")

from clpipe.explorer import timeout
from clpipe.explorer.server import Server
from clpipe.explorer.view import View
from tests.test_explore import NOISY, explorer_of


@pytest.fixture(scope="module")
def explorer(two_renders):
    return explorer_of(two_renders)


@contextmanager
def serving(explorer):
    """The address of a server that runs within this."""
    server = Server(explorer)
    thread = threading.Thread(target=server.run, daemon=True)
    thread.start()
    try:
        yield server.address
    finally:
        server.stop()
        thread.join(GUARD)
    assert not thread.is_alive()


@pytest.fixture(scope="module")
def served(explorer):
    with serving(explorer) as address:
        yield address


def answer(address, name, question=None, host=None, token=None):
    """The status, the headers and the body of an answer."""
    parts = urlsplit(address)
    body = question if question is None or isinstance(question, bytes) else json.dumps(question)
    path = f"/{token}/" if token is not None else parts.path
    headers = {"Host": host} if host else {}
    with closing(
        http.client.HTTPConnection(parts.hostname, parts.port, timeout=GUARD)
    ) as connection:
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
    assert facts["launches"]
    assert all(launch["ms"] > 0 for launch in facts["launches"])


def test_nobody_without_the_token_gets_an_answer(served):
    assert answer(served, "")[0] == 200
    for token in ("", "x", "..", "%2e%2e"):
        assert answer(served, "", token=token)[0] == 404
        assert answer(served, "start", {}, token=token)[0] == 404
    for name in ("../../pyproject.toml", "%2e%2e/server.py", "/etc/passwd", "explore.html"):
        assert answer(served, name)[0] == 404


def test_another_host_name_is_refused(served):
    """This prevents DNS rebinding by other sites."""
    assert answer(served, "", host="evil.example")[0] == 400


def test_the_page_may_load_nothing_from_elsewhere(served):
    headers = answer(served, "")[1]
    assert "default-src 'none'" in headers["Content-Security-Policy"]
    assert headers["Referrer-Policy"] == "no-referrer"
    assert "Access-Control-Allow-Origin" not in headers


@pytest.mark.parametrize(
    ("name", "question", "says"),
    [
        ("develop", [], "not valid JSON"),
        ("develop", {"image": 0, "values": {"\ud800": 1}}, "not valid JSON"),
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
    parts = urlsplit(served)
    head = f"POST {parts.path}start HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: 2\r\n".encode()
    whole = head + b"\r\n{}"

    def until_closed(connection):
        return b"".join(iter(lambda: connection.recv(1 << 16), b""))

    monkeypatch.setattr(timeout, "REQUEST_TIMEOUT", 0.1)
    for sent in (b"", head, whole[:-1]):
        with socket.create_connection((parts.hostname, parts.port), timeout=GUARD) as slow:
            slow.sendall(sent)
            assert until_closed(slow) == b""
    monkeypatch.setattr(timeout, "REQUEST_TIMEOUT", GUARD)
    with socket.create_connection((parts.hostname, parts.port), timeout=GUARD) as slow:
        slow.sendall(whole)
        assert b" 200 " in slow.recv(20)
        monkeypatch.setattr(timeout, "REQUEST_TIMEOUT", 0.1)
        with suppress(ConnectionError):  # uvicorn closes connections on which nothing comes
            slow.sendall(head)
            until_closed(slow)


def test_two_explorers_at_once(served, two_renders):
    with serving(explorer_of(two_renders / "a.exr", device="numpy")) as other:
        for address, count in ((served, 2), (other, 1)):
            assert len(json.loads(answer(address, "start", {})[2])["images"]) == count


def test_a_port_in_use_is_said(two_renders):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = str(taken.getsockname()[1])
        result = clpipe("explore", two_renders, "--device", "numpy", "--port", port, status=2)
    assert f"--port {port}: cannot be used: Address already in use" in result


@pytest.mark.slow
def test_ctrl_c_ends_it_quietly(two_renders):
    command = [sys.executable, "-m", "clpipe", "explore", str(two_renders), "--device", "numpy"]
    with subprocess.Popen(command, stdout=-1, stderr=-1, text=True) as process:
        line = process.stdout.readline()
        assert "http://127.0.0.1:" in line
        address = next(word for word in line.split() if word.startswith("http"))
        assert answer(address, "")[0] == 200
        process.send_signal(signal.SIGINT)
        _, errors = process.communicate(timeout=GUARD)
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
    page.wait_for_selector('body[data-settled="true"]', timeout=1e3 * GUARD)


def put(page, key, value):
    field = page.locator(f'#panel .row[data-key="{key}"] input:not([type="range"])').last
    field.evaluate("field => field.closest('details')?.setAttribute('open', '')")
    field.fill(value)
    field.press("Enter")
    settle(page)


def wait_for_address(page, values):
    """Wait until the address of the page has these values."""

    def is_so():
        fragment = unquote(page.evaluate("location.hash.slice(1)"))
        return fragment and json.loads(fragment)["values"] == values

    wait_until(is_so, f"{values} in the address")


def on_screen(page):
    """Return the whole picture of the page."""
    text = page.evaluate("Array.from(picture.pixels).join()")
    shape = page.evaluate("[picture.facts.height, picture.facts.width, 3]")
    return np.array(text.split(","), np.uint8).reshape(shape)


def test_controls_change_the_picture_and_what_is_saved_makes_it_again(page, two_renders):
    first = on_screen(page)
    put(page, "iso", "6400")
    put(page, "denoise.luma_strength", "0.25")
    page.click('.step[data-step="sharpen"] > input')
    settle(page)
    assert page.evaluate("state.values") == {
        "iso": 6400,
        "denoise": {"luma_strength": 0.25},
        "skip": ["sharpen"],
    }
    seen = on_screen(page)
    assert (seen != first).any()
    page.click('[popovertarget="menu"]')
    with page.expect_download() as download:
        page.click("#save")
    download.value.save_as("camera.toml")
    run = ["run", two_renders / "a.exr", "-o", "out", "--format", "png", "--quiet"]
    clpipe(*run, "-c", "camera.toml")
    np.testing.assert_array_equal(np.asarray(Image.open("out/a.png")), seen)
    page.click("#copy")
    page.wait_for_selector("dialog[open]")
    command = page.inner_text("#say-command")
    own = "--iso 6400 --set denoise.luma_strength=0.25 --skip sharpen"
    assert command == f"clpipe run {two_renders / 'a.exr'} -o out {own}"
    page.keyboard.press("Escape")
    for _ in range(3):
        page.click("#undo")
        settle(page)
    assert page.evaluate("state.values") == {}
    np.testing.assert_array_equal(on_screen(page), first)
    page.click("#redo")
    settle(page)
    wait_for_address(page, {"iso": 6400})
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
    page.click("#tab-noise")
    for field, value in (("left", "8"), ("top", "8"), ("width", "48"), ("height", "48")):
        page.fill(f"#{field}", value)
    page.click("#measure")
    page.wait_for_selector("#noise-plot svg", timeout=1e3 * GUARD)
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
    page.locator('[data-group="Development"] .inactive > summary').click()
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
    wait_for_address(page, {"iso": 6400})
    page.reload()
    settle(page)
    assert page.evaluate("state.values") == {"iso": 6400}
    page.goto(page.url.partition("#")[0] + "#" + json.dumps({"image": 9, "values": {"x": 1}}))
    settle(page)
    page.reload()
    settle(page)
    assert page.evaluate("[state.image, state.values]") == [0, {}]


def test_stages_that_do_nothing_are_neither_on_nor_off(page):
    step = page.locator('.step[data-step="sharpen"]')
    mixed = "element => element.querySelector('input').indeterminate"
    assert not step.evaluate(mixed)
    put(page, "sharpen.amount", "0")
    assert step.evaluate(mixed)
    assert "inactive (unsharp)" in step.locator("summary").inner_text()
    assert "inactive" in step.locator("input").first.get_attribute("aria-label")
    step.locator("summary").click()
    page.wait_for_selector('.inactive [data-step="sharpen"]', state="attached")
    assert step.is_hidden()
    page.locator('[data-group="Development"] .inactive > summary').click()
    step.locator("input").first.click()
    settle(page)
    assert step.locator("summary").inner_text() == "sharpen off"


def test_sliders_have_the_limits_of_their_texts(page):
    sliders = page.evaluate(
        "rows.filter(row => row.dataset.key !== 'iso' && row.querySelector('[type=range]')).map("
        "row => [row.querySelector('[type=range]'), row.querySelector('.help').textContent]).map("
        "([slider, text]) => [Number(slider.min), Number(slider.max), text])"
    )
    assert len(sliders) > 20
    for low, high, text in sliders:
        match = re.search(r"The slider covers (\S+) to (\S+)\.(?= |$)", text)
        match = match or re.search(r"(?:From|Above) (\S+) (?:to|below) (\S+)\.(?= |$)", text)
        assert match, text
        near = pytest.approx((low, high), abs=(high - low) / 300)
        assert (float(match[1]), float(match[2])) == near, text


def test_keys_move_zoom_swap_and_undo(page):
    put(page, "iso", "6400")
    page.click("#keep-b")
    put(page, "seed", "5")
    page.keyboard.press("b")  # in a field it is a letter
    assert page.evaluate("state.values.seed") == 5
    page.focus("#picture")
    before = page.evaluate("[seen.x, seen.y, seen.scale]")
    page.keyboard.press("ArrowLeft")
    page.keyboard.press("ArrowDown")
    x, y, scale = page.evaluate("[seen.x, seen.y, seen.scale]")
    assert x > before[0] and y < before[1] and scale == before[2]
    page.keyboard.press("1")
    page.keyboard.press("+")
    assert page.evaluate("seen.scale") == 1.5
    page.keyboard.press("-")
    assert page.evaluate("seen.scale") == 1
    page.keyboard.press("b")
    settle(page)
    assert page.evaluate("[state.values, settingB]") == [{"iso": 6400}, {"iso": 6400, "seed": 5}]
    page.keyboard.press("z")
    settle(page)
    assert page.evaluate("state.values") == {"iso": 6400, "seed": 5}
    page.keyboard.press("Shift+Z")
    settle(page)
    assert page.evaluate("state.values") == {"iso": 6400}
    page.keyboard.press("?")
    page.wait_for_selector("#keyboard[open]")
    page.keyboard.press("z")
    assert page.evaluate("state.values") == {"iso": 6400}
    page.keyboard.press("Escape")


def test_a_link_shows_the_same_view_again(page, served):
    put(page, "iso", "6400")
    page.click("#keep-b")
    put(page, "seed", "5")
    page.select_option("#step", "demosaic")
    page.fill("#split", "30")
    page.click("#zoom-max")
    settle(page)
    page.click('[popovertarget="menu"]')
    page.click("#link")
    page.wait_for_selector("#say[open]")
    link = page.inner_text("#say-command")
    address, _, fragment = link.partition("#")
    assert address == served
    assert urlsplit(served).path.strip("/") not in fragment
    view = "[state, settingB, viewed()]"
    before = page.evaluate(view)
    page.goto("about:blank")
    page.goto(link)
    settle(page)
    wait_until(lambda: page.evaluate("settingB && viewed().split === 30"), "the view")
    after = page.evaluate(view)
    assert after[2].pop("at") == pytest.approx(before[2]["at"], abs=0.3)
    assert after == [*before[:2], {k: v for k, v in before[2].items() if k != "at"}]
    assert before[2]["compare"] == "B" and before[2]["split"] == 30 and before[2]["at"][0] == 8


@pytest.mark.parametrize(
    "view", [{"compare": "x", "at": [None, 1, 2], "box": "y", "b": 3, "split": []}, 5, []]
)
def test_a_damaged_view_in_a_link_is_passed_over(page, served, view):
    page.goto("about:blank")
    page.goto(f"{served}#{json.dumps({'image': 0, 'values': {'iso': 800}, 'view': view})}")
    settle(page)
    assert page.evaluate("state.values") == {"iso": 800}
    assert page.evaluate("[settingB, box, seen.fits]") == [None, None, True]


def test_a_narrow_page_is_not_wider_than_the_screen(page):
    page.set_viewport_size({"width": 400, "height": 800})
    assert page.evaluate("document.documentElement.scrollWidth") == 400
