"""Malformed files are rejected quickly and within little memory."""

import os
import re
import socket
import struct
import subprocess
import sys
import tarfile
import time
import zlib
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest

from clpipe.base.digests import digests
from clpipe.base.errors import ClpipeError, ImageError, RequestError
from clpipe.base.files import sha256_of
from clpipe.base.reading import check_unchanged
from clpipe.batch.replay import replay_of
from clpipe.batch.tars import Members, is_clpipe_tar
from clpipe.camera.profile import load_camera
from clpipe.chain.files import load_config
from clpipe.chain.isos import check_cameras
from clpipe.chain.registry import load_stage_file
from clpipe.chain.settings import settings_from
from clpipe.images.dump import parse_dump, read_dump
from clpipe.images.raw import read_exif, read_raw_info
from clpipe.images.read import ReadOptions, read_source
from clpipe.images.samples import holds_mosaic
from clpipe.inputs.manifest import read_manifest
from clpipe.stage import Kind
from tests.conftest import ROOT
from tests.dng import field, write_dng
from tests.exr import exr

# Reads each file in every way, in little memory; each way ends in a refusal that names the file.
REFUSE_ALL = r"""
import resource, sys
from pathlib import Path
resource.setrlimit(resource.RLIMIT_AS, (3 << 29, 3 << 29))
from clpipe.base.errors import ImageError
from clpipe.images.attributes import read_attributes
from clpipe.images.dump import parse_dump, read_dump
from clpipe.images.raw import read_raw_info, read_raw
from clpipe.images.read import ReadOptions, read_source
from clpipe.stage import Kind

WAYS = [
    lambda path: read_raw(path, read_raw_info(path)),
    lambda path: read_dump(path, parse_dump("60000x60000:uint8")),
    lambda path: read_source(path, Kind.RGB, ReadOptions()),
    lambda path: read_source(path, Kind.RGB, ReadOptions(transfer="srgb")),
    lambda path: read_source(path, Kind.DISPLAY, ReadOptions()),
    lambda path: read_source(path, Kind.RAW, ReadOptions()),
]
for path in map(Path, sys.argv[1:]):
    read_attributes(path)
    for way in WAYS:
        try:
            way(path)
            sys.exit(f"{path}: was read")
        except ImageError as error:
            assert str(path) in str(error), error
            print(error)
"""


