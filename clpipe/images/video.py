"""Writes video files through PyAV: H.264, H.265 and lossless FFV1, in MP4 and Matroska.

Samples are sRGB, with the primaries of BT.709. Files state the curve as IEC 61966-2-1, which
players with colour management show like a JPEG. Other players ignore the curve and send the samples
to an sRGB display, which is also right. With the curve of BT.709, some players brighten the
shadows.

The same frames give the same bytes: the number of threads is fixed, and files have no dates and no
random numbers. Another version of an encoder may give other bytes.
"""

from contextlib import ExitStack
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, Self

import numpy as np

from clpipe.base.about import __version__
from clpipe.base.cpu_time import CpuTimer
from clpipe.base.errors import ImageError, RequestError
from clpipe.base.extras import require
from clpipe.base.files import atomic_file
from clpipe.base.types import Array
from clpipe.images.video_reading import FULL, LIMITED, video_errors
from clpipe.images.ycbcr import BT709, encode_420

if TYPE_CHECKING:
    import av

Codec = Literal["h264", "h265", "ffv1"]

CONTAINERS = {".mp4": "mp4", ".mkv": "matroska"}  # files that are written, with FFmpeg's names

DEFAULT_CRF = 18  # noise looks like in the frames
H265_WIDTH = 64  # px; of some narrower pictures, x265 4.2 writes outside its memory
REORDERED = 2  # the most frames that x265 waits for before it knows decoding times
THREADS = 4  # of an encoder; their number changes the bytes of H.264

# Codes of ITU-T H.273 (2024), tables 2 to 4.
BT709_PRIMARIES, SRGB_CURVE, RGB_MATRIX = 1, 13, 0

# The encoder and pixel format of each codec and depth.
ENCODERS: dict[tuple[str, int], tuple[str, str]] = {
    ("h264", 8): ("libx264", "yuv420p"),
    ("h264", 10): ("libx264", "yuv420p10le"),
    ("h265", 8): ("libx265", "yuv420p"),
    ("h265", 10): ("libx265", "yuv420p10le"),
    ("ffv1", 8): ("ffv1", "bgr0"),
    ("ffv1", 10): ("ffv1", "gbrp10le"),
}


@dataclass(frozen=True)
class VideoOptions:
    """How a video is encoded.

    Args:
        codec: h264, h265, or ffv1, which is lossless.
        bits: bits per sample, 8 or 10.
        crf: the constant rate factor, 0 to 51. Smaller is better. None is :data:`DEFAULT_CRF`.
        bit_rate: the mean bit rate in bits per second, instead of ``crf``.
        rate: frames per second.
        has_times: whether frames have times of their own, instead of equal intervals.

    Raises:
        RequestError: the values do not fit together.

    >>> VideoOptions("ffv1", crf=20)
    Traceback (most recent call last):
    clpipe.base.errors.RequestError: found crf 20, but ffv1 is lossless; remove crf and bit_rate
    """

    codec: Codec = "h264"
    bits: int = 8
    crf: int | None = None
    bit_rate: int | None = None
    rate: Fraction = Fraction(24)
    has_times: bool = False

    def __post_init__(self) -> None:
        if (self.codec, self.bits) not in ENCODERS:
            allowed = ", ".join(f"{codec} with {bits} bits" for codec, bits in ENCODERS)
            raise RequestError(f"found {self.codec} with {self.bits} bits; expected {allowed}")
        if self.rate <= 0:
            raise RequestError(f"found a frame rate of {self.rate}; expected one above 0")
        rates = {"crf": self.crf, "bit_rate": self.bit_rate}
        found = [f"{name} {value}" for name, value in rates.items() if value is not None]
        if len(found) > 1:
            raise RequestError(f"found {' and '.join(found)}; remove one of them")
        if found and self.is_lossless:
            raise RequestError(f"found {found[0]}, but ffv1 is lossless; remove crf and bit_rate")

    @property
    def time_base(self) -> Fraction:
        """The unit of times in s: an interval between frames, or 1/90000 for other times."""
        return Fraction(1, 90000) if self.has_times else 1 / self.rate

    @property
    def is_lossless(self) -> bool:
        """Whether decoded frames equal the encoded ones, up to rounding to ``bits``."""
        return self.codec == "ffv1"

    def check_suffix(self, suffix: str) -> None:
        """Check that files with an extension, such as ".mp4", may contain the codec.

        Raises:
            RequestError: they may not.
        """
        allowed = (".mkv",) if self.is_lossless else tuple(CONTAINERS)
        if suffix not in allowed:
            raise RequestError(
                f"found a {suffix} file for {self.codec}; expected {' or '.join(allowed)}"
            )

    def check_size(self, width: int, height: int) -> None:
        """Check that the codec can store frames of a size in px.

        Raises:
            ImageError: the width or height is odd, but chroma has half the resolution; or the
                encoder cannot encode such narrow pictures.
        """
        if not self.is_lossless and (width % 2 or height % 2):
            raise ImageError(
                f"the picture has {width}x{height} px, but {self.codec} needs an even width and "
                "height; resize it, or use the codec ffv1"
            )
        if self.codec == "h265" and width < H265_WIDTH:
            raise ImageError(
                f"the picture has {width}x{height} px, but h265 needs a width of {H265_WIDTH} px "
                "at least; use the codec h264 or ffv1"
            )


