"""tools/pages/figures.py makes the paper's figures, and docs/paper.md lists them."""

import re
import typing

import numpy as np
import pytest

from clpipe.analysis.comparison_plot import draw as draw_comparison
from clpipe.camera.profile import load_camera
from clpipe.chain.files import built_in_configs
from clpipe.chain.registry import all_stages
from clpipe.commands.main import COMMANDS
from clpipe.commands.run import run
from clpipe.images.encoding import Encoding
from clpipe.images.read import read_image
from tests.conftest import ROOT, STILL_LIFE
from tests.dng import write_dng
from tools.pages import figures

pytestmark = pytest.mark.slow

PAGE = ROOT / "docs" / "paper.md"


def test_the_figures_are_made(clpipe, tmp_path, write_exr, monkeypatch):
    write_exr("view.01.exr", read_image(STILL_LIFE).pixels[230:390, 400:640])
    random = np.random.default_rng(0)
    write_dng(tmp_path / "shot.dng", random.normal(2000, 300, (128, 192)).astype(int))
    commands, drawn = [], []

    def command(*words):
        commands.append(words)
        clpipe(*words)

    def draw(comparison, path):
        drawn.append(comparison)
        draw_comparison(comparison, path)

    monkeypatch.setattr(figures, "clpipe", command)
    monkeypatch.setattr(figures, "draw", draw)
    monkeypatch.setattr(figures, "SUFFIXES", (".png",))
    monkeypatch.setattr(figures, "METHODS", ("bilinear", "bounded"))
    monkeypatch.setattr(figures, "PLACES", ("flat",))
    monkeypatch.setattr("sys.argv", ["figures", "--render", "view.01.exr", "--raw", "shot.dng"])
    assert figures.main() == 0
    made = sorted(path.name for path in (tmp_path / "figures").glob("*.*"))
    names = ("demosaicing", "iso100", "iso1600", "raw_demosaicing", "raw_iso100", "statistics")
    assert made == [f"{name}.png" for name in names]
    assert [words[0] for words in commands].count("compare") == 4
    (found,) = drawn
    assert found.labels == (*figures.PICTURES.values(), "shot")
    assert found.noise[-1].sigma > 5 > found.noise[0].sigma  # the raw is noise alone
    assert all(len(row.crops) == 5 for row in found.rows)


def rows_of_the_table():
    """The cells of the table of what stands for what: element, what is here, tests."""
    table = PAGE.read_text("utf-8").partition("## From the paper to clpipe")[2]
    rows = [line.strip("| ").split(" | ") for line in table.splitlines() if line.startswith("|")]
    return rows[2:]


def names_a_parameter(text):
    """Whether there is such a stage, or method or parameter of it, or value of a choice."""
    key, _, value = text.partition("=")
    stage, _, parameter = key.partition(".")
    if stage == "output":
        return parameter in Encoding.model_fields
    by_name = all_stages()[stage].by_name
    if parameter == "method":
        return value in by_name
    fields = [
        each.model_fields[parameter] for each in by_name.values() if parameter in each.model_fields
    ]
    choices = [choice for field in fields for choice in typing.get_args(field.annotation)]
    return not parameter or value in choices or bool(fields and not value)


def names_something(text):
    """Whether a code span of the table's second column names something that exists."""
    word, _, value = text.partition(" ")
    options = {name: option for option in run.params for name in option.opts}
    match word:
        case "clpipe":
            return value in COMMANDS
        case "-c":
            return value in built_in_configs()
        case "--camera":
            return load_camera(value) is not None
        case _ if word.startswith("-"):
            return word in options and (not value or value in options[word].type.choices)
        case "tools/run":
            return (ROOT / "tools" / value.replace(" ", "/")).with_suffix(".py").exists()
        case _:
            return names_a_parameter(text)


def test_what_the_table_names_is_there():
    rows = rows_of_the_table()
    assert len(rows) > 20
    for element, here, tests in rows:
        spans = re.findall(r"`([^`]+)`", here)
        assert spans, element
        assert all(map(names_something, spans)), (element, here)
        for name in re.findall(r"`([^`]+)`", tests):
            path, _, function = name.partition("::")
            assert f"\ndef {function}(" in (ROOT / path).read_text("utf-8"), name


@pytest.mark.parametrize(
    "text",
    [
        *("demosaic.method=none", "gamma.chi", "denoise.method", "demosaic.classifier=canny"),
        *("clpipe develop", "--iid", "--truth poisson", "-c papers", "tools/run pages figure"),
    ],
)
def test_what_is_not_there_is_noticed(text):
    assert not names_something(text)
