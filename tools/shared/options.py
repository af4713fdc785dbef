"""Command lines of tools."""

import argparse


def parser_of(documentation: str | None) -> argparse.ArgumentParser:
    """Return a parser whose help shows the documentation of a tool's module."""
    formatter = argparse.RawDescriptionHelpFormatter
    return argparse.ArgumentParser(description=documentation, formatter_class=formatter)


def sides_of(text: str) -> tuple[int, int]:
    """Parse a size.

    Raises:
        argparse.ArgumentTypeError: the text is not WIDTHxHEIGHT.

    >>> sides_of("1920x1080")
    (1920, 1080)
    """
    width, height = numbers_of(text, "WIDTHxHEIGHT")
    return width, height


def numbers_of(text: str, form: str) -> list[int]:
    """Parse whole numbers above 0, separated by x.

    Args:
        text: such as 8x1920x1080.
        form: the names of the numbers, such as COUNTxWIDTHxHEIGHT.

    Raises:
        argparse.ArgumentTypeError: the text has another form.
    """
    words = text.split("x")
    if len(words) != form.count("x") + 1 or not all(w.isdecimal() and int(w) for w in words):
        raise argparse.ArgumentTypeError(f"found {text!r}; expected {form}")
    return [int(word) for word in words]


def count_of(text: str) -> int:
    """Parse a whole number above 0.

    Raises:
        argparse.ArgumentTypeError: it is another number, or none.
    """
    return numbers_of(text, "a whole number above 0")[0]
