"""Requests: each error is one message that names its cause."""

from dataclasses import replace
from pathlib import Path

import pytest

from clpipe.base.errors import RequestError
from clpipe.chain.assignments import parse_assignment
from clpipe.chain.files import built_in_configs, load_settings, toml_text
from clpipe.chain.making import make_chain
from clpipe.chain.registry import all_stages
from clpipe.chain.settings import overlay, settings_from
from clpipe.stage import Kind
from clpipe.stages import DEFAULT_CHAIN


def build(**settings):
    return make_chain(settings_from(settings))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("iso = 100\n[sensor_noise]\na = -1\n", "line 3: sensor_noise.a: found -1"),
        ("iso = 100\n\n[sensor_nose]\na = 1\n", "line 3: unknown stage 'sensor_nose'"),
        ("seed = 1\niso = \n", r"not valid TOML: .*line 2"),
        ("denoise = 3\n", r"line 1: denoise: found 3, but it is a table; .* in a file \[denoise\]"),
        ("seed = false\n", "line 1: seed: found False, but expected a whole number"),
        ("camra = 'x'\n", "line 1: unknown key 'camra'"),
        ("demosaic.method = 'x'\n", "line 1: demosaic.method: unknown method 'x'"),
    ],
)
def test_a_mistake_in_a_file_is_named_with_its_line(tmp_path, text, message):
    path = tmp_path / "pipeline.toml"
    path.write_text(text)
    with pytest.raises(RequestError, match=f"pipeline.toml.*{message}"):
        load_settings(str(path))


