"""Messages between a run and the processes that it starts: pickled values through pipes."""

import contextlib
import pickle
import struct
import threading
from typing import IO, Any

SIZE = struct.Struct("<Q")


class Pipe:
    """One end of a conversation; one thread may receive while others send.

    Args:
        reading: what the other end writes to.
        writing: what it reads.
    """

    def __init__(self, reading: IO[bytes], writing: IO[bytes]) -> None:
        self._reading = reading
        self._writing = writing
        self._sending = threading.Lock()

    def send(self, *message: Any) -> None:
        """Send values.

        Raises:
            OSError: the other end has gone.
        """
        data = pickle.dumps(message, pickle.HIGHEST_PROTOCOL)
        with self._sending:
            self._writing.write(SIZE.pack(len(data)) + data)
            self._writing.flush()

    def receive(self) -> Any:
        """The next message.

        Raises:
            EOFError: the other end has gone.
        """
        (size,) = SIZE.unpack(self._exactly(SIZE.size))
        return pickle.loads(self._exactly(size))  # noqa: S301 - both ends are ours

    def hang_up(self) -> None:
        """Say that nothing more is sent."""
        with self._sending, contextlib.suppress(OSError):
            self._writing.close()

    def close(self) -> None:
        """Close both directions, when nobody receives any more."""
        self.hang_up()
        self._reading.close()

    def _exactly(self, size: int) -> bytes:
        data = self._reading.read(size)
        if len(data) < size:
            raise EOFError
        return data
