"""Metadata about a picture's samples is applied, or named in a warning."""

import json
import struct
import zlib

import numpy as np
import OpenEXR
import OpenImageIO as oiio
import pytest
from PIL import Image, ImageCms

from clpipe import Dataset
from clpipe.base.errors import ImageError
from clpipe.images.colour import SRGB, to_linear_srgb
from clpipe.images.read import ReadOptions, read_finished, read_image, read_source
from clpipe.images.tags import upright
from clpipe.reference.transfer import inverse_srgb_curve
from clpipe.stage import Kind
from tests.conftest import run_cli

HEIGHT, WIDTH = 6, 8
Y, X = np.mgrid[:HEIGHT, :WIDTH].astype(np.float32)
LIGHT = np.stack([0.1 + 0.02 * X + 0.05 * Y, 0.2 + 0.03 * X, 0.3 + 0.01 * Y], -1)
CODES = np.stack([40 + 10 * X, 60 + 15 * Y, 90 + 0 * X], -1).astype(np.uint8)
ALPHA = np.tile(np.linspace(0, 255, WIDTH).astype(np.uint8), (HEIGHT, 1))
P3 = (0.680, 0.320, 0.265, 0.690, 0.150, 0.060, 0.3127, 0.3290)
REC_2020 = (0.708, 0.292, 0.170, 0.797, 0.131, 0.046, 0.3127, 0.3290)


def read(path, transfer=None):
    return read_source(path, Kind.RGB, ReadOptions(transfer=transfer))


def linear(codes):
    return inverse_srgb_curve(codes / 255)


# Radiance


def write_hdr(path, light=LIGHT, lines=(), size=None, form="rgbe", end="\n"):
    """A Radiance picture of light, by its definition: mantissas are cut off."""
    largest = np.maximum(light.max(-1), 1e-30)
    mantissa, exponent = np.frexp(largest)
    rgbe = np.zeros((*largest.shape, 4), np.uint8)
    rgbe[..., :3] = light * (mantissa * 256 / largest)[..., None]
    rgbe[..., 3] = np.where(light.max(-1) > 0, exponent + 128, 0)
    size = size or f"-Y {light.shape[0]} +X {light.shape[1]}"
    header = ["#?RADIANCE", f"FORMAT=32-bit_rle_{form}", *lines, "", size, ""]
    path.write_bytes(end.join(header).encode() + rgbe.tobytes())
    return path


@pytest.mark.parametrize(
    ("lines", "factors"),
    [
        ((), (1, 1, 1)),
        (("EXPOSURE=2.0",), (2, 2, 2)),
        (("EXPOSURE= 2", "# a comment", "EXPOSURE=0.25"), (0.5, 0.5, 0.5)),
        (("COLORCORR=2 1 0.5", "EXPOSURE=4"), (8, 4, 2)),
    ],
)
@pytest.mark.parametrize("end", ["\n", "\r\n"])
def test_radiance_is_divided_by_what_it_was_multiplied_by(tmp_path, lines, factors, end):
    path = write_hdr(tmp_path / "a.hdr", LIGHT * np.float32(factors), lines, end=end)
    source = read(path)
    step = LIGHT.max(-1, keepdims=True) / 128 / 2  # of the mantissa, halved
    assert (np.abs(source.pixels - LIGHT) <= step * 2 * max(factors) / min(factors)).all()
    assert source.warnings == ()


def test_radiance_is_right_in_the_mean(tmp_path):
    light = np.random.default_rng(0).uniform(0.5, 1, (64, 64, 3)).astype(np.float32)
    found = read(write_hdr(tmp_path / "a.hdr", light)).pixels
    assert found.mean() == pytest.approx(light.mean(), rel=3e-4)  # 3e-3 without the half step
    dark = read(write_hdr(tmp_path / "b.hdr", np.zeros((2, 2, 3), np.float32))).pixels
    assert not dark.any()


def orientations():
    """The size line, and LIGHT as it is stored with it, of all eight orientations."""
    for y in "-+":
        for x in "+-":
            stored = LIGHT[:: 1 if y == "-" else -1, :: 1 if x == "+" else -1]
            yield f"{y}Y {HEIGHT} {x}X {WIDTH}", stored
            yield f"{x}X {WIDTH} {y}Y {HEIGHT}", stored.swapaxes(0, 1)


