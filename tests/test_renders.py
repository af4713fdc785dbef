"""Renders of real programs: the correct picture or the correct error."""

import re
import struct
import subprocess
import sys
import zipfile
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest

from clpipe.base.errors import ImageError
from clpipe.images.colour import CIE_XYZ, SRGB, rgb_to_xyz, to_linear_srgb
from clpipe.images.read import ReadOptions, read_image, read_source
from clpipe.stage import Kind
from tests.conftest import DATA, ROOT, run_cli
from tests.exr import exr

# Height, width, and the means of red, green and blue in the files of tests/data/openexr. The means
# are from the samples that the OpenEXR package decodes; NumPy applied windows, chroma and
# chromaticities. Chromaticities_XYZ has the means of the same crop of its sRGB version,
# Chromaticities/Rec709.exr.
PICTURES = {
    "Beachball_multipart": (64, 96, 0.16145, 0.39802, 0.26212),
    "Chromaticities_XYZ": (96, 128, 1.31317, 0.31803, 0.23258),
    "DisplayWindow_t03": (280, 370, 0.0053378, 0.0062066, 0.74247),
    "DisplayWindow_t08": (401, 501, 0.0044798, 0.0054853, 0.44204),
    "DisplayWindow_t13": (101, 101, 0, 9.803e-05, 0),
    "LuminanceChroma_Flowers": (64, 784, 0.69151, 0.70532, 1.80984),
    "ScanLines_Cannon": (96, 128, 0.31781, 0.32564, 0.30412),
    "ScanLines_Carrots": (96, 128, 0.19549, 0.13658, 0.11362),
    "ScanLines_Desk": (96, 128, 8.0272, 7.4736, 3.6098),
    "TestImages_AllHalfValues": (256, 256, *[65504 / 256**2] * 3),  # one of them is infinite
    "TestImages_BrightRingsNanInf": (800, 800, 27.790, 27.790, 27.790),
    "TestImages_GrayRampsHorizontal": (800, 800, 0.64293, 0.64293, 0.64293),
    "TestImages_WideColorGamut": (800, 800, 1.0991, 0.96227, 1.0819),
    "Tiles_GoldenGate": (100, 150, 0.17151, 0.13147, 0.30627),
    "world_night": (256, 1024, 0.23914, 0.20376, 0.16248),
}
REFUSALS = {
    "MultiResolution_ColorCodedLevels": "a texture",
    "v2_LowResLeftView_Trunks": "a deep image",
}
ACES = (0.7347, 0.2653, 0.0, 1.0, 0.0001, -0.077, 0.32168, 0.33767)


def test_every_file_is_in_the_tables():
    assert {p.stem for p in (DATA / "openexr").glob("*.exr")} == {*PICTURES, *REFUSALS}


@pytest.mark.parametrize("name", PICTURES)
def test_the_right_picture(name):
    height, width, *means = PICTURES[name]
    pixels = read_image(DATA / "openexr" / f"{name}.exr").pixels
    assert pixels.shape == (height, width, 3)
    found = pixels.mean((0, 1), dtype=np.float64)
    assert np.allclose(found, means, rtol=2e-4, atol=1e-7), found


@pytest.mark.parametrize("name", REFUSALS)
def test_the_right_refusal(name):
    with pytest.raises(ImageError, match=REFUSALS[name]):
        read_image(DATA / "openexr" / f"{name}.exr")


REFUSED_IN_PEACE = r"""
import re, sys
from pathlib import Path
from clpipe.base.errors import ImageError
from clpipe.images.read import ReadOptions, read_image, read_source
from clpipe.stage import Kind
for path in map(Path, sys.argv[1:]):
    try:
        read_image(path)
        sys.exit(f"{path}: was read")
    except ImageError as error:
        assert str(path) in str(error) and str(error).isprintable(), error
# Not ru_maxrss, which goes on from the process that started this one.
kilobytes = int(re.search(r"VmHWM:\s+(\d+)", Path("/proc/self/status").read_text())[1])
assert kilobytes < 2 << 20, kilobytes
"""


