"""Video files: colours, tags, and files that are complete or absent."""

import itertools
import struct
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest

from clpipe.base.errors import ImageError, RequestError
from clpipe.images.video import VideoOptions, VideoWriter
from clpipe.images.video_reading import read_video, video_info

pytest.importorskip("av", reason="needs PyAV: pip install av")

LOSSY = [("h264", 8), ("h264", 10), ("h265", 8), ("h265", 10)]
SIDE = 16  # px of a patch of colour


def patches(bits):
    """27 flat patches of saturated and grey colours, 48x144."""
    levels = np.array([0, 128, 255], np.uint8)
    colours = np.array(list(itertools.product(levels, repeat=3)), np.uint8).reshape(3, 9, 3)
    picture = colours.repeat(SIDE, 0).repeat(SIDE, 1)
    return picture if bits == 8 else picture.astype(np.uint16) * 257


def write(path, frames, *options, **more):
    with VideoWriter(Path(path), VideoOptions(*options, **more)) as video:
        for frame in frames:
            video.add(frame)
    return Path(path)


def middles(frame, bits):
    """The middle of each patch, in levels of ``bits`` bits."""
    return frame[8::SIDE, 8::SIDE] / np.iinfo(frame.dtype).max * (2**bits - 1)


@pytest.mark.parametrize(("codec", "bits"), LOSSY)
def test_saturated_colours_come_back(tmp_path, codec, bits):
    frames = [patches(bits), patches(bits)[::-1]]
    read = list(read_video(write(tmp_path / "a.mp4", frames, codec, bits, crf=1)))
    assert len(read) == 2
    for before, after in zip(frames, read, strict=True):
        assert after.dtype == before.dtype
        assert np.abs(middles(after, bits) - middles(before, bits)).max() <= (2 if bits == 8 else 3)


@pytest.mark.parametrize(("codec", "bits"), LOSSY)
def test_a_gradient_stays_even(tmp_path, codec, bits):
    grey = np.linspace(0, 1, 256) * (255 if bits == 8 else 65535)
    frame = np.broadcast_to(grey[:, None], (64, 256, 3)).astype(np.uint8 if bits == 8 else "u2")
    (read,) = read_video(write(tmp_path / "a.mp4", [frame], codec, bits, crf=1))
    error = (read.astype(float) - frame) / np.iinfo(frame.dtype).max * (2**bits - 1)
    assert np.abs(error).max() <= 3
    assert abs(error.mean()) < 0.1  # a luma of libswscale would be 1.7 levels of 10 bits too high


def test_another_decoder_sees_the_same_colours(tmp_path):
    import av
    from av.video.reformatter import ColorRange, Colorspace

    path = write(tmp_path / "a.mp4", [patches(8)], crf=1)
    with av.open(path) as container:
        frame = next(container.decode(video=0))
    assert (frame.colorspace, frame.color_range) == (Colorspace.ITU709, ColorRange.MPEG)
    rgb = frame.reformat(
        format="rgb24",
        src_colorspace=Colorspace.ITU709,
        src_color_range=ColorRange.MPEG,
        dst_color_range=ColorRange.JPEG,
        interpolation="BICUBIC",
    ).to_ndarray()
    assert np.abs(middles(rgb, 8) - middles(patches(8), 8)).max() <= 4  # libswscale rounds down


@pytest.mark.parametrize("bits", [8, 10])
def test_ffv1_is_lossless(tmp_path, bits):
    rng = np.random.default_rng(0)
    frames = rng.integers(0, 2**bits, (3, 31, 45, 3))  # an odd size
    if bits == 8:
        frames = frames.astype(np.uint8)
    else:
        frames = np.rint(frames * (65535 / 1023)).astype(np.uint16)
    read = list(read_video(write(tmp_path / "a.mkv", frames, "ffv1", bits)))
    assert np.array_equal(read, frames)


@pytest.mark.parametrize("path", ["a.mp4", "a.mkv"])
@pytest.mark.parametrize(("codec", "bits"), LOSSY)
def test_tags_name_the_colours(tmp_path, path, codec, bits):
    rate = Fraction(30000, 1001)
    found = video_info(write(tmp_path / path, [patches(bits)] * 5, codec, bits, rate=rate))
    assert (found.primaries, found.curve, found.matrix, found.is_full) == (1, 13, 1, False)
    assert (found.width, found.height, found.bits) == (144, 48, bits)
    assert (found.rate, found.frames) == (rate, 5)
    if path == "a.mp4":
        assert found.tag == {"h264": "avc1", "h265": "hvc1"}[codec]


def test_tags_of_ffv1(tmp_path):
    found = video_info(write(tmp_path / "a.mkv", [patches(8)], "ffv1"))
    assert (found.primaries, found.curve, found.matrix, found.is_full) == (1, 13, 0, True)


@pytest.mark.parametrize(("codec", "bits"), [*LOSSY, ("ffv1", 8), ("ffv1", 10)])
def test_the_same_frames_give_the_same_bytes(tmp_path, codec, bits):
    rng = np.random.default_rng(0)
    largest = 255 if bits == 8 else 65535
    frames = rng.integers(0, largest, (9, 48, 64, 3)).astype(np.uint8 if bits == 8 else np.uint16)
    for suffix in (".mkv",) if codec == "ffv1" else (".mp4", ".mkv"):
        first, second = (
            write(tmp_path / f"{name}{suffix}", frames, codec, bits) for name in ("a", "b")
        )
        assert first.read_bytes() == second.read_bytes()