@pytest.mark.parametrize(("size", "stored"), [*orientations()])
def test_radiance_of_every_orientation(tmp_path, size, stored):
    source = read(write_hdr(tmp_path / "a.hdr", stored, size=size))
    assert source.pixels == pytest.approx(LIGHT, rel=0.01)


def test_radiance_with_other_primaries(tmp_path):
    primaries = "PRIMARIES=" + " ".join(map(str, P3))
    source = read(write_hdr(tmp_path / "a.hdr", LIGHT, (primaries,)))
    assert source.pixels == pytest.approx(LIGHT @ to_linear_srgb(P3).T, abs=0.01)
    assert "its colours were converted to linear sRGB" in source.warnings
    xyz = np.float32([[0.9505, 1.0, 1.0891]]) * np.linspace(0.1, 1, 12, dtype=np.float32)[:, None]
    source = read(write_hdr(tmp_path / "b.hdr", xyz.reshape(3, 4, 3), form="xyze"))
    assert source.pixels == pytest.approx(
        np.repeat(np.linspace(0.1, 1, 12).reshape(3, 4, 1), 3, -1), rel=0.02
    )


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("EXPOSURE=0", "expected 1 positive number"),
        ("EXPOSURE=bright", "expected 1 positive number"),
        ("COLORCORR=1 2", "expected 3 positive numbers"),
        ("PRIMARIES=0.6 nan", "expected 8 numbers"),
        ("FORMAT=png", "its FORMAT is 'png'"),
    ],
)
def test_a_radiance_header_that_is_wrong(tmp_path, line, message):
    with pytest.raises(ImageError, match=rf"a\.hdr: .*{message}"):
        read(write_hdr(tmp_path / "a.hdr", lines=(line,)))


def test_pixels_that_are_not_square_are_named(tmp_path, write_exr):
    source = read(write_hdr(tmp_path / "a.hdr", lines=("PIXASPECT=0.5",)))
    assert source.warnings == (
        "its pixel aspect ratio of 2 is not applied; pixels are read as square",
    )
    planes = {c: np.ones((4, 4), np.float32) for c in "RGB"}
    header = {"pixelAspectRatio": 2.0, "whiteLuminance": 250.0}
    OpenEXR.File(header, planes).write(str(tmp_path / "a.exr"))
    aspect, white = read(tmp_path / "a.exr").warnings
    assert "aspect ratio of 2 " in aspect and "whiteLuminance of 250 cd/m2" in white


# PFM


@pytest.mark.parametrize("end", ["\n", "\r\n"])
@pytest.mark.parametrize(("scale", "order"), [("-1.0", "<f4"), ("1.0", ">f4")])
@pytest.mark.parametrize("comment", ["", "# made by hand{end}"])
def test_pfm_headers(tmp_path, end, scale, order, comment):
    header = f"PF{end}{comment.format(end=end)}{WIDTH} {HEIGHT}{end}{scale}{end}"
    path = tmp_path / "a.pfm"
    path.write_bytes(header.encode() + LIGHT[::-1].astype(order).tobytes())
    source = read(path)
    assert np.array_equal(source.pixels, LIGHT) and source.warnings == ()


# TIFF


def write_tiff(path, pixels, type_=oiio.FLOAT, names="R,G,B", **attributes):
    spec = oiio.ImageSpec(pixels.shape[1], pixels.shape[0], pixels.shape[2], type_)
    spec.channelnames = tuple(names.split(","))
    if spec.channelnames[-1] == "A":
        spec.alpha_channel = pixels.shape[2] - 1
    for name, value in attributes.items():
        spec.attribute(name.replace("__", ":"), value)
    file = oiio.ImageOutput.create(str(path))
    assert file.open(str(path), spec) and file.write_image(pixels) and file.close()
    return path


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize("type_", [oiio.FLOAT, oiio.HALF, oiio.UINT8, oiio.UINT16])
def test_tiff_orientation(tmp_path, orientation, type_):
    path = write_tiff(tmp_path / "a.tif", LIGHT, type_, Orientation=orientation)
    source = read(path, "linear")
    assert source.pixels == pytest.approx(upright(LIGHT, orientation), abs=0.003)


