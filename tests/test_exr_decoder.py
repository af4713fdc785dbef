"""The two decoders of OpenEXR files return the same pixels and the same errors."""

import struct
import sys
import threading

import numpy as np
import OpenEXR
import pytest

from clpipe.base.errors import ImageError
from clpipe.images import openexr, samples
from clpipe.images.openexr import open_exr, read_channels
from clpipe.images.pixels import BLOCK, HALF_MAX, clip_to_half, make_finite
from clpipe.images.read import read_image
from tests.conftest import run_python
from tests.exr import exr

COMPRESSIONS = ("NO", "RLE", "ZIPS", "ZIP", "PIZ", "PXR24", "B44", "B44A", "DWAA", "DWAB")
HEIGHT, WIDTH = 300, 40  # more than one chunk in every compression


def light(channels=3, dtype=np.float16):
    values = np.random.default_rng(0).random((HEIGHT, WIDTH, channels)) * 3 - 0.5
    return values.astype(dtype)


def save(path, channels, compression="ZIP", tile=None, **header):
    """Write a part with the OpenEXR package: {name: (rows, columns[, channel])}."""
    header["compression"] = getattr(OpenEXR, f"{compression}_COMPRESSION")
    header["type"] = OpenEXR.tiledimage if tile else OpenEXR.scanlineimage
    if tile:
        header["tiles"] = OpenEXR.TileDescription()
        header["tiles"].xSize, header["tiles"].ySize = tile
    OpenEXR.File(header, channels).write(str(path))
    return path


def box(x, y, width, height):
    return np.array([x, y], np.int32), np.array([x + width - 1, y + height - 1], np.int32)


def outcome(path, **options):
    try:
        image = read_image(path, **options)
    except ImageError as error:
        return str(error)
    return (image.pixels.dtype, image.pixels.shape, image.pixels.tobytes(), image.warnings)


@pytest.fixture
def decoded(monkeypatch):
    """Read a file with both decoders, which must agree; return whether OpenEXR read it."""

    def both(path, **options):
        used = []

        def counted(*arguments):
            pixels = read_channels(*arguments)
            used.append(pixels is not None)
            return pixels

        monkeypatch.setattr(samples, "read_channels", counted)
        first = outcome(path, **options)
        monkeypatch.setattr(samples, "read_channels", lambda *_: None)
        assert first == outcome(path, **options)
        return any(used), first

    return both


@pytest.mark.parametrize("compression", COMPRESSIONS)
def test_both_decoders_read_the_same_pixels(tmp_path, decoded, compression):
    windows = {"dataWindow": box(-7, 5, WIDTH, HEIGHT), "displayWindow": box(0, 0, 30, 400)}
    for dtype in (np.float16, np.float32):
        for tile in (None, (16, 32)):
            for name in ("RGB", "RGBA"):
                channels = {name: light(len(name), dtype)}
                path = save(tmp_path / "a.exr", channels, compression, tile, **windows)
                assert decoded(path)[0]


@pytest.mark.parametrize("names", [("r", "g", "b"), ("X", "Y", "Z"), ("a.R", "a.G", "a.B"), ("Y",)])
@pytest.mark.parametrize("order", ["INCREASING_Y", "DECREASING_Y"])
def test_names_and_orders(tmp_path, decoded, names, order):
    planes = {name: np.ascontiguousarray(light()[..., i]) for i, name in enumerate(names)}
    path = save(tmp_path / "a.exr", planes, lineOrder=getattr(OpenEXR, order))
    used, (_, shape, *_) = decoded(path, mosaic=len(names) == 1)
    assert used and shape == (HEIGHT, WIDTH, 3)[: 2 + (len(names) > 1)]


def test_what_is_not_finite_is_counted_in_both_layouts(tmp_path, decoded):
    for name in ("RGB", "RGBA"):
        pixels = light(len(name), np.float32)
        pixels[0, 0, :3] = np.nan, np.inf, -np.inf
        pixels[1, 1, :2] = 1e9, -1e9
        used, (*_, warnings) = decoded(save(tmp_path / "a.exr", {name: pixels}))
        assert used and [warning.split()[0] for warning in warnings] == ["1", "2", "2"]


def test_alpha_is_left_out_of_memory(tmp_path):
    pixels = read_image(save(tmp_path / "a.exr", {"RGBA": light(4)})).pixels
    assert pixels.transpose(2, 0, 1).flags.c_contiguous
    assert pixels.base.size == pixels.size
    assert read_image(save(tmp_path / "a.exr", {"RGB": light()})).pixels.flags.c_contiguous


def test_unusual_files_are_left_to_openimageio(tmp_path, decoded):
    plane = np.ascontiguousarray(light(1)[..., 0])
    rgb = {"RGB": light()}
    many = {f"layer{i}": plane for i in range(4)}
    whole = {"id": plane.astype(np.uint32)}
    for channels in (rgb | many, {"R": plane, "G": plane.astype(np.float32), "B": plane}, whole):
        used, _ = decoded(save(tmp_path / "a.exr", channels), mosaic=channels is whole)
        assert not used
    parts = [OpenEXR.Part({"name": name}, rgb, name) for name in ("left", "right")]
    OpenEXR.File(parts).write(str(tmp_path / "parts.exr"))
    used, (_, shape, *_) = decoded(tmp_path / "parts.exr", layer="right")
    assert not used and shape == (HEIGHT, WIDTH, 3)


