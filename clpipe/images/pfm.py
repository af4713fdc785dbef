"""Reads the text header of PFM pictures."""

import re
from dataclasses import dataclass

MAGICS = (b"PF", b"Pf")
SPACE = rb"(?:\s+|\s*#[^\n]*\n)+"
HEADER = re.compile(rb"(P[Ff])" + SPACE + rb"(\d+)" + SPACE + rb"(\d+)" + SPACE + rb"([-+.\deE]+)")


@dataclass(frozen=True)
class PfmHeader:
    """A header that OpenImageIO reads correctly, and the offset ``end`` at which samples begin."""

    standard: bytes
    end: int


def pfm_header(start: bytes, size: int) -> PfmHeader | None:
    r"""Return the header of a PFM file whose lines end in CR and LF; None if it has no CR.

    The scale is followed by one character, or by CR and LF. The file's length distinguishes them.

    >>> pfm_header(b"Pf\r\n1 1\r\n-1.0\r\n\0\0\x80\x3f", 19)
    PfmHeader(standard=b'Pf\n1 1\n-1.0\n', end=15)

    Args:
        start: the first bytes of the file.
        size: the size of the file in bytes.
    """
    if not (found := HEADER.match(start)) or b"\r" not in start[: found.end() + 1]:
        return None
    samples = int(found[2]) * int(found[3]) * (3 if found[1] == b"PF" else 1) * 4
    both = start[found.end() : found.end() + 2] == b"\r\n" and size - samples != found.end() + 1
    return PfmHeader(b"%s\n%s %s\n%s\n" % found.groups(), found.end() + 1 + both)
