"""Frames of clips as pictures. The path of a frame is that of its clip with a number: a.mp4/000012.

H.264, H.265, FFV1 and everything else that FFmpeg decodes are read through PyAV. Samples are sRGB,
whichever of the usual curves the clip states, because that is how players show them.
"""

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from fractions import Fraction
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from clpipe.base.digests import stamp_of
from clpipe.base.errors import ImageError
from clpipe.base.extras import require
from clpipe.base.types import Array
from clpipe.images.pixels import check_size
from clpipe.images.png import PRIMARIES
from clpipe.images.video_reading import (
    VIDEO_SUFFIXES,
    opened_video,
    to_rgb,
    video_errors,
    video_stream,
)
from clpipe.images.vocabularies import CLIP

if TYPE_CHECKING:
    import av

DIGITS = 6  # of a frame's number, at least
RECENT = 8  # decoded frames that are kept, because threads ask for frames almost in order
MAX_SKIPPED = 48  # frames that are decoded in vain rather than searched for
KEYS = 3  # key frames before a frame at which decoding is tried
MAX_OPEN = 16  # clips that stay open

LOSSLESS_COLOURS = ("rgb24", "bgr24", "bgr0", "gbrp")  # of 8 bits

# Codes of ITU-T H.273 (2024), tables 2 and 3.
CHROMATICITIES = {code: PRIMARIES[code] for code in (9, 11, 12)}
SRGB_LIKE = (1, 2, 5, 6, 7)  # BT.709, none, and those of BT.601, which are near
SDR_CURVES = (1, 2, 4, 5, 6, 7, 13, 14, 15)
CURVES = {8: "linear light", 16: "PQ (SMPTE ST 2084)", 18: "HLG (ARIB STD-B67)"}


@dataclass(frozen=True)
class ClipFrame:
    """A frame of a clip.

    Args:
        pixels: (height, width, 3) uint8 or uint16, upright, in full range.
        chromaticities: x and y of red, green, blue and white; None means sRGB.
        warnings: sentences about what the clip states and clpipe does not use.
    """

    pixels: Array
    chromaticities: Any
    warnings: tuple[str, ...]


def clip_of(path: Path) -> Path | None:
    """Return the clip that a path names a frame of, or None.

    >>> clip_of(Path("a.png")) is None
    True
    """
    if not path.name.isdecimal():  # first, because it is fast
        return None
    clip = path.parent
    return clip if clip.suffix.lower() in VIDEO_SUFFIXES and clip.is_file() else None


def frame_path(clip: Path, number: int) -> Path:
    """Return the path of a frame, from 0.

    >>> frame_path(Path("a.mp4"), 12).as_posix()
    'a.mp4/000012'
    """
    return clip / f"{number:0{DIGITS}}"


def clip_times(clip: Path) -> tuple[Fraction, ...]:
    """Return the times of a clip's frames in s, in ascending order, from 0.

    Raises:
        RequestError: PyAV is missing.
        ImageError: the clip cannot be read.
    """
    return _reader(clip, stamp_of(clip)).times


def clip_size(clip: Path) -> tuple[int, int]:
    """Return the width and height in px of a clip's frames.

    Raises:
        RequestError, ImageError: as for :func:`clip_times`.
    """
    return _reader(clip, stamp_of(clip)).size


def read_clip_frame(path: Path, max_pixels: int) -> ClipFrame:
    """Read a frame of a clip.

    Args:
        path: its path, see :func:`frame_path`.
        max_pixels: a larger frame is rejected.

    Raises:
        RequestError: PyAV is missing.
        ImageError: there is no such frame, it cannot be decoded, or the clip is not SDR.
    """
    check_size(path, *clip_size(path.parent), max_pixels)
    with _frame(path) as (reader, frame):
        if frame.color_trc not in SDR_CURVES:
            curve = CURVES.get(frame.color_trc, f"number {frame.color_trc} of ITU-T H.273")
            raise ImageError(
                f"{path}: the transfer curve of this clip is {curve}, but clpipe reads clips as "
                "sRGB; convert it to SDR first"
            )
        chromaticities = CHROMATICITIES.get(frame.color_primaries)
        return ClipFrame(_upright(frame, to_rgb), chromaticities, tuple(reader.warnings(frame)))


