"""Clips as inputs: their frames, times, colours, and what they state."""

import json
import re
from concurrent.futures import ThreadPoolExecutor
from fractions import Fraction
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
from PIL import Image

import clpipe as api
from clpipe.base.errors import ImageError, RequestError
from clpipe.images.claims import display_size
from clpipe.images.clip_frames import _reader, clip_times, frame_path, read_clip_frame
from clpipe.images.video import VideoOptions, VideoWriter
from clpipe.images.video_reading import read_video
from clpipe.inputs.find import find_jobs
from tests.conftest import statuses

av = pytest.importorskip("av", reason="needs PyAV: pip install av")

COUNT = 130  # so that frames are far from their key frames
LIMIT = 10**6  # px


def pictures(count=COUNT, size=(32, 64)):
    """Return pictures that differ in each frame."""
    texture = np.random.default_rng(0).integers(0, 100, (*size, 3)).astype(np.uint8)
    return [np.roll(texture, n, 1) + np.uint8(n % 130) for n in range(count)]


def write(path, codec="ffv1", count=COUNT, **options):
    with VideoWriter(Path(path), VideoOptions(codec, **options)) as video:
        for each in pictures(count):
            video.add(each if video.options.bits == 8 else each.astype(np.uint16) * 257)
    return Path(path)


def read(clip, number):
    return read_clip_frame(frame_path(Path(clip), number), LIMIT).pixels


def encode(path, frames, **context):
    """Write a clip with any pixel format and tags, FFV1 in .mkv and H.264 in .mp4."""
    with av.open(path, "w") as file:
        stream = file.add_stream("ffv1" if Path(path).suffix == ".mkv" else "libx264", rate=25)
        stream.height, stream.width = frames[0].height, frames[0].width
        stream.pix_fmt = frames[0].format.name
        for name, value in context.items():
            setattr(stream.codec_context, name, value)
        for number, frame in enumerate(frames):
            frame.pts = number
            file.mux(stream.encode(frame))
        file.mux(stream.encode(None))
    return Path(path)


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("a.mkv", {"codec": "ffv1"}),
        ("b.mkv", {"codec": "ffv1", "bits": 10}),
        ("c.mp4", {"codec": "h264"}),
        ("d.mp4", {"codec": "h265", "bits": 10}),
        ("e.mkv", {"codec": "h264"}),
    ],
)
def test_frames_are_the_same_in_any_order(tmp_path, name, options):
    clip = write(tmp_path / name, **options)
    expected = list(read_video(clip))
    rng = np.random.default_rng(1)
    for number in (*rng.permutation(COUNT)[:40], COUNT - 1, 0, 1, 2):
        assert np.array_equal(read(clip, int(number)), expected[number])
    with ThreadPoolExecutor(4) as threads:
        found = list(threads.map(lambda number: read(clip, number), range(COUNT)))
    assert all(map(np.array_equal, found, expected))


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("open.mp4", {"x264-params": "b-adapt=0:bframes=3:keyint=7:open-gop=1:scenecut=0"}),
        ("open.mkv", {"x264-params": "b-adapt=0:bframes=3:keyint=7:open-gop=1:scenecut=0"}),
        ("b.avi", {"bf": "3"}),
    ],
)
def test_frames_that_need_those_before_their_key_frame(tmp_path, name, options):
    """Open groups of pictures; and AVI, which has no times of presentation."""
    path = tmp_path / name
    with av.open(path, "w") as file:
        stream = file.add_stream("libx264", rate=25, options={"crf": "1", **options})
        stream.height, stream.width, stream.pix_fmt = 32, 64, "yuv420p"
        for number in range(40):
            grey = np.full((32, 64, 3), 20 + 5 * number, np.uint8)
            file.mux(stream.encode(av.VideoFrame.from_ndarray(grey, "rgb24")))
        file.mux(stream.encode(None))
    for number in (*np.random.default_rng(0).permutation(40), 5, 6, 20, 6):
        _reader.cache_clear()
        found = read(path, int(number)).mean()
        assert abs(found - 20 - 5 * number) < 2


