"""The keywords and the docstring of the Python API match the stages and options."""

import inspect
import re
import typing

import pytest

from clpipe.batch.api import run
from clpipe.camera.profile import DEFAULT_CAMERA
from clpipe.chain.files import built_in_configs
from clpipe.chain.keys import CODE, DEFAULT_ISO, KEYS
from clpipe.chain.options import OPTIONS
from clpipe.commands.chain_options import ARGUMENTS, described
from clpipe.images.dump import TYPES
from clpipe.images.pixels import DEFAULT_MAX_PIXELS
from clpipe.images.video import DEFAULT_CRF
from tools.pages.keywords import PATH, text_of


def test_what_is_written_follows_from_stages():
    assert PATH.read_text("utf-8") == text_of(), "write it again: tools/run pages keywords"


DEFAULTS = {"camera": DEFAULT_CAMERA, "iso": DEFAULT_ISO, "crf": DEFAULT_CRF}
DEFAULTS |= {"max_pixels": DEFAULT_MAX_PIXELS}


@pytest.mark.parametrize("name", sorted(ARGUMENTS.keys() & OPTIONS))
def test_the_docstring_names_choices_and_defaults(name):
    entry, choices = ARGUMENTS[name], OPTIONS[name].choices
    named = re.findall(r'"([a-z\d]+)"', entry.partition("The choices are")[2])
    assert named == list(choices)
    default = described(OPTIONS[name]).default_text
    assert name not in DEFAULTS or default == f"{DEFAULTS[name]}".removesuffix(".0")
    assert not choices or default == "" or default.partition(";")[0] in choices


def test_docstrings_name_configurations_and_types():
    assert f"ones are {', '.join(built_in_configs())}." in ARGUMENTS["config"]
    assert f"types are {', '.join(TYPES)}." in KEYS["dump"].text
    assert all(key.text for name, key in KEYS.items() if name != CODE)


def test_types_of_arguments_are_those_of_the_options():
    for name, parameter in inspect.signature(run).parameters.items():
        if name != "settings":
            types = typing.get_args(parameter.annotation)
            choices = [x for each in types for x in typing.get_args(each) if isinstance(x, str)]
            key = OPTIONS[name]
            assert key.type_ is list or choices == list(key.choices), name
            texts = ("device", "memory", "max_failures")  # with a unit, or a part of a name
            assert (int in types) == (key.type_ is int) or name in texts
