"""Text out of files, as it can be shown."""


def printable(text: str) -> str:
    """Text in one line, with ? for what cannot be printed.

    >>> printable("R" + chr(1) + chr(10) + "G")
    'R? G'
    """
    line = " ".join(text.split())
    return "".join(letter if letter.isprintable() else "?" for letter in line)