def test_a_manifest_is_not_for_the_package(tmp_path, decoded):
    planes = {name: (np.zeros((4, 4)), 1) for name in "RGB"}
    path = tmp_path / "a.exr"
    path.write_bytes(exr(planes, 4, 4))
    assert decoded(path)[0]
    manifest, long = ("ids", "idmanifest", bytes(100)), ("a", "string", bytes(70_000))
    for attributes in ([manifest], [long, manifest], [long]):
        path.write_bytes(exr(planes, 4, 4, attributes=attributes))
        assert not decoded(path)[0]


def damage(data, kind):
    """A file with a fault, of one whose table of chunks is behind 8 and its attributes."""
    end = 8
    while data[end]:
        for _ in range(2):
            end = data.index(0, end) + 1
        end += 4 + struct.unpack_from("<I", data, end)[0]
    table, data = end + 1, bytearray(data)
    chunk = struct.unpack_from("<Q", data, table)[0]
    match kind:
        case "cut":
            return data[:-1]
        case "half":
            return data[: len(data) // 2]
        case "table":
            return data[: table + 4]
        case "unfinished":
            chunks = 8 * (-(-HEIGHT // 16) * (3 if b"tiles" in data[:end] else 1))
            return data[:table] + bytes(chunks) + data[table + chunks : len(data) // 2]
        case "missing":
            data[table + 8 : table + 16] = bytes(8)
        case "outside":
            data[table + 8 : table + 16] = struct.pack("<Q", len(data) * 2)
        case "order":
            data[table : table + 16] = data[table + 8 : table + 16] + data[table : table + 8]
        case "leader":
            data[chunk : chunk + 4] = b"\xff" * 4
        case "zeros":
            data[chunk + 16 : chunk + 400] = bytes(384)
    return data


DECODED = ("leader", "zeros")  # OpenEXR prints why its decoder fails
REPAIRED = ("missing", "outside")  # the table is made anew from the chunks


@pytest.mark.parametrize(
    "kind", ["cut", "half", "table", "order", "leader", "zeros", "unfinished", *REPAIRED]
)
@pytest.mark.parametrize("tile", [None, (16, 16)])
def test_damaged_files_are_what_they_are_to_openimageio(tmp_path, decoded, capfd, kind, tile):
    for name in ("RGB", "RGBA"):
        path = save(tmp_path / "a.exr", {name: light(len(name))}, tile=tile)
        path.write_bytes(damage(path.read_bytes(), kind))
        used, found = decoded(path)
        assert not used
        assert found[1] == (HEIGHT, WIDTH, 3) if kind in REPAIRED else found.startswith(f"{path}: ")
    printed = capfd.readouterr()
    assert printed.out == ""
    assert kind in DECODED or printed.err == ""


def test_standard_output_is_that_of_the_other_threads(tmp_path, capsys):
    path = save(tmp_path / "a.exr", {"RGB": light()})
    path.write_bytes(damage(path.read_bytes(), "zeros"))
    stdout, ended = sys.stdout, threading.Event()

    def decode():
        while not ended.is_set():
            assert len(open_exr(path).parts) == 0  # the package prints why

    threads = [threading.Thread(target=decode) for _ in range(2)]
    for thread in threads:
        thread.start()
    for number in range(200):
        print(number)
    ended.set()
    for thread in threads:
        thread.join()
    assert capsys.readouterr().out.split() == list(map(str, range(200)))
    assert sys.stdout is stdout


PRINTING = """
import sys, threading, time
from clpipe.images.openexr import _discard_stdout

def discard():
    while time.monotonic() < end:
        with _discard_stdout():
            pass

sys.setswitchinterval(1e-5)
end = time.monotonic() + 1.5
threads = [threading.Thread(target=discard) for _ in range(2)]
for thread in threads:
    thread.start()
while time.monotonic() < end:
    print("a", "b", "c")
"""


def test_printing_does_not_crash_while_other_threads_are_silent():
    """CPython's print uses sys.stdout without a reference of its own."""
    assert "a b c" in run_python("-c", PRINTING).stdout


def test_a_closed_standard_output_is_left_alone(tmp_path, monkeypatch):
    """Python's print then does nothing, also while a damaged file is read."""
    monkeypatch.setattr(sys, "stdout", None)
    path = save(tmp_path / "a.exr", {"RGB": light()})
    path.write_bytes(damage(path.read_bytes(), "zeros"))
    assert len(open_exr(path).parts) == 0
    with openexr._discard_stdout():
        assert sys.stdout is None


def test_the_digest_of_a_large_file_is_the_same(tmp_path, monkeypatch):
    path = save(tmp_path / "a.exr", {"RGB": light()})
    digest = read_image(path).sha256
    monkeypatch.setattr(samples, "LARGE_FILE", 0)
    assert read_image(path).sha256 == digest
    path.write_bytes(path.read_bytes()[:-1])
    with pytest.raises(ImageError, match="damaged"):
        read_image(path)


@pytest.mark.parametrize("dtype", [np.float16, np.float32])
def test_every_block_is_looked_at(dtype):
    pixels = np.zeros((3, 2, BLOCK), dtype).transpose(1, 2, 0)  # planar in memory
    pixels[0, 0, 0], pixels[1, -1, 2], pixels[1, 7, 1] = -np.inf, np.nan, -65504
    pixels[0, 3, 1] = np.inf
    assert make_finite(pixels) == (1, 2) and make_finite(pixels) == (0, 0)
    assert (pixels[0, 3, 1], pixels.sum(dtype=np.float64)) == (HALF_MAX, 0)
    if dtype == np.float32:
        pixels[1, -1, 2], pixels[0, 5, 1] = 65504.1, -1e30
        assert clip_to_half(pixels) == 2 and clip_to_half(pixels) == 0
        assert (pixels[1, -1, 2], pixels[0, 5, 1]) == (HALF_MAX, -HALF_MAX)
