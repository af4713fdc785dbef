"""Compiled programs of runtimes that keep none themselves, as files that are looked at first.

A file is the program's digest and then the program, as the runtime gave it. One that is damaged, or
that the runtime does not take any more, is compiled again.
"""

import hashlib
from contextlib import suppress
from pathlib import Path
from typing import Any

from clpipe.base.errors import ImageError
from clpipe.base.files import passing_files, write_new


class BinaryCache:
    """A folder of compiled programs.

    Args:
        folder: for the files; made when the first one is written.
        device: the ``pyopencl.Device`` that they are for.
    """

    def __init__(self, folder: Path, device: Any) -> None:
        self.folder = folder
        self._device = device
        platform = device.platform
        # All that decides what a compiler makes of a text.
        self._made_by = "\0".join(
            [platform.name, platform.version, device.name, device.version, device.driver_version]
        )

    def path(self, source: str, options: list[str]) -> Path:
        """The file of a program with these options of the compiler."""
        parts = "\0".join([self._made_by, *options, source])
        return self.folder / hashlib.sha256(parts.encode()).hexdigest()[:40]

    def load(self, context: Any, source: str, options: list[str]) -> Any | None:
        """The program, built in a ``pyopencl.Context``; None where there is none that is whole."""
        import pyopencl as cl

        path = self.path(source, options)
        try:
            digest, binary = (data := path.read_bytes())[:32], data[32:]
        except OSError:
            return None
        if hashlib.sha256(binary).digest() == digest:
            with suppress(cl.Error):
                program = cl.Program(context, [self._device], [binary])
                return program.build(options, cache_dir=False)
        with suppress(OSError):
            path.unlink()
        return None

    def store(self, program: Any, source: str, options: list[str]) -> None:
        """Keep a ``pyopencl.Program`` that was built of a text, as far as there is room."""
        import pyopencl as cl

        with suppress(cl.Error, ImageError):
            (binary,) = program.get_info(cl.program_info.BINARIES)
            if binary:
                with passing_files():
                    digest = hashlib.sha256(binary).digest()
                    write_new(self.path(source, options), digest + binary)