def png(width: int, height: int, bits: int = 8, colour: int = 2) -> bytes:
    """A PNG that claims this size, and holds a hundred bytes."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return (
            struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
        )

    header = struct.pack(">IIBBBBB", width, height, bits, colour, 0, 0, 0)
    pixels = zlib.compress(bytes(100_000))
    parts = chunk(b"IHDR", header), chunk(b"IDAT", pixels), chunk(b"IEND", b"")
    return b"\x89PNG\r\n\x1a\n" + b"".join(parts)


def tiff(width: int, height: int, samples: int = 3, bits: int = 8, kind: int = 1) -> bytes:
    """A TIFF of one strip that claims this size, and holds a hundred bytes."""
    fields = [(256, width), (257, height), (258, bits), (259, 1), (262, 2 if samples == 3 else 1)]
    fields += [(273, 200), (277, samples), (278, height), (279, 100), (339, kind)]
    head = b"II*\0" + struct.pack("<IH", 8, len(fields))
    body = b"".join(struct.pack("<HHII", tag, 4, 1, value) for tag, value in fields)
    return (head + body + bytes(4)).ljust(200, b"\0") + bytes(100)


def jpeg(path, width: int, height: int) -> bytes:
    """A JPEG of a few pixels that claims this size."""
    file = oiio.ImageOutput.create(str(path))
    assert file.open(str(path), oiio.ImageSpec(8, 8, 3, oiio.UINT8))
    assert file.write_image(np.zeros((8, 8, 3), np.uint8)) and file.close()
    data = bytearray(path.read_bytes())
    at = data.index(b"\xff\xc0")
    data[at + 5 : at + 9] = struct.pack(">HH", height, width)
    return bytes(data)


def deep(path, width: int, height: int) -> bytes:
    """A deep EXR of a few pixels that claims this size."""
    spec = oiio.ImageSpec(4, 4, 4, oiio.FLOAT)
    spec.deep = True
    samples = oiio.DeepData()
    samples.init(16, 4, (oiio.FLOAT,) * 4, ("R", "G", "B", "A"))
    file = oiio.ImageOutput.create(str(path))
    assert file.open(str(path), spec) and file.write_deep_image(samples) and file.close()
    small, large = (struct.pack("<4i", 0, 0, w - 1, h - 1) for w, h in ((4, 4), (width, height)))
    return path.read_bytes().replace(small, large)


@pytest.mark.slow
def test_images_that_claim_too_much_are_refused_in_little_memory(tmp_path):
    planes = {c: (np.zeros((1000, 1)), 1) for c in "RGB"}
    chroma = {"Y": (np.zeros((1000, 2)), 1), "RY": (np.zeros((500, 1)), 2)}
    chroma["BY"] = chroma["RY"]
    dn = np.arange(64 * 64).reshape(64, 64)
    sizes = [field(256, 4, 60_000), field(257, 4, 60_000), field(278, 4, 60_000)]
    files = {
        "rgb.png": png(60_000, 60_000),
        "16.png": png(60_000, 60_000, bits=16),
        "grey.png": png(60_000, 60_000, colour=0),
        "rgb.tif": tiff(60_000, 60_000),
        "most.tif": tiff(2**32 - 1, 2**32 - 1),
        "float.tif": tiff(60_000, 60_000, 3, 32, 3),
        "mosaic.tif": tiff(60_000, 60_000, 1, 16),
        "channels.tif": tiff(60_000, 60_000, 60_000),
        "rgb.jpg": jpeg(tmp_path / "rgb.jpg", 65_000, 65_000),
        "rgb.hdr": b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 60000 +X 60000\n" + bytes(100),
        "rgb.pfm": b"PF\n60000 60000\n-1.0\n" + bytes(100),
        "data.exr": exr(planes, 60_000, 60_000),
        "window.exr": exr(planes, 60_000, 60_000, display=(4, 4)),
        "display.exr": exr(planes, 1, 4, display=(60_000, 60_000)),
        "tall.exr": exr(planes, 1, 1_000_000_000),
        "chroma.exr": exr(chroma, 60_000, 60_000),
        "chroma_display.exr": exr(chroma, 2, 4, display=(60_000, 60_000)),
        "deep.exr": deep(tmp_path / "deep.exr", 60_000, 60_000),
        "sensor.dng": write_dng(tmp_path / "a.dng", dn, changes=sizes).read_bytes(),
    }
    for name, data in files.items():
        (tmp_path / name).write_bytes(data)
        os.truncate(tmp_path / name, 16 << 20)  # else OpenImageIO sees that the file is too small
    command = [sys.executable, "-c", REFUSE_ALL, *(str(tmp_path / name) for name in files)]
    # Threads and their heaps take address space on machines with many cores.
    few = {"OPENBLAS_NUM_THREADS": "1", "OPENIMAGEIO_THREADS": "1", "MALLOC_ARENA_MAX": "1"}
    environment = os.environ | few
    done = subprocess.run(
        command, cwd=ROOT, capture_output=True, text=True, timeout=120, env=environment
    )
    assert done.returncode == 0, done.stdout + done.stderr
    large_files = ("rgb.png", "rgb.tif", "mosaic.tif", "rgb.pfm", "window.exr", "sensor.dng")
    for name in (*large_files, "display.exr", "chroma.exr", "chroma_display.exr"):
        assert (
            f"{name}: this file has 60000x60000 pixels; at most 200000000 are read." in done.stdout
        )
    assert "dump" not in done.stdout


def test_max_pixels_on_the_command_line_holds_for_every_reader(tmp_path, clpipe):
    dn = np.arange(80 * 96).reshape(80, 96) % 4096
    write_dng(tmp_path / "a.dng", dn)
    (tmp_path / "a.raw").write_bytes(dn.astype("<u2").tobytes())
    (tmp_path / "a.png").write_bytes(png(96, 80))
    (tmp_path / "a.tif").write_bytes(tiff(96, 80, 1, 16))
    ways = {
        "a.dng": [],
        "a.raw": ["--dump", "96x80:uint16le"],
        "a.png": ["-c", "unprocess"],
        "./a.png": ["--transfer", "srgb"],
        "a.tif": ["--start-at", "normalize"],
    }
    for name, options in ways.items():
        most = ["--max-pixels", 96 * 80 - 1, "--device", "numpy"]
        done = clpipe("run", name, "-o", "out", *most, *options, status=1)
        assert "96x80 pixels; at most 7679 are read. To read more, set" in done.output


def test_channels_far_apart_are_read_one_by_one(write_exr, monkeypatch):
    names = ["A.B", *(f"B.{i:03}" for i in range(300)), "a.G", "a.R"]
    pixels = np.zeros((4, 6, len(names)), np.float32)
    pixels[..., [-1, -2, 0]] = 1, 2, 3
    path = write_exr("wide.exr", pixels, ",".join(names))
    read, sizes = oiio.ImageInput.read_image, []

    def noted(file, *arguments):
        data = read(file, *arguments)
        sizes.append(data.size)
        return data

    monkeypatch.setattr(oiio.ImageInput, "read_image", noted)
    source = read_source(path, Kind.RGB, ReadOptions())
    assert source.pixels[0, 0].tolist() == [1, 2, 3]
    assert max(sizes) == 4 * 6


def test_a_dump_of_another_size_is_not_read(tmp_path, clpipe):
    os.truncate(os.open(tmp_path / "a.raw", os.O_CREAT | os.O_WRONLY), 1 << 40)  # takes no place
    dump = ["--dump", "96x80:uint8", "--device", "numpy"]
    done = clpipe("run", "a.raw", "-o", "out", *dump, status=1)
    assert "a.raw: this file has 1099511627776 bytes, but 96x80 uint8 has 7680" in done.output


def test_exif_that_repeats_itself_is_given_up(tmp_path):
    """65,535 tags of 65,535 values each, all of the same bytes: minutes, if all were read."""
    tags = struct.pack("<HHII", 33434, 1, 65_535, 8) * 65_535
    (tmp_path / "a.dng").write_bytes(b"II*\0" + struct.pack("<IH", 8, 65_535) + tags + bytes(4))
    started = time.process_time()
    assert not read_exif(tmp_path / "a.dng").directories
    assert time.process_time() - started < 5


# How each file that a request names is read, by the ending of its name.
READERS = {
    ".toml": lambda path: load_config(str(path)),
    "camera.toml": lambda path: load_camera(str(path)),
    ".csv": lambda path: settings_from({"tone_curve": {"method": "file", "path": str(path)}}),
    ".cube": lambda path: settings_from({"tone_curve": {"method": "file", "path": str(path)}}),
    "undo.csv": lambda path: settings_from(
        {"inverse_tone_curve": {"method": "file", "path": str(path)}}
    ),
    ".json": lambda path: settings_from(
        {"picture_noise": {"method": "iid_gaussian", "measured": str(path)}}
    ),
    "list.csv": read_manifest,
    "list.jsonl": read_manifest,
    "sidecar.json": lambda path: replay_of(path, (), None),
    ".py": load_stage_file,
    ".exr": lambda path: read_source(path, Kind.RGB, ReadOptions()),
    "mosaic.exr": lambda path: read_source(path, Kind.RAW, ReadOptions()),
    ".png": lambda path: read_source(path, Kind.DISPLAY, ReadOptions()),
    ".dng": read_raw_info,
    ".raw": lambda path: read_dump(path, parse_dump("96x80:uint8")),
}


@pytest.mark.parametrize("reader", READERS)
def test_texts_of_gigabytes_are_not_read(tmp_path, reader):
    path = tmp_path / f"a{reader}"
    path.touch()
    os.truncate(path, 1 << 40)
    with pytest.raises(ClpipeError, match="a" + re.escape(reader)) as refused:
        READERS[reader](path)
    if "list" in reader:
        assert "it has 1024.0 GiB, but the limit is 256.0 MiB" in str(refused.value)
    elif path.suffix in (".toml", ".csv", ".cube"):
        assert "it has 1024.0 GiB, but the limit is 16.0 MiB" in str(refused.value)


@pytest.mark.parametrize("reader", READERS)
@pytest.mark.parametrize("kind", ["folder", "pipe", "device", "socket", "loop", "missing"])
def test_what_is_no_file_is_refused_without_waiting(tmp_path, reader, kind):
    path = tmp_path / f"a{reader}"
    if kind == "folder":
        path.mkdir()
    elif kind == "pipe":
        os.mkfifo(path)
    elif kind == "device":
        path.symlink_to("/dev/zero")
    elif kind == "socket":
        with socket.socket(socket.AF_UNIX) as one:
            one.bind(os.path.relpath(path))
    elif kind == "loop":
        path.symlink_to(path)
    with pytest.raises(ClpipeError, match="a" + re.escape(reader)):
        READERS[reader](path)
    assert digests([str(path)]) == {}
    if kind != "missing":
        with pytest.raises(OSError, match=r"not a file|symbolic links"):
            sha256_of(path)


def test_a_link_to_a_file_is_a_file(tmp_path):
    (tmp_path / "file").write_text('demosaic.method = "bilinear"')
    (tmp_path / "link.toml").symlink_to("file")
    assert load_config(str(tmp_path / "link.toml")).values == {"demosaic": {"method": "bilinear"}}
    assert len(sha256_of(tmp_path / "link.toml")[0]) == 64


def test_a_file_that_changes_while_it_is_read_is_refused(tmp_path):
    path = tmp_path / "a.exr"
    path.write_bytes(b"1234")
    with check_unchanged(path):
        path.read_bytes()
    for change in (lambda: path.write_bytes(b"12345"), path.unlink):
        with (
            pytest.raises(ImageError, match=r"a\.exr: the file changed while it was read"),
            check_unchanged(path),
        ):
            change()


def tar_header(name: str, size: int, kind: bytes = b"0") -> bytes:
    info = tarfile.TarInfo(name)
    info.size, info.type = size, kind
    return info.tobuf(tarfile.GNU_FORMAT)


TARS = {
    **{
        f"{kind.decode()} of 2^{power}": tar_header("a", 1 << power, kind) + bytes(2048)
        for kind in (b"L", b"K", b"x", b"g", b"S")
        for power in (45, 80)
    },
    "large": tar_header("a.json", 1 << 45) + b"{" * 4096,
    "nested": tar_header("a.json", 200_704) + b"[" * 200_704 + bytes(1024),
    "a link to another": tar_header("a.json", 0, b"1") + bytes(1024),
    "a text": tar_header("a.json", 512) + b'"of clpipe"'.ljust(512) + bytes(1024),
    "a list": tar_header("a.json", 512) + b"[1]".ljust(512) + bytes(1024),
}


@pytest.mark.parametrize("data", TARS.values(), ids=TARS)
def test_a_damaged_tar_is_nobodys_and_holds_nothing(tmp_path, data):
    path = tmp_path / "000000.tar"
    path.write_bytes(data)
    assert not is_clpipe_tar(path)
    members = Members(path)
    assert not any(members.sidecar(name) for name in members.locations)


def test_a_pipe_in_the_output_folder_does_not_make_a_run_wait(clpipe, write_exr):
    path = write_exr("a.exr", np.full((4, 6, 3), 0.25))
    Path("tars").mkdir()
    for name in ("tars/000000.tar", "t.json"):
        os.mkfifo(name)
    run = ("run", path, "--device", "numpy", "-o")
    assert "did not write this tar" in clpipe(*run, "tars", "--webdataset", 1, status=2).output
    assert "exists and is not a trace" in clpipe(*run, "x", "--trace", "t.json", status=2).output


def test_an_image_of_very_many_parts_is_refused(tmp_path, monkeypatch):
    """Each part takes as long to find as there are parts before it."""
    fields = [(256, 4), (257, 4), (258, 32), (259, 1), (262, 1), (273, 0), (277, 1), (278, 4)]
    fields += [(279, 64), (339, 3)]
    body = b"".join(struct.pack("<HHII", tag, 4, 1, value) for tag, value in fields)
    size = 2 + len(body) + 4
    offsets = [8 + size * i for i in range(1, 20_000)] + [0]
    parts = [struct.pack("<H", len(fields)) + body + struct.pack("<I", at) for at in offsets]
    path = tmp_path / "a.tif"
    path.write_bytes(b"II*\0" + struct.pack("<I", 8) + b"".join(parts))
    seek, sought = oiio.ImageInput.seek_subimage, []

    def noted(file, part, *level):
        sought.append(part)
        return seek(file, part, *level)

    monkeypatch.setattr(oiio.ImageInput, "seek_subimage", noted)
    with pytest.raises(ImageError, match=r"a\.tif: this file has more than 1000 parts"):
        read_source(path, Kind.RGB, ReadOptions())
    assert holds_mosaic(path)
    # At most a few passes over the parts that are allowed, never one over all 20,000.
    assert max(sought) <= 1000
    assert len(sought) < 5 * 1000


def test_a_message_repeats_a_giant_value_in_part(tmp_path):
    (tmp_path / "a.toml").write_text(f'camera = "{"x" * 100_000}"')
    with pytest.raises(RequestError, match=r"unknown camera 'xxx.*xxx.*calibrate") as refused:
        check_cameras(load_config(str(tmp_path / "a.toml")).settings)
    assert len(str(refused.value)) < 5000


def test_names_from_a_file_are_escaped_in_messages(tmp_path):
    (tmp_path / "a.csv").write_text("pa\x1b[31mth,na\x07me\na.exr,b\n")
    with pytest.raises(RequestError, match="there is no column 'path'") as refused:
        read_manifest(tmp_path / "a.csv")
    assert str(refused.value).isprintable()
