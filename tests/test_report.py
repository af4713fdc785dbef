"""``clpipe report``: the text of its page, and the page in a browser."""

import base64
import io
import json
import os
import re
import shutil
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from clpipe.chain.rendition import DEFAULT_RENDITION
from clpipe.images.write import write_exr as write
from clpipe.outputs.record import whole_step
from clpipe.reports.figures import last_failures, sessions
from clpipe.reports.images import Budget, compared_image, places_of
from clpipe.reports.run import read_run
from tests.conftest import cli_output as clpipe
from tests.conftest import reseal

pytestmark = pytest.mark.slow

pytest.importorskip("jinja2", reason="needs Jinja2, in the extra report")

HOSTILE = "<img src=x onerror=alert(1)>&amp;\x1b[31m\n"
SHOWN = r"<img src=x onerror=alert(1)>&amp;\x1b[31m\n"
NUMPY = ("--device", "numpy")


class Page(HTMLParser):
    """The tags of a page, and the texts of its data and of its other elements."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.text = path.read_text("utf-8")
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.words: list[str] = []
        self.data: dict[str, object] = {}
        self._in: str | None = None
        self.feed(self.text)

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        self._in = dict(attrs).get("id") if tag == "script" else None

    def handle_data(self, data):
        if self._in:
            self.data[self._in] = json.loads(data)
            self._in = None
        else:
            self.words.append(data)

    @property
    def shown_text(self) -> str:
        return " ".join(" ".join(self.words).split())


def report(*arguments) -> Page:
    page = Path(arguments[0], "report.html")
    clpipe("report", *arguments, "-o", page)
    return Page(page)


def pixels_of(data: bytes) -> np.ndarray:
    return np.asarray(Image.open(io.BytesIO(data))).astype(float)


@pytest.fixture(scope="module")
def renders(tmp_path_factory):
    """Three small renders, one with a hostile name, and one that is damaged."""
    folder = tmp_path_factory.mktemp("report") / "renders"
    folder.mkdir()
    y, x = np.mgrid[0:96, 0:160] / 160
    for i, name in enumerate(("a", "b", HOSTILE)):
        picture = np.stack([0.2 + 0.5 * x, 0.6 - 0.5 * y, 0.3 + 0.2 * np.sin(9 * x + i)], -1)
        write(folder / f"{name}.exr", picture.astype(np.float32), ("R", "G", "B"), {})
    (folder / "cut.exr").write_bytes((folder / "a.exr").read_bytes()[:600])
    return folder


@pytest.fixture(scope="module")
def made(renders):
    """A run of them with truths and kept raws."""
    out = renders.parent / "out"
    arguments = ("--iso", 1600, "--truth", "development", "--truth", "mosaic")
    draw = ("--set", "exposure.ev={uniform=[-1, 1]}", "--keep", "normalize")
    clpipe("run", renders, "-o", out, *NUMPY, *arguments, *draw, status=1)
    return out


@pytest.fixture(autouse=True)
def few_drawings(monkeypatch):
    """The noise of one picture is drawn: that is what takes long."""
    monkeypatch.setattr("clpipe.reports.page.MAX_PLOTS", 1)


@pytest.fixture
def out(made, tmp_path):
    """A copy of that run."""
    return Path(shutil.copytree(made, tmp_path / "out"))


def test_figures_pictures_and_failures(out):
    page = report(out)
    assert "Images 3" in page.shown_text and "Failed 1" in page.shown_text
    assert "cut.exr" in page.shown_text
    entries = page.data["sheet-data"]
    assert [entry["name"] for entry in entries] == [SHOWN, "a", "b"]
    assert all(entry["image"].startswith("data:image/webp;base64,") for entry in entries)
    assert {entry["iso"] for entry in entries} == {1600}
    large = page.data["look-data"]
    assert [view["label"] for view in large[0]["views"]] == ["image", "truth", "after normalize"]
    assert [view["label"] for view in large[2]["views"]] == ["image", "truth"]
    assert re.search(r"exposure\.ev ?: -?[\d.]+, -?[\d.]+, -?[\d.]+", page.shown_text)
    assert "sensor_noise skewed_gaussian" in page.shown_text
    assert "finished" in page.shown_text


def test_it_is_one_file_in_which_nothing_is_markup_but_ours(out):
    page = report(out)
    assert ("img", {"src": "x", "onerror": "alert(1)"}) not in page.tags
    assert not any("onerror" in attributes for _, attributes in page.tags)
    addresses = [
        attributes[name]
        for tag, attributes in page.tags
        for name in ("src", "href", "xlink:href")
        if attributes.get(name)
    ]
    assert all(each.startswith(("data:", "#")) for each in addresses)
    assert "url(http" not in page.text and "@import" not in page.text
    ids = [attributes["id"] for _, attributes in page.tags if "id" in attributes]
    assert len(ids) == len(set(ids))
    assert len(page.text) < 15 << 20


def test_names_with_characters_that_cannot_be_printed(out):
    out = out.rename(out.with_name(os.fsdecode(b"o\x1b\xff")))
    page = report(out)
    assert not re.search(r"[\x00-\x09\x0b-\x1f]|\\u001b", page.text)
    assert r"o\x1b\udcff: report of a run" in page.shown_text
    assert page.shown_text.count(SHOWN) > 2


def test_the_law_is_held_against_raws(out):
    page = report(out)
    assert "Raw noise compared with the noise model" in page.shown_text
    assert "deviates from the model" not in page.shown_text
    pair = (out / "a.normalize.exr", "--truth", out / "a.truth_mosaic.exr")
    report_of_it = json.loads(clpipe("measure", *pair, "--json"))
    fit = report_of_it["channels"]["mosaic"]["law"]
    assert f"{fit['a']:.4g} ± {fit['a_error']:.1g}" in page.shown_text
    assert f"{fit['b']:.4g} ± {fit['b_error']:.1g}" in page.shown_text
    (name,) = re.findall(r"against (.*?)\.truth\.jpg in flat areas", page.shown_text)
    name = name.replace(SHOWN, HOSTILE)
    pair = (out / f"{name}.jpg", "--truth", out / f"{name}.truth.jpg")
    measured = json.loads(clpipe("measure", *pair, "--json"))
    assert f"R {measured['channels']['R']['sigma'] * 255:.2f}, G" in page.shown_text
    skew = measured["finished"]["skew_160"]
    assert f"luma skew at 160-219 {skew:.2f} -0.12 to -0.01" in page.shown_text
    assert (
        f"leaves {measured['channels']['Y']['energy_left_2x2']:.2f} of the luma" in page.shown_text
    )
    sidecar = out / "a.json"
    record = json.loads(sidecar.read_text())
    gain = record["noise"]["signal"]["a"]
    text = sidecar.read_text().replace(f'"a": {gain}, "b"', f'"a": {gain * 1.5}, "b"')
    reseal(sidecar, json.loads(text))
    page = report(out)
    assert page.shown_text.count("deviates from the model") == 1
    assert page.data["look-data"][0]["name"] == "a"  # it is shown first


def test_files_that_are_gone_or_changed_are_named(out):
    (out / "a.jpg").unlink()
    changed = bytearray((out / "b.jpg").read_bytes())
    changed[-3] ^= 1
    (out / "b.jpg").write_bytes(changed)
    (out / "b.normalize.exr").write_bytes(b"short")
    page = report(out)
    assert "a.jpg: is missing" in page.shown_text
    assert "b.jpg: has changed since the run; its SHA-256" in page.shown_text
    assert "b.normalize.exr: has 5 bytes, not the " in page.shown_text
    by_name = {entry["name"]: entry for entry in page.data["sheet-data"]}
    assert not by_name["a"]["image"] and not by_name["b"]["image"] and by_name[SHOWN]["image"]
    assert by_name["a"]["odd"] and not by_name[SHOWN]["odd"]


def test_half_a_run_and_a_log_that_is_cut_off(out):
    log = out / "run.jsonl"
    lines = log.read_bytes().splitlines(keepends=True)
    log.write_bytes(b"".join(lines[:-1]) + lines[-1][:20])
    (out / "b.json").write_text((out / "b.json").read_text()[:200])
    (out / "notes.json").write_text('{"mine": 1}')
    page = report(out)
    assert "killed, or still running" in page.shown_text
    assert "b.json: this sidecar was changed after clpipe wrote it" in page.shown_text
    assert "notes" not in page.shown_text
    assert [entry["name"] for entry in page.data["sheet-data"]] == [SHOWN, "a"]


def test_hostile_sidecars(out):
    record = json.loads((out / "a.json").read_text())
    record |= {
        "warnings": ["</script><script>alert(1)</script>"],
        "camera": "<b>x",
        "clipped": None,
    }
    record["stages"] = [{"name": "</style>", "method": [], "parameters": {"<i>": {"a": 1}}}, 3]
    record["noise"], record["device"], record["versions"] = 7, "none", [1]
    reseal(out / "a.json", record)
    page = report(out)
    assert "</script><script>alert(1)" not in page.text
    assert "</script><script>alert(1)</script>" in page.shown_text
    assert [tag for tag, _ in page.tags if tag in ("b", "i")].count("i") == 0
    assert page.text.count("</style>") == page.text.count("<style")


def views_of(page):
    return {each["name"]: [v["label"] for v in each["views"]] for each in page.data["look-data"]}


def test_without_truths_a_picture_is_beside_another_of_its_image_or_sequence(renders, tmp_path):
    run = ("run", renders / "a.exr", *NUMPY)
    clpipe(*run, "-o", tmp_path / "isos", "--iso", "100,1600")
    views = views_of(report(tmp_path / "isos"))
    assert views["iso100/a"] == ["image", "iso1600/a (sony-a7r2, ISO 1600)"]
    clpipe(*run, "-o", tmp_path / "bracket", "--bracket=-1,1", "--iso", 800)
    views = views_of(report(tmp_path / "bracket"))
    assert views["a.ev+1"] == ["image", "a.ev-1 (sony-a7r2, ISO 800)"]
    clpipe(*run, "-o", tmp_path / "one", "--iso", 800)
    page = report(tmp_path / "one")
    assert views_of(page) == {"a": ["image"]}
    assert "To get the image without noise, run with --truth clean" in page.shown_text
    for i in range(3):
        picture = np.asarray(np.random.default_rng(i).random((64, 96, 3)), np.float32)
        write(tmp_path / f"view{i}.exr", picture, ("R", "G", "B"), {})
    clpipe("run", *tmp_path.glob("view*.exr"), "-o", tmp_path / "way", *NUMPY, "--iso", 200)
    views = views_of(report(tmp_path / "way"))
    assert [each[1].split()[0] for each in views.values()] == ["view1", "view0", "view1"]


def test_what_was_drawn_is_drawn_and_what_follows_is_folded(renders, tmp_path):
    out = tmp_path / "out"
    config = tmp_path / "own.toml"
    config.write_text(
        'iso = { uniform = [1000, 6000] }\ncamera = { choice = ["sony-a7r2", "canon-6d"] }\n'
    )
    clpipe("run", renders, "-o", out, "-c", config, "--seed", 4, *NUMPY, status=1)
    page = report(out)
    assert 'aria-label="Histogram of ISO"' in page.text
    requested, _, follows = page.shown_text.partition("Derived values")
    assert re.search(r"ISO ?: \d+, \d+, \d+", requested)
    assert "noise a" in follows and "noise a" not in requested
    assert all(isinstance(entry["iso"], int) for entry in page.data["sheet-data"])


def test_a_report_that_takes_long_says_where_it_is(out, monkeypatch):
    monkeypatch.setattr("clpipe.commands.progress.LINE_INTERVAL", 0)
    said = clpipe("report", out)
    for text in ("sidecars", "noise of raw mosaics", "thumbnail 2 of 3", "comparison 1 of 3"):
        assert f"{text}\n" in said


def test_tars_and_series_are_read(renders, tmp_path):
    out = tmp_path / "out"
    arguments = ("--iso", "100,1600", "--truth", "development")
    clpipe("run", renders / "a.exr", renders / "b.exr", "-o", out / "s", *NUMPY, *arguments)
    arguments = ("--iso", 1600, "--webdataset", 2, "--truth", "clean")
    clpipe("run", renders / "a.exr", renders / "b.exr", "-o", out / "t", *NUMPY, *arguments)
    page = report(out / "s")
    names = {entry["name"]: entry["iso"] for entry in page.data["sheet-data"]}
    assert names == {"iso100/a": 100, "iso100/b": 100, "iso1600/a": 1600, "iso1600/b": 1600}
    assert "ISO : 100, 1600" in page.shown_text
    page = report(out / "t")
    assert [entry["name"] for entry in page.data["sheet-data"]] == ["a", "b"]
    assert all(entry["image"] for entry in page.data["sheet-data"])
    views = [view["label"] for view in page.data["look-data"][0]["views"]]
    assert views == ["image", "truth_clean"]
    tar = out / "t" / "000000.tar"
    tar.write_bytes(tar.read_bytes()[:3000])
    assert "000000.tar: cannot be read to its end" in report(out / "t").shown_text


def test_of_a_large_picture_the_page_has_all_reduced_and_crops_as_they_are(out, monkeypatch):
    monkeypatch.setattr("clpipe.reports.images.MAX_COMPARED_PIXELS", 4_000)
    monkeypatch.setattr("clpipe.reports.images.CROP", (60, 40))
    page = report(out)
    shown = next(each for each in page.data["look-data"] if each["name"] == "a")
    picture = pixels_of((out / "a.jpg").read_bytes())
    assert (shown["width"], shown["height"], shown["by"]) == (160, 96, 2)
    assert shown["places"] == [{"name": "middle", "left": 50, "top": 28, "width": 60, "height": 40}]
    view = shown["views"][0]
    (crop,) = [pixels_of(base64.b64decode(each.partition(",")[2])) for each in view["crops"]]
    assert np.abs(crop - picture[28:68, 50:110]).mean() < 1.5
    whole = pixels_of(base64.b64decode(view["image"].partition(",")[2]))
    means = picture.reshape(48, 2, 80, 2, 3).mean((1, 3))
    assert np.abs(whole - means).mean() < 3
    assert "2 x 2 pixels are averaged" in page.shown_text


def test_places_of_a_reduced_picture_are_around_what_was_found():
    pixels = np.full((400, 600, 3), 128, np.uint8)
    pixels[350:, 560:] = 0, 0, 255
    found = {place.name: place for place in places_of(pixels, 2)}
    assert found["textured"].box == "280,160,320x240"  # within the picture
    assert all(place.within(600, 400) for place in found.values())


def test_an_image_that_failed_at_one_iso_is_counted_though_another_was_done():
    from clpipe.reports.page import listed

    line = {"event": "image", "name": "a.exr", "error": "a.exr: damaged"}
    done = {**line, "stem": "iso100/a", "status": "done"}
    failed = [{**line, "stem": f"iso{iso}/a", "status": "failed"} for iso in (200, 400)]
    start = {"event": "start"}
    texts = last_failures(sessions([start, *failed, done]))
    assert texts == ["a.exr: damaged"] * 2
    assert listed(texts).shown == ["a.exr: damaged (2 times)"] and listed(texts).total == 2
    again = {**done, "stem": "iso200/a"}
    assert len(last_failures(sessions([start, *failed, start, again]))) == 1


def test_two_runs_are_compared(out, renders, tmp_path):
    other = tmp_path / "other"
    more = ("--iso", 400, "--set", "denoise.luma_strength=2", "--truth", "development")
    clpipe("run", renders / "a.exr", "-o", other, *NUMPY, *more)
    page = report(out, other)
    assert "denoise.luma_strength 0.12 2" in page.shown_text
    large = {each["name"]: each for each in page.data["look-data"]}
    labels = [view["label"] for view in large["a"]["views"]]
    assert labels[:2] == ["out image", "other image"]
    names = [entry["name"] for entry in page.data["sheet-data"]]
    assert "out: a" in names and "other: a" in names and "other: b" not in names


def test_many_pictures_are_sampled_within_the_budget(out, monkeypatch):
    monkeypatch.setattr("clpipe.reports.page.BUDGET", 3_000)
    page = report(out)
    assert len(page.data["sheet-data"]) < 3
    assert re.search(r"\d of 3 images are shown: unusual ones", page.shown_text)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["nowhere"], "nowhere: there is no such file or folder"),
        (["."], "has no picture of clpipe with its sidecar"),
        ([".", "-o", "x.pdf"], "-o: found x.pdf; expected a name that ends in .html"),
        ([".", ".", "."], "found 3 directories; name one for a report, or two to compare them"),
    ],
)
def test_bad_input(tmp_path, monkeypatch, arguments, message):
    monkeypatch.chdir(tmp_path)
    assert message in clpipe("report", *arguments, status=2)


def test_a_file_of_the_users_is_not_replaced(out):
    report(out)
    report(out)  # its own is
    (out / "report.html").write_text("<p>mine</p>")
    assert "clpipe did not write this file" in clpipe("report", out, status=2)
    assert (out / "report.html").read_text() == "<p>mine</p>"


def test_the_pace_of_a_run():
    start = {"event": "start", "at": "2026-01-01T00:00:00+00:00", "arguments": ["run"]}
    image = {"event": "image", "status": "done", "megapixels": 2.0, "decode_seconds": 1.0}
    images = [{**image, "at": f"2026-01-01T00:00:{i:02}+00:00"} for i in range(40)]
    (session,) = sessions([start, *images, {"event": "end", "seconds": 40.0}])
    pace = session.pace()
    assert len(pace) == 10
    assert sum(row["speed"] for row in pace) / 10 == pytest.approx(2.0, rel=0.01)
    assert all(row["decode"] == 1 for row in pace)
    (late,) = sessions([start, images[0], images[39], {"event": "end", "seconds": 40.0}])
    assert len(late.pace()) == 1
    (cut,) = sessions([start, *images])
    assert cut.seconds == 39 and cut.state.startswith("killed")


def test_in_a_browser(browser_page, out):
    """The slider moves, filters filter, pages turn, and the console stays empty."""
    report(out)
    page = browser_page
    page.set_viewport_size({"width": 400, "height": 800})
    page.goto((out / "report.html").as_uri())
    assert page.locator("#sheet-list li").count() == 3
    page.fill("#filter-name", "&AMP")
    assert page.locator("#sheet-list li").count() == 1
    page.fill("#filter-name", "")
    page.select_option("#filter-iso", "1600")
    assert page.locator("#sheet-list li").count() == 3
    page.focus("#look-split")
    before = page.evaluate("getComputedStyle(slider).getPropertyValue('--split')")
    page.keyboard.press("ArrowRight")
    after = page.evaluate("getComputedStyle(slider).getPropertyValue('--split')")
    assert (before, after) == ("50%", "50.5%")
    crop = "document.getElementById('loupe-left-4').toDataURL()"
    first = page.evaluate(crop)
    page.mouse.move(*(page.locator("#slider").bounding_box()[side] + 9 for side in "xy"))
    assert page.evaluate(crop) != first
    first = page.evaluate(crop)
    page.focus("#loupes")
    page.keyboard.press("ArrowRight")
    assert page.evaluate(crop) != first
    first = page.evaluate(crop)
    middle = page.locator("#loupe-right-4").bounding_box()
    page.mouse.move(middle["x"] + 50, middle["y"] + 50)
    page.mouse.down()
    page.mouse.move(middle["x"] + 20, middle["y"] + 50)
    page.mouse.up()
    assert page.evaluate(crop) != first
    page.select_option("#look-image", "1")
    assert page.evaluate("document.documentElement.scrollWidth") == 400
    page.click("#theme")
    assert page.evaluate("document.documentElement.dataset.theme") in ("dark", "light")


def test_each_exposure_of_a_bracket_is_a_picture_of_its_own(renders, tmp_path):
    bracket = ("--bracket=-1,1", "--frames", 2, "--truth", "clean")
    clpipe("run", renders / "a.exr", "-o", tmp_path / "out", *NUMPY, *bracket)
    run = read_run(tmp_path / "out")
    assert [made.name for made in run.pictures] == ["a.ev+1.frame0", "a.ev-1.frame0"]
    shown = compared_image([run], [""], run.pictures[1], Budget(1 << 24), [])
    assert [view["label"] for view in shown.views] == ["image", "truth", "truth_clean"]


def test_a_run_is_read_from_its_sidecars(out):
    run = read_run(out)
    assert [made.name for made in run.pictures] == [HOSTILE, "a", "b"]
    assert sorted(each.suffix for each in run.of_image("a")) == ["", ".truth", ".truth_mosaic"]
    assert run.of_image("a")[DEFAULT_RENDITION].files.keys() == {"jpg", "normalize.exr"}
    steps = [{step["name"]: step for step in made.steps} for made in run.pictures]
    assert steps[0]["gamma"] is steps[1]["gamma"]  # lines that are alike are held once
    assert steps[0]["exposure"] != steps[1]["exposure"]
    sidecar = out / "a.json"
    whole = json.loads(sidecar.read_text())
    assert list(steps[1].values()) == [*map(whole_step, whole["stages"])]
    reseal(sidecar, {**whole, "stages": tuple(whole["stages"])})  # in one line
    again = next(made for made in read_run(out).pictures if made.name == "a")
    assert again.record == run.of_image("a")[DEFAULT_RENDITION].record