class VideoWriter:
    """Writes a video. The file appears when the context ends without an error.

    >>> import tempfile
    >>> from clpipe.images.video_reading import read_video
    >>> folder = tempfile.TemporaryDirectory()
    >>> path = Path(folder.name, "clip.mkv")
    >>> with VideoWriter(path, VideoOptions("ffv1")) as video:
    ...     for level in (10, 20):
    ...         video.add(np.full((24, 32, 3), level, np.uint8))
    >>> [int(frame[0, 0, 0]) for frame in read_video(path)]
    [10, 20]
    >>> folder.cleanup()

    Args:
        path: the file, .mp4 or .mkv.
        options: how it is encoded.

    Raises:
        RequestError: the container does not fit the codec, or PyAV is missing.
        ImageError: on leaving the context, the file cannot be written, or there are no frames.
    """

    def __init__(self, path: Path, options: VideoOptions) -> None:
        options.check_suffix(path.suffix)
        require("a video", "video")
        self.path = path
        self.options = options
        self.count = 0
        self._last = -1  # the time of the last frame, in units of the time base
        self._stack = ExitStack()

    def __enter__(self) -> Self:
        import av

        with ExitStack() as stack:
            stack.enter_context(video_errors(self.path, "written"))
            file = stack.enter_context(atomic_file(self.path))
            self._container = stack.enter_context(
                av.open(file, "w", CONTAINERS[self.path.suffix], {"fflags": "+bitexact"})
            )
            self._container.metadata["comment"] = f"clpipe {__version__}"
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *error: Any) -> None:
        with self._stack:
            if error[1]:
                raise error[1]  # the file is then removed
            if not self.count:
                raise ImageError(f"{self.path}: there are no frames for this video")
            packets = self._stream.encode(None)
            if self.count <= REORDERED:
                for packet in packets:  # x265 leaves their decoding times undefined
                    packet.dts = packet.pts
            self._container.mux(packets)

    @CpuTimer("encode")
    def add(self, frame: Array, time: Fraction | None = None) -> None:
        """Add the next frame.

        Args:
            frame: (height, width, 3) sRGB, uint8 for 8 bits, or uint16 in full range for 10 bits.
            time: when it is shown, in s; None is an interval after the frame before.

        Raises:
            ImageError: its size differs from that of the first frame, or is odd; or the file
                cannot be written.
        """
        options = self.options
        assert frame.dtype == (np.uint8 if options.bits == 8 else np.uint16)
        height, width = frame.shape[:2]
        if not self.count:
            options.check_size(width, height)
            self._stream = self._new_stream(width, height)
        stream = self._stream
        if (width, height) != (stream.width, stream.height):
            raise ImageError(
                f"{self.path}: frame {self.count} has {width}x{height} px, but the frames before "
                f"it have {stream.width}x{stream.height} px; frames of one video have one size"
            )
        encoded = self._frame(frame)
        encoded.time_base = options.time_base
        given = self.count / options.rate if time is None else time
        encoded.pts = self._last = max(round(given / options.time_base), self._last + 1)
        self._container.mux(stream.encode(encoded))
        self.count += 1

    def _new_stream(self, width: int, height: int) -> "av.VideoStream":
        """Return a new stream for frames of a size in px."""
        options = self.options
        name, pixels = ENCODERS[options.codec, options.bits]
        stream = self._container.add_stream(name, rate=options.rate)
        stream.width, stream.height, stream.pix_fmt = width, height, pixels
        stream.time_base = options.time_base
        context = stream.codec_context
        context.time_base = options.time_base
        context.thread_count = THREADS
        context.color_primaries, context.color_trc = BT709_PRIMARIES, SRGB_CURVE
        context.colorspace = RGB_MATRIX if options.is_lossless else BT709
        context.color_range = FULL if options.is_lossless else LIMITED
        if options.is_lossless:
            context.options = {"level": "3", "slices": "4", "slicecrc": "1"}
            context.gop_size = 1
            return stream
        if options.bit_rate is not None:
            stream.bit_rate = options.bit_rate
        else:
            context.options = {"crf": str(DEFAULT_CRF if options.crf is None else options.crf)}
        if options.codec == "h265":
            # FFmpeg's thread count does not fix the threads of x265.
            x265 = f"log-level=error:pools={THREADS}:frame-threads=2"
            context.options = {**context.options, "x265-params": x265}
            if self.path.suffix == ".mp4":
                context.codec_tag = "hvc1"  # required by Apple's players
        return stream

    def _frame(self, frame: Array) -> "av.VideoFrame":
        """Return PyAV's frame of an array, in the pixel format of the stream."""
        import av

        bits = self.options.bits
        height, width = frame.shape[:2]
        if self.options.is_lossless:
            if bits == 8:
                return av.VideoFrame.from_ndarray(frame, "rgb24").reformat(format="bgr0")
            levels = np.rint(frame * np.float32(1023 / 65535)).astype(np.uint16)
            return av.VideoFrame.from_ndarray(levels, "gbrp10le")
        planes = encode_420(frame, bits)
        encoded = av.VideoFrame(width, height, ENCODERS[self.options.codec, bits][1])
        for plane, samples in zip(encoded.planes, planes, strict=True):
            line = np.zeros((plane.height, plane.line_size // samples.itemsize), samples.dtype)
            line[:, : plane.width] = samples
            plane.update(line)
        return encoded
