"""The entry point of ``clpipe`` and ``python -m clpipe``."""

import os
import signal
import sys


def main() -> None:
    """Run the command line. Ctrl-C during imports ends the process without a traceback."""
    open_closed_streams()
    handler = signal.signal(signal.SIGINT, signal.SIG_DFL)
    from clpipe.commands.main import main as command

    signal.signal(signal.SIGINT, handler)
    command()


def open_closed_streams() -> None:
    """Open the null device for each standard stream that is closed.

    Without that, the stream is None in Python. The next file that is opened would get its number,
    and libraries that print would write to this file.
    """
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:
            number = os.open(os.devnull, os.O_RDWR)
            os.set_inheritable(number, True)
            setattr(sys, name, os.fdopen(number, mode, encoding="utf-8"))


if __name__ == "__main__":
    main()
