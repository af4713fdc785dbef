"""Reads the colour chunks of a PNG (PNG specification, third edition, 2025)."""

import struct
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from clpipe.images import colour_names

MAGIC = b"\x89PNG\r\n\x1a\n"
MAX_CHUNKS = 1000  # chunks before the first chunk of samples

# Codes of ITU-T H.273 (2024). Table 2: x and y of red, green, blue and white. Table 3: curves.
PRIMARIES = {
    1: colour_names.PRIMARIES["rec709"],
    9: colour_names.PRIMARIES["rec2020"],
    11: (0.680, 0.320, 0.265, 0.690, 0.150, 0.060, 0.314, 0.351),
    12: colour_names.PRIMARIES["p3d65"],
}
CURVES = {1: "BT.709", 4: "gamma 2.2", 5: "gamma 2.8", 8: "linear", 13: "srgb", 16: "PQ", 18: "HLG"}
SRGB_GAMMA = 1 / 2.2


@dataclass(frozen=True)
class PngColours:
    """The colours that a PNG states.

    Args:
        chromaticities: x and y of red, green, blue and white; None if they are not stated.
        curve: how light is encoded: "srgb", "linear" or another name; "" if it is not stated.
        chunk: the chunk that states the curve.
        unknown: the stated primaries if clpipe does not know them; otherwise "".
    """

    chromaticities: tuple[float, ...] | None = None
    curve: str = ""
    chunk: str = ""
    unknown: str = ""


def read_chunks(path: Path) -> dict[bytes, bytes]:
    """Return the chunks of a PNG before its samples, by name; b"" stands for a long content.

    Raises:
        OSError: the file cannot be read.
    """
    chunks: dict[bytes, bytes] = {}
    with path.open("rb") as file:
        file.seek(len(MAGIC))
        for _ in range(MAX_CHUNKS):
            head = file.read(8)
            if len(head) < 8 or head[4:] == b"IDAT":
                break
            (size,) = struct.unpack(">I", head[:4])
            chunks[head[4:]] = file.read(size) if size <= 32 else b""
            file.seek(size - len(chunks[head[4:]]) + 4, 1)
    return chunks


def png_colours(chunks: Mapping[bytes, bytes]) -> PngColours:
    """Return the colours that the chunks of a PNG state, from the chunk of highest priority."""
    if len(chunks.get(b"cICP", b"")) == 4:
        primaries, number = chunks[b"cICP"][:2]
        unknown = "" if primaries in PRIMARIES else f"primaries {primaries}"
        named = CURVES.get(number, f"number {number}")
        return PngColours(PRIMARIES.get(primaries), named, "cICP", unknown)
    if b"iCCP" in chunks:  # OpenImageIO reads its description
        return PngColours()
    if b"sRGB" in chunks:
        return PngColours(PRIMARIES[1], "srgb", "sRGB")
    curve, chromaticities = "", None
    if len(chunks.get(b"gAMA", b"")) == 4:
        gamma = struct.unpack(">I", chunks[b"gAMA"])[0] / 100_000
        known_gammas = {"linear": 1.0, "srgb": SRGB_GAMMA}
        matches = [name for name, value in known_gammas.items() if abs(gamma - value) < 0.01]
        curve = matches[0] if matches else f"gamma {1 / max(gamma, 1e-5):.3g}"
    if len(chunks.get(b"cHRM", b"")) == 32:
        white, colours = (values := struct.unpack(">8I", chunks[b"cHRM"]))[:2], values[2:]
        chromaticities = tuple(value / 100_000 for value in (*colours, *white))
    return PngColours(chromaticities, curve, "gAMA")
