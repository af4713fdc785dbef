"""The request: one set of plain values from options, configurations, rows and sidecars."""

import json
import pickle
from pathlib import Path

import numpy as np
import pytest

from clpipe.base.errors import RequestError
from clpipe.chain.request import RECORDED_FIELDS, Request
from clpipe.chain.settings import settings_from
from clpipe.inputs.loader import ImageLoader
from tests.conftest import reseal

OPTIONS = {
    "config": "paper",
    "values": {"iso": 800.0, "exposure": {"ev": 0.5}},
    "until": "demosaic",
    "keep": ("mosaic",),
    "formats": ("exr",),
    "transfer": "srgb",
    "frames": 2,
}

STAGE_FILE = """
from pathlib import Path
Path({mark!r}).touch()
from clpipe.stage import Kind, Stage, Unchanged


class Nothing(Unchanged):
    method = "nothing"
    summary = "stay"


STAGE = Stage({name!r}, "Do nothing.", Kind.RGB, Kind.RGB, (Nothing,))
"""


def test_a_record_makes_the_same_request_but_for_which_pictures_are_made():
    request = Request.from_options(**OPTIONS).for_image("a.exr", {"seed": 3})
    again = Request.from_record(json.loads(json.dumps(request.record())))
    assert again.record() == request.record()
    assert {name: getattr(again, name) for name in RECORDED_FIELDS} == {
        name: getattr(request, name) for name in RECORDED_FIELDS
    }
    assert again.frames is None and request.frames == 2
    assert again.settings() == request.settings()


@pytest.mark.parametrize(
    "change",
    [
        {"config": None},
        {"values": {"iso": 100.0}},
        {"keep": ()},
        {"formats": ("png",)},
        {"transfer": None},
    ],
)
def test_records_differ_where_bytes_do(change):
    records = [Request.from_options(**{**OPTIONS, **c}).record() for c in ({}, change)]
    assert records[0] != records[1]


@pytest.mark.parametrize("change", [{"frames": None}, {"truth": ("mosaic",)}, {"max_pixels": 9}])
def test_records_are_equal_where_the_bytes_of_a_picture_are(change):
    records = [Request.from_options(**{**OPTIONS, **c}).record() for c in ({}, change)]
    assert records[0] == records[1]


@pytest.mark.parametrize(
    "damage",
    [
        {"formats": ["gif"]},
        {"keep": None},
        {"stage_files": 3},
        {"image_name": 3},
        {"until": ["demosaic"]},
        {"options": [1]},
        {"layer": []},
        {"patch": 7},  # and no number of them
        {"patch": "grid"},
        {"patch": 7, "patches_per_image": 10**30},
        {"augment": 1},
    ],
)
def test_a_damaged_record(damage):
    with pytest.raises(RequestError, match=r"formats|damaged"):
        Request.from_record({**Request().record(), **damage})


def test_a_record_has_no_default_values():
    assert Request().record() == {"files": {}}
    assert Request.from_record({}) == Request()


def test_outputs_that_are_left_open_follow_from_the_chain():
    request = Request.from_options(until="demosaic", keep=("all", "mosaic"))
    completed = request.with_outputs(request.chain())
    assert completed.formats == ("exr",)
    assert completed.keep == tuple(step.name for step in request.chain().steps)
    whole = Request.from_options(formats=("png", "png"))
    assert whole.with_outputs(whole.chain()).formats == ("png",)
    misspelt = Request.from_options(keep=("no",))
    with pytest.raises(RequestError, match="unknown stage in this chain 'no'"):
        misspelt.with_outputs(misspelt.chain())


def test_what_an_image_carries_stands_below_configuration_and_options():
    carried = settings_from({"iso": 400, "exposure": {"ev": 3}, "gamma": {"method": "srgb"}})
    request = Request.from_options(values={"iso": 800.0, "exposure": {"ev": 1}})
    settings = request.for_image("a", {"seed": 9}).settings(carried)
    assert (settings.iso, settings.seed) == (800, 9)
    assert settings.parameters == {"exposure": {"ev": 1}, "gamma": {"method": "srgb"}}


def test_a_request_and_its_loader_can_be_sent_with_a_stage_file(tmp_path, forget_stage_files):
    file = tmp_path / "sent.py"
    file.write_text(STAGE_FILE.format(mark=str(tmp_path / "ran"), name="sent"))
    values = {"stages": ["exposure", "sent"], "sent": {"method": "nothing"}}
    request = Request.from_options(stage_files=[file], values=values)
    loader = ImageLoader(request)
    assert [s.name for s in loader.chain.steps] == ["exposure", "sent"]
    sent = pickle.loads(pickle.dumps(loader))
    assert sent == loader and set(vars(sent)) == {"request", "folder"}
    assert sent.chain.names == loader.chain.names


def test_no_code_comes_from_a_sidecar(clpipe, write_exr, forget_stage_files):
    def forget():
        forget_stage_files()
        Path("ran").unlink(missing_ok=True)

    forget()
    Path("mine.py").write_text(STAGE_FILE.format(mark="ran", name="mine"))
    write_exr("a.exr", np.full((8, 8, 3), 0.5, np.float32))
    options = ("--stages", "exposure,mine", "--format", "exr", "--device", "numpy")
    clpipe("run", "a.exr", "-o", "out", *options, "--stage-file", "mine.py")
    replay = ("replay", "--device", "numpy", "-o", "again")
    record = json.loads(Path("out/a.json").read_text())
    request = record["request"]
    named = {"stage_files": ["mine.py"]}
    for changes in (
        {},
        {"files": {}},
        {"stage_files": []},
        {"files": {}, "config": named},
        {"files": {}, "options": named},
        {"files": {}, "image": named},
    ):
        forget()
        edited = {**record, "request": {**request, **changes}}
        reseal(Path("edited.json"), edited)
        stderr = clpipe(*replay, "edited.json", status=2).stderr
        assert "--stage-file" in stderr or "unknown stage" in stderr
        assert not Path("ran").exists()

    forget()
    Path("there").mkdir()
    Path("mine.py").rename("there/mine.py")
    clpipe(*replay, "out/a.json", "--stage-file", "there/mine.py")
    assert Path("again/a.exr").read_bytes() == Path("out/a.exr").read_bytes()
    assert Path("ran").exists()

    forget()
    Path("there/mine.py").write_text(Path("there/mine.py").read_text() + "\n")
    stderr = clpipe(*replay, "out/a.json", "--stage-file", "there/mine.py", status=2).stderr
    assert "a sidecar runs no code; where you trust that file, name it: --stage-file" in stderr
