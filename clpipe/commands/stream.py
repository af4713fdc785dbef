"""``clpipe stream``: develop frames from standard input, for programs in any language."""

import json
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext, suppress
from io import BufferedIOBase, BufferedReader
from pathlib import Path
from types import SimpleNamespace
from typing import Any, TextIO, cast

import click
import numpy as np

from clpipe.base.errors import ClpipeError, ImageError, RequestError
from clpipe.base.text import one_line
from clpipe.base.types import Array
from clpipe.chain.keys import KEYS
from clpipe.chain.options import Transfer
from clpipe.commands.chain_options import SETTINGS, device_option, options, set_option, settings_in
from clpipe.commands.options import Command, OutputPath
from clpipe.stream import Stream

HEADERS = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}


@click.command("stream", cls=Command)
@options("config", KEYS["camera"], KEYS["iso"], *SETTINGS, "until", "transfer")
@set_option
@device_option
@click.option(
    "--name",
    default="stream",
    show_default=True,
    help="The name of the sequence, on which noise and draws depend.",
)
@click.option(
    "--drop",
    is_flag=True,
    help="Drop frames that arrive while two others are being developed or written, instead of "
    "letting the sender wait.",
)
@click.option(
    "--log",
    "log_path",
    type=OutputPath(),
    metavar="FILE.jsonl",
    help="A file for a line of JSON for each picture: its frame number, settings and estimates.",
)
def stream(
    selector: str | None,
    config: tuple[str, ...],
    until: str | None,
    transfer: Transfer | None,
    name: str,
    drop: bool,
    log_path: Path | None,
    **others: Any,
) -> None:
    """Develop frames from standard input, and write pictures to standard output.

    Each frame and picture is a NumPy array file (.npy), one after the other. Its header is a text
    with the type and the shape (numpy.org/neps/nep-0001-npy-format.html). Frames are (height,
    width, 3), of float16 or float32, or uint8 with --transfer srgb. Pictures are (height, width, 3)
    of uint8. With --until quantize they are raws, (height, width) of uint16. A frame that fails has
    no picture.

    Exposure and white balance follow the frames like in clpipe run --sequence. The sender waits
    while a frame is developed and another one is waiting, unless --drop is set. It also waits for
    the kernels, which are compiled when the header of the first frame arrives.

    \b
    simulator | clpipe stream --iso 800 --set exposure.method=auto | viewer
    """
    settings = settings_in(others)
    streams = {"input": (sys.stdin, sys.__stdin__), "output": (sys.stdout, sys.__stdout__)}
    for each, (file, at_start) in streams.items():
        if at_start is None or file.isatty():
            raise RequestError(
                "clpipe stream reads frames and writes pictures, but standard "
                f"{each} is {'a terminal' if at_start else 'closed'}; use pipes: "
                "simulator | clpipe stream | viewer"
            )
    camera = Camera(
        config or "default",
        name=name,
        device=selector,
        until=until,
        transfer=transfer or "linear",
        drop=drop,
        **settings,
    )
    began = time.perf_counter()
    with (
        open(log_path, "w", encoding="utf-8") if log_path else nullcontext() as log,
        ThreadPoolExecutor(1, "pictures") as pool,
    ):
        output = cast(BufferedIOBase, sys.stdout.buffer)
        written = pool.submit(write_pictures, camera, output, log)
        try:
            for frame in frames_in(cast(BufferedReader, sys.stdin.buffer), camera.warm_up):
                camera.put(frame)
        finally:
            camera.end()
            count, failed = written.result()  # its error is the reason if the stream was closed
            seconds = time.perf_counter() - began
            click.echo(
                f"{count} pictures in {seconds:.1f} s, {count / seconds:.1f} per second; "
                f"{camera.dropped} frames dropped, {failed} failed",
                err=True,
            )
    sys.exit(1 if failed else 0)


class Camera(Stream):
    """A stream that prints its warnings."""

    @staticmethod
    def _warn(text: str) -> None:
        click.echo(f"clpipe: {one_line(text)}", err=True)


def write_pictures(stream: Stream, output: BufferedIOBase, log: TextIO | None) -> tuple[int, int]:
    """Write the pictures of a stream while others are developed. At an error, end the stream.

    Args:
        stream: the stream.
        output: where pictures are written.
        log: where a line for each picture is written, if anywhere.

    Returns:
        The number of pictures, and of frames that failed.

    Raises:
        OSError: a picture or line cannot be written.
    """
    count = failed = 0
    try:
        while True:
            try:
                shot = stream.get()
            except ClpipeError as error:
                failed += 1
                click.echo(f"clpipe: {error}", err=True)
                continue
            if shot is None:
                return count, failed
            np.lib.format.write_array(without_position(output), shot.image)
            output.flush()
            count += 1
            if log:
                record = {"frame": shot.index, "settings": shot.settings, "metered": shot.metered}
                log.write(json.dumps({**record, "estimates": shot.result.estimates}) + "\n")
                log.flush()
    finally:
        stream.end()


def without_position(file: BufferedIOBase) -> Any:
    """Return a file with only the methods that pipes have. NumPy asks others for their position."""
    return SimpleNamespace(read=file.read, write=file.write)


def frames_in(
    file: BufferedReader, begin: Callable[[tuple[int, ...], np.dtype[Any]], None]
) -> Iterator[Array]:
    """Yield arrays from a file with one .npy after the other, which need not be seekable.

    >>> import io
    >>> file = io.BytesIO()
    >>> np.save(file, np.zeros((2, 3), np.float32)); np.save(file, np.ones((1, 2), np.uint8))
    >>> [frame.shape for frame in frames_in(io.BufferedReader(io.BytesIO(file.getvalue())), print)]
    (2, 3) float32
    [(2, 3), (1, 2)]

    Args:
        file: the file.
        begin: receives the shape and the type of the first array before its samples are read. Its
            errors are ignored, because the array itself then has them.

    Raises:
        ImageError: the bytes are no .npy of numbers, end early, or do not fit into memory.
    """
    number = 0
    while file.peek(1):
        try:
            frame = empty_like_next(file)
            if number == 0:
                with suppress(ClpipeError):
                    begin(frame.shape, frame.dtype)
            found = file.readinto(frame.reshape(-1, order="A").view(np.uint8).data)
            if found < frame.nbytes:
                raise ValueError(f"EOF: expected {frame.nbytes} bytes of samples, found {found}")
            yield frame
        except (TypeError, ValueError, MemoryError) as error:
            raise ImageError(
                f"frame {number} of standard input: this is no .npy of numbers: {error}"
            ) from None
        number += 1


def empty_like_next(file: BufferedReader) -> Array:
    """Read the header of a .npy, and return an array of its shape, type and order.

    Raises:
        ValueError, MemoryError: there is no header of numbers, or the array is too large.
    """
    pipe = without_position(file)
    version = np.lib.format.read_magic(pipe)
    if version not in HEADERS:
        raise ValueError(f"found version {version}; expected {' or '.join(map(str, HEADERS))}")
    shape, is_fortran, dtype = HEADERS[version](pipe)
    if dtype.hasobject:
        raise ValueError("Object arrays are not allowed")
    return np.empty(shape, dtype, "F" if is_fortran else "C")
