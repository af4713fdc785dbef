"""The entry point of ``clpipe`` and ``python -m clpipe``."""

import signal


def main() -> None:
    """Run the command line. Ctrl-C during imports ends the process without a traceback."""
    handler = signal.signal(signal.SIGINT, signal.SIG_DFL)
    from clpipe.commands.main import main as command

    signal.signal(signal.SIGINT, handler)
    command()


if __name__ == "__main__":
    main()
