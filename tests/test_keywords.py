"""Typed keywords: the module is that of the stages, and a type checker believes it."""

from tools.pages.keywords import PATH, text_of


def test_the_keywords_are_those_of_the_stages():
    assert PATH.read_text("utf-8") == text_of(), "write it again: tools/run pages keywords"
