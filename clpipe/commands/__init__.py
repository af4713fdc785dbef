"""The command line: one module per command, and the options and tables that commands share.

A command converts options into a request, calls one function of a lower package and prints the
result. A rule that a Python user also needs belongs in that package. This package may import every
other one, and is the only one that imports click and rich.
"""
