"""The command line: one module a command, plus the options and tables they share.

A command turns options into a request, calls one function of a room below and prints the result;
a rule that a Python user would also need belongs there. It may import every other room, and is the
only one that imports click and rich.
"""