def test_the_finished_picture_is_turned_once(tmp_path):
    for name, type_ in (("float.tif", oiio.FLOAT), ("whole.tif", oiio.UINT16)):
        write_tiff(tmp_path / name, np.repeat(LIGHT, 4, 0), type_, Orientation=6)
    run_cli(
        *("run", tmp_path, "-o", tmp_path / "out", "--transfer", "linear", "--device", "numpy"),
        *("--skip", "noise", "--format", "png"),
    )
    one, two = (np.asarray(Image.open(tmp_path / f"out/{n}.png"), int) for n in ("float", "whole"))
    assert one.shape == (WIDTH, 4 * HEIGHT, 3)
    assert np.abs(one - two).max() <= 1


@pytest.mark.parametrize("type_", [oiio.UINT8, oiio.FLOAT])
def test_alpha_of_tiff(tmp_path, type_):
    """Straight alpha multiplies light; premultiplied light is unchanged."""
    share = ALPHA[..., None] / np.float32(255)
    straight = np.concatenate([LIGHT, share], -1)
    path = write_tiff(tmp_path / "a.tif", straight, type_, "R,G,B,A", oiio__UnassociatedAlpha=1)
    assert read(path, "linear").pixels == pytest.approx(LIGHT * share, abs=0.004)
    associated = np.concatenate([LIGHT * share, share], -1)
    path = write_tiff(tmp_path / "b.tif", associated, type_, "R,G,B,A")
    assert read(path, "linear").pixels == pytest.approx(LIGHT * share, abs=0.004)


@pytest.mark.parametrize(
    ("type_", "largest"),
    [
        *((oiio.UINT8, 2**8 - 1), (oiio.UINT16, 2**16 - 1), (oiio.UINT32, 2**32 - 1)),
        *((oiio.INT16, 2**15 - 1), (oiio.INT32, 2**31 - 1)),
    ],
)
def test_whole_numbers_of_any_size(tmp_path, type_, largest):
    for channels, names in ((3, "R,G,B"), (1, "Y")):
        path = write_tiff(tmp_path / f"{names}.tif", LIGHT[..., :channels], type_, names)
        found = read(path, "linear").pixels
        assert found == pytest.approx(LIGHT if channels == 3 else LIGHT[..., [0] * 3], abs=0.004)
        assert np.ptp(found * largest) > 1


@pytest.mark.parametrize("bits", [1, 8, 16, 32])
def test_tiff_with_zero_as_white(tmp_path, bits):
    path = tmp_path / "a.tif"
    stored = LIGHT[..., 0] if bits > 1 else (X > 3).astype(np.float32)
    if bits == 1:
        Image.fromarray(X > 3).save(path)
    else:
        write_tiff(path, stored[..., None], getattr(oiio, f"UINT{bits}"), "Y")
    data = path.read_bytes()
    tag = struct.pack("<HHI", 262, 3, 1)  # PhotometricInterpretation
    assert tag + b"\1" in data
    path.write_bytes(data.replace(tag + b"\1", tag + b"\0"))
    assert read(path, "linear").pixels[..., 0] == pytest.approx(1 - stored, abs=0.003)


@pytest.mark.parametrize("compression", ["zstd", "lzma"])
def test_tiff_that_openimageio_cannot_decode(tmp_path, compression):
    Image.fromarray(CODES).save(tmp_path / "a.tif", compression=compression)
    assert read(tmp_path / "a.tif", "srgb").pixels == pytest.approx(linear(CODES), abs=1e-5)
    Image.fromarray(LIGHT[..., 0]).save(tmp_path / "b.tif", compression=compression)
    with pytest.raises(
        ImageError, match=rf"b\.tif: its compression, {compression.upper()}, cannot"
    ):
        read(tmp_path / "b.tif")


def test_pages_of_tiff_are_named(tmp_path):
    pages = [Image.fromarray(CODES), Image.fromarray(CODES[::-1].copy())]
    pages[0].save(tmp_path / "a.tif", save_all=True, append_images=pages[1:])
    source = read(tmp_path / "a.tif", "srgb")
    assert source.warnings == ("it has several pages; only the first one was read",)
    assert source.pixels == pytest.approx(linear(CODES), abs=1e-5)


# PNG and other finished pictures


