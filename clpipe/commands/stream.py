"""``clpipe stream``: develop frames from standard input, for programs in any language."""

import json
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import nullcontext
from io import BufferedIOBase, BufferedReader
from pathlib import Path
from typing import Any, TextIO, cast

import click
import numpy as np

from clpipe.base.errors import ClpipeError, ImageError, RequestError
from clpipe.base.types import Array
from clpipe.chain.keys import KEYS
from clpipe.commands.chain_options import SETTINGS, device_option, options, set_option, settings_in
from clpipe.commands.options import Command, OutputPath
from clpipe.stream import Shot, Stream


@click.command("stream", cls=Command)
@options("config", KEYS["camera"], KEYS["iso"], *SETTINGS, "until")
@set_option
@device_option
@click.option(
    "--transfer",
    type=click.Choice(["linear", "srgb"]),
    default="linear",
    show_default=True,
    help="srgb converts uint8 frames of a simulator to light.",
)
@click.option(
    "--name",
    default="stream",
    show_default=True,
    help="The name of the sequence, on which noise and draws depend.",
)
@click.option(
    "--drop",
    is_flag=True,
    help="Drop frames that arrive before the one before them has begun, instead of letting the "
    "sender wait.",
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
    transfer: str,
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
    while a frame is developed and another one is waiting, unless --drop is set.

    \b
    simulator | clpipe stream --iso 800 --set exposure.method=auto | viewer
    """
    settings = settings_in(others)
    if sys.stdin.isatty() or sys.stdout.isatty():
        raise RequestError(
            "clpipe stream reads frames and writes pictures, but standard input or output is a "
            "terminal; use pipes: simulator | clpipe stream | viewer"
        )
    camera = Stream(
        config or "default",
        name=name,
        device=selector,
        until=until,
        transfer=transfer,  # type: ignore[arg-type]
        drop=drop,
        **settings,
    )
    with open(log_path, "w", encoding="utf-8") if log_path else nullcontext() as log:
        writer = Writer(camera, cast(BufferedIOBase, sys.stdout.buffer), log)
        writer.start()
        began = time.perf_counter()
        try:
            for frame in frames_in(cast(BufferedReader, sys.stdin.buffer)):
                if writer.error:
                    break
                camera.put(frame)
        finally:
            camera.end()
            writer.join()
            seconds = time.perf_counter() - began
            click.echo(
                f"{writer.count} pictures in {seconds:.1f} s, {writer.count / seconds:.1f} per "
                f"second; {camera.dropped} frames dropped, {writer.failed} failed",
                err=True,
            )
    if writer.error:
        raise writer.error
    sys.exit(1 if writer.failed else 0)


class Writer(threading.Thread):
    """Writes the pictures of a stream while others are developed.

    Args:
        stream: the stream.
        output: where pictures are written.
        log: where a line for each picture is written, if anywhere.

    Attributes:
        count: the number of pictures that were written.
        failed: the number of frames that failed.
        error: why no more can be written.
    """

    def __init__(self, stream: Stream, output: BufferedIOBase, log: TextIO | None) -> None:
        super().__init__(name="pictures", daemon=True)
        self._stream = stream
        self._output = output
        self._log = log
        self.count = self.failed = 0
        self.error: Exception | None = None

    def run(self) -> None:
        """Write all pictures. After an error, the others are dropped, so that nobody waits."""
        is_over = False
        while not is_over:
            try:
                shot = self._stream.get()
                is_over = shot is None
                if shot and not self.error:
                    self._write(shot)
            except ClpipeError as error:
                self.failed += 1
                click.echo(f"clpipe: {error}", err=True)
            except OSError as error:
                self.error = error

    def _write(self, shot: Shot) -> None:
        np.lib.format.write_array(Pipe(self._output), shot.image)
        self._output.flush()
        self.count += 1
        if self._log:
            record = {"frame": shot.index, "settings": shot.settings, "metered": shot.metered}
            line = json.dumps({**record, "estimates": shot.result.estimates})
            self._log.write(line + "\n")
            self._log.flush()


class Pipe:
    """A file with only the methods that pipes have. NumPy asks other files for their position."""

    def __init__(self, file: BufferedIOBase) -> None:
        self.read = file.read
        self.write = file.write


def frames_in(file: BufferedReader) -> Iterator[Array]:
    """Yield arrays from a file with one .npy after the other, which need not be seekable.

    >>> import io
    >>> file = io.BytesIO()
    >>> np.save(file, np.zeros((2, 3), np.float32)); np.save(file, np.ones((1, 2), np.uint8))
    >>> [frame.shape for frame in frames_in(io.BufferedReader(io.BytesIO(file.getvalue())))]
    [(2, 3), (1, 2)]

    Raises:
        ImageError: the bytes are no .npy of numbers, end early, or do not fit into memory.
    """
    number = 0
    while file.peek(1):
        try:
            yield np.lib.format.read_array(Pipe(file), allow_pickle=False)
        except (ValueError, MemoryError) as error:
            raise ImageError(
                f"frame {number} of standard input: this is no .npy of numbers: {error}"
            ) from None
        number += 1