def read_clip_samples(path: Path) -> Array:
    """Read a frame of a clip of depths or labels: its whole numbers, unchanged.

    Args:
        path: its path, see :func:`frame_path`.

    Returns:
        (height, width) for a grey clip, of 8 or 16 bits; else (height, width, 3).

    Raises:
        RequestError, ImageError: as for :func:`read_clip_frame`, or the clip keeps no numbers.
    """
    with _frame(path) as (reader, frame):
        name = frame.format.name
        if not reader.is_lossless or not (name.startswith("gray") or name in LOSSLESS_COLOURS):
            raise ImageError(
                f"{path}: this clip has the codec {reader.codec} and pixels of {name}, which do "
                "not keep depths or labels; use FFV1 with grey of 8 to 16 bits"
            )
        return _upright(frame, _grey if name.startswith("gray") else to_rgb)


@contextmanager
def _frame(path: Path) -> "Iterator[tuple[_Reader, av.VideoFrame]]":
    """Yield a frame, which no other thread uses meanwhile, and the reader of its clip.

    PyAV crashes if two threads convert one frame.
    """
    reader = _reader(path.parent, stamp_of(path.parent))
    frame, guard = reader.frame(path, int(path.name))
    with guard:
        yield reader, frame


def _upright(frame: "av.VideoFrame", convert: "Callable[[av.VideoFrame], Array]") -> Array:
    return np.ascontiguousarray(np.rot90(convert(frame), frame.rotation // 90))


def _grey(frame: "av.VideoFrame") -> Array:
    """Return the numbers of a grey frame, of 8 to 16 bits, as they are stored."""
    (plane,) = frame.planes
    order = ">" if frame.format.name.endswith("be") else "<"
    dtype = np.uint8 if frame.format.components[0].bits == 8 else np.dtype(f"{order}u2")
    return np.frombuffer(plane, dtype).reshape(plane.height, -1)[:, : plane.width]


@lru_cache(maxsize=MAX_OPEN)
def _reader(clip: Path, _stamp: object) -> "_Reader":
    return _Reader(clip)


class _Reader:
    """Decodes the frames of a clip, in any order, but fastest in theirs."""

    def __init__(self, clip: Path) -> None:
        require(f"{clip}: reading a video", "video")
        from av.error import FFmpegError

        self._clip = clip
        self._lock = threading.Lock()  # guards what decodes
        with opened_video(clip) as (container, stream):
            packets = [p for p in container.demux(stream) if p.size and not p.is_discard]
            rate, base = stream.average_rate or Fraction(24), stream.time_base or Fraction(1)
            self.size = stream.width, stream.height
            self.codec = stream.codec_context.name
            self.is_lossless = stream.codec_context.codec.lossless
            self._stated, self._notes = _statements(container, stream)
            with suppress(FFmpegError, StopIteration):  # reading a frame then reports damage
                container.seek(0)
                if next(container.decode(stream)).rotation % 180:
                    self.size = self.size[::-1]
            is_avi = container.format.name == "avi"
            is_alone, duration = len(container.streams) == 1, container.duration or 0
        stamps = sorted({packet.pts for packet in packets if packet.pts is not None})
        # Some files have no times, or not for each frame. AVI has times of decoding only.
        if len(stamps) < len(packets) or is_avi:
            stamps = []
        self._stamps = stamps
        self._numbers = {stamp: number for number, stamp in enumerate(stamps)}
        self._keys = sorted(self._numbers[p.pts] for p in packets if p.is_keyframe and stamps)
        self._broken = len(packets)  # the first frame that decoding from the start does not reach
        # Times of Matroska are rounded to milliseconds.
        regular = [number / rate for number in range(len(packets))]
        times = [(stamp - stamps[0]) * base for stamp in stamps]
        rounded = all(abs(a - b) < base for a, b in zip(times, regular, strict=bool(times)))
        self.times = tuple(regular if rounded else times)
        last = [Fraction(), *self.times][-1] + (stamps[0] * base if stamps else 0)
        if is_alone and duration / 10**6 > last + 2 / rate:
            self._notes.append(
                f"it states a duration of {duration / 10**6:.6g} s, but its last frame is at "
                f"{float(last):.6g} s, so it may be truncated"
            )
        self._container: Any = None
        self._decoded: Iterator[av.VideoFrame] = iter(())
        self._next = 0  # the number of the frame that is decoded next
        # Decoded frames, each with the lock of the thread that converts it.
        self._recent: dict[int, tuple[av.VideoFrame, threading.Lock]] = {}

    def warnings(self, frame: "av.VideoFrame") -> list[str]:
        """Return a sentence for each statement that is not used."""
        pixels = frame.format.name
        stated = {**self._stated, "interlaced": frame.interlaced_frame}
        stated["alpha"] = "yuva" in pixels or pixels[:4] in ("rgba", "bgra", "argb", "abgr", "gbra")
        return [*self._notes, *CLIP.warnings(name for name, value in stated.items() if value)]

    def frame(self, path: Path, number: int) -> "tuple[av.VideoFrame, threading.Lock]":
        """Return a decoded frame, and the lock to hold while it is converted.

        Raises:
            ImageError: there is no such frame, or it cannot be decoded.
        """
        if number >= len(self.times):
            raise ImageError(f"{path}: this clip has {len(self.times)} frames, from 0")
        with self._lock, video_errors(path, "decoded"):
            if number not in self._recent:
                self._decode(number)
            found = self._recent.get(number)
        if found is None:
            raise ImageError(f"{path}: this frame is damaged, and cannot be decoded")
        return found

    def _decode(self, number: int) -> None:
        """Decode frames up to one, which is then among the recent ones if it is intact.

        Decoding begins at the key frame before it. If that fails, because frames refer to those
        before their key frame, it begins earlier, and at last at the beginning of the file.
        """
        from av.error import FFmpegError

        before = [key for key in self._keys if key <= number][: -KEYS - 1 : -1]
        starts = [each for each in (*before, 0) if each or number < self._broken]
        if self._container is None or not 0 <= number - self._next <= MAX_SKIPPED:
            self._seek(starts.pop(0) if starts else 0, "AUTO")
        error: FFmpegError | None = None
        while True:
            try:
                self._advance(number)
                error = None
            except FFmpegError as caught:
                error = caught
            if number in self._recent:
                return
            if not starts:
                break
            start = starts.pop(0)
            self._seek(start, "AUTO" if start else "NONE")  # threads report later errors
        self._broken = min(self._broken, number)
        if error:
            raise error

    def _advance(self, number: int) -> None:
        """Decode the next frames, up to one or to the end of the file."""
        try:
            for frame in self._decoded:
                found = self._numbers.get(frame.pts, -1) if self._stamps else self._next
                self._recent[found] = frame, threading.Lock()
                self._next = found + 1
                if len(self._recent) > RECENT:
                    del self._recent[next(iter(self._recent))]
                if found >= number:
                    return
        finally:
            if self._next <= number:  # the file has ended, or is damaged
                self._container = None

    def _seek(self, number: int, threads: str) -> None:
        """Continue at a key frame, or at the beginning."""
        import av

        self._container = av.open(self._clip)
        stream = video_stream(self._clip, self._container)
        stream.thread_type = threads
        stream.codec_context.options = {"err_detect": "explode"}  # otherwise damage is hidden
        self._next = 0
        if number:
            self._container.seek(self._stamps[number], stream=stream)
            self._next = number
        self._decoded = self._container.decode(stream)


def _statements(container: Any, stream: Any) -> tuple[dict[str, Any], list[str]]:
    """Return what a clip states about all frames, by names of :data:`CLIP`, and sentences."""
    aspect = stream.sample_aspect_ratio or stream.codec_context.sample_aspect_ratio
    names = dict.fromkeys((*container.metadata, *stream.metadata), True)
    notes = []
    if len(container.streams.video) > 1:
        notes.append("it has several video streams; only the first one was read")
    primaries = stream.codec_context.color_primaries
    if primaries not in (*SRGB_LIKE, *CHROMATICITIES):
        text = "its primaries, number {} of ITU-T H.273, are not known; it is read as sRGB"
        notes.append(text.format(primaries))
    return {"sample_aspect_ratio": aspect and aspect != 1, **names}, notes