@pytest.mark.parametrize("ending", ["png", "tif", "tga", "webp"])
def test_straight_alpha_multiplies_light(tmp_path, ending):
    path = tmp_path / f"a.{ending}"
    options = {"lossless": True, "exact": True} if ending == "webp" else {}
    Image.fromarray(np.dstack([CODES, ALPHA]), "RGBA").save(path, **options)
    share = ALPHA[..., None] / 255
    assert read(path, "srgb").pixels == pytest.approx(linear(CODES) * share, abs=1e-5)
    shown = read_finished(path)
    assert shown.pixels * 255 == pytest.approx(CODES, abs=1e-3)
    assert shown.warnings == ("its alpha channel is not used",)


def test_palette_and_grey_with_transparency(tmp_path):
    index = (X + Y).astype(np.uint8)
    palette = Image.fromarray(index, "P")
    palette.putpalette(bytes(range(90, 90 + 42)))
    palette.save(tmp_path / "palette.png", transparency=3)
    colours = np.arange(90, 132).reshape(14, 3)[index]
    expected = linear(colours) * (index != 3)[..., None]
    assert read(tmp_path / "palette.png", "srgb").pixels == pytest.approx(expected, abs=1e-5)
    Image.fromarray(index * 10).save(tmp_path / "grey.png", transparency=30)
    expected = (linear(index * 10.0) * (index != 3))[..., None].repeat(3, -1)
    assert read(tmp_path / "grey.png", "srgb").pixels == pytest.approx(expected, abs=1e-5)


@pytest.mark.parametrize("ending", ["png", "tif", "bmp", "tga", "webp", "jpg"])
def test_grey_pictures(tmp_path, ending):
    path = tmp_path / f"a.{ending}"
    Image.fromarray(CODES[..., 0]).save(path, **({"lossless": True} if ending == "webp" else {}))
    near = 0.01 if ending == "jpg" else 1e-5
    expected = linear(CODES[..., [0] * 3])
    assert read(path, "srgb").pixels == pytest.approx(expected, abs=near)
    run_cli(
        *("run", path, "-o", tmp_path / "out", "-c", "unprocess", "--device", "numpy"),
        *("--skip", "noise", "--format", "png"),
    )
    assert np.asarray(Image.open(tmp_path / "out" / "a.png")).shape == (HEIGHT, WIDTH, 3)


def test_a_grey_picture_of_eight_bits_is_measured(tmp_path):
    random = np.random.default_rng(0)
    for name in ("truth", "noisy"):
        pixels = np.full((64, 64), 128.0) + (name == "noisy") * random.normal(0, 8, (64, 64))
        Image.fromarray(pixels.round().astype(np.uint8)).save(tmp_path / f"{name}.png")
    truth = ("--truth", tmp_path / "truth.png", "--json")
    report = json.loads(run_cli("measure", tmp_path / "noisy.png", *truth).stdout)
    sigma = report["channels"]["R"]["sigma_picture"]
    assert sigma * 255 == pytest.approx(8, rel=0.05)


def test_one_bit_and_sixteen_bits_in_grey(tmp_path):
    Image.fromarray(X > 3).save(tmp_path / "bit.png")
    assert np.array_equal(read(tmp_path / "bit.png", "srgb").pixels[..., 0], X > 3)
    Image.fromarray((LIGHT[..., 0] * 65535).astype(np.uint16)).save(tmp_path / "deep.png")
    found = read(tmp_path / "deep.png", "linear").pixels
    assert found[..., 1] == pytest.approx(LIGHT[..., 0], abs=1e-4)
    both = Image.fromarray(np.dstack([CODES[..., 0], ALPHA]), "LA")
    both.save(tmp_path / "both.png")
    expected = linear(CODES[..., 0]) * ALPHA / 255
    assert read(tmp_path / "both.png", "srgb").pixels[..., 2] == pytest.approx(expected, abs=1e-5)


def with_chunks(path, **chunks):
    """Return a PNG of CODES with further chunks after its header."""
    Image.fromarray(CODES).save(path)
    data = path.read_bytes()
    made = b"".join(
        struct.pack(">I", len(content)) + name.encode() + content
        + struct.pack(">I", zlib.crc32(name.encode() + content))
        for name, content in chunks.items()
    )  # fmt: skip
    path.write_bytes(data[:33] + made + data[33:])
    return path


def integers(*values):
    return struct.pack(f">{len(values)}I", *(round(value * 100_000) for value in values))


