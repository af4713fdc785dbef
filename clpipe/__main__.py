"""The program: ``clpipe``, or ``python -m clpipe``."""

import signal


def main() -> None:
    """Run the command line; Ctrl-C while it is still being loaded just ends it."""
    before = signal.signal(signal.SIGINT, signal.SIG_DFL)
    from clpipe.commands.main import main as command

    signal.signal(signal.SIGINT, before)
    command()


if __name__ == "__main__":
    main()