def test_several_threads_may_read_one_frame(tmp_path):
    clip = write(tmp_path / "a.mkv", count=2)
    expected = list(read_video(clip))
    with ThreadPoolExecutor(8) as threads:
        found = list(threads.map(lambda number: read(clip, number // 100 % 2), range(1000)))
    assert all(np.array_equal(each, expected[n // 100 % 2]) for n, each in enumerate(found))


@pytest.mark.parametrize("rate", [24, Fraction(30000, 1001), 60])
@pytest.mark.parametrize("name", ["a.mkv", "a.mp4"])
def test_times_of_a_constant_rate_are_exact(tmp_path, name, rate):
    codec = "ffv1" if name.endswith("mkv") else "h264"
    clip = write(tmp_path / name, codec, 20, rate=Fraction(rate))
    assert clip_times(clip) == tuple(n / Fraction(rate) for n in range(20))


def test_a_clip_becomes_a_noisy_clip_with_its_times(clpipe):
    times = [Fraction(each, 1000) for each in (0, 40, 80, 180, 220, 240)]
    with VideoWriter(Path("in.mkv"), VideoOptions("ffv1", has_times=True)) as video:
        for each, time in zip(pictures(6), times, strict=True):
            video.add(each, time)
    assert clip_times(Path("in.mkv")) == tuple(times)
    options = ("-c", "unprocess", "--iso", 3200, "--device", "numpy", "--codec", "ffv1")
    stderr = clpipe("run", "in.mkv", "-o", "out.mkv", *options).stderr
    assert "1 sequence of 6 frames, 25 frames per second from their times: in" in stderr
    assert "1 of 7 frames are missing" in stderr  # between 80 and 180 ms
    assert clip_times(Path("out.mkv")) == tuple(times)


def test_frames_are_like_pngs_of_them(clpipe):
    """Names, noise and pictures are those of a directory of pictures."""
    write("film.mkv", count=3)
    Path("png").mkdir()
    for number, each in enumerate(pictures(3)):
        Image.fromarray(each).save(f"png/{number:06}.png")
    options = ("-c", "unprocess", "--device", "numpy", "--format", "png", "--set", "noise_key=a")
    options = options[:-2]
    clpipe("run", "film.mkv", "-o", "a", *options, "--skip", "noise")
    clpipe("run", "png", "-o", "b", *options, "--skip", "noise")
    for number in range(3):
        found = np.asarray(Image.open(f"a/film/{number:06}.png"))
        assert np.array_equal(found, np.asarray(Image.open(f"b/{number:06}.png")))


def test_a_second_run_makes_nothing_and_a_changed_clip_all(clpipe):
    write("film.mkv", count=3)
    run = ("run", "film.mkv", "-o", "out", "-c", "unprocess", "--device", "numpy")
    clpipe(*run)
    for redo in ("missing", "damaged"):
        clpipe(*run, "--redo", redo)
        assert [*statuses("out").values()] == ["skipped"] * 3
    write("film.mkv", count=4)
    clpipe(*run)
    assert [*statuses("out").values()] == ["done"] * 4


def test_a_frame_can_be_replayed(clpipe):
    write("film.mkv", count=3)
    clpipe("run", "film.mkv", "-o", "out", "-c", "unprocess", "--device", "numpy")
    sidecar = "out/film/000001.json"
    assert json.loads(Path(sidecar).read_text())["input"] == "film.mkv/000001"
    assert "the same bytes" in clpipe("replay", sidecar, "-o", "again", "--device", "numpy").output
    write("film.mkv", count=4)
    assert "this file has changed" in clpipe("replay", sidecar, "-o", "more", status=2).stderr


def test_the_settings_of_a_run_name_frames(clpipe):
    write("film.mkv", count=3)
    options = ("-c", "unprocess", "--device", "numpy")
    clpipe("run", "film.mkv", "-o", "a", "--sequence", *options)
    clpipe("run", "a/run.csv", "-o", "b", *options)
    for number in range(3):
        name = f"film/{number:06}.jpg"
        assert Path("a", name).read_bytes() == Path("b", name).read_bytes()


def test_clips_of_a_directory(clpipe):
    Path("in/x").mkdir(parents=True)
    write("in/a.mkv", count=2)
    write("in/x/b.mp4", "h264", count=2)
    Image.fromarray(pictures(1)[0]).save("in/c.png")
    jobs = find_jobs(["in"], Path("o"), endings=(".mkv", ".mp4", ".png"))
    assert [job.key for job in jobs] == [
        "a/000000",
        "a/000001",
        "c.png",
        "x/b/000000",
        "x/b/000001",
    ]
    assert [job.time for job in jobs[:3]] == [0, Fraction(1, 24), None]


def test_a_render_of_a_clip_is_linear_light(clpipe):
    write("film.mkv", count=2)
    options = ("--transfer", "srgb", "--until", "exposure", "--format", "exr", "--device", "numpy")
    clpipe("run", "film.mkv", "-o", "out", *options)
    assert Path("out/film/000001.exr").is_file()


def test_a_clip_without_a_way_to_read_it_is_rejected(clpipe):
    write("film.mkv", count=2)
    stderr = clpipe("run", "film.mkv", "-o", "out", status=2).stderr
    assert "film.mkv: this is a clip. Finished pictures are not linear light. For renders" in stderr
    Path("list.csv").write_text("path\nfilm.mkv\n")
    stderr = clpipe("run", "list.csv", "-o", "out", "-c", "unprocess", status=2).stderr
    assert "film.mkv is a clip; list its frames, such as film.mkv/000000" in stderr
    Path("list.csv").write_text("path\nfilm.mkv/000007\nfilm.mkv/000001\n")
    run = ("run", "list.csv", "-o", "out", "--device", "numpy")
    stderr = clpipe(*run, "-c", "unprocess", status=1).stderr
    assert "film.mkv/000007" in stderr and "this clip has 2 frames, from 0" in stderr
    assert Path("out/film.mkv/000001.jpg").is_file()
    stderr = clpipe("run", "list.csv", "-o", "p", "--device", "numpy", status=1).stderr
    assert "a frame of a clip is no linear light. For a render, add --transfer srgb" in stderr


def test_a_damaged_clip_fails_alone(clpipe):
    write("a.mkv", count=2)
    Path("b.mkv").write_bytes(b"no clip")
    run = ("run", "a.mkv", "b.mkv", "-o", "out", "-c", "unprocess", "--device", "numpy")
    stderr = clpipe(*run, status=1).stderr
    assert "b.mkv: this video cannot be read" in stderr
    assert len([*Path("out/a").glob("*.jpg")]) == 2
    stderr = clpipe("run", "b.mkv", "-o", "c.mp4", "-c", "unprocess", status=1).stderr
    assert "b.mkv: this video cannot be read" in stderr


def test_frames_after_a_damaged_one_are_read(tmp_path):
    clip = write(tmp_path / "a.mp4", "h264", 300)
    intact = list(read_video(clip))
    data = bytearray(clip.read_bytes())
    middle = len(data) // 2
    data[middle : middle + 1000] = bytes(1000)
    clip.write_bytes(data)
    is_right: list[bool] = []
    errors = []
    for number in range(300):
        try:
            is_right.append(np.array_equal(read(clip, number), intact[number]))
        except ImageError as error:
            is_right.append(False)
            errors.append(str(error))
    # H.264 has no checksums, so some of the frames up to the next key frame may only be wrong.
    assert all(is_right[:100]) and all(is_right[260:]) and errors
    assert all(re.search("video cannot be decoded|frame is damaged", each) for each in errors)


@pytest.mark.parametrize(("angle", "turns"), [(90, 1), (180, 2), (-90, 3)])
def test_rotated_clips_are_upright(tmp_path, angle, turns):
    """An angle is anticlockwise, as FFmpeg prints it."""
    path = tmp_path / "a.mp4"
    picture = pictures(1)[0]
    picture[:16, :24] = 255
    with av.open(path, "w") as file:
        stream = file.add_stream("libx264", rate=25, options={"crf": "1"})
        stream.height, stream.width, stream.pix_fmt = 32, 64, "yuv420p"
        stream.set_display_rotation(angle)
        for _ in range(2):
            file.mux(stream.encode(av.VideoFrame.from_ndarray(picture, "rgb24")))
        file.mux(stream.encode(None))
    expected = np.rot90(picture, turns).mean(-1) > 200
    assert display_size(frame_path(path, 0)) == expected.shape[::-1]
    assert ((read(path, 1).mean(-1) > 200) == expected).mean() > 0.95


@pytest.mark.parametrize("range_", [1, 2])
@pytest.mark.parametrize("matrix", [1, 5])
def test_range_and_matrix_are_those_of_the_clip(tmp_path, range_, matrix):
    grey = pictures(1)[0]
    frame = av.VideoFrame.from_ndarray(grey, "rgb24")
    colours = {5: "ITU601", 1: "ITU709"}
    frame = frame.reformat(
        format="yuv444p",
        dst_colorspace=colours[matrix],
        dst_color_range={1: "MPEG", 2: "JPEG"}[range_],
    )
    clip = encode(tmp_path / "a.mkv", [frame], colorspace=matrix, color_range=range_)
    assert np.abs(read(clip, 0).astype(int) - grey).max() <= 3


@pytest.mark.parametrize(
    ("curve", "message"), [(16, "is PQ (SMPTE ST 2084)"), (18, "is HLG"), (8, "is linear light")]
)
def test_clips_for_other_displays_are_rejected(tmp_path, curve, message):
    frame = av.VideoFrame.from_ndarray(pictures(1)[0], "rgb24").reformat(format="yuv444p10le")
    clip = encode(tmp_path / "a.mkv", [frame], color_trc=curve)
    with pytest.raises(ImageError, match="convert it to SDR first") as error:
        read(clip, 0)
    assert message in str(error.value)


def test_other_primaries_are_converted(tmp_path):
    grey = np.full((16, 16, 3), 128, np.uint8)
    grey[..., 0] = 200
    frame = av.VideoFrame.from_ndarray(grey, "rgb24").reformat(format="bgr0")
    for primaries, is_converted in ((1, False), (9, True), (2, False)):
        clip = encode(tmp_path / f"{primaries}.mkv", [frame], color_primaries=primaries)
        found = read_clip_frame(frame_path(clip, 0), LIMIT)
        assert (found.chromaticities is not None) == is_converted


def test_what_a_clip_states_and_clpipe_does_not_use_is_named(clpipe):
    rgba = np.full((16, 16, 4), 128, np.uint8)
    frame = av.VideoFrame.from_ndarray(rgba, "rgba").reformat(format="bgra")
    encode("a.mkv", [frame])
    encode("b.mp4", [frame.reformat(format="yuv420p")], sample_aspect_ratio=Fraction(4, 3))
    run = ("run", "a.mkv", "b.mp4", "-o", "out", "-c", "unprocess", "--device", "numpy")
    result = clpipe(*run)
    assert "its sample_aspect_ratio (width of a pixel over its height) is not used" in result.stderr
    assert "its alpha (opacity) is not used" in result.stderr


def test_a_truncated_clip_is_named(clpipe):
    data = write("a.mkv", count=30).read_bytes()
    Path("a.mkv").write_bytes(data[: len(data) // 2])
    write("b.mkv", count=3)
    run = ("run", "a.mkv", "b.mkv", "-o", "out", "-c", "unprocess", "--device", "numpy")
    stderr = clpipe(*run).stderr
    stated = r"a.mkv/0000\d\d: warning: it states a duration of 1\.25 s, but its last frame is at"
    assert re.search(stated, stderr)
    assert not re.search(r"b.mkv/\d+: warning", stderr)


def test_further_streams_and_unknown_primaries_are_named(tmp_path):
    path = tmp_path / "a.mkv"
    pixels = av.VideoFrame.from_ndarray(np.zeros((16, 16, 3), np.uint8), "rgb24")
    with av.open(path, "w") as file:
        streams = [file.add_stream("ffv1", rate=25) for _ in range(2)]
        for stream in streams:
            stream.height, stream.width, stream.pix_fmt = 16, 16, "bgr0"
            stream.codec_context.color_primaries = 22
        for stream in streams:
            file.mux(stream.encode(pixels.reformat(format="bgr0")))
            file.mux(stream.encode(None))
    found = read_clip_frame(frame_path(path, 0), LIMIT).warnings
    assert "it has several video streams; only the first one was read" in found
    assert "its primaries, number 22 of ITU-T H.273, are not known; it is read as sRGB" in found


def test_a_dataset_reads_clips(tmp_path):
    write(tmp_path / "a.mkv", count=3)
    data = api.Dataset(tmp_path / "a.mkv", "unprocess", device="numpy", until="mosaic")
    assert len(data) == 3


def test_a_frame_is_not_larger_than_allowed(tmp_path):
    clip = write(tmp_path / "a.mkv", count=1)
    with pytest.raises(ImageError, match="64x32"):
        read_clip_frame(frame_path(clip, 0), 100)
    with pytest.raises(RequestError, match="a clip at a URL is not read"):
        find_jobs(["memory://a/b.mkv"], tmp_path, endings=(".mkv",))


def depths(count=3, size=(32, 64)):
    """Return depths in mm of 16 bits, which differ in each frame."""
    ramp = np.add.outer(np.arange(size[0]) * 300, np.arange(size[1])).astype(np.uint16)
    return [ramp + np.uint16(20000 * n) for n in range(count)]


@pytest.mark.parametrize("form", ["clip", "ten bits", "folder", "pattern"])
def test_depth_next_to_a_clip_is_carried_without_loss(clpipe, form):
    """A lossless clip of 16 bits, or a directory of PNGs."""
    Path("in").mkdir()
    write("in/film.mkv", count=3)
    carry = "depth"
    expected = depths()
    if form == "clip":
        frames = [av.VideoFrame.from_ndarray(each, "gray16le") for each in expected]
        encode("in/film_depth.mkv", frames)
    elif form == "ten bits":
        expected = [each % 1024 for each in expected]
        frames = [av.VideoFrame(64, 32, "gray10le") for _ in expected]
        for frame, each in zip(frames, expected, strict=True):
            line = np.zeros((32, frame.planes[0].line_size // 2), np.uint16)
            line[:, :64] = each
            frame.planes[0].update(line)
        encode("in/film_depth.mkv", frames)
    else:
        folder = Path("in", "film_depth" if form == "folder" else "z")
        folder.mkdir()
        for number, each in enumerate(depths()):
            Image.fromarray(each).save(folder / f"{number:06}.png")
        carry = "depth" if form == "folder" else "depth=z/{name}.png"
    options = ("-c", "unprocess", "--carry", carry, "--device", "numpy")
    inputs = "in/film.mkv" if form == "pattern" else "in"
    clpipe("run", inputs, "-o", "out", *options)
    assert sorted(path.name for path in Path("out").iterdir() if path.is_dir()) == ["film"]
    for number, each in enumerate(expected):
        with OpenEXR.File(f"out/film/{number:06}.carried.exr") as file:
            (name,) = [each for each in file.channels() if each.lower().startswith("depth")]
            assert np.array_equal(file.channels()[name].pixels, each)


def test_a_clip_that_keeps_no_numbers_is_no_depth(clpipe):
    write("film.mkv", count=1)
    write("film_depth.mp4", "h264", count=1)
    options = ("-c", "unprocess", "--carry", "depth", "--device", "numpy")
    stderr = clpipe("run", "film.mkv", "-o", "out", *options, status=1).stderr
    assert "this clip has the codec h264 and pixels of yuv420p, which do not keep" in stderr


def test_a_frame_or_a_clip_without_frames_is_named_directly(clpipe):
    write("film.mkv", count=3)
    run = ("-o", "out", "-c", "unprocess", "--device", "numpy")
    clpipe("run", "film.mkv/000001", *run)
    clpipe("run", "film.mkv", "-o", "all", *run[2:])
    name = "film/000001.jpg"
    assert Path("out", name).read_bytes() == Path("all", name).read_bytes()
    data = Path("film.mkv").read_bytes()
    Path("cut.mkv").write_bytes(data[: data.index(b"\x1f\x43\xb6\x75")])  # before the cluster
    stderr = clpipe("run", "cut.mkv", *run, status=1).stderr
    assert re.search("cut.mkv: this (clip has no frames|video cannot be read)", stderr)


def test_a_missing_depth_names_where_it_was_looked_for(clpipe):
    write("film.mkv", count=1)
    options = ("-c", "unprocess", "--carry", "depth", "--device", "numpy")
    stderr = clpipe("run", "film.mkv", "-o", "out", *options, status=1).stderr
    assert "there is no film_depth.mkv/000000 or film_depth/000000.png next to its clip" in stderr