@pytest.mark.parametrize("count", [1, 2, 3])
@pytest.mark.parametrize("codec", ["h264", "h265"])
def test_short_videos(tmp_path, codec, count):
    import av

    frames = np.random.default_rng(0).integers(0, 255, (count, 48, 64, 3)).astype(np.uint8)
    files = {write(tmp_path / "a.mp4", frames, codec).read_bytes() for _ in range(10)}
    assert len(files) == 1  # x265 leaves decoding times undefined
    with av.open(tmp_path / "a.mp4") as container:
        times = [frame.time for frame in container.decode(video=0)]
    assert times == pytest.approx([n / 24 for n in range(count)])


def test_a_lower_bit_rate_gives_a_smaller_file(tmp_path):
    rng = np.random.default_rng(0)
    frames = rng.integers(0, 255, (12, 96, 96, 3)).astype(np.uint8)
    sizes = [
        write(tmp_path / "a.mp4", frames, bit_rate=rate).stat().st_size for rate in (10**6, 10**5)
    ]
    assert sizes[1] < sizes[0] / 2


def test_a_file_appears_when_it_is_complete(tmp_path):
    path = tmp_path / "a.mp4"
    path.write_bytes(b"before")

    def frames():
        yield patches(8)
        raise ValueError("mine")

    with pytest.raises(ValueError, match="mine"):
        write(path, frames())
    assert path.read_bytes() == b"before"
    assert [each.name for each in tmp_path.iterdir()] == ["a.mp4"]


def test_a_full_disk(tmp_path, monkeypatch):
    from clpipe.base import files

    monkeypatch.setattr(files, "_create_temporary", lambda _: Path("/dev/full").open("wb"))  # noqa: SIM115
    with pytest.raises(ImageError, match=r"a\.mp4: .*No space left on device"):
        write(tmp_path / "a.mp4", [patches(8)])


@pytest.mark.parametrize(
    ("name", "options", "message"),
    [
        ("a.mp4", {"codec": "ffv1"}, r"found a \.mp4 file for ffv1; expected \.mkv"),
        ("a.avi", {}, r"found a \.avi file for h264; expected \.mp4 or \.mkv"),
        ("a.mp4", {"crf": 20, "bit_rate": 1000}, "crf 20 and bit_rate 1000; remove one"),
        ("a.mkv", {"codec": "ffv1", "bit_rate": 9}, "bit_rate 9, but ffv1 is lossless"),
        ("a.mp4", {"bits": 12}, "found h264 with 12 bits; expected h264 with 8 bits"),
        ("a.mp4", {"rate": Fraction(0)}, "found a frame rate of 0; expected one above 0"),
    ],
)
def test_options_that_do_not_fit(name, options, message):
    with pytest.raises(RequestError, match=message):
        VideoWriter(Path(name), VideoOptions(**options))


def test_frames_that_do_not_fit(tmp_path):
    odd = np.zeros((32, 31, 3), np.uint8)
    with pytest.raises(ImageError, match=r"31x32 px, but h264 needs an even width and height"):
        write(tmp_path / "a.mp4", [odd])
    with pytest.raises(ImageError, match=r"frame 1 has 30x32 px, but .* have 144x48 px"):
        write(tmp_path / "a.mp4", [patches(8), odd[:, :30]])
    with pytest.raises(ImageError, match=r"a\.mp4: there are no frames"):
        write(tmp_path / "a.mp4", [])
    assert not list(tmp_path.iterdir())


def test_files_that_are_no_videos(tmp_path):
    path = tmp_path / "a.mp4"
    path.write_bytes(b"no video" * 100)
    with pytest.raises(ImageError, match=r"a\.mp4: this video cannot be read: Invalid data"):
        video_info(path)
    with pytest.raises(ImageError, match=r"b\.mp4: this video cannot be read: No such file"):
        next(read_video(tmp_path / "b.mp4"))


def test_a_video_that_was_cut_off(tmp_path):
    frames = np.random.default_rng(0).integers(0, 255, (9, 48, 64, 3)).astype(np.uint8)
    whole = write(tmp_path / "a.mkv", frames).read_bytes()
    cut = tmp_path / "b.mkv"
    cut.write_bytes(whole[: len(whole) // 2])
    try:
        assert len(list(read_video(cut))) < 9
    except ImageError as error:
        assert "this video cannot be read" in str(error)


def test_a_huge_size_in_the_header_is_rejected(tmp_path):
    whole = write(tmp_path / "a.mkv", [patches(8)], "ffv1").read_bytes()
    width = bytes.fromhex("b08190")  # Matroska's PixelWidth: one byte, 144
    assert whole.count(width) == 1
    huge = bytes.fromhex("b084") + struct.pack(">I", 10**9)
    (tmp_path / "b.mkv").write_bytes(whole.replace(width, huge))
    with pytest.raises(ImageError):
        list(read_video(tmp_path / "b.mkv"))
