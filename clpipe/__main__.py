"""``python -m clpipe``."""

from clpipe.cli import main

main()
