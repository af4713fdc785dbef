"""Reads video files through PyAV: what they state, and their frames as RGB."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from clpipe.base.errors import ImageError
from clpipe.base.extras import require
from clpipe.base.types import Array
from clpipe.images.pixels import DEFAULT_MAX_PIXELS, check_size
from clpipe.images.ycbcr import BT709, WEIGHTS, decode

if TYPE_CHECKING:
    import av

VIDEO_SUFFIXES = (".mp4", ".mkv", ".mov", ".webm", ".avi")  # files that are read as videos
LIMITED, FULL = 1, 2  # FFmpeg's numbers of ranges


@dataclass(frozen=True)
class VideoInfo:
    """What a video file states. Codes of colours are those of ITU-T H.273.

    Args:
        codec: FFmpeg's name of the codec, such as "hevc" for H.265.
        tag: the container's code of the codec, such as "hvc1".
        width, height: size in px.
        bits: bits per sample.
        rate: frames per second.
        frames: the number of frames.
        primaries, curve, matrix: codes of colours; 2 is unknown.
        is_full: whether samples have full range.
    """

    codec: str
    tag: str
    width: int
    height: int
    bits: int
    rate: Fraction
    frames: int
    primaries: int
    curve: int
    matrix: int
    is_full: bool


def video_info(path: Path) -> VideoInfo:
    """Return what a video file states.

    Raises:
        RequestError: PyAV is missing.
        ImageError: the file cannot be read, or contains no video.
    """
    with opened_video(path) as (container, stream):
        context = stream.codec_context
        assert context.format
        return VideoInfo(
            codec=context.name,
            tag=context.codec_tag.strip("\0"),
            width=context.width,
            height=context.height,
            bits=context.format.components[0].bits,
            rate=stream.average_rate or Fraction(0),
            frames=stream.frames or sum(packet.size > 0 for packet in container.demux(stream)),
            primaries=context.color_primaries,
            curve=context.color_trc,
            matrix=context.colorspace,
            is_full=context.color_range == FULL,
        )


def read_video(path: Path) -> Iterator[Array]:
    """Yield the frames of a video as RGB. Only one of them is in memory at a time.

    Chroma is interpolated linearly. The file's matrix and range are used. A file without a matrix
    has BT.709 if its height is at least 720 px, else BT.601.

    Returns:
        Frames, (height, width, 3) uint8 for 8 bits, else uint16; full range.

    Raises:
        RequestError: PyAV is missing.
        ImageError: the file cannot be read, or contains no video.
    """
    with opened_video(path) as (container, stream):
        stream.thread_type = "AUTO"
        for frame in container.decode(stream):
            yield to_rgb(frame)


def to_rgb(frame: "av.VideoFrame") -> Array:
    """Return a decoded frame as RGB, (height, width, 3), see :func:`read_video`."""
    bits = frame.format.components[0].bits
    if frame.format.is_rgb:
        if bits == 8 or not frame.format.name.startswith("gbrp"):
            return frame.to_ndarray(format="rgb24" if bits == 8 else "rgb48le")
        scale = np.float32(65535 / (2**bits - 1))
        return np.rint(frame.to_ndarray() * scale).astype(np.uint16)
    is_full = frame.color_range == FULL or frame.format.name.startswith("yuvj")
    matrix = frame.colorspace
    if matrix not in WEIGHTS:
        matrix = BT709 if frame.height >= 720 else 6
    if frame.format.name not in ("yuv420p", "yuvj420p", "yuv420p10le"):
        # A conversion without another matrix and range copies luma, and interpolates chroma.
        bits = 8 if bits == 8 else 10
        frame = frame.reformat(format="yuv444p" if bits == 8 else "yuv444p10le")
    dtype = np.uint8 if bits == 8 else np.uint16
    planes = [
        np.frombuffer(plane, dtype).reshape(plane.height, -1)[:, : plane.width]
        for plane in frame.planes
    ]
    return decode(planes, bits, matrix, is_full)


@contextmanager
def opened_video(path: Path) -> Iterator[tuple[Any, Any]]:
    """Open a video file for reading, and yield its container and first video stream."""
    require(f"{path}: reading a video", "video")
    import av

    with video_errors(path, "read"), av.open(path) as container:
        yield container, video_stream(path, container)


def video_stream(path: Path, container: Any) -> Any:
    """Return the first video stream of an open container.

    Raises:
        ImageError: there is none, or its frames are too large.
    """
    if not container.streams.video:
        raise ImageError(f"{path}: this file contains no video")
    stream = container.streams.video[0]
    check_size(path, stream.width, stream.height, DEFAULT_MAX_PIXELS)
    return stream


@contextmanager
def video_errors(path: Path, done: str) -> Iterator[None]:
    """Convert FFmpeg's errors in the ``with`` block to an ImageError about a file."""
    from av.error import FFmpegError

    try:
        yield
    except FFmpegError as error:
        raise ImageError(f"{path}: this video cannot be {done}: {error.strerror}") from None
