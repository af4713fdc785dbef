"""The generated source of the Python API matches the stages and options."""

import inspect
import typing

import pytest

from clpipe.batch.api import run
from clpipe.chain.options import OPTIONS
from tools.pages.keywords import API, PATH, api_text, text_of


@pytest.mark.parametrize(("path", "text"), [(PATH, text_of), (API, api_text)])
def test_what_is_written_follows_from_stages_and_options(path, text):
    assert path.read_text("utf-8") == text(), "write it again: tools/run pages keywords"


def test_types_of_arguments_are_those_of_the_options():
    for name, parameter in inspect.signature(run).parameters.items():
        if name != "settings":
            types = typing.get_args(parameter.annotation)
            choices = [x for each in types for x in typing.get_args(each) if isinstance(x, str)]
            key = OPTIONS[name]
            assert key.type_ is list or choices == list(key.choices), name
            texts = ("device", "memory", "max_failures")  # with a unit, or a part of a name
            assert (int in types) == (key.type_ is int) or name in texts