def refused(*paths: Path) -> None:
    """Read files in a process of their own: all are rejected, and it takes less than 2 GiB."""
    command = [sys.executable, "-W", "error", "-c", REFUSED_IN_PEACE, *map(str, paths)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stderr


@pytest.mark.slow
def test_damaged_files_cost_nothing(tmp_path):
    """Each file is read under its own name and with .exr appended, which selects the reader."""
    with zipfile.ZipFile(DATA / "openexr" / "damaged.zip") as archive:
        damaged = [tmp_path / name for name in archive.namelist()]
        archive.extractall(tmp_path)
    assert len(damaged) == 23
    renamed = [path.with_name(f"{path.name}.exr") for path in damaged]
    for path, copy in zip(damaged, renamed, strict=True):
        copy.write_bytes(path.read_bytes())
    refused(*damaged, *renamed)


def test_luminance_and_chroma(tmp_path):
    """A picture comes back from luminance and chroma where its colours change linearly."""
    height, width = 12, 18
    y = np.random.default_rng(0).uniform(0.2, 2, (height, width)).astype(np.float16)
    across = np.arange(width) / width / 2
    red = np.broadcast_to(across, y.shape)
    blue = -np.broadcast_to(across, y.shape)
    path = tmp_path / "yc.exr"
    channels = {"Y": (y, 1), "RY": (red[::2, ::2], 2), "BY": (blue[::2, ::2], 2)}
    path.write_bytes(exr(channels, width, height))
    source = read_image(path)
    r, g, b = np.moveaxis(source.pixels[:, :-1], -1, 0)
    y, red, blue = y[:, :-1], red[:, :-1], blue[:, :-1]
    assert np.allclose(r, (red + 1) * y, rtol=1e-3)
    assert np.allclose(b, (blue + 1) * y, rtol=1e-3)
    assert np.allclose(0.2126 * r + 0.7152 * g + 0.0722 * b, y, rtol=1e-3)
    for cut in (300, 400, len(path.read_bytes()) - 9):
        path.write_bytes(path.read_bytes()[:cut])
        with pytest.raises(ImageError, match=r"yc\.exr: .*(damaged|cannot be read)"):
            read_image(path)
    path.write_bytes(exr({"Y": (y[:, :2], 1), "U": (red[::2, :1], 2)}, 2, height))
    with pytest.raises(
        ImageError, match=r"subsampled channels U, Y, but clpipe reads only Y, RY, BY"
    ):
        read_image(path)


def with_chromaticities(pixels, path, *chromaticities, **more):
    channels = {c: (pixels[..., i], 1) for i, c in enumerate("RGB")}
    kinds = {8: "chromaticities", 2: "v2f"}
    given = {"chromaticities": chromaticities, **more} if chromaticities else more
    attributes = [(n, kinds[len(v)], struct.pack(f"<{len(v)}f", *v)) for n, v in given.items()]
    path.write_bytes(exr(channels, pixels.shape[1], pixels.shape[0], attributes=attributes))
    return read_image(path)


def test_other_primaries_become_those_of_srgb(tmp_path):
    grey = np.full((4, 6, 3), 0.5)
    path = tmp_path / "a.exr"
    source = with_chromaticities(grey, path, *ACES)
    assert np.allclose(source.pixels, 0.5, atol=1e-6)  # white stays white
    assert source.warnings == ("its colours were converted to linear sRGB",)
    srgb = np.random.default_rng(0).random((4, 6, 3))
    source = with_chromaticities(srgb @ rgb_to_xyz(SRGB).T, path, *CIE_XYZ)
    assert np.allclose(source.pixels, srgb, atol=4e-3)
    source = with_chromaticities(srgb, path, *SRGB)
    assert source.pixels.dtype == np.float16
    assert not source.warnings
    for primaries in (SRGB, ()):
        source = with_chromaticities(grey, path, *primaries, adoptedNeutral=(0.3457, 0.3585))
        assert source.pixels[0, 0, 2] > source.pixels[0, 0, 0]  # what D50 is becomes neutral
    for wrong in (
        (0,) * 8,
        (np.nan,) * 8,
        (*SRGB[:6], 0.3, 0),
        (*SRGB[:2] * 3, 0.3, 0.3),
        (1, -3e38, *SRGB[2:]),
    ):
        with pytest.raises(
            ImageError, match=r"a\.exr: its chromaticities, .*, do not describe a red"
        ):
            with_chromaticities(grey, path, *wrong)


def test_the_matrix_of_aces_is_the_usual_one():
    """ACES2065-1 to linear sRGB with Bradford, as other programs have it built in."""
    usual = [
        [2.52169, -1.13413, -0.38756],
        [-0.27648, 1.37272, -0.09624],
        [-0.01538, -0.15298, 1.16835],
    ]
    assert np.allclose(to_linear_srgb(ACES), usual, atol=5e-4)


def test_xyz_channels_are_a_picture_but_normals_are_not(write_exr):
    srgb = np.random.default_rng(0).random((4, 6, 3)).astype(np.float32)
    xyz = srgb @ rgb_to_xyz(SRGB).T
    assert np.allclose(read_image(write_exr("x.exr", xyz, "X,Y,Z", False)).pixels, srgb, atol=1e-5)
    with pytest.raises(ImageError, match=r"no R, G and B channels; found N\.X, N\.Y, N\.Z"):
        read_image(write_exr("n.exr", xyz, "N.X,N.Y,N.Z"))


def test_luminance_alone_is_grey(write_exr):
    pixels = np.arange(24, dtype=np.float32).reshape(4, 6, 1)
    source = read_image(write_exr("y.exr", pixels, "Y"))
    assert np.array_equal(source.pixels, np.repeat(pixels, 3, axis=-1))
    assert source.warnings == ("the file has only luminance, so the picture is grey",)
    with pytest.raises(ImageError, match="no R, G and B channels; found Y, Cb, Cr"):
        read_image(write_exr("ycc.exr", np.repeat(pixels, 3, axis=-1), "Y,Cb,Cr"))


def multipart(path, parts):
    """An EXR of parts, {name: channels}; part i holds i + 1."""
    specs = []
    for name, channels in parts.items():
        spec = oiio.ImageSpec(6, 4, len(channels), oiio.HALF)
        spec.channelnames = tuple(channels)
        spec.attribute("oiio:subimagename", name)
        specs.append(spec)
    file = oiio.ImageOutput.create(str(path))
    assert file.open(str(path), tuple(specs))
    for i, spec in enumerate(specs):
        assert i == 0 or file.open(str(path), spec, "AppendSubimage")
        assert file.write_image(np.full((4, 6, spec.nchannels), i + 1, np.float32))
    assert file.close()
    return path


def test_the_layer(tmp_path, write_exr):
    channels = [f"{layer}.{c}" for layer in ("diffuse", "Beauty", "N") for c in "RGB"]
    pixels = np.repeat(np.arange(1, 4, dtype=np.float32), 3) * np.ones((4, 6, 9), np.float32)
    one = write_exr("one.exr", pixels, ",".join(channels))
    parts = {
        "right": "RGBA",
        "depth": "Z",
        "left": "RGB",
        "View.Combined": ["View.Combined." + c for c in "RGB"],
    }
    many = multipart(tmp_path / "many.exr", parts)
    for path, layer, value, called in (
        (one, None, 2, "Beauty"),
        (one, "Diffuse", 1, "diffuse"),
        (many, None, 4, "View.Combined"),
        (many, "left", 3, "left"),
    ):
        source = read_image(path, layer=layer)
        assert (source.pixels[0, 0, 0], source.layer) == (value, called)
    for path, listed in ((one, "Beauty, N, diffuse"), (many, "right, left, View.Combined")):
        with pytest.raises(ImageError, match=f"no layer 'x' with a picture; its layers: {listed}"):
            read_image(path, layer="x")
    run = ("run", one, "-o", tmp_path / "out", "--layer")
    assert "its layers: Beauty, N, diffuse" in run_cli(*run, "depth", status=1).output
    run_cli(*run, "diffuse")
    assert "--layer" in run_cli(*run, "diffuse", "--start-at", "normalize", status=2).output


@pytest.mark.parametrize(
    "compression", ["none", "rle", "zips", "zip", "piz", "pxr24", "b44", "b44a", "dwaa", "dwab"]
)
@pytest.mark.parametrize("tile", [0, 16])
@pytest.mark.parametrize("format_", [oiio.HALF, oiio.FLOAT])
def test_compressions(tmp_path, compression, tile, format_):
    across = np.linspace(0, 1, 50, dtype=np.float32)[None, :, None]
    pixels = across * np.linspace(0.5, 1, 40, dtype=np.float32)[:, None, None] * [1, 0.5, 0.2]
    spec = oiio.ImageSpec(50, 40, 3, format_)
    spec.attribute("compression", compression)
    spec.tile_width = spec.tile_height = tile
    path = tmp_path / "a.exr"
    file = oiio.ImageOutput.create(str(path))
    assert file.open(str(path), spec)
    assert file.write_image(pixels.astype(np.float32))
    assert file.close()
    stored = oiio.ImageInput.open(str(path)).spec()
    assert stored.tile_width == tile
    assert stored.getattribute("compression").split(":")[0] == compression
    lossy = compression in ("b44", "b44a", "dwaa", "dwab")
    assert np.abs(read_image(path).pixels - pixels).max() < (0.01 if lossy else 6e-4)


@pytest.mark.parametrize("ending", ["hdr", "tif"])
def test_other_formats(tmp_path, ending):
    pixels = np.random.default_rng(0).random((8, 10, 3)).astype(np.float32)
    path = tmp_path / f"a.{ending}"
    file = oiio.ImageOutput.create(str(path))
    assert file.open(str(path), oiio.ImageSpec(10, 8, 3, oiio.FLOAT))
    assert file.write_image(pixels)
    assert file.close()
    found = read_image(path).pixels
    assert np.allclose(found, pixels, atol=0.005)
    assert found.dtype == np.float32


@pytest.mark.slow
def test_mutated_files_make_no_traceback_hang_or_crash():
    """A few of every kind; ``tools/stress/fuzz.py --cases 20000`` tries more."""
    command = [sys.executable, "-m", "tools.stress.fuzz", "--cases", "200"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=1200)
    assert done.returncode == 0, done.stdout + done.stderr
    assert re.search(r"\d+ read, \d+ rejected", done.stdout)


@pytest.mark.parametrize(("transfer", "light"), [("linear", 0.5), ("srgb", 0.21404)])
@pytest.mark.parametrize("ending", ["png", "tif"])
def test_renders_in_whole_numbers_with_a_stated_transfer(tmp_path, ending, transfer, light):
    path = tmp_path / f"render.{ending}"
    pixels = np.full((8, 12, 3), 32768, np.uint16)
    file = oiio.ImageOutput.create(str(path))
    assert file.open(str(path), oiio.ImageSpec(12, 8, 3, oiio.UINT16))
    assert file.write_image(pixels) and file.close()
    found = read_source(path, Kind.RGB, ReadOptions(transfer=transfer)).pixels
    assert found.shape == (8, 12, 3) and found == pytest.approx(light, abs=1e-4)
    run_cli("run", tmp_path, "-o", tmp_path / "out", "--transfer", transfer)
    assert (tmp_path / "out" / "render.jpg").is_file()
    without = run_cli("run", path, "-o", tmp_path / "out", status=1)
    assert "add --transfer srgb or --transfer linear" in without.output


def test_a_transfer_is_that_of_a_render(tmp_path):
    (tmp_path / "a.png").touch()
    command = ("run", tmp_path, "-o", "out", "--transfer", "srgb", "-c", "unprocess")
    assert "--transfer: this option is only for renders" in run_cli(*command, status=2).output