@pytest.mark.parametrize(
    ("chunks", "primaries", "warning"),
    [
        ({"gAMA": integers(1 / 2.2)}, SRGB, ""),
        ({"sRGB": b"\0", "gAMA": integers(0.7)}, SRGB, ""),
        ({"gAMA": integers(1.0)}, SRGB, "transfer curve linear is not applied; it is read as srgb"),
        (
            {"gAMA": integers(1 / 1.8)},
            SRGB,
            "transfer curve gamma 1.8 (gAMA chunk) is not applied; it is read as srgb",
        ),
        ({"cHRM": integers(*P3[6:], *P3[:6])}, P3, ""),
        ({"cICP": bytes([12, 13, 0, 1])}, P3, ""),
        (
            {"cICP": bytes([9, 16, 0, 1]), "gAMA": integers(1)},
            REC_2020,
            "PQ (cICP chunk) is not applied; it is read as",
        ),
        ({"cICP": bytes([99, 13, 0, 1])}, SRGB, "cICP chunk states unknown primaries 99"),
    ],
)
def test_colours_of_png(tmp_path, chunks, primaries, warning):
    source = read(with_chunks(tmp_path / "a.png", **chunks), "srgb")
    matrix = to_linear_srgb(primaries)
    expected = linear(CODES) if matrix is None else linear(CODES) @ matrix.T
    assert source.pixels == pytest.approx(expected, abs=1e-5)
    named = [each for each in source.warnings if "converted to linear sRGB" not in each]
    assert len(named) == bool(warning)
    assert warning in "".join(named)


@pytest.mark.parametrize("ending", ["png", "jpg", "tif", "webp"])
def test_an_icc_profile_is_named(tmp_path, ending):
    srgb = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    wide = srgb.replace("sRGB".encode("utf-16-be"), "Wide".encode("utf-16-be"))
    Image.fromarray(CODES).save(tmp_path / f"wide.{ending}", icc_profile=wide)
    Image.fromarray(CODES).save(tmp_path / f"srgb.{ending}", icc_profile=srgb)
    (warning,) = read(tmp_path / f"wide.{ending}", "srgb").warnings
    assert warning == "its ICC profile, Wide built-in, is not applied; it is read as sRGB"
    assert read_finished(tmp_path / f"wide.{ending}").warnings == (warning,)
    assert read(tmp_path / f"srgb.{ending}", "srgb").warnings == ()


@pytest.mark.parametrize(
    ("data", "name"),
    [
        (b"GIF89a" + bytes(20), "GIF"),
        (b"\0\0\0\x0cjP  " + bytes(20), "JPEG 2000"),
        (b"\0\0\0\x20ftypheic" + bytes(20), "HEIC"),
        (b"8BPS" + bytes(20), "Photoshop"),
        (b"P6\n8 6\n255\n" + bytes(144), "PNM"),
    ],
)
def test_a_format_that_is_not_read_is_named(tmp_path, data, name):
    path = tmp_path / "a.png"
    path.write_bytes(data)
    with pytest.raises(ImageError, match=rf"it is a {name} file; .* Convert it") as error:
        read_image(path)
    assert "damaged" not in str(error.value)


def test_a_warning_is_printed_once_in_a_run(tmp_path):
    for name in "abc":
        write_hdr(tmp_path / f"{name}.hdr", lines=("PIXASPECT=2",))
    done = run_cli("run", tmp_path, "-o", tmp_path / "out", "--device", "numpy")
    assert done.stderr.count("pixel aspect ratio of 0.5 is not applied") == 2  # once, and counted
    assert "3 images have this warning: its pixel aspect ratio" in done.stderr
    sidecars = [json.loads(each.read_text()) for each in (tmp_path / "out").glob("*.json")]
    assert sum("aspect" in str(each["warnings"]) for each in sidecars) == 3


def test_a_dataset_warns_once(tmp_path):
    for name in "abc":
        write_hdr(tmp_path / f"{name}.hdr", lines=("PIXASPECT=2",))
    dataset = Dataset(tmp_path, device="numpy", threads=1)
    with pytest.warns(UserWarning, match="aspect ratio of 0.5") as caught:
        assert len(list(dataset)) == 3
    assert sum("aspect ratio" in str(each.message) for each in caught) == 1
