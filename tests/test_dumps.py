"""Dumps: raw bytes of a sensor without a header, with a given geometry."""

import numpy as np
import pytest

from clpipe.base.errors import RequestError
from clpipe.images.dump import parse_dump
from tests.conftest import cli_output as clpipe
from tests.test_raw import MEASURE, colours, developed, mosaic, sidecar


def packed(dn, type_):
    """The bytes of a dump, sample by sample, as the MIPI specification draws them."""
    if type_ in ("uint8", "uint16le", "uint16be"):
        return dn.astype({"uint8": "u1", "uint16le": "<u2", "uint16be": ">u2"}[type_]).tobytes()
    count, low = (4, 2) if type_ == "raw10" else (2, 4)
    data = bytearray()
    for group in dn.astype(int).reshape(-1, count):
        data += bytes(int(s) >> low for s in group)
        bits = "".join(f"{int(s) % (1 << low):0{low}b}" for s in reversed(group))
        data.append(int(bits, 2))
    return bytes(data)


@pytest.mark.parametrize(
    ("type_", "white"),
    [("uint8", 255), ("uint16le", 16383), ("uint16be", 16383), ("raw10", 1023), ("raw12", 4095)],
)
@pytest.mark.parametrize("ending", ["raw", "bin"])
def test_dumps(tmp_path, type_, white, ending):
    dn = mosaic("GBRG", black=16, white=white)
    path = tmp_path / f"a.{ending}"
    path.write_bytes(packed(dn, type_))
    levels = ("mosaic.pattern=GBRG", "normalize.black_level=16", f"normalize.white_level={white}")
    fixed = (
        "white_balance.method=gains",
        "white_balance.red_gain=2",
        "white_balance.blue_gain=1.6",
    )
    options = [o for text in (*levels, *fixed) for o in ("--set", text)]
    size = ("--dump", f"64x48:{type_}")
    out = tmp_path / "out"
    output = clpipe("run", path, "-o", out, *size, *options, *MEASURE, "--until", "demosaic")
    assert "warning" not in output
    assert np.abs(developed(out / "a.exr") - colours())[4:-4, 4:-4].max() < 4 / white + 2e-3
    assert sidecar(out / "a.json")["raw"] == {"width": 64, "height": 48, "type": type_}


def test_a_dump_by_configuration_and_what_it_does_not_say(tmp_path):
    (tmp_path / "a.raw").write_bytes(packed(mosaic(), "uint16le"))
    (tmp_path / "c.toml").write_text('dump = "64x48:uint16le"\n')
    command = ("run", tmp_path / "a.raw", "-o", tmp_path / "out", "-c", tmp_path / "c.toml")
    output = clpipe(*command)
    for message in (
        "does not state its CFA pattern; clpipe assumes RGGB",
        "does not state its levels; clpipe assumes black 512 and white 16383",
        "does not state its ISO; clpipe assumes 100",
        "does not state its white balance; gray_world estimates it",
        "its colour matrix is unknown",
    ):
        assert output.count(message) == 1
    assert clpipe("plan", "-c", tmp_path / "c.toml", "--toml").count('dump = "64x48:uint16le"') == 1
    (tmp_path / "c.toml").write_text('iso = 200\n\ndump = "64x48:uint12"\n')
    assert "c.toml, line 3: dump: unknown type 'uint12'" in clpipe(*command, status=2)


def test_a_dump_of_another_size_is_told_what_would_fit(tmp_path):
    (tmp_path / "a.raw").write_bytes(bytes(64 * 48 * 2))
    options = ("--dump", "64x40:uint16le")
    output = clpipe("run", tmp_path / "a.raw", "-o", tmp_path, *options, status=1)
    assert (
        "a.raw: this file has 6144 bytes, but 64x40 uint16le has 5120; it would fit 64x48 uint16le"
        in output
    )
    output = clpipe("run", tmp_path / "a.raw", "-o", tmp_path, status=1)
    assert "LibRaw does not support it" in output or "--dump" in output


@pytest.mark.parametrize(
    ("size", "type_"),
    [("64", "uint8"), ("0x4", "uint8"), ("4x1", "uint8"), ("6x4", "raw10"), ("5x4", "raw12")],
)
def test_geometries_that_cannot_be(size, type_):
    with pytest.raises(RequestError, match=f"dump: found '{size}:{type_}'"):
        parse_dump(f"{size}:{type_}")