def test_a_file_that_cannot_be_read(tmp_path):
    with pytest.raises(RequestError, match="there is no such file"):
        load_settings(str(Path(tmp_path / "no.toml")))
    (tmp_path / "bad.toml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(RequestError, match="not a text file"):
        load_settings(str(tmp_path / "bad.toml"))


@pytest.mark.parametrize("text", ["", "a", "a.b", "=3", "stage=3", "a.b.c=3"])
def test_a_malformed_assignment(text):
    with pytest.raises(RequestError, match=r"expected stage\.parameter=value"):
        parse_assignment(text)


def test_parameters_come_from_the_camera_and_from_each_other():
    chain = build(iso=640, inverse_white_balance={"red_gain": 2.5})
    values = {step.name: step.method.model_dump() for step in chain.steps}
    assert values["inverse_white_balance"] == {"red_gain": 2.5, "blue_gain": 1.36}
    assert values["white_balance"] == values["inverse_white_balance"]
    assert values["normalize"] == {"black_level": 512, "white_level": 16383}
    assert values["quantize"] == {"bits": 14, **values["normalize"]}
    assert values["sensor_noise"]["a"] == pytest.approx(2.0002 / 15871)
    for name in ("sensor_noise", "motion_blur", "optical_blur"):
        del values[name]  # has other ways to say the same, which stay unused
    assert None not in [v for table in values.values() for v in table.values()]


def test_without_its_inverse_white_balance_takes_nothing_in():
    chain = build(skip=["inverse_white_balance"])
    assert chain.step_named("white_balance").method.model_dump() == {"red_gain": 1, "blue_gain": 1}


def test_a_repeated_stage_has_settings_of_its_own():
    chain = build(stages=["exposure", "exposure"], exposure={"ev": 1}, exposure_2={"ev": 2})
    assert [(s.name, s.method.ev) for s in chain.steps] == [("exposure", 1), ("exposure_2", 2)]


def test_every_parameter_says_what_it_is():
    from clpipe.commands.stages import parameter_rows

    for stage in all_stages().values():
        for method in stage.methods:
            for name, default, _, allowed, text in parameter_rows(method):
                assert default and allowed and text.endswith("."), (stage.name, name)


def test_built_in_configurations():
    for name in built_in_configs():
        make_chain(load_settings(name))
    assert load_settings("default") == settings_from({})
    paper = make_chain(load_settings("paper"))
    methods = {step.name: step.method.method for step in paper.steps}
    assert methods["white_balance"] == "gray_world"
    assert methods["demosaic"] == "edge_directed_median"
    with pytest.raises(RequestError, match=r"unknown configuration 'papr' .*mean 'paper'"):
        load_settings("papr")


def test_what_is_laid_over_settings():
    gamma = {"method": "power", "exponent": 2}
    base = settings_from({"iso": 800, "skip": ["denoise"], "gamma": gamma})
    over = overlay(base, {"seed": 3, "skip": ["row_noise"], "exposure": {"ev": 1}})
    assert (over.iso, over.seed, over.skip) == (800, 3, ("denoise", "row_noise"))
    assert over.parameters == {"gamma": gamma, "exposure": {"ev": 1}}
    other = overlay(base, {"gamma": {"method": "srgb"}})
    assert other.parameters["gamma"] == {"method": "srgb"}
    assert overlay(base, {}) == base


def test_files_that_a_configuration_names_are_relative_to_it(tmp_path, monkeypatch):
    from clpipe.camera.profile import built_in_cameras

    folder = tmp_path / "settings"
    folder.mkdir()
    (folder / "mine.csv").write_text("0,0\n1,1\n")
    (folder / "mine.toml").write_text(built_in_cameras()["sony-a7r2"].read_text())
    (folder / "pipeline.toml").write_text(
        'camera = "mine.toml"\n[tone_curve]\nmethod = "file"\npath = "mine.csv"\n'
    )
    monkeypatch.chdir(tmp_path)
    chain = make_chain(load_settings("settings/pipeline.toml"))
    assert chain.step_named("tone_curve").method.path == "settings/mine.csv"
    (folder / "pipeline.toml").write_text('[tone_curve]\nmethod = "file"\npath = "no.csv"\n')
    with pytest.raises(RequestError, match=r"line 3: tone_curve.path: .*no.csv.*cannot be read"):
        load_settings("settings/pipeline.toml")


def test_a_chain_in_part_knows_what_the_rest_says_of_the_image():
    settings = settings_from({"mosaic": {"pattern": "BGGR"}, "sensor_noise": {"a": 0.5}})
    chain = make_chain(settings, start_at="demosaic", until="denoise")
    assert [step.name for step in chain.steps] == ["demosaic", "denoise"]
    assert chain.source is Kind.MOSAIC
    assert chain.steps[0].context.pattern == "BGGR"
    assert chain.steps[0].context.noise.a == 0.5


def test_one_of_two_alike_can_be_skipped():
    names = ["exposure", "exposure", "exposure"]
    chain = build(stages=names, skip=["exposure_2"], exposure_3={"ev": 3})
    assert [step.name for step in chain.steps] == ["exposure", "exposure_3"]


def test_a_chain_as_toml_is_the_chain_again(tmp_path):
    settings = settings_from(
        {
            "iso": 640,
            "stages": ["exposure", *DEFAULT_CHAIN],
            "exposure_2": {"ev": -0.5},
            "color_matrix": {"method": "given", "matrix": [[1, 0.5, 0], [0, 1, 0], [0, 0, 1]]},
            "sensor_noise": {"a": 1e-3},
        }
    )
    path = tmp_path / "pipeline.toml"
    path.write_text(toml_text(make_chain(settings)))
    one, two = make_chain(settings), make_chain(load_settings(str(path)))
    assert [(s.name, s.method) for s in one.steps] == [(s.name, s.method) for s in two.steps]
    assert "\n# b = " in path.read_text()
    assert "\na = 0.001" in path.read_text()


def test_a_model_is_that_of_its_table():
    settings = settings_from({"exposure": {"ev": 1}})
    other = replace(settings, parameters={"exposure": {"ev": 2}})
    assert (settings.method("exposure").ev, other.method("exposure").ev) == (1, 2)
